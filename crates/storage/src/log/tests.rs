//! Tests with failing disks; a real disk does not fail on request.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

use super::format::SEGMENT_HEADER;
use super::*;
use crate::error::{AppendError, Fault};
use crate::store::Record;
use bytes::Bytes;
use std::fs;
use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering};

/// Faults: from the n-th operation of a kind on, all fail. Counts the operations.
#[derive(Debug, Default)]
struct Faults {
    fail_write_at: Option<usize>,
    fail_sync_at: Option<usize>,
    /// Number of bytes of a failing write that are written.
    part: usize,
    /// Only files whose name contains this fail.
    only: &'static str,
    writes: AtomicUsize,
    syncs: AtomicUsize,
    /// Locked by a test to keep the disk busy.
    busy: Mutex<()>,
}

#[derive(Debug)]
struct FaultyDisk(Arc<Faults>);

#[derive(Debug)]
struct FaultyFile {
    file: Box<dyn LogFile>,
    faults: Arc<Faults>,
    concerned: bool,
}

impl Files for FaultyDisk {
    fn create(&self, path: &Path) -> io::Result<Box<dyn LogFile>> {
        let concerned = path.to_string_lossy().contains(self.0.only);
        Ok(Box::new(FaultyFile { file: Disk.create(path)?, faults: self.0.clone(), concerned }))
    }

    fn sync_directory(&self, _: &Path) -> io::Result<()> {
        Ok(())
    }
}

impl LogFile for FaultyFile {
    fn write(&mut self, bytes: &[u8]) -> io::Result<()> {
        let count = if self.concerned { self.faults.writes.fetch_add(1, Ordering::SeqCst) } else { 0 };
        if self.concerned && self.faults.fail_write_at.is_some_and(|at| count >= at) {
            self.file.write(&bytes[..self.faults.part.min(bytes.len())])?;
            return Err(io::ErrorKind::StorageFull.into());
        }
        self.file.write(bytes)
    }

    fn reserve(&mut self, bytes: usize) -> io::Result<()> {
        let count = self.faults.writes.load(Ordering::SeqCst);
        if self.concerned && self.faults.fail_write_at.is_some_and(|at| count >= at) {
            return Err(io::ErrorKind::StorageFull.into());
        }
        self.file.reserve(bytes)
    }

    fn cut(&mut self) -> io::Result<()> {
        self.file.cut()
    }

    /// Does not sync, because these tests do not lose power.
    fn sync(&mut self) -> io::Result<()> {
        drop(self.faults.busy.lock().unwrap());
        let count = if self.concerned { self.faults.syncs.fetch_add(1, Ordering::SeqCst) } else { 0 };
        let fails = self.concerned && self.faults.fail_sync_at.is_some_and(|at| count >= at);
        if fails { Err(io::Error::other("the disk is gone")) } else { Ok(()) }
    }
}

fn faulty(directory: &Path, options: Options, faults: Faults) -> (Log, Arc<Faults>) {
    let faults = Arc::new(faults);
    let files = Arc::new(FaultyDisk(faults.clone()));
    (Log { directory: directory.to_owned(), options, files }, faults)
}

fn payloads(records: &[Record]) -> Vec<Vec<u8>> {
    records.iter().map(|record| record.payload.to_vec()).collect()
}

fn snapshot(bytes: &'static [u8]) -> crate::store::MakeSnapshot {
    Box::new(move || Bytes::from_static(bytes))
}

/// Waits until no compaction is under way.
fn compacted(writer: &dyn Writer) -> crate::Progress {
    let durable = writer.durable();
    while durable.progress().compacting {
        std::thread::yield_now();
    }
    durable.progress()
}

#[test]
fn zeros_wait_behind_the_last_record_and_a_log_that_is_left_with_them_is_whole() {
    let directory = tempfile::tempdir().unwrap();
    let killed = tempfile::tempdir().unwrap();
    let segment = |place: &Path| super::directory::segment(place, 1);
    let (_, mut writer) = Log::new(directory.path(), Options::default()).open().unwrap();
    for number in 0..100 {
        let position = writer.append(&[number; 10]).unwrap();
        writer.durable().wait_blocking(position).unwrap();
    }
    fs::copy(segment(directory.path()), segment(killed.path())).unwrap();
    let bytes = fs::read(segment(killed.path())).unwrap();
    writer.close().unwrap();
    let written = fs::read(segment(directory.path())).unwrap();
    assert_eq!(bytes.len() % (1 << 20), SEGMENT_HEADER + 34, "reserved with the first record's sync");
    assert_eq!(bytes[..written.len()], written[..], "records went over the zeros");
    assert!(bytes[written.len()..].iter().all(|byte| *byte == 0));
    let (recovered, mut writer) = Log::new(killed.path(), Options::default()).open().unwrap();
    assert_eq!((recovered.records.len(), recovered.torn), (100, None));
    assert_eq!(writer.append(b"next").unwrap(), Position(101));
    writer.close().unwrap();
    // A torn record in place of the zeros is like one at the end of the file.
    let mut torn = bytes;
    torn[written.len() + 5] = 1;
    fs::write(segment(killed.path()), torn).unwrap();
    let read = Log::new(killed.path(), Options::default()).read().unwrap();
    assert_eq!((read.records.len(), read.torn.map(|torn| torn.bytes)), (100, Some(6)));
}

