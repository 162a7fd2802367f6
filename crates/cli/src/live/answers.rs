//! What an operator is asked while a run is painted on a terminal, and what he types there.

use crate::output;
use nix::errno::Errno;
use nix::sys::signal::{SigSet, Signal};
use ratn_executive::protocol::{Awaited, Command, LogEntry, LogLine, Note};
use ratn_model::id::InstanceId;
use ratn_task_control::control::{self, ANY_RUN, Message};
use std::collections::BTreeMap;
use std::io::BufRead;
use std::path::Path;
use std::time::Duration;

/// A run in the background of its shell reads nothing; so often it is looked whether it is in the foreground again.
const IN_BACKGROUND: Duration = Duration::from_secs(1);

/// The questions that are open.
#[derive(Debug, Default)]
pub(super) struct Questions {
    open: BTreeMap<InstanceId, (String, Vec<String>)>,
    can_answer: bool,
    has_changed: bool,
}

impl Questions {
    pub(super) fn new(can_answer: bool) -> Questions {
        Questions { can_answer, ..Questions::default() }
    }

    /// A line of the log.
    pub(super) fn follow(&mut self, line: &LogLine) {
        let LogEntry::Command(Command::Note(note)) = &line.entry else { return };
        match note {
            Note::Awaiting { instance, awaited: Awaited::Answer { question, choices, .. }, .. } => {
                self.open.insert(*instance, (question.clone(), choices.clone()));
                self.has_changed = true;
            }
            Note::Finished { instance, .. } | Note::Squashed { instance } => {
                self.has_changed |= self.open.remove(instance).is_some();
            }
            _ => {}
        }
    }

    /// Whether what is painted stays as it is: somebody may be typing.
    pub(super) fn keep_still(&mut self) -> bool {
        self.can_answer && !self.open.is_empty() && !std::mem::take(&mut self.has_changed)
    }

    /// The questions, one line each.
    pub(super) fn lines(&self, path: impl Fn(InstanceId) -> String) -> Vec<String> {
        let how = match (self.can_answer, self.open.len()) {
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

/// Sends what is typed to the run of the system in `directory`, as long as this process lives; whether anybody listens.
pub(super) fn listen(directory: &Path) -> bool {
    let directory = directory.to_owned();
    let listening = move || {
        // Whoever reads a terminal from the background is stopped by this signal, with all its threads; with it blocked, reading fails.
        if SigSet::from(Signal::SIGTTIN).thread_block().is_err() {
            return;
        }
        let Ok(runtime) = tokio::runtime::Builder::new_current_thread().enable_all().build() else { return };
        while let Some(line) = typed() {
            // The line is on the terminal, below what is painted.
            output::area_was_pushed();
            let Some(message) = answer(&line) else { continue };
            match runtime.block_on(control::send(&directory, &message)) {
                Ok(said) => output::progress(said),
                Err(error) => output::progress(format_args!("not taken: {error}")),
            }
        }
    };
    std::thread::Builder::new().name("answers".to_owned()).spawn(listening).is_ok()
}

/// The next line; `None` when there will be no other.
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

/// `go`, or `STATE go`.
fn answer(line: &str) -> Option<Message> {
    let mut words = line.split_whitespace();
    let (first, second) = (words.next()?, words.next());
    let (state, choice) = match second {
        Some(choice) => (Some(first.to_owned()), choice),
        None => (None, first),
    };
    Some(Message::Answer { run: ANY_RUN.to_owned(), state, choice: choice.to_owned() })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn line(text: &str) -> LogLine {
        serde_json::from_str(text).expect("a line of a log")
    }

    #[test]
    fn a_question_is_shown_until_it_is_answered_and_nothing_is_painted_over_who_types() {
        let mut questions = Questions::new(true);
        assert!(!questions.keep_still());
        let asks = r#"{"at":0,"command":"note","note":"awaiting","instance":1,"awaits":"answer","question":"Go on?","choices":["go","stop"]}"#;
        questions.follow(&line(asks));
        assert!(!questions.keep_still(), "the question itself is painted");
        assert!(questions.keep_still());
        assert_eq!(questions.lines(|_| "ask".to_owned()), ["  asks   ask: Go on? (go, stop): type the answer"]);
        questions.follow(&line(r#"{"at":1,"command":"note","note":"finished","instance":1,"outcome":"success"}"#));
        assert!(!questions.keep_still() && questions.lines(|_| String::new()).is_empty());
    }

    #[test]
    fn one_word_is_the_answer_and_two_say_whose_question() {
        let of = |state: Option<&str>, choice: &str| {
            let state = state.map(str::to_owned);
            Some(Message::Answer { run: ANY_RUN.to_owned(), state, choice: choice.to_owned() })
        };
        assert_eq!(answer("  go "), of(None, "go"));
        assert_eq!(answer("left/ask stop"), of(Some("left/ask"), "stop"));
        assert_eq!(answer(" "), None);
    }
}
