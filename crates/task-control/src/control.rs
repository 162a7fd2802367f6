//! The control socket of a run, a Unix socket `RUN.control` in the runtime directory of its system. `ratn control` pauses the run, resumes it, lets
//! one PIA begin, aborts it, and sets breakpoints; `ratn status` asks for its status; `ratn signal` and `ratn answer` send what its states wait for.
//! The protocol is a word or a [`Message`] (in JSON) per line, each answered by one line.

mod find;
mod service;

pub use find::{status, statuses};
pub use service::{ROLE, RunServer};

use super::progress::UnderWay;
use crate::messages::Messages;
use ratn_executive::protocol::{Awaited, Event, Mode};
use ratn_model::value::Value;
use ratn_proto::convert::{Malformed, label};
use ratn_proto::v1;
use serde::{Deserialize, Serialize};
use std::io::{Error, ErrorKind};
use std::path::{Path, PathBuf};
use std::time::Duration;
use tokio::io::{AsyncBufReadExt, AsyncReadExt, AsyncWriteExt, BufReader};
use tokio::net::unix::ReadHalf;
use tokio::net::{UnixListener, UnixStream};
use tokio::sync::{mpsc, oneshot};
use tokio::task::JoinSet;
use tokio_util::sync::{CancellationToken, DropGuard};

/// Maximum number of requests that the run has not received yet.
const MAX_PENDING: usize = 16;
/// Longer lines are not control words.
const MAX_LINE_BYTES: u64 = 64;
/// Longer lines are not messages.
const MAX_MESSAGE_BYTES: u64 = 64 << 10;
/// A connection whose request the run has not answered after this time is closed.
const ANSWER_DEADLINE: Duration = Duration::from_secs(5);
/// The client waits longer than the run's deadline: a request that was not answered by then is not performed later either.
const PATIENCE: Duration = Duration::from_secs(6);
/// A new connection has this long to send its line.
const LINE_DEADLINE: Duration = Duration::from_secs(1);
/// Maximum number of simultaneous connections; the next one waits until one of them ends or times out.
const MAX_CONNECTIONS: usize = 32;
const DONE: &str = "ok";
/// The word that requests the status of the run.
const STATUS: &str = "status";
/// Maximum size of a status.
const MAX_STATUS_BYTES: u64 = 4 << 20;

/// The status of a run.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RunStatus {
    /// The id of the run.
    pub run: String,
    /// The name of the task.
    pub task: String,
    /// The execution mode.
    pub mode: Mode,
    /// The event log.
    pub log: PathBuf,
    /// Time since the run began, in seconds of the robot's time.
    pub at_s: f64,
    /// Its share (weight) of resources that several runs compete for.
    #[serde(default = "usual_share")]
    pub share: f64,
    /// Wall time until its due date in seconds, if it has one; negative if overdue.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub due_in_s: Option<f64>,
    /// Whether the user has paused it.
    pub paused: bool,
    /// The number of states that have retired.
    pub ended: u64,
    /// The states under way, in the order in which they began.
    pub under_way: Vec<UnderWay>,
    /// Why states have not begun, one sentence each, up to a maximum number; in HSM mode only those that the operator holds back.
    #[serde(default)]
    pub waits: Vec<String>,
    /// The states that wait for something themselves, with what they wait for.
    #[serde(default)]
    pub awaits: Vec<Awaiting>,
    /// The breakpoints: paths of states without visits.
    #[serde(default)]
    pub breakpoints: Vec<String>,
}

fn usual_share() -> f64 {
    1.0
}

/// A state that waits for a time, a condition, a signal or an answer.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Awaiting {
    /// The path of the state with visits.
    pub path: String,
    /// What it waits for.
    #[serde(flatten)]
    pub awaited: Awaited,
    /// The end of the wait at the latest, in seconds of the robot's time since the run began.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub until_s: Option<f64>,
}

