//! Questions to the operator while a run is painted on a terminal, and the answers typed there.

use crate::output;
use nix::errno::Errno;
use nix::sys::signal::{SigSet, Signal};
use nix::sys::termios::{FlushArg, tcflush};
use ratn_executive::protocol::{Awaited, Command, Event, LogEntry, LogLine, Note};
use ratn_model::id::InstanceId;
use ratn_task_control::control::{self, Message};
use std::collections::BTreeMap;
use std::io::BufRead;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

/// Interval at which a run in the background of its shell, which cannot read, checks whether it is in the foreground again.
const IN_BACKGROUND: Duration = Duration::from_secs(1);

/// The open questions.
#[derive(Debug, Default)]
pub(super) struct Questions {
    open: BTreeMap<InstanceId, (String, Vec<String>)>,
    /// The run's id, once the log has it.
    run: String,
    /// The system whose run the typed answers are for; taken when the listener starts.
    directory: Option<PathBuf>,
    typing: Option<Arc<Typing>>,
    has_changed: bool,
}

/// Shared state of the reader of the terminal and the painter.
#[derive(Debug, Default)]
struct Typing {
    /// A line was typed, and its result has replaced the questions on the screen.
    has_come: AtomicBool,
    /// No more lines will be read.
    is_over: AtomicBool,
}

impl Questions {
    /// Text typed on this terminal answers the run of the system in `directory`; `None` where nobody can type.
    pub(super) fn new(directory: Option<PathBuf>) -> Questions {
        Questions { directory, ..Questions::default() }
    }

    /// Processes a line of the log.
    pub(super) fn follow(&mut self, line: &LogLine) {
        let note = match &line.entry {
            LogEntry::Event(Event::Started { origin, .. }) => return origin.run.clone_into(&mut self.run),
            LogEntry::Command(Command::Note(note)) => note,
            _ => return,
        };
        match note {
            Note::Awaiting { instance, awaited: Awaited::Answer { question, choices, .. }, .. } => {
                self.open.insert(*instance, (question.clone(), choices.clone()));
                self.has_changed = true;
                // Before the first question nothing is read: text typed earlier is for the shell.
                if let Some(directory) = self.directory.take() {
                    self.typing = listen(directory, self.run.clone());
                }
            }
            Note::Finished { instance, .. } | Note::Squashed { instance } => {
                self.has_changed |= self.open.remove(instance).is_some();
            }
            _ => {}
        }
    }

    /// Whether the painted lines must stay as they are, because the user may be typing.
    pub(super) fn keep_still(&mut self) -> bool {
        let has_come = self.typing.as_ref().is_some_and(|typing| typing.has_come.swap(false, Ordering::Relaxed));
        let has_changed = std::mem::take(&mut self.has_changed) || has_come;
        self.can_answer() && !self.open.is_empty() && !has_changed
    }

    fn can_answer(&self) -> bool {
        self.typing.as_ref().is_some_and(|typing| !typing.is_over.load(Ordering::Relaxed))
    }

    /// The questions, one line each.
    pub(super) fn lines(&self, path: impl Fn(InstanceId) -> String) -> Vec<String> {
        let how = match (self.can_answer(), self.open.len()) {
            (false, _) => "answer with `ratn answer - CHOICE`",
            (true, 1) => "type the answer",
            (true, _) => "type STATE ANSWER",
        };
        let line = |(instance, (question, choices)): (&InstanceId, &(String, Vec<String>))| {
            format!("  asks   {}: {question} ({}): {how}", path(*instance), choices.join(", "))
        };
        self.open.iter().map(line).collect()
    }
}

