//! The life of one goal, from giving it to a provider (or finding it there again) to the event of its end.

use super::Answer;
use super::goals::Doubtful;
use super::told::Told;
use crate::ledger::Confirmed;
use crate::readable::{one_line, readable};
use crate::record::said;
use crate::safe_on_disk::Mark;
use ratn_executive::protocol::Event;
use ratn_model::fact::FactKey;
use ratn_model::id::{InstanceId, LeaseId, Revision};
use ratn_model::measurement::Measurement;
use ratn_model::program::{ABORTED, PREEMPTED};
use ratn_model::value::Value;
use ratn_proto::types::{Goal, GoalImproved, GoalOutcome, HOST_KIND};
use ratn_worker::action::STOP_GRACE;
use ratn_worker::client::retry_unanswered;
use ratn_worker::client::{ActionClient, CallError, Channels, Fate, ProcessClient, ResourceClient, Said};
use ratn_worker::endpoint::Endpoint;
use ratn_worker::session::DEFAULT_TTL;
use std::collections::BTreeMap;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};
use tokio::sync::mpsc::error::TrySendError;
use tokio::sync::{mpsc, watch};
use tokio_util::sync::CancellationToken;

/// A cancelled goal whose provider does not end it within this time is abandoned: what it moves may still move. A provider says after its grace that a
/// goal has not ended.
pub(super) const CANCEL_DEADLINE: Duration = STOP_GRACE.saturating_add(Duration::from_millis(500));
/// How long a goal goes on without task control, so that a resumed run finds it under way: as long as its lease would live.
pub(super) const GRACE_MS: u64 = DEFAULT_TTL.as_millis() as u64;
/// How long the resource of a provider that has ended may still exist: its process manager withdraws it at once, and if that has ended too, the
/// resource ends with its session.
const WITHDRAWAL_DEADLINE: Duration = Duration::from_secs(DEFAULT_TTL.as_secs() + 1);
/// Reason code: the provider still runs another run's cancelled goal.
const STILL_RUNNING: &str = "STILL_RUNNING";
/// Reason codes of a provider that does not begin a goal because its lease is over.
const LEASE_OVER: [&str; 2] = ["LEASE_REFUTED", "LEASE_FENCED"];
/// A worker that refuses for this reason is kept this long before another one is acquired: an immediate acquire would get the same worker again.
const STILL_RUNNING_PAUSE: Duration = Duration::from_secs(5);
/// Interval at which the withdrawal of a resource is checked.
const WITHDRAWAL_POLL: Duration = Duration::from_millis(100);
/// How long to wait for a process manager to say how a provider ended.
const END_DEADLINE: Duration = Duration::from_secs(1);
/// How much longer than its time to live a session may still be visible.
const SESSION_SLACK: Duration = Duration::from_millis(500);
/// The executive ends a goal that takes too long. The provider does so this much later, in case the cancel does not arrive.
const DEADLINE_SLACK: Duration = Duration::from_millis(500);

/// Maximum number of intermediate results of one goal; each is a line of the event log.
const MOST_RESULTS: u32 = 256;

/// What has to be waited for no longer than this before a goal is given is not told to the executive.
const HARDLY: Duration = Duration::from_millis(20);
/// Interval, beside other runs, at which to check whether a goal has given its first result.
const LOOK_AGAIN: Duration = Duration::from_millis(20);

/// The intermediate results of a goal.
#[derive(Debug)]
pub(super) struct Results {
    taken: u32,
    /// The cost of the last one, in seconds.
    cost_s: f64,
}

impl Default for Results {
    fn default() -> Results {
        Results { taken: 0, cost_s: f64::INFINITY }
    }
}

impl Results {
    /// Whether a result with this cost is accepted: the first one, or a better one.
    fn takes(&mut self, cost_s: f64) -> bool {
        let takes = cost_s < self.cost_s && self.taken < MOST_RESULTS;
        if takes {
            *self = Results { taken: self.taken + 1, cost_s };
        }
        takes
    }
}