/// A message from a client to a run: something that its states wait for, or a breakpoint.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "message", rename_all = "snake_case", deny_unknown_fields)]
pub enum Message {
    /// A signal. It ends the wait of one state: of one that waits for a signal of this name, else of the next one that will.
    Signal {
        /// The run: its id, the name of its task, or [`ANY_RUN`].
        run: String,
        /// The name of the signal.
        signal: String,
        /// The value sent with it.
        value: Value,
    },
    /// An answer.
    Answer {
        /// The run: its id, the name of its task, or [`ANY_RUN`].
        run: String,
        /// The path of the asking state, with or without visits; required if several states ask.
        state: Option<String>,
        /// One of the question's choices.
        choice: String,
    },
    /// A breakpoint: the run is paused before a PIA of a state, or inside of it, begins.
    Breakpoint {
        /// The run: its id, the name of its task, or [`ANY_RUN`].
        run: String,
        /// The path of the state, with or without visits; `None` for all existing breakpoints.
        state: Option<String>,
        /// True to set the breakpoint, false to remove it.
        set: bool,
    },
}

impl Message {
    /// The run that the message is for.
    pub(crate) fn run(&self) -> &str {
        let (Message::Signal { run, .. } | Message::Answer { run, .. } | Message::Breakpoint { run, .. }) = self;
        run
    }

    /// Checks that the names and the value are within the limits for every client.
    fn checked(self) -> Result<Message, Malformed> {
        match &self {
            Message::Signal { run, signal, value } => {
                label(run, "run")?;
                label(signal, "signal")?;
                Value::try_from(v1::Value::from(value.clone()))?;
            }
            Message::Answer { run, state, choice } => {
                label(run, "run")?;
                label(state.as_deref().unwrap_or_default(), "state")?;
                label(choice, "choice")?;
            }
            Message::Breakpoint { run, state, .. } => {
                label(run, "run")?;
                label(state.as_deref().unwrap_or_default(), "state")?;
            }
        }
        Ok(self)
    }
}

/// Stands for the only run under way.
pub const ANY_RUN: &str = "-";

impl RunStatus {
    /// Maximum number of `waits`.
    pub(crate) const MOST_WAITS: usize = 256;
}

/// A request to a run.
#[derive(Debug)]
pub(crate) enum Asked {
    /// Control: an event for the executive.
    Told(Box<Event>),
    /// Asks for the status.
    Status(oneshot::Sender<RunStatus>),
    /// A message for a state. The reply is sent when the message is in the run's log; an error says why it is not accepted.
    Message(Message, oneshot::Sender<Result<String, String>>),
}

/// A control word.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Word {
    /// No further PIA begins; states under way go on.
    Pause,
    /// PIAs may begin again.
    Resume,
    /// One PIA begins, then the run pauses again.
    Step,
    /// The run ends: motions stop and hold, all leases are released.
    Abort,
}

impl Word {
    const ALL: [Word; 4] = [Word::Pause, Word::Resume, Word::Step, Word::Abort];

    fn text(self) -> &'static str {
        match self {
            Word::Pause => "pause",
            Word::Resume => "resume",
            Word::Step => "step",
            Word::Abort => "abort",
        }
    }

    fn event(self) -> Event {
        match self {
            Word::Pause => Event::PauseRequested,
            Word::Resume => Event::ResumeRequested,
            Word::Step => Event::StepRequested,
            Word::Abort => Event::AbortRequested { reason: "the user asked for it".into(), at_once: false },
        }
    }
}

/// Listens until it is dropped.
#[derive(Debug)]
pub(crate) struct Control {
    words: mpsc::Receiver<Asked>,
    path: PathBuf,
    _end: DropGuard,
}

impl Control {
    /// Listens in `directory` for the run with this id. An existing socket was left by the same run when it was killed, and is replaced.
    ///
    /// # Errors
    /// The socket cannot be created, for example because its path is too long.
    pub(crate) fn listen(directory: &Path, run: &str) -> std::io::Result<Control> {
        Control::listen_with(directory, run, ANSWER_DEADLINE)
    }