#[test]
fn a_write_that_fails_stops_the_writer_and_what_was_acknowledged_is_recovered() {
    for part in [0, 1, 25, 1_000] {
        let directory = tempfile::tempdir().unwrap();
        // Two writes create the segment; the write of the fifth record is the first to fail.
        let faults = Faults { fail_write_at: Some(2 + 4), part, ..Faults::default() };
        let (log, faults) = faulty(directory.path(), Options::default(), faults);
        let (_, mut writer) = log.open().unwrap();
        let mut durable = writer.durable();
        let mut acknowledged = Vec::new();
        let fault = loop {
            let record = format!("record {}", acknowledged.len()).into_bytes();
            let position = writer.append(&record).unwrap();
            match durable.wait_blocking(position) {
                Ok(()) => acknowledged.push(record),
                Err(fault) => break fault,
            }
        };
        assert_eq!(acknowledged.len(), 4);
        assert!(fault.to_string().contains("free space"), "{fault}");
        assert!(matches!(writer.append(b"more"), Err(AppendError::Stopped(Fault::Io { .. }))));
        assert!(durable.progress().fault.is_some());
        assert_eq!(faults.writes.load(Ordering::SeqCst), 2 + 5, "nothing is written after the fault");
        let read = payloads(&log.read().unwrap().records);
        assert!(read.starts_with(&acknowledged), "reading goes on");
        assert!(writer.close().is_err());

        let (recovered, writer) = Log::new(directory.path(), Options::default()).open().unwrap();
        // A completely written record is recovered, though it was not acknowledged.
        assert_eq!(payloads(&recovered.records), read);
        assert_eq!(read.len(), acknowledged.len() + usize::from(part == 1_000));
        assert_eq!(recovered.torn.is_some(), part > 0 && part < 1_000, "{part}: {:?}", recovered.torn);
        drop(writer);
    }
}

#[test]
fn a_sync_that_fails_is_not_tried_again_and_nothing_after_it_is_acknowledged() {
    let directory = tempfile::tempdir().unwrap();
    let faults = Faults { fail_sync_at: Some(1 + 2), ..Faults::default() };
    let (log, faults) = faulty(directory.path(), Options::default(), faults);
    let (_, mut writer) = log.open().unwrap();
    let mut durable = writer.durable();
    for record in [b"1", b"2"] {
        let position = writer.append(record).unwrap();
        durable.wait_blocking(position).unwrap();
    }
    let position = writer.append(b"3").unwrap();
    let fault = durable.wait_blocking(position).unwrap_err();
    assert!(matches!(fault, Fault::Io { action: "sync", .. }), "{fault:?}");
    assert!(matches!(writer.append(b"4"), Err(AppendError::Stopped(_))));
    assert!(matches!(writer.compact(Position(2), snapshot(b"")), Err(crate::CompactError::Stopped(_))));
    assert_eq!(durable.progress().durable, Position(2));
    assert!(writer.close().is_err());
    assert_eq!(faults.syncs.load(Ordering::SeqCst), 1 + 3);
    assert!(durable.reached(Position(2)).unwrap());
    assert!(durable.reached(Position(3)).is_err());
}

#[test]
fn a_snapshot_that_cannot_be_written_is_thrown_away_and_the_log_goes_on() {
    let directory = tempfile::tempdir().unwrap();
    let faults = Faults { fail_write_at: Some(1), only: "snapshot", part: 3, ..Faults::default() };
    let (log, _) = faulty(directory.path(), Options::default(), faults);
    let (_, mut writer) = log.open().unwrap();
    let last = writer.append(b"before").unwrap();
    writer.compact(last, snapshot(b"a snapshot")).unwrap();
    let progress = compacted(&*writer);
    assert!(progress.compaction_failure.unwrap().to_string().contains("cannot write"));
    assert_eq!(progress.compacted, Position(0));
    assert!(progress.fault.is_none());
    let last = writer.append(b"after").unwrap();
    writer.durable().wait_blocking(last).unwrap();
    writer.close().unwrap();
    let recovered = log.read().unwrap();
    assert!(recovered.snapshot.is_none());
    assert_eq!(payloads(&recovered.records), [b"before".to_vec(), b"after".to_vec()]);
    assert!(directory::list(directory.path()).unwrap().unfinished.is_empty());
}

