//! Logs on disk with checkpoints beside them: whatever happens to either, a run is resumed correctly or not at all.

#![allow(clippy::unwrap_used, reason = "a test may panic")]

use super::*;
use crate::checkpoint::{Checkpointer, path_of};
use crate::ledger::{Confirmed, Ledger};
use crate::progress::Progress;
use crate::replay::tests::{fetch_boxes, log};
use ratn_executive::executive::Executive;
use ratn_model::id::InstanceId;
use ratn_model::time::Timestamp;
use ratn_model::tolerance::Tolerance;
use std::collections::BTreeMap;
use std::path::Path;

/// A run as made by task control, in its own folder.
struct Bench {
    folder: tempfile::TempDir,
    program: Arc<Program>,
    lines: Vec<LogLine>,
}

impl Bench {
    fn new(mode: Mode) -> Bench {
        let program = fetch_boxes();
        let lines = log(&program, mode);
        Bench { folder: tempfile::tempdir().unwrap(), program, lines }
    }

    fn log(&self) -> PathBuf {
        self.folder.path().join("log.jsonl")
    }

    fn checkpoint(&self) -> PathBuf {
        path_of(&self.log())
    }

    /// Runs until the log has `lines` lines, with a checkpoint after `place` of them, and is then killed.
    fn run(&self, events: impl Iterator<Item = (Timestamp, Event)>, place: usize, lines: usize) {
        let mut writer = LogWriter::create(&self.log()).unwrap();
        let mut checkpointer = Checkpointer::start(&writer, &self.program.digest, 1, Ledger::default(), 0).unwrap();
        let mut executive = Executive::new(self.program.clone(), Tolerance::ROBOT);
        let (mut states, mut progress) = (BTreeMap::new(), Progress::new(true));
        for (at, event) in events {
            if writer.lines() >= lines {
                break;
            }
            let commands = executive.handle(at, event.clone());
            commands.iter().for_each(|command| replay::follow(&mut states, command));
            writer.append(at, &event, &commands).unwrap();
            checkpointer.follow(at, &event, &commands);
            progress.follow(at, &event, &commands, |_| false);
            if writer.lines() >= place && !self.checkpoint().exists() {
                checkpointer.make(&writer, &executive, &states, &progress, Confirmed::default());
                // The checkpoint is written before the run goes on.
                while checkpointer.is_busy() {
                    std::thread::yield_now();
                }
            }
        }
    }

    fn events(&self) -> impl Iterator<Item = (Timestamp, Event)> {
        self.lines.iter().filter_map(|line| match &line.entry {
            LogEntry::Event(event) => Some((line.at, event.clone())),
            LogEntry::Command(_) => None,
        })
    }

    fn resume(&self) -> Result<(Replayed, Log), HistoryError> {
        let writer = LogWriter::go_on(&self.log()).unwrap();
        History::of(&writer, Messages::nowhere())?.replay(&self.program)
    }

    /// Resumes the run, and returns how many lines were not read.
    fn resumes_behind(&self) -> usize {
        let (replayed, read) = self.resume().unwrap();
        let whole = replay::replay(&self.program, &log::read(&self.log()).unwrap().lines).unwrap();
        assert_eq!(replayed.standing, whole.standing);
        assert_eq!(replayed.missing, whole.missing);
        let length = std::fs::metadata(self.log()).unwrap().len();
        assert!(read.whole == length || read.torn.is_some() && read.whole < length);
        read.before
    }
}

fn rewrite(path: &Path, change: impl FnOnce(&mut Vec<u8>)) {
    let mut bytes = std::fs::read(path).unwrap();
    change(&mut bytes);
    std::fs::write(path, bytes).unwrap();
}

#[test]
fn a_run_is_resumed_from_its_checkpoint_and_the_lines_behind_it() {
    for mode in [Mode::Hsm, Mode::Cdtn] {
        let bench = Bench::new(mode);
        bench.run(bench.events(), 100, 180);
        assert!(bench.resumes_behind() >= 100);
        // A torn line after the checkpoint is dropped as usual, with its number in the whole log.
        let lines = log::read(&bench.log()).unwrap().lines.len();
        rewrite(&bench.log(), |log| log.extend(b"{\"at\":1,"));
        assert_eq!(bench.resume().unwrap().1.torn, Some(lines + 1));
        // Without a checkpoint the whole log is replayed.
        std::fs::remove_file(bench.checkpoint()).unwrap();
        assert_eq!(bench.resume().unwrap().1.before, 0);
    }
}

