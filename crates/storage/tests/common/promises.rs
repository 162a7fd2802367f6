//! What [`Store`] and [`Writer`] promise, for every log there is: each function is a test, given how to make a log.

use super::interrupted::Interrupted;
use super::{append_durably, compacted, payloads};
use bytes::Bytes;
use proptest::prelude::*;
use proptest::test_runner::{RngAlgorithm, TestRng, TestRunner};
use ratn_storage::{CopyError, OpenError, Position, ReadError, Recovered, Store, Writer, transfer, transfer_running};

/// Makes a log by its name: the same name, the same log.
pub(crate) type Make<'a> = &'a dyn Fn(&str) -> Box<dyn Store>;

pub(crate) fn a_second_writer_is_refused_until_the_first_is_gone(make: Make<'_>) {
    let (first, mut writer) = make("second").open().unwrap();
    append_durably(&mut *writer, b"one");
    assert!(matches!(make("second").open(), Err(OpenError::Held { .. })));
    append_durably(&mut *writer, b"two");
    drop(writer);
    let (second, _writer) = make("second").open().unwrap();
    assert!(second.epoch > first.epoch);
    assert_eq!(payloads(&second.records), [b"one", b"two"]);
}

pub(crate) fn many_restarts_keep_every_record(make: Make<'_>) {
    for round in 0..20_u64 {
        let (recovered, mut writer) = make("restarts").open().unwrap();
        assert_eq!((recovered.last(), recovered.epoch.0), (Position(round), round + 1));
        writer.append(&round.to_le_bytes()).unwrap();
        drop(writer);
    }
}

pub(crate) fn compaction_beside_appends_loses_nothing(make: Make<'_>) {
    let log = make("compaction");
    let (_, mut writer) = log.open().unwrap();
    let mut sum = 0_u64;
    for number in 1..=2_000_u64 {
        sum += number;
        let position = writer.append(&number.to_le_bytes()).unwrap();
        if number.is_multiple_of(500) {
            let state = Bytes::copy_from_slice(&sum.to_le_bytes());
            writer.compact(position, Box::new(move || state)).unwrap();
        }
        if number % 500 == 250 {
            assert!(compacted(&*writer).compaction_failure.is_none());
            // A reader beside the writer sees a prefix.
            assert!(log.read().unwrap().last() <= position);
        }
    }
    compacted(&*writer);
    writer.close().unwrap();
    let read = log.read().unwrap();
    let state = read.snapshot.as_ref().map_or(0, |state| u64::from_le_bytes(state.payload[..].try_into().unwrap()));
    let rest: u64 = read.records.iter().map(|record| u64::from_le_bytes(record.payload[..].try_into().unwrap())).sum();
    assert_eq!((state + rest, read.last()), (sum, Position(2_000)));
    assert_eq!(read.snapshot.unwrap().through, Position(2_000));
}

pub(crate) fn a_copy_that_was_interrupted_is_not_opened(make: Make<'_>) {
    let (_, mut source) = make("source").open().unwrap();
    for record in [b"1", b"2", b"3"] {
        append_durably(&mut *source, record);
    }
    source.close().unwrap();
    for after in 0..3 {
        let name = format!("target-{after}");
        assert!(transfer(&*make("source"), &Interrupted { store: make(&name), after }).is_err());
        let unfinished = |error: &ReadError| matches!(error, ReadError::Unfinished { .. });
        let refused = make(&name).open().map(drop).unwrap_err();
        assert!(matches!(&refused, OpenError::Read(error) if unfinished(error)), "{refused}");
        assert!(unfinished(&make(&name).read().unwrap_err()));
        let again = transfer(&*make("source"), &*make(&name)).unwrap_err().to_string();
        assert!(again.contains("part of a copy") && again.contains("copy again"), "{again}");
    }
    transfer(&*make("source"), &*make("target")).unwrap();
    assert_eq!(payloads(&make("target").open().unwrap().0.records), [b"1", b"2", b"3"]);
}

