//! The resource pool as the core of an actor: requests, deadlines, and replies to callers.
//!
//! A grant whose call was dropped at the same moment is released at once. Pings of sessions are handled first: a session does not expire because the
//! actor is busy.

mod calls;
mod demands;
mod leaving;
mod looks;
mod message;
mod watchers;

pub(super) use message::{Answer, Claim, Handle, KeptAlive, Message};

use super::providers::Providers;
use super::watch_message::WatchMessage;
use super::{Granted, ResourceManagerConfig, status};
use crate::details::ending;
use crate::durable_actor::{self, Core, Journal, JournalError, TurnContext};
use crate::metrics::{Amounts, Metrics};
use message::{Ping, most_urgent_first};
use ratn_model::id::{LeaseId, Revision};
use ratn_model::resource::Lease;
use ratn_model::time::Timestamp;
use ratn_resources::{Notice, Pool, PoolError, Reply, Request, SessionId, Speaker, WaiterId};
use ratn_worker::vitals::Vitals;
use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;
use tokio::sync::{oneshot, watch};
use tokio::task::JoinHandle;
use tokio_util::sync::CancellationToken;
use tonic::Status;

/// An answer about earlier requests ends behind the request with which it has so many units.
const RECALLED_UNITS: usize = 4_096;

/// A session lives at least this long.
const MIN_SESSION_TTL: Duration = Duration::from_millis(50);

type ResourceTurn = TurnContext<ResourceCore>;

#[derive(Debug)]
pub(super) struct ResourceCore {
    config: ResourceManagerConfig,
    pool: Pool,
    /// Nobody may wait in the queue any more.
    draining: bool,
    /// The calls that wait for the answer of each waiter; a repeated request joins.
    calls: BTreeMap<WaiterId, Vec<(u64, oneshot::Sender<Granted>)>>,
    tickets: BTreeMap<u64, WaiterId>,
    /// Number of calls that got a lease because its request was repeated: all of them have to be dropped before the lease goes back.
    shared: BTreeMap<LeaseId, usize>,
    /// By ticket: calls that repeat a granted request, until they are answered.
    repeated: BTreeMap<u64, (Lease, oneshot::Sender<Granted>)>,
    /// The resources that are missing.
    demand: Vec<ratn_resources::Demand>,
    /// The providers, and the part of the demand that each is asked for.
    providers: Providers,
    /// Sessions with records that may not be on disk yet, and the number of these records.
    opening: BTreeMap<SessionId, usize>,
    /// The last revision that clients may know.
    told: Revision,
    metrics: Arc<Metrics>,
}

/// Starts the actor on what was kept. With `draining` everybody who waits is told to ask the successor; with `over` it ends.
pub(super) fn start(
    live: watch::Receiver<ResourceManagerConfig>,
    (pool, journal): (Pool, Journal),
    draining: CancellationToken,
    vitals: Vitals,
    metrics: Arc<Metrics>,
    over: CancellationToken,
) -> Result<(Handle, JoinHandle<()>), JournalError> {
    let core = ResourceCore {
        told: pool.revision(),
        pool,
        draining: false,
        config: live.borrow().clone(),
        calls: BTreeMap::new(),
        tickets: BTreeMap::new(),
        shared: BTreeMap::new(),
        repeated: BTreeMap::new(),
        demand: Vec::new(),
        providers: Providers::new(live.borrow().provider_patience(), live.borrow().grow_after()),
        opening: BTreeMap::new(),
        metrics,
    };
    durable_actor::start(core, journal, live, vitals, draining, over)
}

/// Output, besides direct answers, that is sent when its records are on disk.
#[derive(Debug)]
pub(super) enum Said {
    /// A notice of the pool.
    Notice(Notice),
    /// The answer to a call that repeated a granted request.
    GrantedAgain { ticket: u64 },
    /// The change of a session by a ping is on disk.
    SessionKept(SessionId),
}

impl Core for ResourceCore {
    type State = Pool;
    type Message = Message;
    type Urgent = Ping;
    type Said = Said;
    type Update = WatchMessage;
    type Signal = ResourceManagerConfig;

    fn state(&mut self) -> &mut Pool {
        &mut self.pool
    }