    /// A connection that is not answered before the deadline is closed.
    fn listen_with(directory: &Path, run: &str, deadline: Duration) -> std::io::Result<Control> {
        let path = find::socket(directory, run);
        match std::fs::remove_file(&path) {
            Err(error) if error.kind() != ErrorKind::NotFound => return Err(error),
            _ => {}
        }
        let listener = UnixListener::bind(&path)?;
        let (tell, words) = mpsc::channel(MAX_PENDING);
        let end = CancellationToken::new();
        // The path is published to clients in other working directories.
        let to = std::path::absolute(directory)?;
        let (server, until) = (RunServer::of(&to, run, tell.clone()), end.clone());
        tokio::spawn(async move {
            find::sweep(&to).await;
            if let Err(error) = server.serve(&to, until).await {
                tracing::warn!(%error, "clients cannot reach this run over gRPC");
            }
        });
        tokio::spawn(end.clone().run_until_cancelled_owned(accept(listener, tell, deadline)));
        Ok(Control { words, path, _end: end.drop_guard() })
    }

    /// Like [`Control::listen`]; if that is impossible, the run goes on without a control socket.
    pub(crate) fn listen_if_possible(directory: &Path, run: &str, messages: &Messages) -> Option<Control> {
        let listening = Control::listen(directory, run);
        if let Err(error) = &listening {
            let place = find::socket(directory, run);
            messages.say(format_args!("`ratn control` cannot reach this run: {}: {error}", place.display()));
        }
        listening.ok()
    }

    /// The next request to the run.
    pub(crate) async fn asked(&mut self) -> Asked {
        match self.words.recv().await {
            Some(event) => event,
            None => std::future::pending().await,
        }
    }
}

impl Drop for Control {
    fn drop(&mut self) {
        let _ = std::fs::remove_file(&self.path);
    }
}

async fn accept(listener: UnixListener, tell: mpsc::Sender<Asked>, deadline: Duration) {
    // A slow client keeps no other client waiting: its connection is closed at the deadline, and its request is then not performed.
    let mut connections = JoinSet::new();
    loop {
        tokio::select! {
            accepted = listener.accept(), if connections.len() < MAX_CONNECTIONS => {
                if let Ok((stream, _)) = accepted {
                    let tell = tell.clone();
                    connections.spawn(async move {
                        let _ = tokio::time::timeout(deadline, hear(stream, &tell)).await;
                    });
                }
            }
            Some(_) = connections.join_next() => {}
        }
    }
}

/// Reads the line that a client sends, as bytes: a limit may lie within a character.
async fn line_of(reader: ReadHalf<'_>) -> std::io::Result<Vec<u8>> {
    let mut line = Vec::new();
    let mut lines = BufReader::new(reader.take(MAX_LINE_BYTES));
    lines.read_until(b'\n', &mut line).await?;
    if line.starts_with(b"{") && !line.ends_with(b"\n") {
        lines.get_mut().set_limit(MAX_MESSAGE_BYTES - MAX_LINE_BYTES);
        lines.read_until(b'\n', &mut line).await?;
    }
    Ok(line)
}

async fn hear(mut stream: UnixStream, tell: &mpsc::Sender<Asked>) -> std::io::Result<()> {
    let (reader, mut writer) = stream.split();
    let line = tokio::time::timeout(LINE_DEADLINE, line_of(reader)).await.map_err(Error::other)??;
    // Bytes that are not UTF-8 are not a control word.
    let line = std::str::from_utf8(&line).unwrap_or_default();
    const BEHIND: &str = "the run is too far behind";
    let word = Word::ALL.into_iter().find(|word| word.text() == line.trim());
    let answer = match word {
        Some(word) if tell.try_send(Asked::Told(Box::new(word.event()))).is_ok() => DONE.to_owned(),
        Some(_) => BEHIND.to_owned(),
        None if line.trim() == STATUS => {
            let (say, said) = oneshot::channel();
            match tell.try_send(Asked::Status(say)) {
                Ok(()) => said.await.map_err(Error::other).and_then(|status| Ok(serde_json::to_string(&status)?))?,
                Err(_) => BEHIND.to_owned(),
            }
        }
        None if line.len() as u64 >= MAX_MESSAGE_BYTES => format!("that is longer than {MAX_MESSAGE_BYTES} bytes"),
        None if line.starts_with('{') => match read(line) {
            Ok(message) => {
                let (say, said) = oneshot::channel();
                match tell.try_send(Asked::Message(message, say)) {
                    Ok(()) => match said.await.map_err(Error::other)? {
                        Ok(said) => format!("{DONE} {}", one_line(&said)),
                        Err(why) => one_line(&why),
                    },
                    Err(_) => BEHIND.to_owned(),
                }
            }
            Err(why) => format!("that is no message: {}", one_line(&why)),
        },
        None => "expected pause, resume, step, abort or status".to_owned(),
    };
    writer.write_all(format!("{answer}\n").as_bytes()).await
}