#[test]
fn what_arrives_during_a_sync_shares_the_next_one() {
    let directory = tempfile::tempdir().unwrap();
    let (log, faults) = faulty(directory.path(), Options::default(), Faults::default());
    let (_, mut writer) = log.open().unwrap();
    let busy = faults.busy.lock().unwrap();
    let mut last = Position(0);
    for number in 0..1_000_u32 {
        last = writer.append(&number.to_le_bytes()).unwrap();
    }
    assert!(!writer.durable().reached(Position(1)).unwrap());
    drop(busy);
    writer.durable().wait_blocking(last).unwrap();
    assert!(faults.syncs.load(Ordering::SeqCst) <= 1 + 2);
}

#[test]
fn with_a_sync_for_each_every_record_has_its_own() {
    let directory = tempfile::tempdir().unwrap();
    let options = Options { durability: Durability::Each, ..Options::default() };
    let (log, faults) = faulty(directory.path(), options, Faults::default());
    let (_, mut writer) = log.open().unwrap();
    let busy = faults.busy.lock().unwrap();
    for number in 0..100_u32 {
        writer.append(&number.to_le_bytes()).unwrap();
    }
    drop(busy);
    assert_eq!(writer.close().unwrap(), Position(100));
    assert_eq!(faults.syncs.load(Ordering::SeqCst), 1 + 100);
    assert_eq!(log.read().unwrap().records.len(), 100);
}

#[test]
fn without_durability_nothing_waits_and_nothing_is_synced() {
    let directory = tempfile::tempdir().unwrap();
    let options = Options { durability: Durability::None, ..Options::default() };
    let (log, faults) = faulty(directory.path(), options, Faults::default());
    let (_, mut writer) = log.open().unwrap();
    let position = writer.append(b"1").unwrap();
    assert!(writer.durable().reached(position).unwrap());
    writer.close().unwrap();
    assert_eq!(faults.syncs.load(Ordering::SeqCst), 1, "only that of the new segment");
    assert_eq!(log.read().unwrap().records.len(), 1);
}

#[test]
fn more_than_the_bound_is_refused_while_the_disk_is_busy_and_accepted_afterwards() {
    let directory = tempfile::tempdir().unwrap();
    let options = Options { record_bytes: 100, buffered_bytes: 1_000, ..Options::default() };
    let (log, faults) = faulty(directory.path(), options, Faults::default());
    let (_, mut writer) = log.open().unwrap();
    assert!(matches!(writer.append(&[0; 101]), Err(AppendError::TooLarge { bytes: 101, most: 100 })));
    let busy = faults.busy.lock().unwrap();
    let (mut accepted, mut last) = (0, Position(0));
    loop {
        match writer.append(&[1; 100]) {
            Ok(position) => (accepted, last) = (accepted + 1, position),
            Err(AppendError::Full { most: 1_000, .. }) => break,
            Err(other) => panic!("{other}"),
        }
    }
    assert!((9..=18).contains(&accepted), "{accepted}");
    drop(busy);
    writer.durable().wait_blocking(last).unwrap();
    assert_eq!(writer.append(&[2; 100]).unwrap(), last.next());
}

#[test]
fn appends_go_on_while_a_snapshot_is_made() {
    let directory = tempfile::tempdir().unwrap();
    let (log, _) = faulty(directory.path(), Options::default(), Faults::default());
    let (_, mut writer) = log.open().unwrap();
    let through = writer.append(b"1").unwrap();
    let (go, made) = std::sync::mpsc::channel();
    let make = move || {
        made.recv().unwrap();
        Bytes::from_static(b"state")
    };
    writer.compact(through, Box::new(make)).unwrap();
    assert!(matches!(writer.compact(through, snapshot(b"")), Err(crate::CompactError::Busy)));
    let last = writer.append(b"2").unwrap();
    writer.durable().wait_blocking(last).unwrap();
    assert!(writer.durable().progress().compacting);
    go.send(()).unwrap();
    assert_eq!(compacted(&*writer).compacted, through);
    assert!(matches!(writer.compact(through, snapshot(b"")), Err(crate::CompactError::Behind { .. })));
    assert!(matches!(writer.compact(last.next(), snapshot(b"")), Err(crate::CompactError::Ahead { .. })));
    writer.close().unwrap();
    let recovered = log.read().unwrap();
    assert_eq!(recovered.snapshot.unwrap().payload, "state");
    assert_eq!(payloads(&recovered.records), [b"2".to_vec()]);
}

