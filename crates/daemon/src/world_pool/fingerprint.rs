//! Fingerprints of requests: two requests are the same if the hashes of their messages are.
//!
//! A fingerprint is kept over restarts and upgrades, so it must not depend on how this program serializes its types. The wire form is
//! stable: fields have numbers, a field with its default value is absent, and maps are sorted by key. A field that is added changes nothing
//! for a request without it.

use prost::Message;
use ratn_model::fact::{Change, Footprint};
use ratn_proto::convert::all;
use ratn_proto::v1;
use serde::{Deserialize, Serialize};
use std::sync::Arc;

/// FNV-1a over 128 bits; clients do not attack themselves. 0 is an unknown fingerprint: one of a version that hashed something else.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct Fingerprint(u128);

impl Fingerprint {
    /// Fingerprint of requests that an earlier version remembers in another form: only the id tells that they are the same.
    pub(super) const UNKNOWN: Fingerprint = Fingerprint(0);

    /// Fingerprint of the changes of a commit.
    pub(super) fn of_commit(changes: &[Change]) -> Fingerprint {
        let changes = all(changes.iter().cloned());
        Fingerprint::of("commit 1", &v1::CommitRequest { changes, ..v1::CommitRequest::default() })
    }

    /// Fingerprint of a projection. Its lease and its base revision are left out: they may differ when it is requested again.
    pub(super) fn of_projection(changes: &[Change], reads: &Footprint, writers: &[Arc<str>]) -> Fingerprint {
        let message = v1::ProjectRequest {
            changes: all(changes.iter().cloned()),
            reads: Some(reads.clone().into()),
            writers: writers.iter().map(ToString::to_string).collect(),
            ..v1::ProjectRequest::default()
        };
        Fingerprint::of("projection 2", &message)
    }

    /// Fingerprint of a message; `form` names what is hashed, with a number that grows when that changes.
    pub(super) fn of(form: &str, message: &impl Message) -> Fingerprint {
        const OFFSET: u128 = 0x6c62_272e_07bb_0142_62b8_2175_6295_c58d;
        const PRIME: u128 = 0x0000_0000_0100_0000_0000_0000_0000_013b;
        let bytes = message.encode_to_vec();
        let hashed = form.as_bytes().iter().chain(&[0]).chain(&bytes);
        let hash = hashed.fold(OFFSET, |hash, byte| (hash ^ u128::from(*byte)).wrapping_mul(PRIME));
        Fingerprint(hash.max(1))
    }

    /// Whether both can belong to the same request.
    pub(super) fn may_be(self, other: Fingerprint) -> bool {
        self == other || self == Fingerprint::UNKNOWN || other == Fingerprint::UNKNOWN
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ratn_model::fact::{FactKey, FactPattern, Term};
    use ratn_model::value::Value;
    use std::collections::BTreeMap;

    fn set(value: Value) -> Change {
        let arguments = vec![Term::Name("box".to_owned()), Term::Int(7)];
        Change::Set { fact: FactKey { predicate: "at".to_owned(), arguments }, value }
    }

    fn changes() -> Vec<Change> {
        let fields = [("z", Value::Int(1)), ("a", Value::Float(0.5)), ("m", Value::Null)];
        let fields: BTreeMap<String, Value> = fields.map(|(name, value)| (name.to_owned(), value)).into();
        let total = FactKey { predicate: "total".to_owned(), arguments: Vec::new() };
        let gone = FactPattern { predicate: "on".to_owned(), arguments: vec![None, Some(Term::Int(0))] };
        vec![set(Value::Map(fields)), Change::Increase { fact: total, by: -2.5 }, Change::Delete { pattern: gone }]
    }

    /// These are in the states of installations: another hash refuses the retries of requests from before an upgrade. A change of the form
    /// needs another tag, and the old fingerprints count as those of the old form.
    #[test]
    fn the_hashes_of_commits_are_those_of_every_version() {
        let hash = |changes: &[Change]| format!("{:032x}", Fingerprint::of_commit(changes).0);
        let hashes = [hash(&[]), hash(&changes()), hash(&[set(Value::String("cup".to_owned()))])];
        let known = [
            "d6c34fda67062683de3684e1c2e380d5",
            "366747e28b725ee756c1ac2bdacef250",
            "3d0ff2f53e0bce56fd5b52e75d78a7d9",
        ];
        assert_eq!(hashes, known);
    }

    #[test]
    fn what_is_asked_otherwise_has_another_hash_and_what_is_of_an_old_form_may_be_anything() {
        let (one, other) = (Fingerprint::of_commit(&changes()), Fingerprint::of_commit(&changes()[1..]));
        assert!(one.may_be(Fingerprint::of_commit(&changes())));
        assert!(!one.may_be(other));
        assert!(Fingerprint::UNKNOWN.may_be(one) && one.may_be(Fingerprint::UNKNOWN));
        assert_ne!(
            one,
            Fingerprint::of("commit 2", &v1::CommitRequest { changes: all(changes()), ..Default::default() })
        );
    }
}
