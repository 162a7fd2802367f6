//! A client's stream: many executes over one HTTP/2 stream.
//!
//! The stream of answers is what is polled: it takes questions from the connection, keeps those who listen to goals, and hands out
//! what they hear, all in the connection's task. Dropped, it drops the listeners, who leave as those of streams of their own do.
//! When the server drains, no more questions are taken; the results of what is under way are handed out, then the stream ends.

use super::ActionServer;
use super::service::Messages;
use crate::gate::{Draining, ending};
use crate::trace::{self, TraceContext};
use futures::stream::{AbortHandle, BoxStream, SelectAll, Stream, StreamExt, abortable, unfold};
use futures::{FutureExt, TryFutureExt};
use ratn_proto::convert::required;
use ratn_proto::types::Goal;
use ratn_proto::v1::execute_response::Kind as Heard;
use ratn_proto::v1::perform_request::Kind as Asked;
use ratn_proto::v1::perform_response::Kind;
use ratn_proto::v1::{CallFailure, ExecuteRequest, PerformRequest, PerformResponse};
use std::collections::BTreeMap;
use std::pin::Pin;
use std::task::{Context, Poll};
use tokio_util::sync::WaitForCancellationFutureOwned;
use tonic::{Status, Streaming};
use tracing::Instrument;

/// Executes under way of one stream; more are refused.
const MAX_EXECUTES: usize = 1_024;
/// Questions taken in before answers get their turn.
const AT_ONCE: usize = 64;

/// What is heard on one stream.
pub struct PerformStream {
    server: ActionServer,
    questions: Option<Streaming<PerformRequest>>,
    listening: SelectAll<BoxStream<'static, PerformResponse>>,
    /// What ends the listening of an execute.
    leave: BTreeMap<u64, AbortHandle>,
    draining: Option<Pin<Box<WaitForCancellationFutureOwned>>>,
}

impl PerformStream {
    pub(super) fn new(
        server: ActionServer,
        questions: Streaming<PerformRequest>,
        draining: Option<Draining>,
    ) -> PerformStream {
        PerformStream {
            server,
            questions: Some(questions),
            listening: SelectAll::new(),
            leave: BTreeMap::new(),
            draining: draining.map(|draining| Box::pin(draining.0.cancelled_owned())),
        }
    }

    fn take(&mut self, question: PerformRequest) -> Option<PerformResponse> {
        let id = question.id;
        let context = question.traceparent.parse::<TraceContext>().ok().map(TraceContext::child);
        match question.kind {
            Some(Asked::Leave(_)) => {
                if let Some(listening) = self.leave.remove(&id) {
                    listening.abort();
                }
                None
            }
            _ if self.leave.contains_key(&id) => {
                Some(failed(id, &Status::invalid_argument(format!("id: {id} is that of an execute under way"))))
            }
            _ if self.leave.len() >= MAX_EXECUTES => {
                let message = format!("{MAX_EXECUTES} executes are under way on this stream: no more at once");
                Some(failed(id, &Status::resource_exhausted(message)))
            }
            Some(Asked::Execute(execute)) => {
                let (heard, leave) = abortable(heard(self.server.clone(), id, execute, context));
                self.leave.insert(id, leave);
                self.listening.push(heard.boxed());
                None
            }
            None => Some(failed(id, &Status::invalid_argument("kind: is missing: set one of the questions"))),
        }
    }
}

impl Stream for PerformStream {
    type Item = Result<PerformResponse, Status>;

    fn poll_next(self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<Self::Item>> {
        let this = self.get_mut();
        if this.draining.as_mut().is_some_and(|draining| draining.poll_unpin(context).is_ready()) {
            (this.draining, this.questions) = (None, None);
            if this.leave.is_empty() {
                return Poll::Ready(Some(Err(ending())));
            }
        }
        for turn in 0..=AT_ONCE {
            let Some(questions) = &mut this.questions else { break };
            if turn == AT_ONCE {
                context.waker().wake_by_ref();
                break;
            }
            let asked = questions.poll_next_unpin(context);
            match asked {
                Poll::Ready(Some(Ok(question))) => {
                    if let Some(refused) = this.take(question) {
                        return Poll::Ready(Some(Ok(refused)));
                    }
                }
                // Nobody asks any more; who listens still does.
                Poll::Ready(None) => this.questions = None,
                // Nobody is there to hear anything.
                Poll::Ready(Some(Err(_))) => return Poll::Ready(None),
                Poll::Pending => break,
            }
        }
        match this.listening.poll_next_unpin(context) {
            Poll::Ready(Some(heard)) => {
                if !matches!(heard.kind, Some(Kind::Progress(_))) {
                    this.leave.remove(&heard.id);
                }
                Poll::Ready(Some(Ok(heard)))
            }
            Poll::Ready(None) if this.questions.is_none() => Poll::Ready(None),
            Poll::Ready(None) | Poll::Pending => Poll::Pending,
        }
    }
}

/// What is heard of one execute, its end as the last.
fn heard(
    server: ActionServer,
    id: u64,
    execute: ExecuteRequest,
    context: Option<TraceContext>,
) -> impl Stream<Item = PerformResponse> + Send + 'static {
    let admitted = async move {
        let goal: Goal = required(execute.goal, "goal")?;
        if execute.known_only { server.join(&goal.id) } else { server.admit(goal).await }
    };
    let admitted = match context {
        None => admitted.left_future(),
        Some(context) => trace::within(context, admitted).instrument(context.entered()).right_future(),
    };
    let admitted = admitted.map_ok_or_else(
        move |refused| futures::stream::once(async move { failed(id, &refused) }).left_stream(),
        move |messages| told(id, messages).right_stream(),
    );
    admitted.flatten_stream()
}

fn told(id: u64, messages: Messages) -> impl Stream<Item = PerformResponse> + Send + 'static {
    unfold(messages, move |mut messages| async move {
        loop {
            let kind = match messages.next().await? {
                // That it goes on is no news.
                Ok(Heard::Accepted(_)) => continue,
                Ok(Heard::Progress(progress)) => Kind::Progress(progress),
                Ok(Heard::Result(result)) => Kind::Result(result),
                Err(status) => return Some((failed(id, &status), messages)),
            };
            return Some((PerformResponse { id, kind: Some(kind) }, messages));
        }
    })
}

fn failed(id: u64, status: &Status) -> PerformResponse {
    let failure = CallFailure {
        code: status.code().into(),
        message: status.message().to_owned(),
        details: status.details().to_vec(),
    };
    PerformResponse { id, kind: Some(Kind::Failure(failure)) }
}

impl std::fmt::Debug for PerformStream {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("PerformStream").field("server", &self.server).field("under_way", &self.leave.len()).finish()
    }
}
