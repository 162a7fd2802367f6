//! The streams of goals as their client has them: all goals that are given to one provider share one HTTP/2 stream, which saves each
//! the cost of one of its own.
//!
//! ```text
//! execute ─ question ─▶ stream ─▶ provider
//!    ▲                               │
//!    └─ by its id ◀─ reader ◀─ progress, result
//! ```
//! Opened with the first goal, and again with the first one after it broke; who listened then hears that, as from a stream of one's
//! own. Who does not listen any more says so.

use super::{CallError, Channels};
use crate::endpoint::Endpoint;
use crate::trace;
use ratn_proto::MAX_MESSAGE_BYTES;
use ratn_proto::v1::action_service_client::ActionServiceClient;
use ratn_proto::v1::perform_request::Kind as Asked;
use ratn_proto::v1::perform_response::Kind as Heard;
use ratn_proto::v1::{ExecuteRequest, GoalProgress, GoalResult, LeaveRequest, PerformRequest, PerformResponse};
use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use tokio::sync::{mpsc, oneshot};
use tokio_stream::wrappers::ReceiverStream;
use tonic::{Code, Status, Streaming};

/// Questions that wait for the connection; more make their askers wait.
const OUTGOING: usize = 256;
/// Who falls further behind misses progress.
const PROGRESS: usize = 64;
/// So many streams are kept; beyond it those that are not used are forgotten.
const MAX_LINES: usize = 256;

/// One stream for each provider.
#[derive(Debug, Clone, Default)]
pub(super) struct Goals {
    lines: Arc<Mutex<BTreeMap<Endpoint, Line>>>,
}

/// A stream that is opened when it is needed.
type Line = Arc<tokio::sync::Mutex<Option<Open>>>;

/// An open stream.
#[derive(Debug, Clone)]
struct Open {
    questions: mpsc::Sender<PerformRequest>,
    listening: Arc<Mutex<Listening>>,
}

/// Who listens.
#[derive(Debug, Default)]
struct Listening {
    last: u64,
    by_id: BTreeMap<u64, Listener>,
    /// Why nothing will be heard any more.
    broken: Option<Status>,
}

#[derive(Debug)]
struct Listener {
    progress: mpsc::Sender<GoalProgress>,
    end: oneshot::Sender<Result<GoalResult, Status>>,
}

impl Goals {
    /// Gives a goal, or joins it, and listens to its end.
    pub(super) async fn execute(
        &self,
        channels: &Channels,
        endpoint: &Endpoint,
        question: ExecuteRequest,
        on_progress: impl FnMut(GoalProgress),
    ) -> Result<GoalResult, CallError> {
        let open = self.open(channels, endpoint).await?;
        let ended = open.execute(question, on_progress).await;
        ended.map_err(|status| CallError::from_status(endpoint, &status))
    }

    async fn open(&self, channels: &Channels, endpoint: &Endpoint) -> Result<Open, CallError> {
        let line = self.line(endpoint);
        let mut open = line.lock().await;
        if let Some(open) = open.as_ref().filter(|open| open.listening().broken.is_none()) {
            return Ok(open.clone());
        }
        let mut client = ActionServiceClient::new(channels.get(endpoint)?)
            .max_decoding_message_size(MAX_MESSAGE_BYTES)
            .max_encoding_message_size(MAX_MESSAGE_BYTES);
        let (questions, outgoing) = mpsc::channel(OUTGOING);
        let heard = client.perform(ReceiverStream::new(outgoing)).await;
        let heard = heard.map_err(|status| CallError::from_status(endpoint, &status))?.into_inner();
        let listening = Arc::default();
        tokio::spawn(read(heard, Arc::clone(&listening)));
        Ok(open.insert(Open { questions, listening }).clone())
    }