fn read(line: &str) -> Result<Message, String> {
    let message: Message = serde_json::from_str(line).map_err(|error| error.to_string())?;
    message.checked().map_err(|malformed| malformed.to_string())
}

/// Sends a control word to a run of the system in `directory`: the run with this id or this task, or [`ANY_RUN`].
///
/// # Errors
/// No run listens, it is unclear which run is meant, or the run rejects the word.
pub async fn tell(directory: &Path, run: &str, word: Word) -> std::io::Result<()> {
    match say(&find::meant(directory, run).await?, word.text(), MAX_LINE_BYTES).await?.as_str() {
        DONE => Ok(()),
        other => Err(Error::other(other.to_owned())),
    }
}

fn one_line(text: &str) -> String {
    text.replace(['\n', '\r'], " ")
}

/// Sends a message to its run, of the system in `directory`, and returns what the run does with it. The message is in the run's log on disk when this
/// returns. After an error in transit the run may have received the message; the error says so.
///
/// # Errors
/// No run listens, it is unclear which run is meant, or the run rejects the message.
pub async fn send(directory: &Path, message: &Message) -> std::io::Result<String> {
    let line = serde_json::to_string(message)?;
    if line.len() as u64 >= MAX_MESSAGE_BYTES {
        return Err(Error::new(ErrorKind::InvalidInput, format!("it has more than {MAX_MESSAGE_BYTES} bytes")));
    }
    let socket = find::meant(directory, message.run()).await?;
    let answer = say(&socket, &line, MAX_MESSAGE_BYTES).await.map_err(|error| {
        if is_uncertain(&error) {
            let why = "the run did not answer, and it is not known whether it got that: `ratn status` and its log tell";
            return Error::new(error.kind(), why);
        }
        error
    })?;
    match answer.strip_prefix(DONE) {
        Some(said) => Ok(said.trim().to_owned()),
        None => Err(Error::other(answer)),
    }
}

/// Whether an error says that no run listens.
pub fn is_nobody(error: &Error) -> bool {
    matches!(error.kind(), ErrorKind::NotFound | ErrorKind::ConnectionRefused)
}

/// Whether an error says that a run was reached and did not answer: it may have got what was sent.
pub fn is_uncertain(error: &Error) -> bool {
    use ErrorKind::{BrokenPipe, ConnectionReset, TimedOut, UnexpectedEof};
    matches!(error.kind(), TimedOut | UnexpectedEof | ConnectionReset | BrokenPipe)
}

/// Sends a line to the socket of a run and reads the answer, one line.
async fn say(socket: &Path, word: &str, most: u64) -> std::io::Result<String> {
    let asking = async {
        let mut stream = UnixStream::connect(socket).await?;
        stream.write_all(format!("{word}\n").as_bytes()).await?;
        let mut answer = String::new();
        BufReader::new(stream.take(most)).read_line(&mut answer).await?;
        match answer.trim() {
            "" => Err(Error::new(ErrorKind::UnexpectedEof, "it has just ended")),
            answer => Ok(answer.to_owned()),
        }
    };
    tokio::time::timeout(PATIENCE, asking).await.unwrap_or_else(|_| Err(ErrorKind::TimedOut.into()))
}

