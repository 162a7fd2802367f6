//! Writes that have an effect once, however often and however late their copies arrive.
//!
//! ```text
//!   step N: { leader is mine, the key is as step N-1 left it?  operations, the key says N }
//!      └── no answer: the same again; if the key says N already, it was performed
//! ```
//! A copy of a step that arrives when a later one was performed finds another revision of the key, and does nothing. So nothing but such a
//! chain changes what a log consists of: one chain over `head` for frames, one over `step` for snapshots and for what they replace.

use super::keys::{found_one, get, put, written_at};
use super::term::Term;
use super::wire::{RequestOp, TxnRequest, TxnResponse};
use crate::error::Fault;
use bytes::Bytes;

/// See the module.
#[derive(Debug)]
pub(super) struct Chain {
    key: Bytes,
    /// When the key was written last; 0 where it is not there.
    revision: i64,
}

impl Chain {
    pub(super) fn from(key: Bytes, revision: i64) -> Chain {
        Chain { key, revision }
    }

    /// Performs operations, once. `value` is what the key says then: nothing that it has said before. `perform` asks etcd until
    /// there is an answer.
    pub(super) fn step(
        &mut self,
        term: &Term,
        mut operations: Vec<RequestOp>,
        value: Bytes,
        perform: impl FnOnce(&TxnRequest) -> Result<TxnResponse, Fault>,
    ) -> Result<(), Fault> {
        operations.push(put(self.key.clone(), value.clone()));
        let request = TxnRequest {
            compare: vec![term.guard(), written_at(self.key.clone(), self.revision)],
            success: operations,
            failure: vec![get(term.keys.leader()), get(self.key.clone())],
        };
        let answer = perform(&request)?;
        if answer.succeeded {
            self.revision = answer.header.map_or(0, |header| header.revision);
            return Ok(());
        }
        let mut found = answer.responses.into_iter();
        if !term.is_since(found_one(found.next()).map_or(0, |kv| kv.mod_revision)) {
            return Err(term.deposed());
        }
        match found_one(found.next()) {
            // A copy was performed whose answer is still on its way, or lost.
            Some(kv) if kv.value == value => {
                self.revision = kv.mod_revision;
                Ok(())
            }
            _ => {
                let key = String::from_utf8_lossy(&self.key).into_owned();
                let what = "somebody who is not its writer has written there".to_owned();
                Err(Fault::Remote { action: "write to", place: key, what })
            }
        }
    }
}