/// Sends typed lines to a run of the system in `directory`, as long as this process lives; `None` where that is impossible.
fn listen(directory: PathBuf, run: String) -> Option<Arc<Typing>> {
    let typing = Arc::new(Typing::default());
    let told = Arc::clone(&typing);
    let listening = move || {
        // A background process that reads the terminal is stopped by SIGTTIN, and one that changes it by SIGTTOU, with all its threads; with
        // both signals blocked, the operation fails instead.
        let mut stopping = SigSet::from(Signal::SIGTTIN);
        stopping.add(Signal::SIGTTOU);
        if stopping.thread_block().is_ok()
            && let Ok(runtime) = tokio::runtime::Builder::new_current_thread().enable_all().build()
        {
            // Text typed before the question is not an answer to it.
            let _ = tcflush(std::io::stdin(), FlushArg::TCIFLUSH);
            while let Some(line) = typed() {
                // The typed line is on the terminal now, below the painted lines.
                output::area_was_pushed();
                if let Some(message) = answer(&run, &line) {
                    match runtime.block_on(control::send(&directory, &message)) {
                        Ok(said) => output::progress(said),
                        Err(error) => output::progress(format_args!("not taken: {error}")),
                    }
                }
                told.has_come.store(true, Ordering::Relaxed);
            }
        }
        told.is_over.store(true, Ordering::Relaxed);
    };
    let thread = std::thread::Builder::new().name("answers".to_owned()).spawn(listening);
    thread.is_ok().then_some(typing)
}

/// The next line; `None` at the end of input.
fn typed() -> Option<String> {
    let mut line = String::new();
    loop {
        match std::io::stdin().lock().read_line(&mut line) {
            Ok(0) => return None,
            Ok(_) => return Some(line),
            Err(error) if error.raw_os_error() == Some(Errno::EIO as i32) => std::thread::sleep(IN_BACKGROUND),
            Err(_) => return None,
        }
    }
}

/// Parses `go`, or `STATE go`.
fn answer(run: &str, line: &str) -> Option<Message> {
    let mut words = line.split_whitespace();
    let (first, second) = (words.next()?, words.next());
    let (state, choice) = match second {
        Some(choice) => (Some(first.to_owned()), choice),
        None => (None, first),
    };
    Some(Message::Answer { run: run.to_owned(), state, choice: choice.to_owned() })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn line(text: &str) -> LogLine {
        serde_json::from_str(text).expect("a line of a log")
    }

    #[test]
    fn a_question_is_shown_until_it_is_answered_and_nothing_is_painted_over_who_types() {
        let typing = Arc::new(Typing::default());
        let mut questions = Questions { typing: Some(Arc::clone(&typing)), ..Questions::default() };
        assert!(!questions.keep_still());
        let asks = r#"{"at":0,"command":"note","note":"awaiting","instance":1,"awaits":"answer","question":"Go on?","choices":["go","stop"]}"#;
        questions.follow(&line(asks));
        assert!(!questions.keep_still(), "the question itself is painted");
        assert!(questions.keep_still());
        assert_eq!(questions.lines(|_| "ask".to_owned()), ["  asks   ask: Go on? (go, stop): type the answer"]);
        typing.has_come.store(true, Ordering::Relaxed);
        assert!(!questions.keep_still(), "what was said of a wrong answer stands where the question was");
        assert!(questions.keep_still());
        typing.is_over.store(true, Ordering::Relaxed);
        assert!(!questions.keep_still(), "nobody types any more");
        assert!(questions.lines(|_| "ask".to_owned())[0].ends_with("answer with `ratn answer - CHOICE`"));
        questions.follow(&line(r#"{"at":1,"command":"note","note":"finished","instance":1,"outcome":"success"}"#));
        assert!(!questions.keep_still() && questions.lines(|_| String::new()).is_empty());
    }

    #[test]
    fn one_word_is_the_answer_and_two_say_whose_question() {
        let of = |state: Option<&str>, choice: &str| {
            let state = state.map(str::to_owned);
            Some(Message::Answer { run: "run-1".to_owned(), state, choice: choice.to_owned() })
        };
        assert_eq!(answer("run-1", "  go "), of(None, "go"));
        assert_eq!(answer("run-1", "left/ask stop"), of(Some("left/ask"), "stop"));
        assert_eq!(answer("run-1", " "), None);
    }
}
