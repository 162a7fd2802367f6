//! Whatever bytes arrive as a message: no panic, and what is refused is refused with its field. `fuzz/` has the same without end.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

mod support;

use proptest::collection::vec;
use proptest::prelude::*;
use prost::Message;
use ratn_model::fact::{Change, FactKey, FactPattern, Footprint, Term};
use ratn_model::measurement::Measurement;
use ratn_model::resource::{Lease, Requirement};
use ratn_model::value::Value;
use ratn_proto::convert::Malformed;
use ratn_proto::types;
use ratn_proto::v1;
use std::sync::LazyLock;
use support::Schema;

/// Decodes, converts, and says what is wrong.
type Read = fn(&[u8]) -> Option<Malformed>;

fn read<W: Message + Default, T: TryFrom<W, Error = Malformed>>(bytes: &[u8]) -> Option<Malformed> {
    W::decode(bytes).ok().and_then(|message| T::try_from(message).err())
}

/// All that can come in, by the message's name.
const READERS: [(&str, Read); 26] = [
    ("Change", read::<v1::Change, Change>),
    ("Contradiction", read::<v1::Contradiction, types::Contradiction>),
    ("EndingUnits", read::<v1::EndingUnits, types::EndingUnits>),
    ("Evidence", read::<v1::Evidence, (FactKey, Measurement)>),
    ("FactDifference", read::<v1::FactDifference, types::FactDifference>),
    ("FactKey", read::<v1::FactKey, FactKey>),
    ("Fact", read::<v1::Fact, types::FactRecord>),
    ("FactVersion", read::<v1::FactVersion, types::FactVersion>),
    ("FactPattern", read::<v1::FactPattern, FactPattern>),
    ("Footprint", read::<v1::Footprint, Footprint>),
    ("Goal", read::<v1::Goal, types::Goal>),
    ("GoalResult", read::<v1::GoalResult, types::GoalOutcome>),
    ("Holding", read::<v1::Holding, types::Holding>),
    ("Lease", read::<v1::Lease, Lease>),
    ("ListRequest", read::<v1::ListRequest, types::ResourceFilter>),
    ("Measurement", read::<v1::Measurement, Measurement>),
    ("Pool", read::<v1::Pool, types::PoolStatus>),
    ("Requirement", read::<v1::Requirement, Requirement>),
    ("Resource", read::<v1::Resource, types::Resource>),
    ("ResourceEvent", read::<v1::ResourceEvent, types::ResourceEvent>),
    ("ResourceServiceWatchResponse", read::<v1::ResourceServiceWatchResponse, types::ResourceUpdate>),
    ("SessionStatus", read::<v1::SessionStatus, types::SessionStatus>),
    ("Term", read::<v1::Term, Term>),
    ("WaitingAcquire", read::<v1::WaitingAcquire, types::WaitingAcquire>),
    ("WorldPoolServiceWatchResponse", read::<v1::WorldPoolServiceWatchResponse, types::WorldUpdate>),
    ("WorkerStatus", read::<v1::WorkerStatus, types::WorkerStatus>),
];

static SCHEMA: LazyLock<Schema> = LazyLock::new(Schema::read);

/// One thing done to bytes: what, where, with what.
fn change(bytes: &mut Vec<u8>, (what, place, byte): (u8, prop::sample::Index, u8)) {
    if bytes.is_empty() {
        return bytes.push(byte);
    }
    let place = place.index(bytes.len());
    match what % 5 {
        0 => bytes[place] = byte,
        1 => bytes[place] ^= 1 << (byte % 8),
        2 => bytes.insert(place, byte),
        3 => bytes.truncate(place),
        _ => {
            let end = (place + usize::from(byte)).min(bytes.len());
            let again = bytes[place..end].to_vec();
            bytes.splice(place..place, again);
        }
    }
}

fn check(name: &str, reader: Read, bytes: &[u8]) -> Result<(), TestCaseError> {
    if let Some(malformed) = reader(bytes) {
        prop_assert!(!malformed.path.is_empty() && !malformed.problem.is_empty(), "{name}: {malformed:?}");
    }
    Ok(())
}

#[test]
fn every_message_made_from_the_schema_is_taken() {
    for (name, reader) in READERS {
        let refused = reader(&SCHEMA.example(&format!(".ratn.v1.{name}")));
        assert_eq!(refused, None, "{name}");
    }
    assert_eq!(read::<v1::Value, Value>(&SCHEMA.example(".ratn.v1.Value")), None);
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(1_000))]

    #[test]
    fn a_message_that_was_changed_on_the_way_is_taken_or_refused_with_its_field(
        which in 0..READERS.len(),
        changes in vec((any::<u8>(), any::<prop::sample::Index>(), any::<u8>()), 1..12),
    ) {
        let (name, reader) = READERS[which];
        let mut bytes = SCHEMA.example(&format!(".ratn.v1.{name}"));
        for one in changes {
            change(&mut bytes, one);
        }
        check(name, reader, &bytes)?;
    }

    #[test]
    fn any_bytes_are_taken_or_refused_with_their_field(bytes in vec(any::<u8>(), 0..512)) {
        for (name, reader) in READERS {
            check(name, reader, &bytes)?;
        }
        // A value may be wrong as a whole.
        read::<v1::Value, Value>(&bytes);
    }

    #[test]
    fn lists_in_lists_without_end_are_refused(depth in 1_usize..400) {
        let mut value = v1::Value { kind: Some(v1::value::Kind::Null(v1::Null {})) };
        for _ in 0..depth {
            value = v1::Value { kind: Some(v1::value::Kind::List(v1::ValueList { values: vec![value] })) };
        }
        // Beyond a hundred messages deep prost does not even decode it.
        let read = v1::Value::decode(value.encode_to_vec().as_slice()).ok().map(|value| Value::try_from(value).is_ok());
        prop_assert_eq!(read.unwrap_or(false), depth <= ratn_proto::convert::MAX_DEPTH);
    }
}
