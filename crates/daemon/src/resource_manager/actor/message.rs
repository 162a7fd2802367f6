//! Messages from the service to the actor.

use super::super::providers::Provisions;
use super::super::watch_filter::WatchFilter;
use super::super::watch_message::WatchMessage;
use super::ResourceCore;
use crate::resource_manager::Granted;
use ratn_model::id::{LeaseId, Revision};
use ratn_model::time::Timestamp;
use ratn_proto::types::{Demand, SessionStatus, WaitingAcquire, WatchPosition};
use ratn_resources::{
    AcquireRequest, Reply, Request, ResourceView, Search, SessionId, Share, Speaker, Standing, WaiterId,
};
use std::cmp::Reverse;
use std::sync::Arc;
use std::time::Duration;
use tokio::sync::{mpsc, oneshot, watch};
use tonic::Status;

/// The result of a keep-alive.
#[derive(Debug)]
pub(in super::super) struct KeptAlive {
    pub(in super::super) ttl: Duration,
    pub(in super::super) created: bool,
    pub(in super::super) number: u64,
    pub(in super::super) revision: Revision,
}

/// A ping of a session.
#[derive(Debug)]
pub(in super::super) struct Ping {
    pub(super) speaker: Speaker,
    pub(super) session: SessionId,
    pub(super) client: String,
    pub(super) ttl: Duration,
    pub(super) claim: Claim,
    pub(super) answer: Answer<KeptAlive>,
}

/// The standing that a session claims beside others.
#[derive(Debug, Clone, Copy, Default)]
pub(in super::super) struct Claim {
    pub(in super::super) share: Share,
    /// In how many milliseconds its task is due; negative if that has passed.
    pub(in super::super) due_in_ms: Option<i64>,
}

impl Claim {
    pub(super) fn at(self, now: Timestamp) -> Standing {
        let due = |ms: i64| match Duration::from_millis(ms.unsigned_abs()) {
            left if ms >= 0 => now + left,
            passed => Timestamp(now.0.saturating_sub(u64::try_from(passed.as_nanos()).unwrap_or(u64::MAX))),
        };
        Standing { share: self.share, due: self.due_in_ms.map(due) }
    }
}

/// A request of the service to the actor.
#[derive(Debug)]
pub(in super::super) enum Message {
    Perform {
        speaker: Speaker,
        request_id: String,
        request: Request,
        answer: Answer<(Reply, Revision)>,
    },
    Acquire {
        speaker: Speaker,
        ticket: u64,
        request_id: String,
        request: AcquireRequest,
        wait: Duration,
        answer: oneshot::Sender<Granted>,
    },
    /// The call with this ticket was dropped before its answer.
    Abandon {
        ticket: u64,
    },
    Withdraw {
        speaker: Speaker,
        session: SessionId,
        request_id: String,
        answer: Answer<bool>,
    },
    /// The call was dropped after its answer was sent and before it was read.
    Return {
        lease: LeaseId,
    },
    /// The client has got no answer to this request, and does not want one any more.
    Undo {
        speaker: Speaker,
        session: SessionId,
        request_id: String,
    },
    /// The answers to earlier requests.
    Recall {
        speaker: Speaker,
        session: SessionId,
        request_ids: Vec<String>,
        answer: Answer<Vec<Option<Reply>>>,
    },
    /// Examines some more resources; the answer says whether it examined any.
    Search {
        search: Search,
        resources: usize,
        answer: oneshot::Sender<(Search, bool)>,
    },
    Get {
        id: String,
        answer: oneshot::Sender<Option<ResourceView>>,
    },
    /// At most so many resources after an id.
    List {
        after: String,
        most: usize,
        answer: oneshot::Sender<(Vec<ResourceView>, Revision)>,
    },
    Revision {
        answer: oneshot::Sender<Revision>,
    },
    /// Some sessions after an id.
    Sessions {
        after: String,
        answer: oneshot::Sender<Vec<SessionStatus>>,
    },
    /// The waiter of a request id (the caller's own before those of others), or the first of the queue; and the number of waiters.
    Waiters {
        caller: Arc<str>,
        request_id: String,
        answer: Answer<(Vec<WaiterId>, usize)>,
    },
    /// Why the first of these wait, and how many of them were explained.
    Explain {
        waiters: Vec<WaiterId>,
        answer: oneshot::Sender<(Vec<WaitingAcquire>, usize)>,
    },
    WatchDemand {
        speaker: Speaker,
        session: SessionId,
        provisions: Provisions,
        answer: Answer<watch::Receiver<Vec<Demand>>>,
    },
    ReportShortage {
        speaker: Speaker,
        session: SessionId,
        kind: String,
        most: u32,
        reason: String,
        answer: Answer<()>,
    },
    Watch {
        /// If set, without a snapshot: the events after this position.
        after: Option<WatchPosition>,
        filter: Arc<WatchFilter>,
        answer: Answer<mpsc::Receiver<WatchMessage>>,
    },
}

