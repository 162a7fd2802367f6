//! One writer; compaction beside appends; backup and restore; a copy at any moment.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

mod common;

use bytes::Bytes;
use common::{append_durably, compacted, log, payloads, segments, write};
use ratn_storage::{CopyError, Log, OpenError, Options, Position, Store, backup, restore};
use std::fs;
use std::path::Path;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};

#[test]
fn a_second_writer_is_refused_and_told_who_has_the_place() {
    let directory = tempfile::tempdir().unwrap();
    let (first, writer) = log(directory.path()).open().unwrap();
    match log(directory.path()).open().map(|_| ()) {
        Err(OpenError::Held { holder, .. }) => {
            assert!(holder.contains(&format!("process {}", std::process::id())), "{holder}");
        }
        other => panic!("{other:?}"),
    }
    drop(writer);
    let (second, _writer) = log(directory.path()).open().unwrap();
    assert!(second.epoch > first.epoch);
}

#[test]
fn many_restarts_leave_one_segment_and_every_record() {
    let directory = tempfile::tempdir().unwrap();
    for round in 0..20_u64 {
        let (recovered, mut writer) = log(directory.path()).open().unwrap();
        assert_eq!(recovered.last(), Position(round));
        assert_eq!(recovered.epoch.0, round + 1);
        writer.append(&round.to_le_bytes()).unwrap();
        drop(writer);
    }
    assert_eq!(segments(directory.path()).len(), 1);
}

#[test]
fn options_that_contradict_each_other_are_refused() {
    let directory = tempfile::tempdir().unwrap();
    let options = Options { record_bytes: 1_000, buffered_bytes: 1_000, ..Options::default() };
    let error = Log::new(directory.path(), options).open().map(|_| ()).unwrap_err();
    assert!(error.to_string().contains("buffered_bytes has to hold"), "{error}");
}

#[test]
fn compaction_beside_appends_loses_nothing_and_frees_what_it_stands_for() {
    let directory = tempfile::tempdir().unwrap();
    let options = Options { segment_bytes: 2_000, ..Options::default() };
    let small = Log::new(directory.path(), options);
    let (_, mut writer) = small.open().unwrap();
    let mut sum = 0_u64;
    for number in 1..=5_000_u64 {
        sum += number;
        let position = writer.append(&number.to_le_bytes()).unwrap();
        if number.is_multiple_of(500) {
            let state = Bytes::copy_from_slice(&sum.to_le_bytes());
            writer.compact(position, Box::new(move || state)).unwrap();
        }
        if number % 500 == 250 {
            assert!(compacted(&*writer).compaction_failure.is_none());
            // A reader beside the writer sees a prefix.
            let read = small.read().unwrap();
            assert!(read.last() <= position);
        }
    }
    compacted(&*writer);
    // The segment that a compaction begins is begun by the next batch, which may hold records from before it. With nothing waiting the
    // first of these begins a segment behind all records, and the second stands for all before its own.
    for _ in 0..2 {
        let last = append_durably(&mut *writer, &0_u64.to_le_bytes());
        let state = Bytes::copy_from_slice(&sum.to_le_bytes());
        writer.compact(last, Box::new(move || state)).unwrap();
        compacted(&*writer);
    }
    writer.close().unwrap();
    let read = small.read().unwrap();
    let state = read.snapshot.as_ref().map_or(0, |state| u64::from_le_bytes(state.payload[..].try_into().unwrap()));
    let rest: u64 = read.records.iter().map(|record| u64::from_le_bytes(record.payload[..].try_into().unwrap())).sum();
    assert_eq!(state + rest, sum);
    assert_eq!(read.last(), Position(5_002));
    let left: u64 = segments(directory.path()).iter().map(|path| fs::metadata(path).unwrap().len()).sum();
    assert!(left < 1_000, "{left} bytes are left");
}

