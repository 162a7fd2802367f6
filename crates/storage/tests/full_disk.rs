//! A disk that is really full: a small file system in memory. Mounting one takes root; without it this is counted as skipped.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

mod common;

use common::{log, payloads};
use nix::mount::{MntFlags, MsFlags, mount, umount2};
use ratn_storage::{AppendError, Fault, Store};
use std::path::Path;

struct Mounted<'a>(&'a Path);

impl Drop for Mounted<'_> {
    fn drop(&mut self) {
        let _ = umount2(self.0, MntFlags::MNT_DETACH);
    }
}

#[test]
fn a_full_disk_stops_the_writer_and_after_space_was_made_everything_acknowledged_is_there() {
    let place = tempfile::tempdir().unwrap();
    let mounted = mount(Some("tmpfs"), place.path(), Some("tmpfs"), MsFlags::empty(), Some("size=1m"));
    if let Err(error) = mounted {
        eprintln!("skipped: cannot mount a small file system ({error}); run it as root");
        return;
    }
    let _mounted = Mounted(place.path());
    let ballast = place.path().join("ballast");
    std::fs::write(&ballast, vec![1; 600 << 10]).unwrap();
    let directory = place.path().join("log");
    let (_, mut writer) = log(&directory).open().unwrap();
    let mut durable = writer.durable();
    let mut acknowledged = Vec::new();
    let fault = loop {
        let record = vec![acknowledged.len() as u8; 3_000];
        let position = match writer.append(&record) {
            Ok(position) => position,
            Err(AppendError::Stopped(fault)) => break fault,
            Err(other) => panic!("{other}"),
        };
        match durable.wait_blocking(position) {
            Ok(()) => acknowledged.push(record),
            Err(fault) => break fault,
        }
        assert!(acknowledged.len() < 1_000, "the disk is never full");
    };
    assert!(matches!(fault, Fault::Io { .. }), "{fault:?}");
    assert!(fault.to_string().contains("free space on this disk"), "{fault}");
    assert!(acknowledged.len() > 50);
    assert_eq!(payloads(&log(&directory).read().unwrap().records), acknowledged, "reading goes on");
    assert!(writer.append(b"small").is_err(), "stopped for good");
    drop(writer);

    let refused = log(&directory).open().map(|_| ()).unwrap_err();
    assert!(refused.to_string().contains("cannot write"), "{refused}");
    std::fs::remove_file(&ballast).unwrap();
    let (recovered, mut writer) = log(&directory).open().unwrap();
    assert_eq!(payloads(&recovered.records), acknowledged);
    let position = writer.append(b"goes on").unwrap();
    writer.durable().wait_blocking(position).unwrap();
}
