//! A run's ear: a Unix socket in the runtime directory of its system, over which `ratn control` pauses it, lets it go on, lets
//! one PIA begin, or ends it. One word per line; each is answered by one line.

use crate::output;
use ratn_executive::protocol::Event;
use std::io::{Error, ErrorKind};
use std::path::{Path, PathBuf};
use std::time::Duration;
use tokio::io::{AsyncBufReadExt, AsyncReadExt, AsyncWriteExt, BufReader};
use tokio::net::{UnixListener, UnixStream};
use tokio::sync::mpsc;
use tokio_util::sync::{CancellationToken, DropGuard};

/// In a system's runtime directory: where its run listens.
const SOCKET: &str = "run.control";
/// Words that the run has not been told yet.
const MAX_PENDING: usize = 16;
/// Longer lines are no words of control.
const MAX_LINE_BYTES: u64 = 64;
/// A run that does not answer for so long does not listen.
const ANSWER_DEADLINE: Duration = Duration::from_secs(5);
const DONE: &str = "ok";

/// What a run can be told.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub(crate) enum Word {
    /// No further PIA begins; what runs goes on
    Pause,
    /// PIAs may begin again
    Resume,
    /// One PIA begins, then it is a pause again
    Step,
    /// The run ends: motions stop and hold, everything is given back
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
            Word::Abort => Event::AbortRequested { reason: "the user asked for it".into() },
        }
    }
}

/// Listens until dropped.
#[derive(Debug)]
pub(crate) struct Control {
    words: mpsc::Receiver<Event>,
    path: PathBuf,
    _end: DropGuard,
}

impl Control {
    /// Listens in `directory`. A socket that is there already is one of a run that was killed: a system has one run at a time.
    ///
    /// # Errors
    /// Where the socket cannot be made, for example because its path is too long for one.
    pub(crate) fn listen(directory: &Path) -> std::io::Result<Control> {
        let path = directory.join(SOCKET);
        match std::fs::remove_file(&path) {
            Err(error) if error.kind() != ErrorKind::NotFound => return Err(error),
            _ => {}
        }
        let listener = UnixListener::bind(&path)?;
        let (tell, words) = mpsc::channel(MAX_PENDING);
        let end = CancellationToken::new();
        tokio::spawn(end.clone().run_until_cancelled_owned(accept(listener, tell)));
        Ok(Control { words, path, _end: end.drop_guard() })
    }

    /// As [`Control::listen`]; a run goes on without it where it cannot be.
    pub(crate) fn listen_if_possible(directory: &Path) -> Option<Control> {
        let listening = Control::listen(directory);
        if let Err(error) = &listening {
            let place = directory.join(SOCKET);
            output::progress(format_args!("`ratn control` cannot reach this run: {}: {error}", place.display()));
        }
        listening.ok()
    }

    /// What the run is told next.
    pub(crate) async fn told(&mut self) -> Event {
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

async fn accept(listener: UnixListener, tell: mpsc::Sender<Event>) {
    loop {
        // One after the other: whoever is slow is given up after a while.
        if let Ok((stream, _)) = listener.accept().await {
            let _ = tokio::time::timeout(ANSWER_DEADLINE, hear(stream, &tell)).await;
        }
    }
}

async fn hear(mut stream: UnixStream, tell: &mpsc::Sender<Event>) -> std::io::Result<()> {
    let (reader, mut writer) = stream.split();
    let mut line = String::new();
    BufReader::new(reader.take(MAX_LINE_BYTES)).read_line(&mut line).await?;
    let word = Word::ALL.into_iter().find(|word| word.text() == line.trim());
    let answer = match word {
        Some(word) if tell.try_send(word.event()).is_ok() => DONE,
        Some(_) => "the run is too far behind",
        None => "expected pause, resume, step or abort",
    };
    writer.write_all(format!("{answer}\n").as_bytes()).await
}

/// Tells the run of the system in `directory`.
///
/// # Errors
/// Where no run listens, or it does not take the word.
pub(crate) async fn tell(directory: &Path, word: Word) -> std::io::Result<()> {
    let asking = async {
        let mut stream = UnixStream::connect(directory.join(SOCKET)).await?;
        stream.write_all(format!("{}\n", word.text()).as_bytes()).await?;
        let mut answer = String::new();
        BufReader::new(stream.take(MAX_LINE_BYTES)).read_line(&mut answer).await?;
        match answer.trim() {
            DONE => Ok(()),
            "" => Err(Error::new(ErrorKind::UnexpectedEof, "it has just ended")),
            other => Err(Error::other(other.to_owned())),
        }
    };
    tokio::time::timeout(ANSWER_DEADLINE, asking).await.unwrap_or_else(|_| Err(ErrorKind::TimedOut.into()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn words_arrive_as_events_in_order() -> anyhow::Result<()> {
        let place = tempfile::tempdir()?;
        // One of a run that was killed.
        std::fs::write(place.path().join(SOCKET), "")?;
        let mut control = Control::listen(place.path())?;
        for word in [Word::Pause, Word::Step] {
            tell(place.path(), word).await?;
        }
        assert_eq!((control.told().await, control.told().await), (Event::PauseRequested, Event::StepRequested));
        drop(control);
        assert!(tell(place.path(), Word::Resume).await.is_err());
        Ok(())
    }

    #[tokio::test]
    async fn what_is_no_word_is_answered_and_not_told() -> anyhow::Result<()> {
        let place = tempfile::tempdir()?;
        let mut control = Control::listen(place.path())?;
        for nonsense in ["fly\n".to_owned(), "x".repeat(1000)] {
            let mut stream = UnixStream::connect(place.path().join(SOCKET)).await?;
            let _ = stream.write_all(nonsense.as_bytes()).await;
            let mut answer = String::new();
            let _ = stream.read_to_string(&mut answer).await;
            assert!(control.words.try_recv().is_err());
        }
        tell(place.path(), Word::Abort).await?;
        assert!(matches!(control.told().await, Event::AbortRequested { .. }));
        Ok(())
    }
}