    fn line(&self, endpoint: &Endpoint) -> Line {
        let mut lines = self.lines.lock().unwrap_or_else(PoisonError::into_inner);
        if lines.len() >= MAX_LINES {
            // One that is being opened is locked.
            lines.retain(|_, line| line.try_lock().map_or(true, |open| open.as_ref().is_some_and(Open::is_used)));
        }
        Arc::clone(lines.entry(endpoint.clone()).or_default())
    }
}

impl Open {
    async fn execute(
        &self,
        question: ExecuteRequest,
        mut on_progress: impl FnMut(GoalProgress),
    ) -> Result<GoalResult, Status> {
        let (tell, mut progress) = mpsc::channel(PROGRESS);
        let (end, ended) = oneshot::channel();
        let id = self.listening().begin(Listener { progress: tell, end })?;
        let mut call = Call { line: self, id, under_way: true };
        let traceparent = trace::current().map_or_else(String::new, |context| context.child().to_string());
        let question = PerformRequest { id, kind: Some(Asked::Execute(question)), traceparent };
        // Where that fails the stream has broken, and `ended` says why.
        let _ = self.questions.send(question).await;
        let heard = async {
            while let Some(said) = progress.recv().await {
                on_progress(said)
            }
        };
        // Whoever tells of the end has let go of the progress before.
        let (ended, ()) = tokio::join!(ended, heard);
        call.under_way = false;
        ended.unwrap_or_else(|_| Err(closed()))
    }

    fn is_used(&self) -> bool {
        let listening = self.listening();
        listening.broken.is_none() && !listening.by_id.is_empty()
    }

    fn listening(&self) -> MutexGuard<'_, Listening> {
        self.listening.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Listening {
    fn begin(&mut self, listener: Listener) -> Result<u64, Status> {
        if let Some(broken) = &self.broken {
            return Err(broken.clone());
        }
        self.last += 1;
        self.by_id.insert(self.last, listener);
        Ok(self.last)
    }

    fn hear(&mut self, PerformResponse { id, kind }: PerformResponse) {
        let ended = match kind {
            Some(Heard::Progress(progress)) => {
                if let Some(listener) = self.by_id.get(&id) {
                    // Progress is for people; who has much to read misses some.
                    let _ = listener.progress.try_send(progress);
                }
                return;
            }
            Some(Heard::Result(result)) => Ok(result),
            Some(Heard::Failure(failure)) => {
                let code = Code::from(failure.code);
                Err(Status::with_details(code, failure.message, failure.details.into()))
            }
            None => Err(Status::internal("what became of a goal has no kind")),
        };
        if let Some(listener) = self.by_id.remove(&id) {
            // Nobody listens any more otherwise.
            let _ = listener.end.send(ended);
        }
    }
}

/// One execute under way.
struct Call<'a> {
    line: &'a Open,
    id: u64,
    under_way: bool,
}

impl Drop for Call<'_> {
    fn drop(&mut self) {
        let left = self.line.listening().by_id.remove(&self.id).is_some();
        if !left || !self.under_way {
            return;
        }
        let leave = PerformRequest { id: self.id, kind: Some(Asked::Leave(LeaveRequest {})), ..Default::default() };
        if let Err(mpsc::error::TrySendError::Full(leave)) = self.line.questions.try_send(leave) {
            let questions = self.line.questions.clone();
            tokio::spawn(async move { questions.send(leave).await });
        }
    }
}

/// Hands out what is heard until there is no more.
async fn read(mut heard: Streaming<PerformResponse>, listening: Arc<Mutex<Listening>>) {
    let lock = || listening.lock().unwrap_or_else(PoisonError::into_inner);
    let broken = loop {
        match heard.message().await {
            Ok(Some(response)) => lock().hear(response),
            Ok(None) => break closed(),
            Err(status) => break status,
        }
    };
    let mut listening = lock();
    for (_, listener) in std::mem::take(&mut listening.by_id) {
        let _ = listener.end.send(Err(broken.clone()));
    }
    listening.broken = Some(broken);
}

fn closed() -> Status {
    Status::unavailable("the stream of goals was closed")
}
