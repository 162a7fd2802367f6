//! Tests a loss of power after every step in a log's life: created, written, next segment, compacted, closed, opened, copied.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

use super::steps::{Dice, Fate, after};
use super::{PowerLossDisk, Step};
use crate::log::{Disk, Durability, Files, Log, LogFile, Options, backup::copy};
use crate::store::{Position, Recovered, Store, Writer};
use bytes::Bytes;
use std::io;
use std::path::Path;
use std::sync::Arc;

/// The payload of the record at a position.
fn payload(position: u64) -> Vec<u8> {
    let length = usize::try_from(position * 37 % 90).unwrap();
    format!("record {position} {}", "x".repeat(length)).into_bytes()
}

fn snapshot(through: u64) -> Bytes {
    Bytes::from(format!("everything through {through} {}", "y".repeat(200)))
}

fn options(durability: Durability) -> Options {
    Options { durability, segment_bytes: 400, ..Options::default() }
}

struct Life {
    disk: PowerLossDisk,
    log: &'static str,
    writer: Box<dyn Writer>,
}

impl Life {
    fn open(disk: &PowerLossDisk, root: &Path, log: &'static str, durability: Durability) -> Life {
        let opened = Log::new(root.join(log), options(durability)).on(Arc::new(disk.clone())).open().unwrap();
        Life { disk: disk.clone(), log, writer: opened.1 }
    }

    fn append(&mut self, position: u64) {
        assert_eq!(self.writer.append(&payload(position)).unwrap(), Position(position));
    }

    /// Appends records, and waits for each to be acknowledged.
    fn acknowledged(&mut self, positions: std::ops::RangeInclusive<u64>) {
        for position in positions {
            self.append(position);
            self.wait(position);
        }
    }

    /// Appends the first record, and then the others in one frame.
    fn together(&mut self, positions: std::ops::RangeInclusive<u64>) {
        let (first, last, writes) = (*positions.start(), *positions.end(), self.disk.writes());
        let busy = self.disk.busy.clone();
        let busy = busy.lock().unwrap();
        self.append(first);
        while self.disk.writes() == writes {
            std::thread::yield_now();
        }
        (first + 1..=last).for_each(|position| self.append(position));
        drop(busy);
        self.wait(last);
    }

    fn wait(&self, position: u64) {
        self.writer.durable().wait_blocking(Position(position)).unwrap();
        self.disk.record(Step::Acknowledged { log: self.log, through: position });
    }

    fn compact(&mut self, through: u64) {
        self.writer.compact(Position(through), Box::new(move || snapshot(through))).unwrap();
        let durable = self.writer.durable();
        while durable.progress().compacting {
            std::thread::yield_now();
        }
        assert_eq!(durable.progress().compacted, Position(through));
    }

    fn close(self) {
        self.writer.close().unwrap();
    }
}

/// Runs a log through all of its operations.
fn live(root: &Path, durability: Durability) -> Vec<Step> {
    let disk = PowerLossDisk::of(root);
    let mut life = Life::open(&disk, root, "log", durability);
    life.acknowledged(1..=7);
    life.together(8..=12);
    life.compact(9);
    life.acknowledged(13..=16);
    life.close();
    let mut life = Life::open(&disk, root, "log", durability);
    life.acknowledged(17..=18);
    life.compact(18);
    life.together(19..=24);
    let copied = copy(&disk, &root.join("log"), &root.join("backup")).unwrap();
    disk.record(Step::Copied { log: "backup", through: copied.through.0 });
    life.acknowledged(25..=26);
    life.close();
    let copied = copy(&disk, &root.join("backup"), &root.join("restored")).unwrap();
    disk.record(Step::Copied { log: "restored", through: copied.through.0 });
    let mut life = Life::open(&disk, root, "restored", durability);
    life.acknowledged(25..=27);
    life.compact(26);
    life.close();
    disk.steps()
}

/// Checks that the records read are those written, and contain everything that was acknowledged.
fn check(recovered: &Recovered, promised: u64) {
    let through = recovered.snapshot.as_ref().map_or(0, |snapshot| snapshot.through.0);
    if let Some(found) = &recovered.snapshot {
        assert_eq!(found.payload, self::snapshot(through), "a torn snapshot is none");
    }
    for (record, position) in recovered.records.iter().zip(through + 1..) {
        assert_eq!((record.position, &record.payload[..]), (Position(position), &payload(position)[..]));
    }
    assert!(recovered.last().0 >= promised, "{promised} was acknowledged, and {} is there", recovered.last());
}

