//! Fingerprints of requests: two requests with one id are the same if the hashes of their contents are equal.
//!
//! Fingerprints are kept over restarts and upgrades, so they must not depend on the format of records. The hash covers the names and values of the
//! request's fields, in the order of names, and omits absent values (`None`). So an added field that is omitted when not used does not change the
//! fingerprints of older requests.

use crate::queue::AcquireRequest;
use crate::request::Request;
use serde::{Deserialize, Serialize};
use serde_json::Value;

/// FNV-1a over 128 bits; clients do not attack themselves. 0 is an unknown fingerprint: of a version that hashed something else.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Fingerprint(u128);

/// First bytes of the hashed content; the number is increased if the content changes.
const FORM: &[u8] = b"request 1";

struct Fnv(u128);

impl Fingerprint {
    /// For answers of an earlier version with another kind of fingerprint: the id alone says that a request is the same.
    pub(crate) const UNKNOWN: Fingerprint = Fingerprint(0);

    /// The fingerprint of a request, without the deadline of an acquire, because a repeated acquire has a later one.
    pub(crate) fn of(request: &Request) -> Fingerprint {
        let said = match request {
            Request::Acquire(acquire) if acquire.deadline.is_some() => {
                serde_json::to_value(Request::Acquire(AcquireRequest { deadline: None, ..acquire.clone() }))
            }
            request => serde_json::to_value(request),
        };
        let mut hash = Fnv(0x6c62_272e_07bb_0142_62b8_2175_6295_c58d);
        hash.bytes(FORM);
        // All fields of requests have names, and nothing else can make the conversion fail.
        hash.value(&said.unwrap_or_default());
        Fingerprint(hash.0.max(1))
    }

    /// Whether both may be of the same request.
    pub(crate) fn may_be(self, other: Fingerprint) -> bool {
        self == other || self == Fingerprint::UNKNOWN || other == Fingerprint::UNKNOWN
    }
}

impl Fnv {
    fn value(&mut self, value: &Value) {
        match value {
            Value::Null => self.bytes(b"null"),
            Value::Bool(holds) => self.bytes(if *holds { b"true" } else { b"false" }),
            Value::Number(number) => match (number.as_i64(), number.as_u64()) {
                (Some(whole), _) => self.tagged(b'i', &whole.to_le_bytes()),
                (None, Some(whole)) => self.tagged(b'u', &whole.to_le_bytes()),
                (None, None) => self.tagged(b'f', &number.as_f64().unwrap_or_default().to_bits().to_le_bytes()),
            },
            Value::String(text) => self.tagged(b's', text.as_bytes()),
            Value::Array(items) => {
                self.tagged(b'[', &(items.len() as u64).to_le_bytes());
                items.iter().for_each(|item| self.value(item));
            }
            Value::Object(fields) => {
                let mut said: Vec<(&String, &Value)> = fields.iter().filter(|(_, value)| !value.is_null()).collect();
                said.sort_by_key(|(name, _)| *name);
                self.tagged(b'{', &(said.len() as u64).to_le_bytes());
                for (name, value) in said {
                    self.tagged(b's', name.as_bytes());
                    self.value(value);
                }
            }
        }
    }

    fn tagged(&mut self, tag: u8, bytes: &[u8]) {
        self.bytes(&[tag]);
        self.bytes(bytes);
    }

