//! The gRPC adapter of [`ActionServer`].

use super::ActionServer;
use super::goal::{Ending, Fingerprint, GoalEntry, Listener};
use super::stream::CallerGoals;
use crate::access::Caller;
use crate::audit::{self, Mutation};
use crate::gate::Draining;
use crate::multiplex::GoalCalls;
use crate::multiplex::server::Answers;
use futures::stream::{BoxStream, StreamExt, unfold};
use ratn_proto::MAX_MESSAGE_BYTES;
use ratn_proto::convert::{name, required};
use ratn_proto::types::Goal;
use ratn_proto::v1;
use ratn_proto::v1::action_service_server::{ActionService, ActionServiceServer};
use ratn_proto::v1::execute_response::Kind;
use std::collections::BTreeMap;
use std::sync::Arc;
use tokio::sync::broadcast::error::RecvError;
use tokio::sync::{broadcast, watch};
use tonic::{Request, Response, Status, Streaming};

impl ActionServer {
    /// The gRPC service, for [`crate::server::Services::with`].
    pub fn into_service(self) -> ActionServiceServer<ActionServer> {
        ActionServiceServer::new(self)
            .max_decoding_message_size(MAX_MESSAGE_BYTES)
            .max_encoding_message_size(MAX_MESSAGE_BYTES)
    }
}

impl ActionServer {
    /// A goal that a caller gives.
    pub(super) async fn given(&self, caller: &Caller, request: v1::ExecuteRequest) -> Result<Messages, Status> {
        let inputs = Fingerprint::of(request.goal.as_ref());
        let goal: Goal = required(request.goal, "goal")?;
        let pending = asked(caller, &goal, false);
        let token = goal.lease.as_ref().map(|lease| lease.token);
        let admitted = self.admit(caller, goal, inputs).await;
        pending.ended_with(&admitted, |_| token);
        admitted
    }

    /// A goal that a caller asks about again.
    fn asked_again(&self, caller: &Caller, request: v1::AttachRequest) -> Result<Messages, Status> {
        let inputs = Fingerprint::of(request.goal.as_ref());
        let goal: Goal = required(request.goal, "goal")?;
        let pending = asked(caller, &goal, true);
        let joined = self.join(caller, &goal, inputs);
        pending.ended_with(&joined, |_| goal.lease.as_ref().map(|lease| lease.token));
        joined
    }
}

fn asked(caller: &Caller, goal: &Goal, known_only: bool) -> audit::Pending {
    audit::begin(caller, "", || Mutation::Goal {
        goal: goal.id.clone(),
        action: goal.action.clone(),
        lease: goal.lease.as_ref().map_or(0, |lease| lease.id.0),
        known_only,
    })
}

#[tonic::async_trait]
impl ActionService for ActionServer {
    type ExecuteStream = BoxStream<'static, Result<v1::ExecuteResponse, Status>>;

    async fn execute(&self, request: Request<v1::ExecuteRequest>) -> Result<Response<Self::ExecuteStream>, Status> {
        let caller = Caller::of(&request);
        Ok(Response::new(self.given(&caller, request.into_inner()).await?.into_stream()))
    }

    type AttachStream = BoxStream<'static, Result<v1::ExecuteResponse, Status>>;

    async fn attach(&self, request: Request<v1::AttachRequest>) -> Result<Response<Self::AttachStream>, Status> {
        let caller = Caller::of(&request);
        Ok(Response::new(self.asked_again(&caller, request.into_inner())?.into_stream()))
    }

    type PerformStream = Answers<GoalCalls, CallerGoals>;

    async fn perform(
        &self,
        request: Request<Streaming<v1::PerformRequest>>,
    ) -> Result<Response<Self::PerformStream>, Status> {
        let draining = request.extensions().get::<Draining>().map(|draining| draining.0.clone());
        let goals = CallerGoals { caller: Caller::of(&request), server: self.clone() };
        Ok(Response::new(Answers::new(goals, request.into_inner(), draining)))
    }

