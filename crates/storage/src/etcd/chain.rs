//! Idempotent writes: each has one effect, however many copies of it arrive, and however late.
//!
//! ```text
//!   step N: { leader is mine, the key is as step N-1 left it?  operations, the key says N }
//!      └── no answer: the same again; if the key says N already, it was performed
//! ```
//! A step that was given up without an answer may still be performed, until a later step is. The next step finds that by the value of the
//! key, and goes on from there.
//!
//! A copy of a step that arrives after a later step finds another revision of the key, and does nothing. So all changes of a log's keys go
//! through such a chain: one chain over `head` for frames, one over `step` for snapshots and for what they replace.

use super::format::{Step, parse};
use super::keys::{found_one, get, put, written_at};
use super::term::Term;
use super::wire::{RequestOp, TxnRequest, TxnResponse};
use crate::error::Fault;
use bytes::Bytes;

/// See the module.
#[derive(Debug)]
pub(super) struct Chain {
    key: Bytes,
    /// The revision at which the key was last written; 0 if the key does not exist.
    revision: i64,
    /// A step was given up: it may have been performed, or may be performed later.
    undecided: bool,
}

impl Chain {
    pub(super) fn from(key: Bytes, revision: i64) -> Chain {
        Chain { key, revision, undecided: false }
    }

    /// Performs operations, once. `value` is the new value of the key, which contains the [`Step`]; no value may occur twice. `perform`
    /// asks etcd until there is an answer, or gives up.
    pub(super) fn step(
        &mut self,
        term: &Term,
        mut operations: Vec<RequestOp>,
        value: Bytes,
        mut perform: impl FnMut(&TxnRequest) -> Result<TxnResponse, Fault>,
    ) -> Result<(), Fault> {
        operations.push(put(self.key.clone(), value.clone()));
        loop {
            let request = TxnRequest {
                compare: vec![term.guard(), written_at(self.key.clone(), self.revision)],
                success: operations.clone(),
                failure: vec![get(term.keys.leader()), get(self.key.clone())],
            };
            let answer = perform(&request).inspect_err(|_| self.undecided = true)?;
            if answer.succeeded {
                (self.revision, self.undecided) = (answer.header.map_or(0, |header| header.revision), false);
                return Ok(());
            }
            let mut found = answer.responses.into_iter();
            if !term.is_since(found_one(found.next()).map_or(0, |kv| kv.mod_revision)) {
                return Err(term.deposed());
            }
            match found_one(found.next()) {
                // A copy was performed whose answer is late, or was lost.
                Some(kv) if kv.value == value => {
                    (self.revision, self.undecided) = (kv.mod_revision, false);
                    return Ok(());
                }
                // An earlier step was performed after it had been given up.
                Some(kv) if self.undecided && self.is_of(term, &kv.value) && kv.mod_revision > self.revision => {
                    self.revision = kv.mod_revision;
                }
                _ => {
                    let key = String::from_utf8_lossy(&self.key).into_owned();
                    let what = "somebody who is not its writer has written there".to_owned();
                    return Err(Fault::Remote { action: "write to", place: key, what });
                }
            }
        }
    }