    fn restore(&mut self, journal: &Journal, context: &ResourceTurn) -> Result<(), JournalError> {
        let stopped = context.stopped().map_or_else(ending, |stopped| stopped.status.clone());
        for (_, call) in std::mem::take(&mut self.calls).into_values().flatten() {
            let _ = call.send(Err(stopped.clone()));
        }
        for (_, call) in std::mem::take(&mut self.repeated).into_values() {
            let _ = call.send(Err(stopped.clone()));
        }
        self.tickets.clear();
        self.shared.clear();
        self.opening.clear();
        self.pool = Pool::new(self.config.limits.clone());
        let pool = super::journal::read(journal, self.config.limits.clone())?;
        self.pool = pool.with_kinds(self.config.hierarchy());
        self.told = self.pool.revision();
        Ok(())
    }

    fn next_deadline(&self, context: &ResourceTurn) -> Option<Timestamp> {
        let deadlines = self.pool.next_deadline().into_iter().chain(self.providers.deadline(context.now()));
        deadlines.min().filter(|_| context.stopped().is_none())
    }

    fn advance(&mut self, context: &mut ResourceTurn) {
        self.pool.advance(context.now());
    }

    fn receive_urgent(&mut self, ping: Ping, context: &mut ResourceTurn) {
        let Ping { speaker, session, client, ttl, claim, answer } = ping;
        let before = self.pool.session_ttl(&session);
        let kept = match context.stopped() {
            Some(stopped) => Err(stopped.status.clone()),
            None => self
                .keep_alive(context.now(), &speaker, &session, &client, ttl)
                .map_err(|error| status::of_error(&error)),
        };
        if kept.is_ok() && !ttl.is_zero() {
            // The session existed a moment ago.
            let _ = self.pool.set_standing(context.now(), &session, claim.at(context.now()));
        }
        match kept {
            // Nothing has changed that must be on disk: a slow disk does not end sessions.
            Ok(kept)
                if before == Some(kept.ttl.max(MIN_SESSION_TTL))
                    && !kept.created
                    && !self.opening.contains_key(&session) =>
            {
                context.reply_now(answer, Ok(KeptAlive { revision: self.told, ..kept }));
            }
            Ok(kept) => {
                *self.opening.entry(session.clone()).or_default() += 1;
                context.reply(answer, Ok(kept));
                context.say(Said::SessionKept(session));
            }
            Err(refused) => context.reply(answer, Err(refused)),
        }
    }

    fn receive(&mut self, message: Message, context: &mut ResourceTurn) {
        let stopped = context.stopped().map(|stopped| stopped.status.clone());
        let message = match stopped {
            None => message,
            Some(stopped) => match refuse_change(message, stopped, context) {
                Some(read) => read,
                None => return,
            },
        };
        let now = context.now();
        match message {
            Message::Perform { speaker, request_id, request, answer } => {
                let reply = self.may_speak(now, &speaker, request.session()).and_then(|()| {
                    let reply = self
                        .pool
                        .handle_as(now, &speaker, &request_id, request)
                        .map_err(|error| status::of_error(&error))?;
                    Ok((reply, self.pool.revision()))
                });
                context.reply(answer, reply);
            }
            Message::Acquire { answer, .. } if self.draining => drop(answer.send(Err(ending()))),
            Message::Acquire { speaker, ticket, request_id, mut request, wait, answer } => {
                if let Err(refused) = self.may_speak(now, &speaker, Some(&request.session)) {
                    return context.reply(answer, Err(refused));
                }
                request.deadline = Some(now + wait.min(self.config.max_wait()));
                match self.pool.handle_as(now, &speaker, &request_id, Request::Acquire(request)) {
                    Ok(Reply::Queued(waiter)) => {
                        self.tickets.insert(ticket, waiter);
                        self.calls.entry(waiter).or_default().push((ticket, answer));
                    }
                    Ok(Reply::Granted(lease)) => self.grant_again(ticket, lease, answer, context),
                    Ok(reply) => debug_assert!(false, "an acquire is queued or granted, not {reply:?}"),
                    Err(error) => context.reply(answer, Err(status::of_error(&error))),
                }
            }
            Message::Abandon { ticket } => self.abandon(ticket, context),
            Message::Withdraw { speaker, session, request_id, answer } => {
                let withdrawn = self.may_speak(now, &speaker, Some(&session)).and_then(|()| {
                    self.pool.withdraw(now, &session, &request_id).map_err(|error| status::of_error(&error))
                });
                context.reply(answer, withdrawn);
            }
            Message::Return { lease } => self.give_back(lease, context),
            Message::Undo { speaker, session, request_id } => {
                if self.may_speak(now, &speaker, Some(&session)).is_ok() {
                    // A request of another session is not undone.
                    let _ = self.pool.undo(now, &session, &request_id);
                }
            }
            Message::Recall { speaker, session, request_ids, answer } => {
                let recalled = recalled(&request_ids, |id| self.pool.recall(now, &speaker, &session, id));
                context.reply(answer, recalled.map_err(|error| status::of_error(&error)));
            }
            Message::Search { mut search, resources, answer } => {
                let finished = self.pool.go_on(&mut search, resources);
                context.tell(answer, (search, finished));
            }
            Message::Get { id, answer } => context.tell(answer, self.pool.get(&id)),
            Message::List { after, most, answer } => {
                let listed = (self.pool.list_after(&after, most), self.pool.revision());
                context.tell(answer, listed);
            }
            Message::Revision { answer } => context.tell(answer, self.pool.revision()),
            Message::Sessions { after, answer } => context.tell(answer, self.sessions(&after, context)),
            Message::WatchDemand { speaker, session, provisions, answer } => {
                let allowed = self.may_speak(now, &speaker, Some(&session));
                let watch = allowed.and_then(|()| self.watch_demand(session, provisions));
                context.reply(answer, watch);
            }
            Message::ReportShortage { speaker, session, kind, most, reason, answer } => {
                let allowed = self.may_speak(now, &speaker, Some(&session));
                let reported = allowed.and_then(|()| self.report_shortage(now, &session, &kind, most, &reason));
                context.reply(answer, reported);
            }
            Message::Waiters { caller, request_id, answer } => {
                let waiters = self.waiters(&caller, &request_id);
                context.reply(answer, waiters);
            }
            Message::Explain { waiters, answer } => context.tell(answer, self.explain(&waiters, now)),
            Message::Watch { after, filter, answer } => {
                let watch = self.watch(after, filter, context);
                context.reply(answer, watch);
            }
        }
    }