/// Whether a goal is new to its provider.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Given {
    /// The goal is given for the first time.
    Now,
    /// Task control gave it before it was killed, or was about to: it is not given again.
    Before,
    /// Like `Before`, and it was cancelled, or was about to be.
    ToStop,
}

/// A goal that is being performed.
pub(super) struct Performing {
    pub(super) instance: InstanceId,
    pub(super) attempt: u32,
    /// Cancelled goals that have to end first: each token is cancelled when its goal has ended.
    pub(super) before: Vec<CancellationToken>,
    pub(super) endpoint: Result<Endpoint, String>,
    /// The provider's id: the source of measurements that name none.
    pub(super) source: String,
    pub(super) timeout_s: Option<f64>,
    pub(super) speed: f64,
    pub(super) actions: ActionClient,
    pub(super) resources: ResourceClient,
    pub(super) channels: Channels,
    pub(super) events: mpsc::Sender<Answer>,
    pub(super) stop: CancellationToken,
    pub(super) goal: Goal,
    pub(super) results: Mutex<Results>,
    /// The output ports that a result must have.
    pub(super) outputs: Vec<String>,
    /// What has to be synced to disk before the goal begins.
    pub(super) safe: Option<Mark>,
    /// For a goal without a projection: the root world has to contain this commit of the run before the goal is given.
    pub(super) sees: Option<(watch::Receiver<Confirmed>, Revision)>,
    /// The run is over: no goal begins any more.
    pub(super) over: CancellationToken,
    pub(super) told: Told,
    /// The goal was given, and it is not known that nothing moves for it any more.
    pub(super) may_move: AtomicBool,
    pub(super) doubtful: Doubtful,
}

/// The deadline sent to the provider, in milliseconds of wall time; 0 for none.
pub(super) fn deadline_ms(timeout_s: Option<f64>, speed: f64) -> u64 {
    let Some(timeout_s) = timeout_s else { return 0 };
    // A conversion from float to integer saturates.
    ((timeout_s / speed * 1e3).ceil() as u64).saturating_add(DEADLINE_SLACK.as_millis() as u64)
}

impl Performing {
    /// Performs the goal until its end; sends the event to the shell, unless the goal was cancelled.
    pub(super) async fn perform(self, given: Given) {
        // One that was given before may be under way, whether or not it is found.
        self.may_move.store(given != Given::Now, Ordering::Release);
        let mut event = self.ended(given).await;
        // Whoever gives the lease back says so, also after a resumption.
        let may_move = self.may_move.load(Ordering::Acquire);
        if may_move {
            self.doubtful.add(self.goal.lease.as_ref().map(|lease| lease.id));
        }
        if let Some(Event::Finished { at_rest, .. }) = &mut event {
            *at_rest = !may_move;
        }
        if let Some(event) = event
            && !self.stop.is_cancelled()
        {
            let _ = self.events.send(event.into()).await;
        }
    }

    /// The end of the goal; `None` if it was cancelled.
    async fn ended(&self, given: Given) -> Option<Event> {
        // A goal that was given before is looked for first.
        if given == Given::Now && !self.may_be_given().await {
            return None;
        }
        // One that was given before has to hear that it is cancelled.
        if given == Given::Now && self.stop.is_cancelled() || self.over.is_cancelled() {
            return None;
        }
        match &self.endpoint {
            Ok(endpoint) => self.execute(endpoint, given).await,
            Err(reason) => Some(self.aborted(reason.clone())),
        }
    }

    /// Waits until the log says on disk that the goal is given, the goals that have to end first have ended, and the root has every earlier decision; the
    /// goal's timeout does not count meanwhile, if that takes longer than [`HARDLY`]. Returns whether the goal may be given.
    async fn may_be_given(&self) -> bool {
        let mut waiting = std::pin::pin!(async {
            self.is_safe_on_disk().await && self.is_its_turn().await && self.sees_what_was_decided().await
        });
        if let Ok(may) = tokio::time::timeout(HARDLY, waiting.as_mut()).await {
            return may;
        }
        self.counts(false).await;
        let may = waiting.await;
        if may {
            self.counts(true).await;
        }
        may
    }