#[cfg(test)]
mod tests {
    use super::*;

    const RUN: &str = "run-1";

    #[tokio::test]
    async fn words_arrive_as_events_in_order() -> anyhow::Result<()> {
        let place = tempfile::tempdir()?;
        // Left by a run that was killed.
        std::fs::write(find::socket(place.path(), RUN), "")?;
        let mut control = Control::listen(place.path(), RUN)?;
        for word in [Word::Pause, Word::Step] {
            tell(place.path(), ANY_RUN, word).await?;
        }
        for expected in [Event::PauseRequested, Event::StepRequested] {
            assert!(matches!(control.asked().await, Asked::Told(event) if *event == expected));
        }
        drop(control);
        assert!(tell(place.path(), ANY_RUN, Word::Resume).await.is_err());
        Ok(())
    }

    #[tokio::test]
    async fn a_run_says_what_it_is_doing_and_where_none_listens_there_is_none() -> anyhow::Result<()> {
        let place = tempfile::tempdir()?;
        assert_eq!(status(place.path(), ANY_RUN).await?, None);
        let mut control = Control::listen(place.path(), RUN)?;
        let doing = RunStatus {
            run: RUN.to_owned(),
            task: "sort".to_owned(),
            mode: Mode::Cdtn,
            log: PathBuf::from("log.jsonl"),
            at_s: 3.5,
            share: 2.0,
            due_in_s: Some(90.5),
            paused: true,
            ended: 2,
            under_way: vec![UnderWay {
                path: "place[2]/plan".to_owned(),
                for_s: 1.5,
                usually_s: Some(4.0),
                message: "2 of 5 ways".to_owned(),
            }],
            waits: vec!["move waits for an output of place[2]/plan".to_owned()],
            awaits: vec![Awaiting {
                path: "wait_for_lid".to_owned(),
                awaited: Awaited::Signal { signal: "lid".to_owned() },
                until_s: Some(20.0),
            }],
            breakpoints: vec!["place/move".to_owned()],
        };
        let said = doing.clone();
        let answering = tokio::spawn(async move {
            if let Asked::Status(say) = control.asked().await {
                let _ = say.send(said);
            }
        });
        assert_eq!(status(place.path(), ANY_RUN).await?, Some(doing));
        answering.await?;
        // The socket of a killed run.
        std::fs::write(find::socket(place.path(), RUN), "")?;
        assert_eq!(status(place.path(), ANY_RUN).await?, None);
        Ok(())
    }

    #[tokio::test]
    async fn a_message_is_answered_with_what_became_of_it() -> anyhow::Result<()> {
        let place = tempfile::tempdir()?;
        let mut control = Control::listen(place.path(), RUN)?;
        let signal = |name: &str, value| Message::Signal { run: ANY_RUN.to_owned(), signal: name.to_owned(), value };
        let long = signal("go", Value::String("x".repeat(10_000)));
        let expected = long.clone();
        let answering = tokio::spawn(async move {
            for said in [Ok("it goes\non".to_owned()), Err("no state waits for that".to_owned())] {
                let Asked::Message(message, say) = control.asked().await else { break };
                assert!(said.is_err() || message == expected);
                let _ = say.send(said);
            }
            control
        });
        assert_eq!(send(place.path(), &long).await?, "it goes on");
        let refused = send(place.path(), &signal("stop", Value::Null)).await;
        assert_eq!(refused.map_err(|error| error.to_string()), Err("no state waits for that".to_owned()));
        let huge = send(place.path(), &signal("go", Value::String("x".repeat(70_000)))).await;
        assert!(huge.is_err_and(|error| error.kind() == ErrorKind::InvalidInput));
        drop(answering.await?);
        Ok(())
    }