    /// Applies the limits of a config; other changes need a restart.
    fn signal(&mut self, config: &ResourceManagerConfig, context: &mut ResourceTurn) {
        let ResourceManagerConfig { max_session_ttl_ms, max_wait_ms, max_watchers, limits, .. } = config.clone();
        self.pool.set_limits(limits.clone());
        // Under wider limits waiting requests may be served.
        if context.stopped().is_none() {
            self.pool.advance(context.now());
        }
        self.config =
            ResourceManagerConfig { max_session_ttl_ms, max_wait_ms, max_watchers, limits, ..self.config.clone() };
    }

    fn collect(&mut self, context: &mut ResourceTurn) {
        for notice in self.pool.take_notices() {
            context.say(Said::Notice(notice));
        }
    }

    fn hand_out(&mut self, said: Said, context: &mut ResourceTurn) {
        match said {
            Said::Notice(notice) => self.notify(notice, context),
            Said::GrantedAgain { ticket } => self.answer_again(ticket, context),
            Said::SessionKept(session) => {
                if let Some(records) = self.opening.get_mut(&session) {
                    *records -= 1;
                    if *records == 0 {
                        self.opening.remove(&session);
                    }
                }
            }
        }
    }

    /// Refuses requests that take or create something, but not those that give back.
    fn refuse(message: Message, behind: &Status) -> Option<Message> {
        match message {
            Message::Perform { request: Request::Create { .. } | Request::Consume { .. }, answer, .. } => {
                let _ = answer.send(Err(behind.clone()));
                None
            }
            Message::Acquire { answer, .. } => {
                let _ = answer.send(Err(behind.clone()));
                None
            }
            message => Some(message),
        }
    }

    /// A create may have as many attributes as fit in a message.
    fn is_large(message: &Message) -> bool {
        matches!(message, Message::Perform { request: Request::Create { .. }, .. })
    }

    fn order(messages: &mut [Message]) {
        most_urgent_first(messages);
    }

    /// Tells all waiting calls, and removes their waiters from the queue.
    fn drain(&mut self, context: &mut ResourceTurn) {
        self.draining = true;
        self.tickets.clear();
        let calls = std::mem::take(&mut self.calls);
        tracing::info!(waiting = calls.len(), "draining: nobody is granted anything any more");
        let now = context.now();
        for (waiter, calls) in calls {
            // Unknown if it was answered at this moment: then the grant finds no call, and goes back.
            let _ = self.pool.cancel(now, waiter);
            for (_, call) in calls {
                let _ = call.send(Err(ending()));
            }
        }
    }