/// Opens the remaining log, continues it, and opens it again.
fn recovers(place: &Path, promised: u64, durability: Durability) {
    let log = Log::new(place, options(durability)).on(Arc::new(Unsynced));
    let (recovered, mut writer) = log.open().unwrap();
    check(&recovered, promised);
    let next = recovered.last().next();
    assert_eq!(writer.append(&payload(next.0)).unwrap(), next);
    writer.close().unwrap();
    let (again, writer) = log.open().unwrap();
    check(&again, next.0);
    drop(writer);
}

/// File operations without syncs: the power is not lost again.
#[derive(Debug)]
struct Unsynced;

#[derive(Debug)]
struct UnsyncedFile(Box<dyn LogFile>);

impl Files for Unsynced {
    fn create(&self, path: &Path) -> io::Result<Box<dyn LogFile>> {
        Ok(Box::new(UnsyncedFile(Disk.create(path)?)))
    }

    fn sync_directory(&self, _: &Path) -> io::Result<()> {
        Ok(())
    }
}

impl LogFile for UnsyncedFile {
    fn write(&mut self, bytes: &[u8]) -> io::Result<()> {
        self.0.write(bytes)
    }

    fn reserve(&mut self, bytes: usize) -> io::Result<()> {
        self.0.reserve(bytes)
    }

    fn cut(&mut self) -> io::Result<()> {
        self.0.cut()
    }

    fn sync(&mut self) -> io::Result<()> {
        Ok(())
    }
}

/// Loses power at every step, with each of these fates.
fn lose_power_at_every_step(durability: Durability, seed: u64, fates: &[Fate]) -> usize {
    let root = tempfile::tempdir().unwrap();
    let steps = live(root.path(), durability);
    let (mut log, mut backup, mut restored) = (0, None, None);
    for count in 0..=steps.len() {
        match count.checked_sub(1).map(|last| &steps[last]) {
            Some(Step::Acknowledged { log: "log", through }) => log = *through,
            Some(Step::Acknowledged { through, .. } | Step::Copied { log: "restored", through }) => {
                restored = Some(*through);
            }
            Some(Step::Copied { through, .. }) => backup = Some(*through),
            _ => {}
        }
        for (round, fate) in fates.iter().copied().enumerate() {
            let said = format!("{durability}, seed {seed}, step {count} {:?}, round {round}", steps.get(count));
            let outcome = std::panic::catch_unwind(|| {
                let mut dice = Dice(seed ^ ((count as u64) << 8) ^ round as u64);
                let left = tempfile::tempdir().unwrap();
                after(&steps[..count], fate, &mut dice, left.path());
                recovers(&left.path().join("log"), log, durability);
                for (name, promised) in [("backup", backup), ("restored", restored)] {
                    let place = left.path().join(name);
                    // There is a complete copy, or none.
                    assert!(promised.is_none() || place.is_dir(), "{name} is gone");
                    if place.is_dir() {
                        recovers(&place, promised.unwrap_or(24), durability);
                    }
                }
            });
            assert!(outcome.is_ok(), "{said}");
        }
    }
    steps.len()
}

#[test]
fn whenever_power_is_lost_everything_acknowledged_is_there_and_the_log_opens() {
    use Fate::{Kept, Lost, Mixed};
    assert!(lose_power_at_every_step(Durability::Group, 1, &[Kept, Lost, Mixed, Mixed]) > 100);
    assert!(lose_power_at_every_step(Durability::Each, 2, &[Mixed]) > 100);
}

#[test]
fn the_disk_of_these_tests_does_lose_what_was_not_synced() {
    let (root, left) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    let disk = PowerLossDisk::of(root.path());
    let path = root.path().join("file");
    let mut file = disk.create(&path).unwrap();
    file.write(b"synced").unwrap();
    file.sync().unwrap();
    disk.sync_directory(root.path()).unwrap();
    file.write(b" and not").unwrap();
    disk.rename(&path, &root.path().join("renamed")).unwrap();
    after(&disk.steps(), Fate::Lost, &mut Dice(0), left.path());
    assert_eq!(std::fs::read(left.path().join("file")).unwrap(), b"synced");
    assert!(!left.path().join("renamed").exists());
}