    /// Tells the executive whether the goal's timeout counts.
    async fn counts(&self, counts: bool) {
        if self.timeout_s.is_none() || self.stop.is_cancelled() {
            return;
        }
        let (instance, attempt) = (self.instance, self.attempt);
        let event = if counts { Event::Given { instance, attempt } } else { Event::Delayed { instance, attempt } };
        let _ = self.events.send(event.into()).await;
    }

    /// Waits until the log is on disk; returns whether the goal may be given.
    async fn is_safe_on_disk(&self) -> bool {
        let Some(safe) = self.safe.clone() else { return true };
        tokio::select! {
            biased;
            () = self.stop.cancelled() => false,
            () = self.over.cancelled() => false,
            // If it never will be, the run ends.
            is_safe = safe.safe() => is_safe,
        }
    }

    /// Waits for the end of the goals that have to end first; returns whether the goal may be given.
    async fn is_its_turn(&self) -> bool {
        for before in &self.before {
            tokio::select! {
                biased;
                () = self.stop.cancelled() => return false,
                () = self.over.cancelled() => return false,
                () = before.cancelled() => {}
            }
        }
        true
    }

    /// Waits until the root has every earlier decision; returns whether the goal may be given.
    async fn sees_what_was_decided(&self) -> bool {
        let Some((mut confirmed, decided)) = self.sees.clone() else { return true };
        let is_there = async { confirmed.wait_for(|confirmed| confirmed.commit >= decided).await.is_ok() };
        tokio::select! {
            biased;
            () = self.stop.cancelled() => false,
            () = self.over.cancelled() => false,
            // If it never has, the run ends.
            is_there = is_there => is_there,
        }
    }

    /// `None` if the goal was cancelled.
    async fn execute(&self, endpoint: &Endpoint, given: Given) -> Option<Event> {
        let begun = Instant::now();
        self.may_move.store(true, Ordering::Release);
        let ending = async {
            let mut ending = std::pin::pin!(self.ending(endpoint, given));
            tokio::select! {
                event = &mut ending => return event,
                () = self.is_in_the_way() => {}
            }
            let _ = Box::pin(self.actions.cancel(endpoint, &self.goal.id)).await;
            ending.await
        };
        let mut ending = std::pin::pin!(ending);
        let event = tokio::select! {
            // The goal is given before it is cancelled.
            biased;
            event = &mut ending => event,
            () = self.stop.cancelled() => {
                let stopping = async {
                    tokio::select! {
                        _ = &mut ending => {}
                        () = Box::pin(self.actions.stop(endpoint, &self.goal.id)) => drop(ending.await),
                    }
                };
                let _ = tokio::time::timeout(CANCEL_DEADLINE, stopping).await;
                return None;
            }
        };
        Some(self.in_time(event, begun))
    }

    /// The end of the goal was heard.
    fn heard(&self, fate: &Fate) {
        self.may_move.store(fate.may_move, Ordering::Release);
    }

    /// Resolves when the goal only improves a given result while there are other runs: its resources are not held for that.
    async fn is_in_the_way(&self) {
        if self.goal.improves.is_none() {
            return std::future::pending().await;
        }
        self.told.others_after(Duration::ZERO).await;
        while !self.results.lock().is_ok_and(|results| results.taken > 0) {
            tokio::time::sleep(LOOK_AGAIN).await;
        }
    }

    /// Rare branches are boxed, so that the future of a goal is small: it is copied about ten times on its way through the runtime.
    async fn ending(&self, endpoint: &Endpoint, given: Given) -> Event {
        match given {
            Given::Now => self.given(endpoint, given).await,
            Given::Before | Given::ToStop => match Box::pin(self.found(endpoint)).await {
                // A process that was started again refuses what was granted before it: the one before may have begun the goal.
                Event::Crashed { reason, refused: true, .. } => self.unknown(reason),
                event => event,
            },
        }
    }