    /// Hashes the length, too, so that the content is unambiguous.
    fn bytes(&mut self, bytes: &[u8]) {
        const PRIME: u128 = 0x0000_0000_0100_0000_0000_0000_0000_013b;
        let length = (bytes.len() as u64).to_le_bytes();
        for byte in length.iter().chain(bytes) {
            self.0 = (self.0 ^ u128::from(*byte)).wrapping_mul(PRIME);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::id::SessionId;
    use crate::resource::ResourceSpec;
    use ratn_model::id::LeaseId;
    use ratn_model::resource::{Quantity, Requirement, ResourceClass, ResourceOperation};
    use ratn_model::time::Timestamp;
    use ratn_model::value::Value;
    use std::collections::BTreeMap;
    use std::time::Duration;

    fn session() -> SessionId {
        SessionId::from("run-1")
    }

    fn requirement() -> Requirement {
        let attributes = [("gpu".to_owned(), Value::Bool(false)), ("rack".to_owned(), Value::Int(0))];
        Requirement {
            attributes: BTreeMap::from(attributes),
            count: Quantity::from_thousandths(1_500),
            conditions: "level >= 0.2".parse().into_iter().collect(),
            ..Requirement::new(ResourceOperation::Block, "PathPlanner")
        }
    }

    fn acquire(deadline: Option<u64>) -> Request {
        let hold_for = Some(Duration::from_millis(2_500));
        let deadline = deadline.map(Timestamp);
        let request = AcquireRequest::new(session(), vec![requirement()]);
        Request::Acquire(AcquireRequest { priority: -3, deadline, hold_for, ..request })
    }

    /// These hashes are in the state of existing installations: another hash would refuse retries of requests from before an upgrade. An added field
    /// has to be an `Option`, or omitted while it is empty. Otherwise the number in [`FORM`] and the format of the records have to be increased, and
    /// older fingerprints are [`Fingerprint::UNKNOWN`] from then on.
    #[test]
    fn the_hashes_of_requests_are_those_of_every_version() {
        let hash = |request: &Request| format!("{:032x}", Fingerprint::of(request).0);
        let mut spec = ResourceSpec::new(ResourceClass::Module, "Arm");
        spec.attributes = [("reach_m".to_owned(), Value::Float(0.82)), ("left".to_owned(), Value::Null)].into();
        let release = Request::Release { session: None, lease: LeaseId(7), at_rest: false };
        let consume = Request::Consume { session: session(), requirement: requirement(), resource: None };
        let requests = [
            Request::Create { session: Some(session()), spec },
            Request::Delete { session: None, id: "arm@sim".to_owned() },
            Request::DeleteUnits { session: session(), requirement: requirement() },
            consume,
            acquire(None),
            release,
            Request::EndTask { session: session() },
        ];
        let known = [
            "b813fa3daccfb00cbee62c895bd58172",
            "4f7a6a0c4f93bf64fe6a6ba8bb9e13be",
            "90bec4fd062b5b9569ce8b7f9099acc1",
            "59968c1d5f6bcbf43c7371ea67a103dd",
            "d0cf73207822e5501a534d4fea72a8ea",
            "617c4486f35f8ebb784ad4945713d040",
            "3f7726ad23d1dfed20ea7413c62bd05c",
        ];
        assert_eq!(requests.map(|request| hash(&request)), known);
    }

    #[test]
    fn what_is_asked_later_is_the_same_and_what_is_asked_otherwise_is_not() {
        assert_eq!(Fingerprint::of(&acquire(Some(5))), Fingerprint::of(&acquire(None)));
        let plain = AcquireRequest::new(session(), vec![requirement()]);
        let other = |change: fn(&mut Requirement)| {
            let mut changed = requirement();
            change(&mut changed);
            Fingerprint::of(&Request::Acquire(AcquireRequest { requirements: vec![changed], ..plain.clone() }))
        };
        let changes: [fn(&mut Requirement); 5] = [
            |_| {},
            |changed| drop(changed.attributes.remove("gpu")),
            |changed| drop(changed.attributes.insert("rack".to_owned(), Value::Null)),
            |changed| changed.count = Quantity::ONE,
            |changed| changed.conditions.clear(),
        ];
        let hashes: Vec<Fingerprint> = changes.into_iter().map(other).collect();
        for (i, hash) in hashes.iter().enumerate() {
            assert!(hashes[..i].iter().all(|before| before != hash), "{i}");
        }
        assert!(Fingerprint::UNKNOWN.may_be(hashes[0]) && !hashes[0].may_be(hashes[1]));
    }
}