#[test]
fn a_checkpoint_that_is_torn_or_damaged_anywhere_is_not_used() {
    let bench = Bench::new(Mode::Hsm);
    bench.run(bench.events(), 1, 20);
    let (first, whole) = (log::first(&bench.log()).unwrap(), std::fs::read(bench.checkpoint()).unwrap());
    let LogEntry::Event(Event::Started { origin, digest, .. }) = &first.entry else { panic!("no start") };
    let find = || checkpoint::find(&bench.log(), origin, digest);
    assert!(find().unwrap().is_some());
    for length in 0..whole.len() {
        std::fs::write(bench.checkpoint(), &whole[..length]).unwrap();
        assert!(!find().unwrap_err().refuses(), "{length} bytes");
    }
    for place in 0..whole.len() {
        let mut damaged = whole.clone();
        damaged[place] ^= 1;
        std::fs::write(bench.checkpoint(), &damaged).unwrap();
        assert!(!find().unwrap_err().refuses(), "byte {place}");
    }
    for other in ["", "what is this?", "ratn checkpoint\n"] {
        std::fs::write(bench.checkpoint(), other).unwrap();
        assert_eq!(bench.resumes_behind(), 0);
    }
    // Of an older or newer format version.
    std::fs::write(bench.checkpoint(), &whole).unwrap();
    rewrite(&bench.checkpoint(), |bytes| bytes[16] += 1);
    assert!(find().unwrap_err().to_string().contains("of format 10"));
    assert_eq!(bench.resumes_behind(), 0);
}

#[test]
fn a_checkpoint_of_another_run_or_of_a_log_that_was_edited_is_not_used() {
    let (bench, other) = (Bench::new(Mode::Cdtn), Bench::new(Mode::Cdtn));
    bench.run(bench.events(), 100, 180);
    let another_run = other.events().map(|(at, mut event)| {
        if let Event::Started { origin, .. } = &mut event {
            origin.run = "run-2".into();
        }
        (at, event)
    });
    other.run(another_run, 100, 180);
    let ours = std::fs::read(bench.checkpoint()).unwrap();
    std::fs::copy(other.checkpoint(), bench.checkpoint()).unwrap();
    assert_eq!(bench.resumes_behind(), 0);

    // Edited so that every line is valid and the log keeps its length.
    std::fs::write(bench.checkpoint(), ours).unwrap();
    assert!(bench.resumes_behind() > 0);
    rewrite(&bench.log(), |log| {
        let place = log.windows(8).position(|bytes| bytes == b"\"seed\":3").unwrap();
        log[place + 7] = b'4';
    });
    assert_eq!(bench.resume().map_or(0, |(_, read)| read.before), 0);
    rewrite(&bench.log(), |log| {
        let place = log.windows(8).position(|bytes| bytes == b"\"seed\":4").unwrap();
        log[place + 7] = b'3';
    });
    assert!(bench.resumes_behind() > 0);
}

#[test]
fn a_log_that_is_shorter_than_its_checkpoint_says_is_refused() {
    let bench = Bench::new(Mode::Cdtn);
    bench.run(bench.events(), 100, 180);
    let before = bench.resumes_behind();
    let place: usize =
        std::fs::read_to_string(bench.log()).unwrap().lines().take(before).map(|line| line.len() + 1).sum();
    // The log may lose everything after the checkpoint, but not more.
    rewrite(&bench.log(), |log| log.truncate(place));
    assert_eq!(bench.resumes_behind(), before);
    rewrite(&bench.log(), |log| log.truncate(place - 1));
    let refused = bench.resume().err().unwrap();
    assert!(refused.to_string().contains("lines are missing at its end"), "{refused}");
    std::fs::remove_file(bench.checkpoint()).unwrap();
    assert_eq!(bench.resumes_behind(), 0);
}

#[test]
fn a_state_that_does_not_fit_the_lines_behind_it_is_not_used() {
    let bench = Bench::new(Mode::Cdtn);
    bench.run(bench.events(), 100, 180);
    // A state that cannot be restored, and one that gives other commands.
    let file = std::fs::read(bench.checkpoint()).unwrap();
    for executive in [b"what?".to_vec(), Executive::new(bench.program.clone(), Tolerance::ROBOT).checkpoint()] {
        let checkpoint = Checkpoint { executive, ..Checkpoint::decode(&file).unwrap() };
        std::fs::write(bench.checkpoint(), checkpoint.encode().unwrap()).unwrap();
        assert_eq!(bench.resumes_behind(), 0);
    }
}

#[test]
fn a_run_that_has_ended_leaves_no_checkpoint() {
    let bench = Bench::new(Mode::Hsm);
    bench.run(bench.events(), 100, usize::MAX);
    assert!(bench.resume().unwrap().0.ended.is_some());
    std::fs::remove_file(bench.log()).unwrap();
    let writer = LogWriter::create(&bench.log()).unwrap();
    Checkpointer::start(&writer, &bench.program.digest, 1, Ledger::default(), 0).unwrap().end();
    assert!(!bench.checkpoint().exists());
}

#[test]
fn what_is_read_of_a_long_log_is_what_is_behind_its_checkpoint() {
    const EVENTS: usize = 200_000;
    let bench = Bench::new(Mode::Cdtn);
    // A goal that reports progress all the time.
    let says = |number: u64| {
        let (instance, attempt, message) = (InstanceId(1), 1, format!("step {number}"));
        (Timestamp::from_seconds(1e3), Event::Progressed { instance, attempt, message })
    };
    let first = bench.events().take_while(|(at, _)| at.seconds() < 20.0);
    bench.run(first.chain((0..EVENTS as u64).map(says)), EVENTS, EVENTS + 10);
    let (replayed, read) = bench.resume().unwrap();
    assert!(read.before >= EVENTS, "{}", read.before);
    assert!(read.lines.len() <= 20 && replayed.events <= 20, "{} lines", read.lines.len());
}