    async fn found(&self, endpoint: &Endpoint) -> Event {
        self.counts(true).await;
        let fate = self.actions.attach_hearing(endpoint, self.goal.clone(), |said| self.said(said)).await;
        match fate.inspect(|fate| self.heard(fate)) {
            Ok(fate) if fate.orphaned => {
                self.unknown(format!("it was stopped while task control was gone: {}", fate.outcome.reason))
            }
            Ok(fate) => self.finished(fate.outcome),
            Err(error) if error.is_unreadable() => self.unreadable(endpoint, &error).await,
            // Task control was killed after it logged that it gives the goal, and before it gave it.
            Err(error)
                if error.code() == Some(tonic::Code::NotFound) && self.may_be_given_after_all(endpoint).await =>
            {
                self.given(endpoint, Given::Before).await
            }
            Err(error) if error.code() == Some(tonic::Code::NotFound) => {
                self.unknown(format!("nobody knows what became of it while task control was gone: {}", said(&error)))
            }
            Err(error) if error.code() == Some(tonic::Code::Unimplemented) => self.left_alone(endpoint).await,
            Err(error) => self.lost(endpoint, &error).await,
        }
    }

    /// Whether the goal may be given, although task control was killed when it had logged that it gives it.
    async fn may_be_given_after_all(&self, endpoint: &Endpoint) -> bool {
        self.counts(false).await;
        let is_new = self.would_be_known(endpoint).await;
        let may = is_new && self.is_its_turn().await && self.sees_what_was_decided().await && !self.stop.is_cancelled();
        if may {
            self.counts(true).await;
        }
        may
    }

    /// A goal that may be under way at a worker that keeps none of its goals, because it implements no `Attach`: it is told to stop.
    async fn left_alone(&self, endpoint: &Endpoint) -> Event {
        let _ = tokio::time::timeout(CANCEL_DEADLINE, self.actions.stop(endpoint, &self.goal.id)).await;
        self.unknown("its worker does not know which goals it was given before (it has no `Attach`)".to_owned())
    }

    async fn given(&self, endpoint: &Endpoint, given: Given) -> Event {
        let is_wanted = || !self.stop.is_cancelled();
        let fate = self.actions.execute_hearing(endpoint, self.goal.clone(), is_wanted, |said| self.said(said)).await;
        // A provider that refuses a goal has not begun it; the process before it may have, if the goal was given before.
        if given == Given::Now && fate.as_ref().is_err_and(|error| !error.is_crash() && !error.is_unreadable()) {
            self.may_move.store(false, Ordering::Release);
        }
        match fate.inspect(|fate| self.heard(fate)) {
            Ok(fate) => self.finished(fate.outcome),
            // A malformed goal will be malformed the next time, too.
            Err(error) if error.code() == Some(tonic::Code::InvalidArgument) => self.aborted(said(&error)),
            // An unreadable answer will be unreadable the next time, too.
            Err(error) if error.is_unreadable() => Box::pin(self.unreadable(endpoint, &error)).await,
            // Perhaps only the connection broke; then the goal is still there.
            Err(error @ CallError::Broken { .. }) => Box::pin(self.attached(endpoint, &error)).await,
            Err(error) => Box::pin(self.lost(endpoint, &error)).await,
        }
    }

    /// Whether a provider that does not know the goal was never given it. It could also be a new process, or have forgotten the goal; but then the
    /// session of the resource would not live on, and nobody else gives goals under this goal's lease. Where the session does live on, because its
    /// id is fixed, the new process refuses the lease, and the goal is not begun again.
    async fn would_be_known(&self, endpoint: &Endpoint) -> bool {
        let Some((lease, provider)) = self.provider(endpoint) else { return false };
        let owner = async || {
            let resource = retry_unanswered(|| self.resources.get(&provider)).await.ok()?;
            let held = resource.holdings.iter().any(|holding| holding.lease == lease);
            held.then_some(resource.session)
        };
        let lives = async {
            let owned_by = owner().await?;
            let sessions = retry_unanswered(|| self.resources.sessions()).await.ok()?;
            let ttl_ms = sessions.iter().find(|session| session.id == owned_by)?.ttl_ms;
            tokio::time::sleep(Duration::from_millis(ttl_ms) + SESSION_SLACK).await;
            Some(owner().await? == owned_by)
        };
        tokio::select! {
            lives = lives => lives == Some(true),
            () = self.stop.cancelled() => false,
        }
    }