#[test]
fn a_snapshot_ahead_of_the_log_counts_and_the_log_goes_on_behind_it() {
    // Without syncs, a loss of power can take away the end of the log while the snapshot stays.
    let directory = tempfile::tempdir().unwrap();
    let (log, _) = faulty(directory.path(), Options::default(), Faults::default());
    let (_, mut writer) = log.open().unwrap();
    for record in [b"1", b"2", b"3"] {
        writer.append(record).unwrap();
    }
    writer.close().unwrap();
    let contents = contents::read(directory.path()).unwrap();
    let ahead = crate::Snapshot { through: Position(10), payload: Bytes::from_static(b"ten") };
    snapshot::write(&Disk, directory.path(), contents.store.unwrap(), &ahead).unwrap();
    for round in 0..3 {
        let (recovered, mut writer) = log.open().unwrap();
        assert_eq!(recovered.snapshot, Some(ahead.clone()));
        assert_eq!(recovered.records.len(), round);
        assert_eq!(writer.append(b"more").unwrap(), Position(11 + round as u64));
        writer.close().unwrap();
    }
    assert_eq!(directory::list(directory.path()).unwrap().segments, [2]);
}

#[test]
fn a_newer_format_is_refused_by_name() {
    let directory = tempfile::tempdir().unwrap();
    let (log, _) = faulty(directory.path(), Options::default(), Faults::default());
    drop(log.open().unwrap());
    let path = directory::segment(directory.path(), 1);
    let mut bytes = fs::read(&path).unwrap();
    bytes[8..12].copy_from_slice(&2_u32.to_le_bytes());
    fs::write(&path, &bytes).unwrap();
    let error = log.open().map(|_| ()).unwrap_err();
    assert!(error.to_string().contains("format version 2, and this program reads up to 1"), "{error}");
    assert_eq!(fs::read(&path).unwrap(), bytes, "nothing was changed");
    assert_eq!(bytes.len(), SEGMENT_HEADER);
}

#[test]
fn a_writer_whose_segment_was_replaced_by_a_copy_or_removed_acknowledges_nothing_more() {
    let replaced = |segment: &Path| {
        let copy = segment.with_extension("copy");
        fs::copy(segment, &copy).unwrap();
        fs::rename(&copy, segment).unwrap();
    };
    let removed = |segment: &Path| fs::remove_file(segment).unwrap();
    for (case, spoil) in [("replaced", &replaced as &dyn Fn(&Path)), ("removed", &removed)] {
        let directory = tempfile::tempdir().unwrap();
        let log = Log::new(directory.path(), Options { segment_bytes: 64, ..Options::default() });
        let (_, mut writer) = log.open().unwrap();
        let place = writer.place();
        let append = |writer: &mut Box<dyn crate::Writer>| {
            let last = writer.append(&[7; 100]).unwrap();
            writer.durable().wait_blocking(last)
        };
        // The check also works after the segment has changed.
        for _ in 0..3 {
            append(&mut writer).unwrap();
            place.check().unwrap();
        }
        let newest = *directory::list(directory.path()).unwrap().segments.last().unwrap();
        assert!(newest > 1);
        spoil(&directory::segment(directory.path(), newest));
        assert!(matches!(place.check(), Err(Fault::Fenced { .. })), "{case}");
        assert!(matches!(append(&mut writer), Err(Fault::Fenced { .. })), "{case}");
    }
}

#[test]
fn a_writer_that_was_got_past_acknowledges_nothing_more() {
    let directory = tempfile::tempdir().unwrap();
    let log = Log::new(directory.path(), Options::default());
    let (first, mut old) = log.open().unwrap();
    let last = old.append(b"old").unwrap();
    old.durable().wait_blocking(last).unwrap();
    fs::remove_file(directory.path().join(directory::LOCK)).unwrap();
    let (second, mut new) = log.open().unwrap();
    assert!(second.epoch > first.epoch);
    assert_eq!(payloads(&second.records), [b"old".to_vec()]);
    let last = old.append(b"lost").unwrap();
    assert!(matches!(old.durable().wait_blocking(last), Err(Fault::Fenced { .. })));
    let last = new.append(b"new").unwrap();
    new.durable().wait_blocking(last).unwrap();
    drop((old, new));
    assert_eq!(payloads(&log.read().unwrap().records), [b"old".to_vec(), b"new".to_vec()]);
}