    #[tokio::test]
    async fn what_no_client_may_send_is_refused_and_not_told() -> anyhow::Result<()> {
        let place = tempfile::tempdir()?;
        let mut control = Control::listen(place.path(), RUN)?;
        let signal = |name: &str, value| Message::Signal { run: ANY_RUN.to_owned(), signal: name.to_owned(), value };
        let deep = (0..17).fold(Value::Null, |value, _| Value::List(vec![value].into()));
        for (message, why) in [
            (signal("go", deep), "nest deeper than 16"),
            (signal("a\u{7}b", Value::Null), "holds control characters"),
            (signal(&"x".repeat(60_000), Value::Null), "has 60000 bytes"),
        ] {
            let Err(refused) = send(place.path(), &message).await else { anyhow::bail!("it was taken") };
            assert!(refused.to_string().contains(why), "{refused}");
        }
        assert!(control.words.try_recv().is_err());
        Ok(())
    }

    #[tokio::test]
    async fn a_message_arrives_whatever_characters_it_has() -> anyhow::Result<()> {
        let place = tempfile::tempdir()?;
        let mut control = Control::listen(place.path(), RUN)?;
        // The first limit falls on each byte of a character.
        for before in 0..8 {
            let value = Value::String("x".repeat(before) + &"\u{1f916}\u{fc}".repeat(30));
            let message = Message::Signal { run: ANY_RUN.to_owned(), signal: "go".to_owned(), value };
            let sending = send(place.path(), &message);
            let answering = async {
                if let Asked::Message(heard, say) = control.asked().await {
                    assert_eq!(heard, message);
                    let _ = say.send(Ok(String::new()));
                }
            };
            let (sent, ()) = tokio::join!(sending, answering);
            sent?;
        }
        Ok(())
    }

    #[tokio::test]
    async fn a_silent_connection_and_one_that_is_not_answered_keep_nobody_waiting() -> anyhow::Result<()> {
        let place = tempfile::tempdir()?;
        let mut control = Control::listen(place.path(), RUN)?;
        let _silent = UnixStream::connect(find::socket(place.path(), RUN)).await?;
        let message = Message::Signal { run: ANY_RUN.to_owned(), signal: "go".to_owned(), value: Value::Null };
        let mut unanswered = UnixStream::connect(find::socket(place.path(), RUN)).await?;
        unanswered.write_all(format!("{}\n", serde_json::to_string(&message)?).as_bytes()).await?;
        let Asked::Message(_, _unsaid) = control.asked().await else { anyhow::bail!("no message") };
        tokio::time::timeout(Duration::from_millis(500), tell(place.path(), ANY_RUN, Word::Abort)).await??;
        assert!(matches!(control.asked().await, Asked::Told(event) if matches!(*event, Event::AbortRequested { .. })));
        Ok(())
    }

    #[tokio::test]
    async fn who_got_no_answer_is_told_that_it_is_not_known_whether_the_message_came() -> anyhow::Result<()> {
        let place = tempfile::tempdir()?;
        let mut control = Control::listen_with(place.path(), RUN, Duration::from_millis(200))?;
        let message = Message::Signal { run: ANY_RUN.to_owned(), signal: "go".to_owned(), value: Value::Null };
        let Err(error) = send(place.path(), &message).await else { anyhow::bail!("nobody answered") };
        assert!(error.to_string().contains("not known whether"), "{error}");
        // The request is still queued; the run sees that its client no longer waits.
        assert!(matches!(control.asked().await, Asked::Message(_, say) if say.is_closed()));
        Ok(())
    }

    #[tokio::test]
    async fn what_is_no_word_is_answered_and_not_told() -> anyhow::Result<()> {
        let place = tempfile::tempdir()?;
        let mut control = Control::listen(place.path(), RUN)?;
        for nonsense in ["fly\n".to_owned(), "x".repeat(1000)] {
            let mut stream = UnixStream::connect(find::socket(place.path(), RUN)).await?;
            let _ = stream.write_all(nonsense.as_bytes()).await;
            let mut answer = String::new();
            let _ = stream.read_to_string(&mut answer).await;
            assert!(control.words.try_recv().is_err());
        }
        tell(place.path(), ANY_RUN, Word::Abort).await?;
        assert!(matches!(control.asked().await, Asked::Told(event) if matches!(*event, Event::AbortRequested { .. })));
        Ok(())
    }
}