    /// The lease under which the goal is given, and the id of the resource that performs it.
    fn provider(&self, endpoint: &Endpoint) -> Option<(LeaseId, String)> {
        let (lease, there) = (self.goal.lease.as_ref()?, endpoint.to_string());
        let resource = lease.resources.iter().find(|resource| resource.endpoint == there)?;
        Some((lease.id, resource.id.clone()))
    }

    /// The provider's answer cannot be read. If it is not a valid message, it may belong to another goal on the same stream: this goal is asked
    /// for over a stream of its own.
    async fn unreadable(&self, endpoint: &Endpoint, unreadable: &CallError) -> Event {
        if !matches!(unreadable, CallError::Malformed { .. }) {
            let attached = self.actions.attach_hearing(endpoint, self.goal.clone(), |said| self.said(said));
            match Box::pin(attached).await.inspect(|fate| self.heard(fate)) {
                Ok(fate) if !fate.orphaned => return self.finished(fate.outcome),
                Err(broken @ CallError::Broken { .. }) if !broken.is_unreadable() => {
                    return self.lost(endpoint, &broken).await;
                }
                // The goal never reached its provider, because the stream broke before it.
                Err(unknown) if unknown.code() == Some(tonic::Code::NotFound) => {
                    return self.lost(endpoint, unreadable).await;
                }
                _ => {}
            }
        }
        // The goal may be under way still, and the next holder gets the same resource.
        let _ = tokio::time::timeout(CANCEL_DEADLINE, self.actions.stop(endpoint, &self.goal.id)).await;
        self.aborted(format!("its worker answered what cannot be read: {}", said(unreadable)))
    }

    async fn attached(&self, endpoint: &Endpoint, broken: &CallError) -> Event {
        let fate = self.actions.attach_hearing(endpoint, self.goal.clone(), |said| self.said(said)).await;
        match fate.inspect(|fate| self.heard(fate)) {
            Ok(fate) if !fate.orphaned => self.finished(fate.outcome),
            Err(error) if error.is_unreadable() => self.unreadable(endpoint, &error).await,
            Err(error) if error.code() == Some(tonic::Code::Unimplemented) => self.left_alone(endpoint).await,
            _ => self.lost(endpoint, broken).await,
        }
    }

    async fn lost(&self, endpoint: &Endpoint, error: &CallError) -> Event {
        self.withdrawn(endpoint, error).await;
        let reason = match (self.provider(endpoint), error) {
            (Some((_, provider)), CallError::Broken { reason, .. }) => match self.end_of(&provider).await {
                Some(end) => format!("{provider}: {end}"),
                None => format!("{provider} does not answer: {reason}"),
            },
            _ => said(error),
        };
        self.crashed(reason, LEASE_OVER.contains(&error.reason()))
    }

    /// How the process of a provider ended, according to the process manager of its host; `None` if unknown.
    async fn end_of(&self, provider: &str) -> Option<String> {
        let host = provider.rsplit_once('@')?.1;
        let asking = async {
            let hosts = self.resources.list(&[HOST_KIND]).await.ok()?;
            let manager = hosts.iter().find(|one| one.host == host)?.endpoint().parse().ok()?;
            let pools = ProcessClient::new(&self.channels, &manager).ok()?.pools().await.ok()?.pools;
            let end = pools.iter().find_map(|pool| pool.last_exit.strip_prefix(&format!("{provider}: ")));
            // Its last output is in `ratn logs`.
            Some(end?.split("; its last words").next()?.to_owned())
        };
        tokio::time::timeout(END_DEADLINE, asking).await.ok().flatten()
    }