    async fn cancel(&self, request: Request<v1::CancelRequest>) -> Result<Response<v1::CancelResponse>, Status> {
        let (caller, goal) = (Caller::of(&request), request.into_inner().goal_id);
        name(&goal, "goal_id")?;
        let pending = audit::begin(&caller, "", || Mutation::Cancel { goal: goal.clone() });
        let cancelled = self.inner.state().cancel(&caller, &goal);
        pending.ended(&cancelled);
        Ok(Response::new(v1::CancelResponse { under_way: cancelled? }))
    }

    async fn describe(&self, _: Request<v1::DescribeRequest>) -> Result<Response<v1::DescribeResponse>, Status> {
        let inner = &self.inner;
        Ok(Response::new(described(&inner.resource, (&inner.provider, &inner.kind), &inner.actions)))
    }
}

/// The description of a provider with this resource, name and kind.
pub(super) fn described(
    resource: &str,
    (provider, kind): (&str, &str),
    actions: &BTreeMap<String, Arc<dyn super::Action>>,
) -> v1::DescribeResponse {
    let description = |action: &Arc<dyn super::Action>| v1::ActionDescription {
        name: action.name().to_owned(),
        description: action.description().to_owned(),
        cancel_when_abandoned: action.cancel_when_abandoned(),
        signature: action.signature().map(|signature| signature.said().clone().into()),
    };
    v1::DescribeResponse {
        resource_id: resource.to_owned(),
        actions: actions.values().map(description).collect(),
        provider: provider.to_owned(),
        kind: kind.to_owned(),
    }
}

/// The messages that one client gets of a goal. A client leaves by dropping this.
pub(super) struct Messages {
    accepted: Option<bool>,
    over: bool,
    progress: broadcast::Receiver<v1::GoalProgress>,
    improved: watch::Receiver<Option<v1::GoalImproved>>,
    result: watch::Receiver<Option<Ending>>,
    _listener: Listener,
}

impl Messages {
    pub(super) fn of(entry: &Arc<GoalEntry>, joined: bool) -> Messages {
        let mut improved = entry.improved.subscribe();
        if improved.borrow().is_some() {
            improved.mark_changed();
        }
        Messages {
            accepted: Some(joined),
            over: false,
            progress: entry.progress.subscribe(),
            improved,
            result: entry.result.subscribe(),
            _listener: entry.listen(),
        }
    }

    fn into_stream(self) -> BoxStream<'static, Result<v1::ExecuteResponse, Status>> {
        let step = async |mut messages: Messages| {
            let message = messages.next().await?;
            Some((message.map(|kind| v1::ExecuteResponse { kind: Some(kind) }), messages))
        };
        unfold(self, step).boxed()
    }

    pub(super) async fn next(&mut self) -> Option<Result<Kind, Status>> {
        if let Some(joined) = self.accepted.take() {
            return Some(Ok(Kind::Accepted(v1::GoalAccepted { joined })));
        }
        if self.over {
            return None;
        }
        loop {
            let ending = tokio::select! {
                biased;
                progress = self.progress.recv() => match progress {
                    Ok(progress) => return Some(Ok(Kind::Progress(progress))),
                    Err(RecvError::Lagged(_)) => continue,
                    Err(RecvError::Closed) => return None,
                },
                Ok(()) = self.improved.changed() => {
                    let Some(improved) = self.improved.borrow_and_update().clone() else { continue };
                    return Some(Ok(Kind::Improved(improved)));
                }
                ending = self.result.wait_for(Option::is_some) => match ending {
                    Ok(ending) => ending.clone()?,
                    Err(_) => return None,
                },
            };
            // A last progress report may have come between the two checks.
            if let Ok(progress) = self.progress.try_recv() {
                return Some(Ok(Kind::Progress(progress)));
            }
            if self.improved.has_changed().unwrap_or_default()
                && let Some(improved) = self.improved.borrow_and_update().clone()
            {
                return Some(Ok(Kind::Improved(improved)));
            }
            self.over = true;
            return Some(match ending {
                Ending::Outcome { outcome, orphaned, may_move } => {
                    Ok(Kind::Result(v1::GoalResult { orphaned, may_move, ..outcome.into() }))
                }
                Ending::Gone => Err(Status::unavailable("the provider shuts down")),
                Ending::Lost(reason) => Err(Status::aborted(reason)),
            });
        }
    }
}
