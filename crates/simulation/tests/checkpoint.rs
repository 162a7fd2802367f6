//! Checkpoints of an executive that are no more what they were: refused, with what is wrong. That a run goes on the same from one is
//! compared by `golden.rs` in every scenario, and by `ratn-trials` in random programs.

#![allow(clippy::unwrap_used, reason = "a test may panic")]

mod support;

use ratn_executive::executive::{Executive, RestoreError};
use ratn_executive::protocol::{LogEntry, Mode};
use ratn_model::program::Program;
use ratn_model::tolerance::Tolerance;
use std::path::Path;
use std::sync::Arc;
use support::script::Script;
use support::{NoFiles, load};

/// A scenario's program.
fn program(scenario: &str) -> (Arc<Program>, Script) {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/scenarios").join(scenario);
    let task = std::fs::read_to_string(folder.join("task.yaml")).unwrap();
    let script = Script::from_toml(&std::fs::read_to_string(folder.join("script.toml")).unwrap_or_default());
    (Arc::new(load(&task, scenario, &NoFiles)), script)
}

/// The largest checkpoint of a scenario's run.
fn checkpoint(scenario: &str, mode: Mode) -> (Arc<Program>, Vec<u8>) {
    let (program, mut script) = program(scenario);
    let run = script.run(&program, mode).unwrap();
    let mut executive = Executive::new(program.clone(), Tolerance::ROBOT);
    let mut largest = Vec::new();
    for line in &run.log {
        if let LogEntry::Event(event) = &line.entry {
            executive.handle(line.at, event.clone());
            let bytes = executive.checkpoint();
            if bytes.len() > largest.len() {
                largest = bytes;
            }
        }
    }
    (program, largest)
}

fn refusal(program: &Arc<Program>, bytes: &[u8]) -> Option<RestoreError> {
    Executive::restore(program.clone(), Tolerance::ROBOT, bytes).err()
}

const SCENARIO: &str = "fig5_concurrency";

#[test]
fn a_checkpoint_that_is_restored_is_written_the_same_again() {
    for mode in [Mode::Hsm, Mode::Cdtn] {
        let (program, bytes) = checkpoint(SCENARIO, mode);
        let restored = Executive::restore(program, Tolerance::ROBOT, &bytes).unwrap();
        assert!(restored.checkpoint() == bytes, "in {mode:?} mode");
    }
}

#[test]
fn a_checkpoint_that_is_torn_or_damaged_anywhere_is_refused() {
    for mode in [Mode::Hsm, Mode::Cdtn] {
        let (program, bytes) = checkpoint(SCENARIO, mode);
        assert_eq!(refusal(&program, &bytes), None);
        for length in 0..bytes.len() {
            assert_eq!(refusal(&program, &bytes[..length]), Some(RestoreError::Torn), "of {length} bytes");
        }
        for place in 1..bytes.len() {
            let mut damaged = bytes.clone();
            damaged[place] ^= 0x10;
            assert_eq!(refusal(&program, &damaged), Some(RestoreError::Torn), "at {place}");
        }
        let more = [&bytes[..], b"more"].concat();
        assert_eq!(refusal(&program, &more), Some(RestoreError::Torn));
    }
}

/// As if whoever wrote it had made a mistake: the hash is that of what stands there.
#[test]
fn a_checkpoint_that_was_written_wrongly_is_read_or_refused() {
    for mode in [Mode::Hsm, Mode::Cdtn] {
        let (program, bytes) = checkpoint(SCENARIO, mode);
        let mut refused = 0;
        for place in 33..bytes.len() {
            for with in [0x00, 0x01, 0x7f, 0xff] {
                let mut wrong = bytes.clone();
                wrong[place] = with;
                let hash = *blake3::hash(&wrong[33..]).as_bytes();
                wrong[1..33].copy_from_slice(&hash);
                refused += usize::from(refusal(&program, &wrong).is_some());
            }
        }
        assert!(refused > bytes.len() / 10, "{refused} were refused, of {} bytes", bytes.len());
    }
}

#[test]
fn a_checkpoint_of_another_version_or_another_program_is_refused_as_that() {
    let (own, mut bytes) = checkpoint(SCENARIO, Mode::Cdtn);
    let (other, _) = program("fig5_loop");
    assert_eq!(refusal(&other, &bytes), Some(RestoreError::OtherProgram));
    bytes[0] += 1;
    let said = refusal(&own, &bytes).unwrap().to_string();
    assert_eq!(said, "it is of format 13, and this version of ratn reads 12");
}
