//! Any bytes as any message that can come in: decoded and converted, or refused with the field. The first byte says which message.
#![no_main]

use libfuzzer_sys::fuzz_target;
use prost::Message;
use ratn_model::fact::{Change, FactPattern, Footprint};
use ratn_model::resource::{Lease, Requirement};
use ratn_model::value::Value;
use ratn_proto::convert::Malformed;
use ratn_proto::{types, v1};

fn read<W: Message + Default, T: TryFrom<W, Error = Malformed>>(bytes: &[u8]) -> Option<Malformed> {
    W::decode(bytes).ok().and_then(|message| T::try_from(message).err())
}

type Read = fn(&[u8]) -> Option<Malformed>;

const READERS: [Read; 11] = [
    read::<v1::Change, Change>,
    read::<v1::FactPattern, FactPattern>,
    read::<v1::Footprint, Footprint>,
    read::<v1::Goal, types::Goal>,
    read::<v1::GoalResult, types::GoalOutcome>,
    read::<v1::Lease, Lease>,
    read::<v1::ListRequest, types::ResourceFilter>,
    read::<v1::Requirement, Requirement>,
    read::<v1::Resource, types::Resource>,
    read::<v1::ResourceServiceWatchResponse, types::ResourceUpdate>,
    read::<v1::Value, Value>,
];

fuzz_target!(|bytes: &[u8]| {
    let Some((which, bytes)) = bytes.split_first() else { return };
    if let Some(malformed) = READERS[usize::from(*which) % READERS.len()](bytes) {
        assert!(!malformed.problem.is_empty());
    }
});
