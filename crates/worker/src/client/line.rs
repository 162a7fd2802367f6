//! A session's stream as its client has it: the calls of all tasks share one HTTP/2 stream, which saves each the cost of one of its own.
//!
//! ```text
//! ask ─ question ─▶ stream ─▶ manager
//!  ▲                            │
//!  └─ by its id ◀─ reader ◀─ answer
//! ```
//!
//! Opened with the first call, and again with the first one after it broke; the calls that were under way then fail as calls of
//! their own would. One that is dropped is withdrawn.

use crate::trace::{self, Traced};
use ratn_proto::v1::resource_service_client::ResourceServiceClient;
use ratn_proto::v1::session_request::Kind as Asked;
use ratn_proto::v1::session_response::Kind as Answered;
use ratn_proto::v1::{SessionRequest, SessionResponse, WithdrawRequest};
use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use tokio::sync::{mpsc, oneshot};
use tokio_stream::wrappers::ReceiverStream;
use tonic::{Code, Status, Streaming};

/// Questions that wait for the connection; more make their askers wait.
const OUTGOING: usize = 1_024;

/// A stream that is opened when it is needed.
#[derive(Debug, Clone, Default)]
pub(super) struct Line {
    open: Arc<tokio::sync::Mutex<Option<Open>>>,
}

/// An open stream.
#[derive(Debug, Clone)]
struct Open {
    questions: mpsc::Sender<SessionRequest>,
    calls: Arc<Mutex<Calls>>,
}

/// The calls under way.
#[derive(Debug, Default)]
struct Calls {
    last: u64,
    waiting: BTreeMap<u64, oneshot::Sender<Result<Answered, Status>>>,
    /// Why no answer will come any more.
    broken: Option<Status>,
}

impl Line {
    /// Asks over the stream, which `client` opens if there is none.
    pub(super) async fn ask(
        &self,
        client: &ResourceServiceClient<Traced>,
        question: Asked,
    ) -> Result<Answered, Status> {
        self.open(client).await?.ask(question).await
    }

    async fn open(&self, client: &ResourceServiceClient<Traced>) -> Result<Open, Status> {
        let mut open = self.open.lock().await;
        if let Some(open) = open.as_ref().filter(|open| open.calls().broken.is_none()) {
            return Ok(open.clone());
        }
        let (questions, outgoing) = mpsc::channel(OUTGOING);
        let answers = client.clone().session(ReceiverStream::new(outgoing)).await?.into_inner();
        let calls = Arc::default();
        tokio::spawn(read(answers, Arc::clone(&calls)));
        Ok(open.insert(Open { questions, calls }).clone())
    }
}

impl Open {
    async fn ask(&self, question: Asked) -> Result<Answered, Status> {
        let undo = undoing(&question);
        let (id, answered) = self.calls().begin()?;
        let mut call = Call { line: self, id, undo };
        let traceparent = trace::current().map_or_else(String::new, |context| context.child().to_string());
        if self.questions.send(SessionRequest { id, kind: Some(question), traceparent }).await.is_err() {
            call.undo = None;
        }
        let answer = answered.await;
        call.undo = None;
        answer.unwrap_or_else(|_| Err(closed()))
    }

    fn calls(&self) -> MutexGuard<'_, Calls> {
        self.calls.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Calls {
    fn begin(&mut self) -> Result<(u64, oneshot::Receiver<Result<Answered, Status>>), Status> {
        if let Some(broken) = &self.broken {
            return Err(broken.clone());
        }
        let (answer, answered) = oneshot::channel();
        self.last += 1;
        self.waiting.insert(self.last, answer);
        Ok((self.last, answered))
    }
}

/// One call under way.
struct Call<'a> {
    line: &'a Open,
    id: u64,
    /// What undoes it, while it has no answer.
    undo: Option<WithdrawRequest>,
}

impl Drop for Call<'_> {
    fn drop(&mut self) {
        self.line.calls().waiting.remove(&self.id);
        let Some(undo) = self.undo.take() else { return };
        // Nobody waits for its answer.
        let undo = SessionRequest { kind: Some(Asked::Withdraw(undo)), ..SessionRequest::default() };
        if let Err(mpsc::error::TrySendError::Full(undo)) = self.line.questions.try_send(undo) {
            let questions = self.line.questions.clone();
            tokio::spawn(async move { questions.send(undo).await });
        }
    }
}

/// Only what waits in a queue is undone when nobody waits for it any more.
fn undoing(question: &Asked) -> Option<WithdrawRequest> {
    let (request_id, session_id) = match question {
        Asked::Block(block) => (&block.request_id, &block.session_id),
        Asked::Acquire(acquire) => (&acquire.request_id, &acquire.session_id),
        Asked::KeepAlive(_) | Asked::Release(_) | Asked::Withdraw(_) => return None,
    };
    Some(WithdrawRequest { request_id: request_id.clone(), session_id: session_id.clone() })
}

/// Hands out the answers until there are no more.
async fn read(mut answers: Streaming<SessionResponse>, calls: Arc<Mutex<Calls>>) {
    let broken = loop {
        match answers.message().await {
            Ok(Some(SessionResponse { id, kind })) => {
                let Some(call) = calls.lock().unwrap_or_else(PoisonError::into_inner).waiting.remove(&id) else {
                    continue;
                };
                // Dropped in this moment otherwise.
                let _ = call.send(match kind {
                    Some(Answered::Failure(failure)) => {
                        let code = Code::from(failure.code);
                        Err(Status::with_details(code, failure.message, failure.details.into()))
                    }
                    Some(answer) => Ok(answer),
                    None => Err(Status::internal("an answer without a kind")),
                });
            }
            Ok(None) => break closed(),
            Err(status) => break status,
        }
    };
    let mut calls = calls.lock().unwrap_or_else(PoisonError::into_inner);
    calls.broken = Some(broken.clone());
    for (_, call) in std::mem::take(&mut calls.waiting) {
        let _ = call.send(Err(broken.clone()));
    }
}

fn closed() -> Status {
    Status::unavailable("the session's stream was closed")
}