pub(in super::super) type Answer<T> = oneshot::Sender<Result<T, Status>>;

/// Sends messages to the actor.
pub(in super::super) type Handle = crate::durable_actor::Handle<ResourceCore>;

impl Handle {
    pub(in super::super) async fn keep_alive(
        &self,
        speaker: Speaker,
        session: SessionId,
        client: String,
        ttl: Duration,
        claim: Claim,
    ) -> Result<KeptAlive, Status> {
        self.ask_urgently(|answer| Ping { speaker, session, client, ttl, claim, answer }).await?
    }
}

/// Orders calls that arrived together, which are handled by separate tasks and so have no order of their own: the most urgent acquire goes first, and
/// releases come after acquires. All other calls keep their order, and no acquire passes the end of an earlier call: it may be the same request,
/// repeated.
pub(super) fn most_urgent_first(messages: &mut [Message]) {
    let ends_call = |message: &Message| {
        use Message::{Abandon, Return, Undo, Withdraw};
        matches!(message, Withdraw { .. } | Undo { .. } | Abandon { .. } | Return { .. })
    };
    for messages in messages.split_mut(ends_call) {
        messages.sort_by_key(|message| match message {
            Message::Acquire { request, .. } => (0, Reverse(request.priority)),
            _ => (1, Reverse(0)),
        });
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn acquire(ticket: u64, priority: i64) -> Message {
        let request = AcquireRequest::new(SessionId::from("s"), Vec::new()).priority(priority);
        let (speaker, request_id, wait) = (Speaker::trusted(), String::new(), Duration::ZERO);
        Message::Acquire { speaker, ticket, request_id, request, wait, answer: oneshot::channel().0 }
    }

    fn release() -> Message {
        let (speaker, request_id) = (Speaker::trusted(), String::new());
        let request = Request::Release { session: None, lease: LeaseId(1), at_rest: true };
        Message::Perform { speaker, request_id, request, answer: oneshot::channel().0 }
    }

    fn withdraw() -> Message {
        let (speaker, session, request_id) = (Speaker::trusted(), SessionId::from("s"), "r".to_owned());
        Message::Withdraw { speaker, session, request_id, answer: oneshot::channel().0 }
    }

    /// The order of messages: tickets of acquires, names of others.
    fn sorted(mut messages: Vec<Message>) -> Vec<String> {
        most_urgent_first(&mut messages);
        let name = |message: &Message| match message {
            Message::Acquire { ticket, .. } => ticket.to_string(),
            Message::Perform { .. } => "release".to_owned(),
            _ => "end".to_owned(),
        };
        messages.iter().map(name).collect()
    }

    #[test]
    fn the_most_urgent_acquire_goes_first_and_what_is_given_back_last() {
        let messages = vec![release(), acquire(1, 0), acquire(2, 7), acquire(3, 0)];
        assert_eq!(sorted(messages), ["2", "1", "3", "release"]);
    }

    #[test]
    fn no_acquire_goes_past_the_end_of_a_call_that_came_before_it() {
        let ends = [withdraw(), Message::Abandon { ticket: 1 }, Message::Return { lease: LeaseId(1) }];
        for end in ends {
            let messages = vec![acquire(1, 0), release(), end, acquire(2, 7), release(), acquire(3, 8)];
            assert_eq!(sorted(messages), ["1", "release", "end", "3", "2", "release"]);
        }
    }
}
