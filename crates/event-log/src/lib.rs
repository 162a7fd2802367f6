//! The event log: one JSON object per line, for every event that the executive got and every command that it gave.
//!
//! It is the single source of Gantt charts, statistics, replay and resume. So each line is written to the file before any command of its
//! event leaves the process, and synced to disk if the commands cannot be undone. The writer holds a lock on the file: no other process
//! writes it meanwhile. A reader reports which line is wrong and why; a torn last line (the writer was killed) is ignored and named.
//!
//! An entry that is too long for one line, for example the start of a run in a large world, is split into several lines (`pieces`). Readers
//! get it as one entry, and count the lines of the file.

mod error;
mod parts;
mod pieces;
mod reader;
mod writer;

pub use error::LogError;
pub use parts::Parts;
pub use reader::{Lines, Log, Tail, first, read, read_behind};
pub use writer::LogWriter;

/// Maximum length of a line. No task makes a longer one, so a longer line was not written by `ratn`. Tests use a smaller limit to be
/// faster.
const MAX_LINE_BYTES: usize = if cfg!(test) { 1 << 20 } else { 16 << 20 };
/// Maximum length of an event or a command, all pieces together: a reader has all of it in memory.
const MAX_ENTRY_BYTES: usize = 8 * MAX_LINE_BYTES;
/// Capacity of the buffer that is kept for the next lines, however long the last ones were.
const USUAL_BYTES: usize = 64 << 10;
/// Maximum size of a log: a run whose log would grow beyond it is ended, so that it does not fill the disk.
const MAX_LOG_BYTES: u64 = 4 << 30;