pub(crate) fn a_copy_that_was_interrupted_when_its_source_was_marked_is_finished_by_the_same_copy(make: Make<'_>) {
    let (_, mut source) = make("begun").open().unwrap();
    for record in [b"1", b"2", b"3"] {
        append_durably(&mut *source, record);
    }
    source.close().unwrap();
    // Another one, which is not what the source was moved to.
    transfer_running(&*make("begun"), &*make("earlier")).unwrap();
    assert!(transfer(&*make("begun"), &Interrupted { store: make("part"), after: 2 }).is_err());
    // All records, and not the removal of the mark.
    assert!(transfer(&*make("begun"), &Interrupted { store: make("finished"), after: 3 }).is_err());
    let refused = make("finished").open().map(drop).unwrap_err();
    assert!(refused.to_string().contains("the same `ratn state copy` again"), "{refused}");
    let moved = |error: CopyError| assert!(error.to_string().contains("was moved to"), "{error}");
    for other in ["part", "earlier", "empty"] {
        moved(transfer(&*make("begun"), &*make(other)).unwrap_err());
    }
    assert!(matches!(make("part").open(), Err(OpenError::Read(ReadError::Unfinished { .. }))));
    assert_eq!(transfer(&*make("begun"), &*make("finished")).unwrap(), Position(3));
    let (recovered, mut writer) = make("finished").open().unwrap();
    assert_eq!(payloads(&recovered.records), [b"1", b"2", b"3"]);
    append_durably(&mut *writer, b"4");
    writer.close().unwrap();
    moved(transfer(&*make("begun"), &*make("finished")).unwrap_err());
    assert!(matches!(make("begun").open(), Err(OpenError::Read(ReadError::Moved { .. }))));
}

pub(crate) fn what_was_moved_is_opened_only_where_it_is_now(make: Make<'_>) {
    let (_, mut source) = make("here").open().unwrap();
    for record in [b"1", b"2", b"3"] {
        append_durably(&mut *source, record);
    }
    source.close().unwrap();
    transfer_running(&*make("here"), &*make("backup")).unwrap();
    let goes_on = |name: &str| assert_eq!(payloads(&make(name).open().unwrap().0.records), [b"1", b"2", b"3"]);
    goes_on("here");
    transfer(&*make("here"), &*make("there")).unwrap();
    let moved = |name: &str, to: &str| {
        let error = make(name).open().map(drop).unwrap_err();
        let says = error.to_string();
        assert!(matches!(&error, OpenError::Read(ReadError::Moved { .. })), "{error:?}");
        assert!(says.contains(&make(to).place()) && says.contains("to go back"), "{says}");
        assert!(matches!(make(name).read(), Err(ReadError::Moved { .. })));
        for copy in [transfer, transfer_running] {
            assert!(copy(&*make(name), &*make("other")).unwrap_err().to_string().contains("was moved to"));
        }
    };
    moved("here", "there");
    goes_on("there");
    transfer(&*make("there"), &*make("back")).unwrap();
    moved("there", "back");
    goes_on("back");
    goes_on("backup");
}

pub(crate) fn a_copy_of_what_another_writer_has_taken_meanwhile_is_not_opened(
    make: Make<'_>,
    take: &(dyn Fn(&str) + Sync),
) {
    let (_, mut source) = make("taken").open().unwrap();
    append_durably(&mut *source, b"1");
    source.close().unwrap();
    let target = Meanwhile { store: make("copy"), what: &|| take("taken") };
    let error = transfer(&*make("taken"), &target).unwrap_err();
    assert!(matches!(error, CopyError::SourceLost(_)), "{error:?}");
    assert!(matches!(make("copy").open(), Err(OpenError::Read(ReadError::Unfinished { .. }))));
    assert_eq!(payloads(&make("taken").open().unwrap().0.records), [b"1"]);
}

pub(crate) fn a_copy_to_what_another_writer_has_taken_meanwhile_leaves_it_alone(
    make: Make<'_>,
    take: &(dyn Fn(&str) + Sync),
) {
    let (_, mut source) = make("kept").open().unwrap();
    append_durably(&mut *source, b"1");
    source.close().unwrap();
    let (taken, another) = (std::sync::Mutex::new(None), make("target"));
    let taking = || {
        take("target");
        let (_, mut writer) = another.open().unwrap();
        append_durably(&mut *writer, b"its own");
        *taken.lock().unwrap() = Some(writer);
    };
    let error = {
        let target = Opened { store: make("target"), then: &taking };
        transfer(&*make("kept"), &target).unwrap_err()
    };
    assert!(matches!(error, CopyError::Write(_)), "{error:?}");
    append_durably(&mut **taken.lock().unwrap().as_mut().unwrap(), b"more");
    drop(taken.into_inner().unwrap());
    assert_eq!(payloads(&make("target").open().unwrap().0.records), [&b"its own"[..], b"more"]);
    assert_eq!(payloads(&make("kept").open().unwrap().0.records), [b"1"]);
}

/// When it has been opened something else happens.
struct Opened<'a> {
    store: Box<dyn Store>,
    then: &'a (dyn Fn() + Sync),
}

impl std::fmt::Debug for Opened<'_> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        self.store.fmt(f)
    }
}

impl Store for Opened<'_> {
    fn open(&self) -> Result<(Recovered, Box<dyn Writer>), OpenError> {
        let opened = self.store.open()?;
        (self.then)();
        Ok(opened)
    }

    fn read(&self) -> Result<Recovered, ReadError> {
        self.store.read()
    }

    fn finish_copy(&self, moved: &str) -> Result<Option<Position>, CopyError> {
        self.store.finish_copy(moved)
    }

    fn place(&self) -> String {
        self.store.place()
    }
}

