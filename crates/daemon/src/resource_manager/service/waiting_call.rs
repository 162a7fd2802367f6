//! A call that waits for a lease. Its client may drop the call at any time: a lease granted to it in the meantime returns to the pool.

use crate::details::{ending, status};
use crate::resource_manager::Granted;
use crate::resource_manager::actor::{Handle, Message};
use ratn_resources::{AcquireRequest, Speaker};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;
use tokio::sync::oneshot;
use tonic::{Code, Status};

/// Additional time for the pool's own answer at a deadline to arrive.
const GRACE: Duration = Duration::from_millis(20);

/// The numbers of waiting calls; clones share the counter.
#[derive(Debug, Clone, Default)]
pub(super) struct Tickets {
    next: Arc<AtomicU64>,
}

/// A waiting acquire. Dropped before its answer, it leaves the queue, or returns what it was granted in the meantime.
pub(super) struct WaitingCall {
    actor: Handle,
    ticket: u64,
    answered: Option<oneshot::Receiver<Granted>>,
}

impl WaitingCall {
    /// Enters the queue.
    pub(super) async fn begin(
        actor: &Handle,
        tickets: &Tickets,
        speaker: Speaker,
        request_id: String,
        request: AcquireRequest,
        wait: Duration,
    ) -> Result<WaitingCall, Status> {
        let ticket = tickets.next.fetch_add(1, Ordering::Relaxed);
        let (answer, answered) = oneshot::channel();
        actor.send(Message::Acquire { speaker, ticket, request_id, request, wait, answer }).await?;
        Ok(WaitingCall { actor: actor.clone(), ticket, answered: Some(answered) })
    }

    /// Waits for the answer, a little longer than `wait`, so that the pool can say what was waited for.
    pub(super) async fn granted(mut self, wait: Duration) -> Granted {
        let Some(answered) = &mut self.answered else { return Err(ending()) };
        // The pool answers at the deadline, and says what was waited for; a call that joined another one with its request id has its own deadline,
        // and leaves by being dropped.
        let Ok(granted) = tokio::time::timeout(wait + GRACE, answered).await else {
            return Err(status(Code::DeadlineExceeded, "NOT_GRANTED_IN_TIME", "not granted: the deadline has passed"));
        };
        self.answered = None;
        granted.map_err(|_| ending())?
    }
}

impl Drop for WaitingCall {
    fn drop(&mut self) {
        let Some(mut answered) = self.answered.take() else { return };
        answered.close();
        match answered.try_recv() {
            Ok(Ok(lease)) => self.actor.send_later(Message::Return { lease: lease.id }),
            Ok(Err(_)) => {}
            Err(_) => self.actor.send_later(Message::Abandon { ticket: self.ticket }),
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::super::test_actor;
    use super::*;
    use crate::resource_manager::actor::Claim;
    use ratn_model::resource::{Requirement, ResourceClass, ResourceOperation};
    use ratn_resources::{Request as PoolRequest, ResourceSpec, SessionId};

    #[tokio::test]
    async fn a_lease_that_two_calls_of_one_request_got_goes_back_when_both_are_dropped() {
        let (actor, _directory) = test_actor::started(|log| log);
        let session = SessionId::from("s");
        actor
            .keep_alive(Speaker::trusted(), session.clone(), "s".to_owned(), Duration::from_secs(60), Claim::default())
            .await
            .unwrap();
        let requirement = Requirement::new(ResourceOperation::Block, "Arm");
        let mut calls = Vec::new();
        for ticket in [1, 2] {
            let (answer, answered) = oneshot::channel();
            let request = AcquireRequest::new(session.clone(), vec![requirement.clone()]);
            let (request_id, wait) = ("run/i1".to_owned(), Duration::from_secs(60));
            let speaker = Speaker::trusted();
            actor.send(Message::Acquire { speaker, ticket, request_id, request, wait, answer }).await.unwrap();
            calls.push(WaitingCall { actor: actor.clone(), ticket, answered: Some(answered) });
        }
        let create = PoolRequest::Create { session: None, spec: ResourceSpec::new(ResourceClass::Module, "Arm") };
        let request_id = String::new();
        let speaker = Speaker::trusted();
        actor.ask(|answer| Message::Perform { speaker, request_id, request: create, answer }).await.unwrap().unwrap();
        for free in [0, 0, 1] {
            let list = |answer| Message::List { after: String::new(), most: 1, answer };
            let (views, _) = actor.ask(list).await.unwrap();
            assert_eq!(views[0].free, free);
            calls.pop();
        }
    }

    /// An actor with one free arm, and a session.
    async fn with_an_arm() -> (Handle, SessionId, tempfile::TempDir) {
        let (actor, directory) = test_actor::started(|log| log);
        let session = SessionId::from("s");
        actor
            .keep_alive(Speaker::trusted(), session.clone(), "s".to_owned(), Duration::from_secs(60), Claim::default())
            .await
            .unwrap();
        let create = PoolRequest::Create { session: None, spec: ResourceSpec::new(ResourceClass::Module, "Arm") };
        let request_id = String::new();
        actor
            .ask(|answer| Message::Perform { speaker: Speaker::trusted(), request_id, request: create, answer })
            .await
            .unwrap()
            .unwrap();
        (actor, session, directory)
    }

    /// The same request each time. If it does not wait, it is dropped before it is answered.
    async fn call(actor: &Handle, session: &SessionId, ticket: u64, waits: bool) -> WaitingCall {
        let (answer, answered) = oneshot::channel();
        let answered = waits.then_some(answered);
        let requirement = Requirement::new(ResourceOperation::Block, "Arm");
        let request = AcquireRequest::new(session.clone(), vec![requirement]);
        let (request_id, wait) = ("run/i1".to_owned(), Duration::from_secs(60));
        actor
            .send(Message::Acquire { speaker: Speaker::trusted(), ticket, request_id, request, wait, answer })
            .await
            .unwrap();
        WaitingCall { actor: actor.clone(), ticket, answered }
    }

    async fn is_free(actor: &Handle) -> bool {
        let id = "Arm-1".to_owned();
        actor.ask(|answer| Message::Get { id, answer }).await.unwrap().unwrap().free == 1
    }

    #[tokio::test]
    async fn a_lease_that_a_repeated_request_was_told_stays_when_the_first_call_of_it_is_dropped() {
        let (actor, session, _directory) = with_an_arm().await;
        let first = call(&actor, &session, 1, true).await;
        let mut second = call(&actor, &session, 2, true).await;
        let third = call(&actor, &session, 3, true).await;
        // Read by its client, as by the service.
        second.answered.take().unwrap().await.unwrap().unwrap();
        for unread in [first, third] {
            drop(unread);
            assert!(!is_free(&actor).await, "the client of the second call holds it");
        }
        call(&actor, &session, 4, false).await;
        assert!(!is_free(&actor).await, "the client of the second call holds it");
    }

    #[tokio::test]
    async fn a_lease_goes_back_when_the_first_call_and_those_that_repeated_it_are_all_dropped() {
        let (actor, session, _directory) = with_an_arm().await;
        let mut calls = Vec::new();
        for (ticket, waits) in [(1, true), (2, true), (3, false)] {
            calls.push(call(&actor, &session, ticket, waits).await);
            assert!(!is_free(&actor).await);
        }
        calls.pop();
        calls.pop();
        assert!(!is_free(&actor).await);
        calls.pop();
        assert!(is_free(&actor).await);
    }
}