    /// Whether the writer of this term wrote the value.
    fn is_of(&self, term: &Term, value: &[u8]) -> bool {
        parse::<Step>(&self.key, value).is_ok_and(|step| step.epoch == term.epoch.0)
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::super::client::Client;
    use super::super::format::text;
    use super::super::keys::{Keys, delete};
    use super::super::wire::{KeyValue, RangeResponse, ResponseHeader, ResponseOp};
    use super::super::wire::{compare, request_op, response_op};
    use super::*;
    use std::collections::BTreeMap;
    use std::sync::Arc;

    /// A model of etcd, as far as a step needs it.
    #[derive(Default)]
    struct Model {
        revision: i64,
        keys: BTreeMap<Bytes, (Bytes, i64)>,
    }

    impl Model {
        fn txn(&mut self, request: &TxnRequest) -> TxnResponse {
            let holds = request.compare.iter().all(|compare| {
                let Some(compare::TargetUnion::ModRevision(revision)) = compare.target_union else { return false };
                self.keys.get(&compare.key).map_or(0, |(_, at)| *at) == revision
            });
            let operations = if holds { &request.success } else { &request.failure };
            self.revision += i64::from(holds);
            let responses = operations.iter().map(|operation| self.perform(operation)).collect();
            let header = ResponseHeader { revision: self.revision, ..Default::default() };
            TxnResponse { header: Some(header), succeeded: holds, responses }
        }

        fn perform(&mut self, operation: &RequestOp) -> ResponseOp {
            let response = match operation.request.clone().unwrap() {
                request_op::Request::RequestPut(put) => {
                    self.keys.insert(put.key, (put.value, self.revision));
                    None
                }
                request_op::Request::RequestDeleteRange(delete) => {
                    self.keys.remove(&delete.key);
                    None
                }
                request_op::Request::RequestRange(range) => {
                    let one = |(value, at): &(Bytes, i64)| KeyValue {
                        key: range.key.clone(),
                        value: value.clone(),
                        mod_revision: *at,
                        ..Default::default()
                    };
                    let kvs = self.keys.get(&range.key).map(one).into_iter().collect();
                    Some(response_op::Response::ResponseRange(RangeResponse { kvs, ..Default::default() }))
                }
            };
            ResponseOp { response }
        }

        fn values(&self) -> Vec<(Bytes, Bytes)> {
            self.keys.iter().map(|(key, (value, _))| (key.clone(), value.clone())).collect()
        }
    }

    #[test]
    fn a_step_that_was_given_up_and_performed_later_holds_up_no_later_one() {
        let keys = Keys::new("/test");
        let client = Arc::new(Client::new(&[], Arc::new(|_: &str| Err("nobody".to_owned()))).unwrap());
        let mut etcd = Model { revision: 1, ..Model::default() };
        etcd.keys.insert(keys.leader(), (Bytes::from_static(b"us"), 1));
        let term = Term::since(client, keys.clone(), 1);
        let mut chain = Chain::from(keys.step(), 0);
        let value = |step: u64| text(&Step { epoch: 1, step });
        let fault = || Fault::Remote { action: "write to", place: String::new(), what: "no answer".to_owned() };
        // Two steps are given up; one of them, or none, arrives later.
        for (round, arrives) in [None, Some(0), Some(1)].into_iter().enumerate() {
            let begin = 3 * round as u64;
            let mut given_up = Vec::new();
            for step in 0..2_u8 {
                let operation = put(Bytes::from(format!("part {step}")), vec![step]);
                let performed = chain.step(&term, vec![operation], value(begin + u64::from(step)), |request| {
                    given_up.push(request.clone());
                    Err(fault())
                });
                assert!(performed.is_err());
            }
            if let Some(late) = arrives {
                assert!(etcd.txn(&given_up[late]).succeeded);
            }
            let next = value(begin + 2);
            chain.step(&term, Vec::new(), next.clone(), |request| Ok(etcd.txn(request))).unwrap();
            assert_eq!(etcd.keys[&keys.step()].0, next, "{arrives:?}");
            for late in &given_up {
                assert!(!etcd.txn(late).succeeded, "{arrives:?}");
            }
        }
        // No other process may have written the key: the step fails.
        etcd.revision += 1;
        etcd.keys.insert(keys.step(), (value(99), etcd.revision));
        assert!(chain.step(&term, Vec::new(), value(9), |request| Ok(etcd.txn(request))).is_err());
    }

    #[test]
    fn a_step_has_its_effect_once_although_its_answers_are_lost_and_its_copies_are_late() {
        let keys = Keys::new("/test");
        let client = Arc::new(Client::new(&[], Arc::new(|_: &str| Err("nobody".to_owned()))).unwrap());
        let mut etcd = Model { revision: 1, ..Model::default() };
        etcd.keys.insert(keys.leader(), (Bytes::from_static(b"us"), 1));
        let term = Term::since(client, keys.clone(), 1);
        let mut chain = Chain::from(keys.head(), 0);
        let mut copies: Vec<TxnRequest> = Vec::new();
        for step in 0..8_u8 {
            // A frame is put, and later deleted, as a compaction does: a late copy of the put would restore it.
            let frame = Bytes::from(format!("frame {}", step / 2));
            let operation = if step % 2 == 0 { put(frame, vec![step]) } else { delete(frame) };
            let answer_is_lost = step % 3 == 0;
            let performed = chain.step(&term, vec![operation], Bytes::from(vec![step]), |request| {
                copies.push(request.clone());
                let answer = etcd.txn(request);
                Ok(if answer_is_lost { etcd.txn(request) } else { answer })
            });
            performed.unwrap();
            let before = etcd.values();
            for copy in &copies {
                assert!(!etcd.txn(copy).succeeded, "step {step}");
            }
            assert_eq!(etcd.values(), before, "step {step}");
        }
        assert_eq!(etcd.keys[&keys.head()].0, vec![7]);
        // Another process leads: nothing is written any more.
        etcd.revision += 1;
        etcd.keys.insert(keys.leader(), (Bytes::from_static(b"others"), etcd.revision));
        let before = etcd.values();
        let deposed = chain.step(&term, Vec::new(), Bytes::from_static(b"8"), |request| Ok(etcd.txn(request)));
        assert!(matches!(deposed, Err(Fault::Deposed { .. })));
        assert_eq!(etcd.values(), before);
    }
}