#[test]
fn a_backup_of_a_running_log_is_restored_and_never_over_another() {
    let place = tempfile::tempdir().unwrap();
    let [live, kept, back] = ["live", "kept", "back"].map(|name| place.path().join(name));
    let (_, mut writer) = log(&live).open().unwrap();
    for number in 0..10_u8 {
        append_durably(&mut *writer, &[number]);
    }
    writer.compact(Position(4), Box::new(|| Bytes::from_static(b"four"))).unwrap();
    compacted(&*writer);
    let copied = backup(&live, &kept).unwrap();
    assert_eq!((copied.through, copied.snapshot), (Position(10), Position(4)));
    append_durably(&mut *writer, b"after the backup");

    assert!(matches!(backup(&live, &kept), Err(CopyError::NotEmpty { .. })));
    assert!(matches!(restore(&kept, &live), Err(CopyError::NotEmpty { .. })));
    assert!(matches!(restore(&place.path().join("nowhere"), &back), Err(CopyError::Nothing { .. })));
    fs::create_dir(&back).unwrap();
    assert_eq!(restore(&kept, &back).unwrap(), copied);
    let (recovered, mut writer) = log(&back).open().unwrap();
    assert_eq!(recovered.snapshot.as_ref().unwrap().payload, "four");
    assert_eq!(payloads(&recovered.records), (4..10_u8).map(|number| vec![number]).collect::<Vec<_>>());
    assert_eq!(append_durably(&mut *writer, b"goes on"), Position(11));
    let names: Vec<_> = fs::read_dir(place.path()).unwrap().map(|entry| entry.unwrap().file_name()).collect();
    assert_eq!(names.len(), 3, "nothing unfinished is left: {names:?}");
}

#[test]
fn a_damaged_backup_is_not_restored() {
    let place = tempfile::tempdir().unwrap();
    let [live, kept, back] = ["live", "kept", "back"].map(|name| place.path().join(name));
    write(&live, &[b"one", b"two"]);
    backup(&live, &kept).unwrap();
    let path = &segments(&kept)[0];
    let mut bytes = fs::read(path).unwrap();
    bytes[60] ^= 4;
    fs::write(path, bytes).unwrap();
    assert!(matches!(restore(&kept, &back), Err(CopyError::Read(_))));
    assert!(!back.exists());
}

/// A copy of a directory file by file, the newest data of each: what a killed process leaves.
fn copy_files(from: &Path, to: &Path) -> std::io::Result<()> {
    fs::create_dir_all(to)?;
    for entry in fs::read_dir(from)? {
        let entry = entry?;
        fs::copy(entry.path(), to.join(entry.file_name()))?;
    }
    Ok(())
}

#[test]
fn whatever_was_acknowledged_before_a_copy_was_taken_is_in_it() {
    let place = tempfile::tempdir().unwrap();
    let live = place.path().join("live");
    let (_, mut writer) = log(&live).open().unwrap();
    let durable = writer.durable();
    let (ended, acknowledged) = (AtomicBool::new(false), AtomicU64::new(0));
    std::thread::scope(|scope| {
        scope.spawn(|| {
            let mut number = 0_u64;
            while !ended.load(Ordering::Relaxed) {
                number += 1;
                let payload = number.to_le_bytes().repeat(1 + number as usize % 50);
                let position = writer.append(&payload).unwrap();
                if number.is_multiple_of(7) {
                    writer.durable().wait_blocking(position).unwrap();
                    acknowledged.store(number, Ordering::SeqCst);
                }
            }
        });
        for round in 0..40 {
            let before = acknowledged.load(Ordering::SeqCst).max(durable.progress().durable.0);
            let copy = place.path().join(format!("copy-{round}"));
            copy_files(&live, &copy).unwrap();
            let (recovered, writer) = log(&copy).open().unwrap();
            assert!(recovered.last().0 >= before, "{} of {before}", recovered.last());
            for (index, record) in recovered.records.iter().enumerate() {
                let number = index as u64 + 1;
                assert_eq!(record.position, Position(number));
                assert_eq!(record.payload, number.to_le_bytes().repeat(1 + number as usize % 50));
            }
            drop(writer);
            fs::remove_dir_all(&copy).unwrap();
        }
        ended.store(true, Ordering::Relaxed);
    });
}

#[tokio::test]
async fn a_task_waits_for_its_record_and_hears_when_the_writer_is_gone() {
    let directory = tempfile::tempdir().unwrap();
    let (_, mut writer) = log(directory.path()).open().unwrap();
    let mut durable = writer.durable();
    let position = writer.append(b"one").unwrap();
    durable.wait(position).await.unwrap();
    assert!(durable.progress().durable >= position);
    let waiting = tokio::spawn({
        let mut durable = durable.clone();
        async move { durable.wait(position.next()).await }
    });
    writer.close().unwrap();
    assert!(waiting.await.unwrap().is_err());
    assert!(durable.reached(position).unwrap());
}