/// The path of a state, from the path of one of its visits: `place_all[2]/plan_transfer` → `place_all/plan_transfer`
pub fn without_visits(path: &str) -> String {
    let mut depth = 0_usize;
    let mut number = false;
    path.chars()
        .filter(|c| {
            depth += usize::from(*c == '[');
            number = *c == '#' || (number && c.is_ascii_digit());
            let keep = depth == 0 && !number;
            depth -= usize::from(*c == ']' && depth > 0);
            keep
        })
        .collect()
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::writer::Written;
    use super::*;
    use ratn_executive::protocol::{Command, Event, LogEntry, LogLine};
    use ratn_executive::protocol::{Mode, Note};
    use ratn_model::fact::{FactKey, Term};
    use ratn_model::id::{InstanceId, Revision};
    use ratn_model::time::Timestamp;
    use ratn_model::value::Value;

    fn started() -> Event {
        Event::Started {
            task: "t".into(),
            digest: "d".into(),
            mode: Mode::Cdtn,
            parameters: Default::default(),
            seed: 7,
            world: vec![],
            revision: Revision(3),
            capacity: Default::default(),
            learned: Default::default(),
            breakpoints: Box::default(),
            origin: Default::default(),
        }
    }

    fn refusal(text: &str) -> String {
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(file.path(), text).unwrap();
        read(file.path()).unwrap_err().to_string().replace(&file.path().display().to_string(), "LOG")
    }

    #[test]
    fn a_log_reads_back_as_written() {
        let file = tempfile::NamedTempFile::new().unwrap();
        let mut log = LogWriter::create(file.path()).unwrap();
        let command = Command::Note(Note::Retired { instance: InstanceId(1) });
        // This command has a time of its own.
        let wake = Command::Wake { at: Timestamp(7) };
        log.append(Timestamp(0), &started(), &[command.clone(), wake.clone()]).unwrap();
        let Log { lines, torn, .. } = read(file.path()).unwrap();
        assert_eq!((lines.len(), torn), (3, None));
        assert_eq!(lines[2], LogLine { at: Timestamp(0), entry: LogEntry::Command(wake) });
        assert_eq!(lines[0], LogLine { at: Timestamp(0), entry: LogEntry::Event(started()) });
        assert_eq!(lines[1], LogLine { at: Timestamp(0), entry: LogEntry::Command(command) });
        let written = std::fs::read_to_string(file.path()).unwrap();
        let of_lines: String = lines.iter().map(|line| format!("{}\n", serde_json::to_string(line).unwrap())).collect();
        assert_eq!(written, of_lines);
    }

    #[test]
    fn what_is_noted_is_written_together_and_what_is_refused_of_it_leaves_the_rest() {
        let file = tempfile::NamedTempFile::new().unwrap();
        let mut log = LogWriter::create(file.path()).unwrap();
        log.note(Timestamp(0), &started(), &[Command::Wake { at: Timestamp(7) }]).unwrap();
        assert_eq!((log.written(), log.lines(), std::fs::read(file.path()).unwrap().len()), (0, 0, 0));
        let value = ratn_model::value::Value::Null;
        let long = Event::Signalled { signal: "x".repeat(MAX_ENTRY_BYTES), value };
        assert!(matches!(log.note(Timestamp(1), &long, &[]), Err(LogError::TooMuchAtOnce { .. })));
        log.note(Timestamp(2), &Event::Woken, &[]).unwrap();
        log.write().unwrap();
        log.write().unwrap();
        let Log { lines, whole, .. } = read(file.path()).unwrap();
        assert_eq!((lines.len(), lines[2].at), (3, Timestamp(2)));
        assert_eq!((log.lines(), log.written()), (3, whole));
    }

    #[test]
    fn a_log_that_grows_is_followed_by_whole_lines() {
        let place = tempfile::tempdir().unwrap();
        let path = place.path().join("log.jsonl");
        let mut tail = Tail::of(&path);
        assert_eq!(tail.more().unwrap(), []);
        let line =
            |entry: &LogEntry| serde_json::to_string(&LogLine { at: Timestamp(0), entry: entry.clone() }).unwrap();
        let (first, second) =
            (line(&LogEntry::Event(started())), line(&LogEntry::Event(Event::Resumed { share: None })));
        std::fs::write(&path, format!("{first}\n{}", &second[..9])).unwrap();
        assert_eq!(tail.more().unwrap().len(), 1);
        assert_eq!(tail.more().unwrap(), []);
        std::fs::write(&path, format!("{first}\n{second}\n")).unwrap();
        assert_eq!(
            tail.more().unwrap(),
            [LogLine { at: Timestamp(0), entry: LogEntry::Event(Event::Resumed { share: None }) }]
        );
    }

    #[test]
    fn a_log_has_one_writer() {
        let file = tempfile::NamedTempFile::new().unwrap();
        let mut writer = LogWriter::create(file.path()).unwrap();
        writer.append(Timestamp(0), &started(), &[]).unwrap();
        assert!(matches!(LogWriter::create(file.path()), Err(LogError::UnderWay { .. })));
        assert!(matches!(LogWriter::go_on(file.path()), Err(LogError::UnderWay { .. })));
        assert_eq!(read(file.path()).unwrap().lines.len(), 1);
    }

    #[test]
    fn a_log_into_a_pipe_that_nobody_reads_is_refused_at_once() {
        let place = tempfile::tempdir().unwrap();
        let pipe = place.path().join("pipe");
        assert!(std::process::Command::new("mkfifo").arg(&pipe).status().unwrap().success());
        let refused = LogWriter::create(&pipe).unwrap_err();
        let why = std::error::Error::source(&refused).map(ToString::to_string).unwrap_or_default();
        assert!(why.contains("nobody reads"), "{refused}: {why}");
    }

    #[test]
    fn nothing_is_written_over_a_file_with_something_in_it() {
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(file.path(), "mine").unwrap();
        assert!(matches!(LogWriter::create(file.path()), Err(LogError::There { .. })));
        assert_eq!(std::fs::read_to_string(file.path()).unwrap(), "mine");
    }

    #[test]
    fn a_torn_last_line_is_left_out() {
        let first = serde_json::to_string(&LogLine { at: Timestamp(0), entry: LogEntry::Event(started()) }).unwrap();
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(file.path(), format!("{first}\n{{\"at\":1,")).unwrap();
        let log = read(file.path()).unwrap();
        assert_eq!((log.lines.len(), log.torn), (1, Some(2)));
        // A writer that continues the log overwrites the torn line.
        let mut writer = LogWriter::go_on(file.path()).unwrap();
        writer.go_on_behind(&log);
        writer.append(Timestamp(2), &Event::Resumed { share: None }, &[]).unwrap();
        writer.make_durable().unwrap();
        let log = read(file.path()).unwrap();
        assert_eq!((log.lines.len(), log.torn), (2, None));
        assert!(refusal(&first).contains("has no whole line"));
    }

    #[test]
    fn what_no_reader_takes_is_refused_when_it_is_written_with_all_of_its_event() {
        let file = tempfile::NamedTempFile::new().unwrap();
        let mut log = LogWriter::create(file.path()).unwrap();
        log.append(Timestamp(0), &started(), &[]).unwrap();
        let around = serde_json::to_string(&Written { at: Timestamp(1), entry: &says(0) }).unwrap().len();
        let (bytes, lines) = (log.written(), log.lines());
        let refused = log.append(Timestamp(1), &says(MAX_ENTRY_BYTES - around + 1), &[]).unwrap_err();
        assert!(refused.to_string().starts_with("the event signalled has 8388609 bytes"), "{refused}");
        // An event is not written without the commands decided on it.
        let end = Command::End {
            outcome: "aborted".to_owned(),
            outputs: Default::default(),
            reason: "y".repeat(MAX_ENTRY_BYTES),
        };
        let refused = log.append(Timestamp(1), &Event::Woken, &[Command::Wake { at: Timestamp(2) }, end]).unwrap_err();
        assert!(matches!(&refused, LogError::TooMuchAtOnce { what, .. } if what == "command end"), "{refused}");
        assert_eq!((log.written(), log.lines()), (bytes, lines));
        log.append(Timestamp(2), &Event::Resumed { share: None }, &[]).unwrap();
        assert_eq!(read(file.path()).unwrap().lines.len(), 2);
    }

    #[test]
    fn a_world_too_large_for_a_line_stands_in_several_and_is_read_as_one() {
        let file = tempfile::NamedTempFile::new().unwrap();
        let mut log = LogWriter::create(file.path()).unwrap();
        let mut large = started();
        if let Event::Started { world, .. } = &mut large {
            // Characters that need escapes, that have several bytes, and that would end a line.
            let text = "a\"\\\u{1}\n漢".repeat(100);
            let fact = |i| FactKey { predicate: "at".to_owned(), arguments: vec![Term::Int(i)] };
            world.extend((0..2_000).map(|i| (fact(i), Value::String(text.clone()))));
        }
        log.append(Timestamp(5), &large, &[Command::Wake { at: Timestamp(7) }]).unwrap();
        let lines = std::fs::read(file.path()).unwrap();
        let lines: Vec<&[u8]> = lines.split_inclusive(|byte| *byte == b'\n').collect();
        assert!(lines.len() > 3 && lines.len() == log.lines(), "{}", lines.len());
        for line in &lines {
            assert!(line.len() <= MAX_LINE_BYTES);
            serde_json::from_slice::<serde_json::Value>(line).unwrap();
        }
        let all = read(file.path()).unwrap();
        let entries = [LogEntry::Event(large), LogEntry::Command(Command::Wake { at: Timestamp(7) })];
        assert!(all.lines.iter().map(|line| &line.entry).eq(&entries));
        assert_eq!((all.whole, all.read), (log.written(), log.lines()));
        // The writer was killed within the entry.
        let whole = log.written();
        log.append(Timestamp(6), &says(MAX_LINE_BYTES), &[]).unwrap();
        let lines = log.lines();
        drop(log);
        let short = std::fs::File::options().write(true).open(file.path()).unwrap();
        for cut in [1, MAX_LINE_BYTES as u64 / 2] {
            let length = short.metadata().unwrap().len();
            short.set_len(length - cut).unwrap();
            let all = read(file.path()).unwrap();
            assert_eq!((all.lines.len(), all.whole, all.torn), (2, whole, Some(all.read + 1)));
        }
        let mut log = LogWriter::go_on(file.path()).unwrap();
        log.go_on_behind(&read(file.path()).unwrap());
        log.append(Timestamp(6), &says(MAX_LINE_BYTES), &[]).unwrap();
        assert_eq!((read(file.path()).unwrap().lines.len(), log.lines()), (3, lines));
    }

    fn says(length: usize) -> Event {
        Event::Signalled { signal: "x".repeat(length), value: Value::Null }
    }

    #[test]
    fn a_foreign_line_is_named() {
        let first = serde_json::to_string(&LogLine { at: Timestamp(0), entry: LogEntry::Event(started()) }).unwrap();
        assert!(refusal(&format!("{first}\n{{\"at\":1,\n{first}\n")).starts_with("LOG:2: not a line of an event log"));
        assert!(refusal(&format!("{first}\nhello\n")).starts_with("LOG:2: not a line of an event log: not JSON"));
        let strange = format!("{first}\n{{\"at\":1,\"event\":\"rained\"}}\n");
        assert!(refusal(&strange).starts_with("LOG:2: not a line of an event log: not a known event: unknown variant"));
        assert!(refusal("").contains("has no whole line"));
        assert!(
            refusal("{\"at\":1,\"command\":\"note\",\"note\":\"retired\",\"instance\":1}\n").contains("begins with")
        );
    }
}
