//! Torn ends are cut, damage is refused: at every byte.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

mod common;

use common::{append_durably, log, payloads, segments, write};
use ratn_storage::{Log, OpenError, Options, ReadError, Store};
use std::fs;

const RECORDS: [&[u8]; 4] = [b"the first", b"", b"the third, which is longer", b"the last one"];
/// Of a frame with one record.
const OVERHEAD: usize = 24;

#[test]
fn a_log_torn_at_any_byte_of_its_last_record_holds_all_before_it() {
    let made = tempfile::tempdir().unwrap();
    write(made.path(), &RECORDS);
    let whole = fs::read(&segments(made.path())[0]).unwrap();
    let last = whole.len() - OVERHEAD - RECORDS[3].len();
    for end in last..whole.len() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join(segments(made.path())[0].file_name().unwrap());
        fs::write(&path, &whole[..end]).unwrap();
        let (recovered, mut writer) = log(directory.path()).open().unwrap();
        assert_eq!(payloads(&recovered.records), RECORDS[..3], "torn at byte {end}");
        let torn = recovered.torn.map(|torn| (torn.offset, torn.bytes));
        // Zeros at the end may have been reserved as well.
        let written = whole[last..end].iter().rposition(|byte| *byte != 0).map_or(0, |at| at as u64 + 1);
        assert_eq!(torn, (written > 0).then_some((last as u64, written)));
        assert_eq!(append_durably(&mut *writer, b"afterwards").0, 4, "its place is taken by the next");
        writer.close().unwrap();
        let read = log(directory.path()).read().unwrap();
        assert_eq!(payloads(&read.records)[3], b"afterwards");
        assert_eq!(read.torn, None);
    }
}

#[test]
fn blocks_that_reached_the_disk_in_any_order_are_a_torn_end_too() {
    let made = tempfile::tempdir().unwrap();
    write(made.path(), &RECORDS[..1]);
    let before = fs::read(&segments(made.path())[0]).unwrap().len();
    {
        let (_, mut writer) = log(made.path()).open().unwrap();
        append_durably(&mut *writer, &[7; 20_000]);
    }
    let path = &segments(made.path())[0];
    let whole = fs::read(path).unwrap();
    for block in (before..whole.len()).step_by(4_096) {
        let mut bytes = whole.clone();
        let end = whole.len().min(block + 4_096);
        bytes[block..end].fill(0);
        // With and without zeros that were reserved for others.
        for reserved in [0, 10_000] {
            bytes.resize(whole.len() + reserved, 0);
            fs::write(path, &bytes).unwrap();
            assert_eq!(payloads(&log(made.path()).read().unwrap().records), RECORDS[..1], "without block {block}");
        }
    }
}

#[test]
fn a_flipped_bit_before_the_last_record_is_refused_with_file_and_offset() {
    let made = tempfile::tempdir().unwrap();
    write(made.path(), &RECORDS);
    let path = &segments(made.path())[0];
    let whole = fs::read(path).unwrap();
    let last = whole.len() - OVERHEAD - RECORDS[3].len();
    for at in 0..last {
        let mut bytes = whole.clone();
        bytes[at] ^= 1 << (at % 8);
        fs::write(path, &bytes).unwrap();
        match log(made.path()).open().map(|_| ()) {
            Err(OpenError::Read(error @ (ReadError::Damaged { .. } | ReadError::Newer { .. }))) => {
                let message = error.to_string();
                assert!(message.contains(&path.display().to_string()), "{message}");
            }
            other => panic!("bit {} of byte {at}: {other:?}", at % 8),
        }
        assert_eq!(fs::read(path).unwrap(), bytes, "what is refused is not changed");
    }
}

#[test]
fn a_segment_before_the_last_is_whole_or_refused() {
    let directory = tempfile::tempdir().unwrap();
    let small = Log::new(directory.path(), Options { segment_bytes: 100, ..Options::default() });
    let (_, mut writer) = small.open().unwrap();
    for number in 0..10_u8 {
        append_durably(&mut *writer, &[number; 30]);
    }
    writer.close().unwrap();
    let paths = segments(directory.path());
    assert!(paths.len() >= 3, "{paths:?}");
    assert_eq!(small.read().unwrap().records.len(), 10);
    let whole = fs::read(&paths[1]).unwrap();
    for end in 0..whole.len() {
        fs::write(&paths[1], &whole[..end]).unwrap();
        assert!(small.read().is_err(), "cut at byte {end}");
    }
    fs::remove_file(&paths[1]).unwrap();
    let error = small.open().map(|_| ()).unwrap_err();
    assert!(error.to_string().contains("are missing before it"), "{error}");
}

#[test]
fn a_segment_of_another_log_is_refused() {
    let (one, other) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    for directory in [&one, &other] {
        let small = Log::new(directory.path(), Options { segment_bytes: 60, ..Options::default() });
        let (_, mut writer) = small.open().unwrap();
        for number in 0..3_u8 {
            append_durably(&mut *writer, &[number; 30]);
        }
    }
    fs::copy(&segments(other.path())[1], &segments(one.path())[1]).unwrap();
    let error = log(one.path()).read().unwrap_err();
    assert!(error.to_string().contains("it belongs to another log"), "{error}");
}

#[test]
fn a_log_inside_a_record_is_not_taken_for_one() {
    let directory = tempfile::tempdir().unwrap();
    write(directory.path(), &RECORDS);
    let path = &segments(directory.path())[0];
    let whole = fs::read(path).unwrap();
    // What is torn holds frames that are right elsewhere in the same segment.
    {
        let (_, mut writer) = log(directory.path()).open().unwrap();
        append_durably(&mut *writer, &[&whole[..], &whole[..]].concat());
    }
    let longer = fs::read(path).unwrap();
    fs::write(path, &longer[..longer.len() - 1]).unwrap();
    assert_eq!(payloads(&log(directory.path()).read().unwrap().records), RECORDS);
}
