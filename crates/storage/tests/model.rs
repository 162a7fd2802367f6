//! Random histories: the log does what a vector does.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

mod common;

use bytes::Bytes;
use common::{compacted, payloads};
use proptest::prelude::*;
use ratn_storage::{Durability, Log, Options, Position, Store, Writer, backup};

#[derive(Debug, Clone)]
enum Step {
    Append(Vec<u8>),
    /// Waits for everything.
    Wait,
    /// Of so many thousandths of what there is.
    Compact(u64),
    /// Closes or drops the writer, and opens the log again.
    Restart {
        close: bool,
    },
    /// Goes on in a copy.
    MoveToBackup,
}

fn step() -> impl Strategy<Value = Step> {
    prop_oneof![
        10 => prop::collection::vec(any::<u8>(), 0..60).prop_map(Step::Append),
        2 => Just(Step::Wait),
        1 => (0..=1_000_u64).prop_map(Step::Compact),
        1 => any::<bool>().prop_map(|close| Step::Restart { close }),
        1 => Just(Step::MoveToBackup),
    ]
}

/// What a snapshot of the first records is: all of them, each with its length before it.
fn snapshot_of(records: &[Vec<u8>]) -> Bytes {
    let with_length = |record: &Vec<u8>| [&[u8::try_from(record.len()).unwrap()], &record[..]].concat();
    records.iter().flat_map(with_length).collect()
}

fn check(log: &Log, model: &[Vec<u8>], compacted: usize) -> Box<dyn Writer> {
    let (recovered, writer) = log.open().unwrap();
    let through = recovered.snapshot.as_ref().map_or(0, |snapshot| snapshot.through.0 as usize);
    assert_eq!(through, compacted);
    if let Some(snapshot) = &recovered.snapshot {
        assert_eq!(snapshot.payload, snapshot_of(&model[..through]));
    }
    assert_eq!(payloads(&recovered.records), model[through..]);
    assert_eq!(recovered.last(), Position(model.len() as u64));
    assert_eq!(recovered.torn, None);
    writer
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]
    #[test]
    fn a_log_is_a_vector(
        steps in prop::collection::vec(step(), 1..60),
        durability in prop::sample::select(vec![Durability::None, Durability::Group, Durability::Each]),
        segment_bytes in 50..500_u64,
    ) {
        // In memory where there is such a directory: here no power fails, and syncs of a disk take their time.
        let place = tempfile::tempdir_in("/dev/shm").or_else(|_| tempfile::tempdir()).unwrap();
        let options = Options { durability, segment_bytes, ..Options::default() };
        let mut log = Log::new(place.path().join("log"), options.clone());
        let (mut model, mut through) = (Vec::new(), 0);
        let mut writer = check(&log, &model, through);
        for (number, step) in steps.into_iter().enumerate() {
            match step {
                Step::Append(record) => {
                    let position = writer.append(&record).unwrap();
                    model.push(record);
                    prop_assert_eq!(position, Position(model.len() as u64));
                }
                Step::Wait => {
                    let last = Position(model.len() as u64);
                    writer.durable().wait_blocking(last).unwrap();
                    if durability != Durability::None {
                        prop_assert_eq!(payloads(&log.read().unwrap().records), &model[through..]);
                    }
                }
                Step::Compact(share) => {
                    let to = model.len() * share as usize / 1_000;
                    let state = snapshot_of(&model[..to]);
                    if writer.compact(Position(to as u64), Box::new(move || state)).is_ok() {
                        through = to;
                    }
                    prop_assert_eq!(compacted(&*writer).compacted, Position(through as u64));
                }
                Step::Restart { close } => {
                    if close {
                        writer.close().unwrap();
                    } else {
                        drop(writer);
                    }
                    writer = check(&log, &model, through);
                }
                Step::MoveToBackup => {
                    drop(writer);
                    let copy = place.path().join(format!("copy-{number}"));
                    backup(log.directory(), &copy).unwrap();
                    log = Log::new(copy, options.clone());
                    writer = check(&log, &model, through);
                }
            }
        }
        drop(writer);
        drop(check(&log, &model, through));
    }
}