    fn turned(&mut self, context: &mut ResourceTurn) {
        if context.may_speak() {
            self.spread_demand(context);
        }
        let [resources, sessions, leases, waiters] = self.pool.amounts();
        self.metrics.set(Amounts { resources, sessions, leases, waiters, watchers: context.watchers.len() });
    }
}

impl ResourceCore {
    /// Checks that the speaker may act for a session; without a session they act as an operator.
    fn may_speak(&mut self, now: Timestamp, speaker: &Speaker, session: Option<&SessionId>) -> Result<(), Status> {
        match session {
            Some(session) => self.pool.check_speaker(now, speaker, session).map_err(|error| status::of_error(&error)),
            None if speaker.for_anybody => Ok(()),
            None => Err(status::without_session(&speaker.name)),
        }
    }

    fn keep_alive(
        &mut self,
        now: Timestamp,
        speaker: &Speaker,
        session: &SessionId,
        client: &str,
        ttl: Duration,
    ) -> Result<KeptAlive, PoolError> {
        let ttl = ttl.min(self.config.max_session_ttl());
        let created = if ttl.is_zero() {
            self.pool.check_speaker(now, speaker, session)?;
            match self.pool.close_session(now, session) {
                Err(PoolError::UnknownSession { .. }) | Ok(()) => false,
                Err(error) => return Err(error),
            }
        } else {
            self.pool.keep_alive_as(now, speaker, session, client, ttl.max(MIN_SESSION_TTL))?
        };
        if created {
            tracing::info!(%session, client, opened_by = %speaker.name, ttl_ms = ttl.as_millis(), "session opened");
        }
        let number = self.pool.session_number(session).unwrap_or(0);
        Ok(KeptAlive { ttl, created, number, revision: self.pool.revision() })
    }
}

/// Refuses a change. Returns a read, because reads of what is on disk go on.
fn refuse_change(message: Message, stopped: Status, context: &mut ResourceTurn) -> Option<Message> {
    match message {
        Message::Perform { answer, .. } => context.reply(answer, Err(stopped)),
        Message::Acquire { answer, .. } => context.reply(answer, Err(stopped)),
        // A session is checked for it, which makes time go on.
        Message::Recall { answer, .. } => context.reply(answer, Err(stopped)),
        Message::Withdraw { answer, .. } => context.reply(answer, Err(stopped)),
        Message::WatchDemand { answer, .. } => context.reply(answer, Err(stopped)),
        Message::ReportShortage { answer, .. } => context.reply(answer, Err(stopped)),
        Message::Abandon { .. } | Message::Return { .. } | Message::Undo { .. } => {}
        read @ (Message::Search { .. }
        | Message::Get { .. }
        | Message::List { .. }
        | Message::Revision { .. }
        | Message::Sessions { .. }
        | Message::Waiters { .. }
        | Message::Explain { .. }
        | Message::Watch { .. }) => return Some(read),
    }
    None
}

/// What is known of earlier requests, in their order, until the answer is long; at least of the first.
fn recalled(
    request_ids: &[String],
    mut recall: impl FnMut(&str) -> Result<Option<Reply>, PoolError>,
) -> Result<Vec<Option<Reply>>, PoolError> {
    let (mut all, mut units) = (Vec::new(), 0);
    for id in request_ids {
        let reply = recall(id)?;
        if let Some(Reply::Operated(operated)) = &reply {
            units += operated.len();
        }
        all.push(reply);
        if units >= RECALLED_UNITS {
            break;
        }
    }
    Ok(all)
}

#[cfg(test)]
mod tests {
    use super::*;
    use ratn_model::resource::{OperatedUnits, Quantity};

    #[test]
    fn an_answer_about_earlier_requests_ends_when_it_is_long_and_has_the_first_in_any_case() {
        let ids: Vec<String> = (0..100).map(|id| format!("r{id}")).collect();
        let asked = |each: usize| {
            let mut asked = 0;
            let reply = |_: &str| {
                asked += 1;
                let (resource, kind) = ("r".to_owned(), "K".to_owned());
                let unit = OperatedUnits { resource, kind, units: Quantity::ONE, ends_with_session: false };
                Ok(Some(Reply::Operated(vec![unit; each])))
            };
            let answered = recalled(&ids, reply).map(|all| all.len());
            (answered, asked)
        };
        assert_eq!(asked(1), (Ok(100), 100));
        assert_eq!(asked(RECALLED_UNITS / 4), (Ok(4), 4));
        assert_eq!(asked(10 * RECALLED_UNITS), (Ok(1), 1));
    }
}