/// While it is opened something else happens.
struct Meanwhile<'a> {
    store: Box<dyn Store>,
    what: &'a (dyn Fn() + Sync),
}

impl std::fmt::Debug for Meanwhile<'_> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        self.store.fmt(f)
    }
}

impl Store for Meanwhile<'_> {
    fn open(&self) -> Result<(Recovered, Box<dyn Writer>), OpenError> {
        (self.what)();
        self.store.open()
    }

    fn read(&self) -> Result<Recovered, ReadError> {
        self.store.read()
    }

    fn finish_copy(&self, moved: &str) -> Result<Option<Position>, CopyError> {
        self.store.finish_copy(moved)
    }

    fn place(&self) -> String {
        self.store.place()
    }
}

pub(crate) fn a_waiter_hears_when_the_writer_is_gone(make: Make<'_>) {
    let (_, mut writer) = make("waiter").open().unwrap();
    let position = append_durably(&mut *writer, b"one");
    let mut durable = writer.durable();
    let waiting = std::thread::spawn({
        let mut durable = durable.clone();
        move || durable.wait_blocking(position.next())
    });
    writer.close().unwrap();
    assert!(waiting.join().unwrap().is_err());
    assert!(durable.reached(position).unwrap());
    assert!(durable.wait_blocking(position).is_ok());
}

#[derive(Debug, Clone)]
enum Step {
    /// Bytes of the record.
    Append(usize),
    Wait,
    /// Of so many thousandths of what there is.
    Compact(u64),
    /// Closes or drops the writer, and opens the log again.
    Restart {
        close: bool,
    },
}

fn step(longest: usize) -> impl Strategy<Value = Step> {
    prop_oneof![
        10 => (0..longest).prop_map(Step::Append),
        2 => Just(Step::Wait),
        1 => (0..=1_000_u64).prop_map(Step::Compact),
        1 => any::<bool>().prop_map(|close| Step::Restart { close }),
    ]
}

/// Random histories of so many steps: the log does what a vector does.
pub(crate) fn a_log_is_a_vector(make: Make<'_>, histories: u32, steps: usize, longest: usize) {
    let config = ProptestConfig { failure_persistence: None, ..ProptestConfig::with_cases(histories) };
    let mut runner = TestRunner::new_with_rng(config, TestRng::deterministic_rng(RngAlgorithm::ChaCha));
    let number = std::cell::Cell::new(0);
    let history = prop::collection::vec(step(longest), 1..steps);
    let ran = runner.run(&history, |steps| {
        number.set(number.get() + 1);
        run(make, &format!("vector-{}", number.get()), steps);
        Ok(())
    });
    ran.unwrap();
}

fn check(log: &dyn Store, model: &[Vec<u8>], compacted: usize) -> Box<dyn Writer> {
    let (recovered, writer) = log.open().unwrap();
    let through = recovered.snapshot.as_ref().map_or(0, |snapshot| snapshot.through.0 as usize);
    assert_eq!(through, compacted);
    if let Some(snapshot) = &recovered.snapshot {
        assert_eq!(snapshot.payload, model[..through].concat());
    }
    assert_eq!(payloads(&recovered.records), model[through..]);
    assert_eq!(recovered.last(), Position(model.len() as u64));
    writer
}

fn run(make: Make<'_>, name: &str, steps: Vec<Step>) {
    let log = make(name);
    let (mut model, mut through) = (Vec::new(), 0);
    let mut writer = check(&*log, &model, through);
    for step in steps {
        match step {
            Step::Append(length) => {
                let record = vec![u8::try_from(model.len() % 251).unwrap(); length];
                let position = writer.append(&record).unwrap();
                model.push(record);
                assert_eq!(position, Position(model.len() as u64));
            }
            Step::Wait => {
                writer.durable().wait_blocking(Position(model.len() as u64)).unwrap();
                assert_eq!(payloads(&log.read().unwrap().records), &model[through..]);
            }
            Step::Compact(share) => {
                let to = model.len() * share as usize / 1_000;
                let state: Bytes = model[..to].concat().into();
                if writer.compact(Position(to as u64), Box::new(move || state)).is_ok() {
                    through = to;
                }
                assert_eq!(compacted(&*writer).compacted, Position(through as u64));
            }
            Step::Restart { close } => {
                if close {
                    writer.close().unwrap();
                } else {
                    drop(writer);
                }
                writer = check(&*log, &model, through);
            }
        }
    }
    drop(writer);
    drop(check(&*log, &model, through));
}