    /// Waits until nobody can be granted the failed provider any more: an immediate retry would be granted the same provider again, and all its
    /// attempts would fail. The lease is not released before.
    async fn withdrawn(&self, endpoint: &Endpoint, error: &CallError) {
        if error.reason() == STILL_RUNNING {
            tokio::select! {
                () = tokio::time::sleep(STILL_RUNNING_PAUSE) => {}
                () = self.stop.cancelled() => {}
            }
        }
        if let Some((_, provider)) = self.provider(endpoint)
            && error.is_crash()
        {
            let there = endpoint.to_string();
            let withdrawn = async {
                // A manager that does not answer may still have the resource when it returns.
                while match self.resources.get(&provider).await {
                    Ok(resource) => resource.endpoint() == there,
                    Err(error) => error.is_crash(),
                } {
                    tokio::time::sleep(WITHDRAWAL_POLL).await;
                }
            };
            tokio::select! {
                _ = tokio::time::timeout(WITHDRAWAL_DEADLINE, withdrawn) => {}
                () = self.stop.cancelled() => {}
            }
        }
    }

    /// A goal that the provider ended at its deadline has failed, whatever outcome the provider gives.
    fn in_time(&self, event: Event, begun: Instant) -> Event {
        match (event, self.timeout_s) {
            (Event::Finished { outcome, .. }, Some(timeout_s))
                if outcome == PREEMPTED && begun.elapsed().as_secs_f64() * self.speed >= timeout_s =>
            {
                self.aborted(format!("took longer than {timeout_s} s"))
            }
            (event, _) => event,
        }
    }

    fn said(&self, said: Said) {
        let (instance, attempt) = (self.instance, self.attempt);
        let event = match said {
            Said::Progress { message, .. } => Event::Progressed { instance, attempt, message: one_line(&message) },
            // Nobody waits for the results of a cancelled goal.
            Said::Improved(_) if self.stop.is_cancelled() => return,
            // A result with missing outputs is not a result.
            Said::Improved(GoalImproved { outputs, .. })
                if !self.outputs.iter().all(|port| outputs.contains_key(port)) =>
            {
                return;
            }
            Said::Improved(GoalImproved { outputs, cost_s }) => {
                if !self.results.lock().unwrap_or_else(PoisonError::into_inner).takes(cost_s) {
                    return;
                }
                Event::Improved { instance, attempt, outputs, cost_s }
            }
        };
        let sent = self.events.try_send(event.into());
        // When events pile up, progress can be dropped: it is for people. A result cannot, because the goal may give no other.
        if let Err(TrySendError::Full(Answer::Event { event, withdrawn })) = sent
            && matches!(*event, Event::Improved { .. })
        {
            let events = self.events.clone();
            tokio::spawn(async move { events.send(Answer::Event { event, withdrawn }).await });
        }
    }

    fn finished(&self, done: GoalOutcome) -> Event {
        let said: BTreeMap<FactKey, Measurement> = done.evidence.into_iter().collect();
        let by = |fact: &FactKey| {
            let mut measured = said.get(fact).cloned().unwrap_or_default();
            if measured.source.is_empty() {
                measured.source.clone_from(&self.source);
            }
            (fact.clone(), measured)
        };
        Event::Finished {
            evidence: done.measured.iter().map(|(fact, _)| by(fact)).collect(),
            instance: self.instance,
            attempt: self.attempt,
            outcome: done.outcome,
            outputs: done.outputs,
            measured: done.measured,
            reason: readable(&done.reason),
            at_rest: false,
        }
    }

    fn aborted(&self, reason: String) -> Event {
        let outputs: BTreeMap<String, Value> = BTreeMap::new();
        self.finished(GoalOutcome { outputs, reason, ..GoalOutcome::named(ABORTED) })
    }

    fn crashed(&self, reason: String, refused: bool) -> Event {
        let (instance, attempt, reason) = (self.instance, self.attempt, readable(&reason));
        Event::Crashed { instance, attempt, reason, unknown: false, refused }
    }

    /// A crash after which it is unknown whether the goal was performed.
    fn unknown(&self, reason: String) -> Event {
        let (instance, attempt, reason) = (self.instance, self.attempt, readable(&reason));
        Event::Crashed { instance, attempt, reason, unknown: true, refused: false }
    }
}

#[cfg(test)]
mod tests;
