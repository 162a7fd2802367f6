//! What the tests of the log share.
#![allow(dead_code, reason = "each test uses some of it")]

pub(crate) mod cluster;
pub(crate) mod etcd;
pub(crate) mod interrupted;
pub(crate) mod promises;

use ratn_storage::{Log, Options, Position, Progress, Record, Store, Writer};
use std::fs;
use std::path::{Path, PathBuf};

pub(crate) fn log(directory: &Path) -> Log {
    Log::new(directory, Options::default())
}

/// A log that holds these records, each in a frame of its own.
pub(crate) fn write(directory: &Path, records: &[&[u8]]) {
    let (_, mut writer) = log(directory).open().unwrap();
    for record in records {
        append_durably(&mut *writer, record);
    }
    writer.close().unwrap();
}

pub(crate) fn append_durably(writer: &mut dyn Writer, record: &[u8]) -> Position {
    let position = writer.append(record).unwrap();
    writer.durable().wait_blocking(position).unwrap();
    position
}

pub(crate) fn payloads(records: &[Record]) -> Vec<Vec<u8>> {
    records.iter().map(|record| record.payload.to_vec()).collect()
}

/// Waits until no compaction is under way.
pub(crate) fn compacted(writer: &dyn Writer) -> Progress {
    let durable = writer.durable();
    while durable.progress().compacting {
        std::thread::yield_now();
    }
    durable.progress()
}

/// The segments of a log, in order.
pub(crate) fn segments(directory: &Path) -> Vec<PathBuf> {
    let mut found: Vec<PathBuf> = fs::read_dir(directory)
        .unwrap()
        .map(|entry| entry.unwrap().path())
        .filter(|path| path.extension().is_some_and(|extension| extension == "log"))
        .collect();
    found.sort();
    found
}
