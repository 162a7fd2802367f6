//! The actor's turns.

use super::clock::TICK;
use super::inbox::Inbox;
use super::may_speak::{MaySpeak, Speech, failure_of};
use super::outbox::Outbox;
use super::turn_context::{Outgoing, Stopped, TurnContext};
use super::{Core, Journal};
use crate::details::of_fault;
use ratn_panic_point::panic_point;
use ratn_storage::{AppendError, Fault, Position, Progress};
use ratn_worker::vitals::{CoreFailure, Vitals};
use std::time::{Duration, Instant};
use tokio::sync::watch;
use tokio_util::sync::CancellationToken;
use tonic::Status;

/// Messages that are put into an order together.
const AT_ONCE: usize = 64;
/// Urgent messages that are taken in a row while others wait.
const URGENT_AT_ONCE: usize = 64;
/// What came together is written down together, and nothing else is looked at meanwhile, unless that takes longer than this.
const TURN: Duration = Duration::from_millis(1);
/// Before the state is closed, what is being written has so long to be on the disk.
const LAST_WRITES: Duration = Duration::from_secs(1);

pub(super) struct Actor<C: Core> {
    core: C,
    journal: Journal,
    context: TurnContext<C>,
    outbox: Outbox<Outgoing<C>>,
    drained: bool,
    /// Nothing may be said for now, and health says so.
    silenced: bool,
    vitals: Vitals,
}

impl<C: Core> Actor<C> {
    pub(super) fn new(core: C, journal: Journal, may_speak: MaySpeak, vitals: Vitals) -> Actor<C> {
        Actor {
            core,
            journal,
            context: TurnContext::new(may_speak),
            outbox: Outbox::default(),
            drained: false,
            silenced: false,
            vitals,
        }
    }

    pub(super) async fn run(
        mut self,
        mut inbox: Inbox<C>,
        mut signals: watch::Receiver<C::Signal>,
        draining: CancellationToken,
        over: CancellationToken,
    ) {
        let mut arrived = Vec::new();
        // Since other messages were.
        let mut urgent_taken = 0;
        let mut tick = tokio::time::interval(TICK);
        tick.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Delay);
        loop {
            self.context.begin_turn();
            self.vitals.beat();
            panic_point("durable-actor");
            match self.context.speech().now() {
                Speech::Over(fault) => return self.fenced(&fault),
                Speech::Held(why) => self.silence(why.as_ref()),
                Speech::Allowed => self.end_silence(),
            }
            let deadline = self.core.next_deadline(&self.context).and_then(|at| self.context.instant(at));
            let (running, room) = (self.context.stopped().is_none(), !self.outbox.is_full() && !self.context.is_full());
            // What is urgent comes first, but not for ever.
            let urgent_first = urgent_taken < URGENT_AT_ONCE || !room || inbox.messages.is_empty();
            tokio::select! {
                biased;
                () = over.cancelled() => return self.end().await,
                () = draining.cancelled(), if !self.drained => self.drain(),
                // While nothing may be said its answers wait as all do, so it waits for room as well.
                Some(urgent) = inbox.urgent.recv(), if urgent_first && (room || self.context.may_speak()) => {
                    urgent_taken += 1;
                    self.receive_urgent(urgent);
                }
                Ok(()) = signals.changed() => self.core.signal(&signals.borrow_and_update(), &mut self.context),
                progress = self.journal.changed(), if running => self.written(progress),
                _ = tick.tick() => {}
                () = self.context.speech().changed() => {}
                () = sleep_until(deadline) => self.core.advance(&mut self.context),
                count = inbox.messages.recv_many(&mut arrived, AT_ONCE), if room => {
                    if count == 0 {
                        return self.end().await;
                    }
                    urgent_taken = 0;
                    C::order(&mut arrived);
                    let mut turn = Instant::now();
                    for message in arrived.drain(..) {
                        for _ in 0..URGENT_AT_ONCE {
                            let Ok(urgent) = inbox.urgent.try_recv() else { break };
                            self.receive_urgent(urgent);
                        }
                        let alone = C::is_large(&message);
                        self.receive(message);
                        if alone {
                            self.deliver();
                        }
                        if turn.elapsed() > TURN {
                            self.deliver();
                            // So that what is urgent and came meanwhile is read.
                            tokio::task::yield_now().await;
                            turn = Instant::now();
                        }
                    }
                }
            }
            self.deliver();
            self.core.turned(&mut self.context);
        }
    }

    fn receive_urgent(&mut self, urgent: C::Urgent) {
        self.vitals.beat();
        self.core.receive_urgent(urgent, &mut self.context);
        self.collect();
    }

    /// A batch of messages may take long: each of them is a sign of life.
    fn receive(&mut self, message: C::Message) {
        self.vitals.beat();
        let behind = if self.context.stopped().is_none() { self.journal.behind() } else { None };
        let message = match behind {
            Some(behind) => C::refuse(message, &behind),
            None => Some(message),
        };
        if let Some(message) = message {
            self.core.receive(message, &mut self.context);
            self.collect();
        }
    }

    fn drain(&mut self) {
        self.drained = true;
        self.core.drain(&mut self.context);
        self.collect();
    }

    /// Lets out what is on the disk by now, and what the rest of it was waiting for. A disk or an etcd that hangs does not keep it from
    /// showing that it is alive: how long this may take is decided by the deadline of the process, not by a watchdog.
    async fn end(mut self) {
        self.deliver();
        self.write_last().await;
        tracing::info!("the state is closed when all of it is written");
        self.context.speech().expect_loss();
        let mut closing = self.journal.close();
        let closed = loop {
            tokio::select! {
                biased;
                closed = &mut closing => break closed,
                // What is on the disk leaves before the place is given up.
                Ok(Progress { fault: None, .. }) = self.journal.changed() => self.hand_out_durable(),
                () = tokio::time::sleep(TICK) => {}
            }
            self.vitals.beat();
        };
        match closed {
            // What changes by it now is not written any more.
            Ok(Ok(())) => self.hand_out_durable(),
            // It is the end of a process that was told to end. Nobody was told of anything that is lost.
            Ok(Err(fault)) if self.journal.is_written() => {
                tracing::info!(%fault, "all was written before");
                self.outbox.take_all();
            }
            Ok(Err(fault)) => drop(self.refuse_changes(&fault)),
            // The runtime ends, and with it the process.
            Err(error) => tracing::debug!(%error, "nobody waits for the state to be closed"),
        }
    }

    /// Waits for a moment until all is on the disk, also what handing it out led to: a grant that nobody waits for any more is given back. A
    /// log that is closed takes nothing.
    async fn write_last(&mut self) {
        let until = Instant::now() + LAST_WRITES;
        while self.context.stopped().is_none() && Instant::now() < until {
            let written = self.journal.is_written();
            self.deliver();
            // All was handed out, and led to nothing new.
            if written && self.journal.is_written() {
                return;
            }
            tokio::select! {
                biased;
                progress = self.journal.changed() => if !matches!(progress, Ok(Progress { fault: None, .. })) { return },
                () = tokio::time::sleep(TICK) => {}
            }
            self.vitals.beat();
        }
    }

    /// What the state has to say goes behind what was to be said before.
    fn collect(&mut self) {
        if self.context.stopped().is_none() {
            self.core.collect(&mut self.context);
        }
    }

    /// Writes down what has changed, and hands out what is on the disk, including what that in turn leads to.
    fn deliver(&mut self) {
        loop {
            self.collect();
            let written = match self.context.stopped() {
                // What is told when nothing can be written any more is on the disk.
                Some(_) => Ok(Position(0)),
                None => self.journal.write(self.core.state()),
            };
            match written {
                Ok(position) => {
                    for outgoing in self.context.take_outgoing() {
                        self.outbox.hold(position, outgoing);
                    }
                }
                // It has no position yet.
                Err(AppendError::Full { .. }) => {}
                Err(error) => self.stop(&error),
            }
            if !self.context.may_speak() {
                return;
            }
            let Some(outgoing) = self.take_durable() else { return };
            self.hand_out(outgoing);
        }
    }

    fn hand_out_durable(&mut self) {
        while self.context.may_speak()
            && let Some(outgoing) = self.take_durable()
        {
            self.hand_out(outgoing);
        }
    }

    fn take_durable(&mut self) -> Option<Outgoing<C>> {
        let first = self.outbox.waits_for()?;
        if self.journal.reached(first) { self.outbox.take() } else { None }
    }

    fn hand_out(&mut self, outgoing: Outgoing<C>) {
        let unreadable =
            self.context.stopped().filter(|stopped| stopped.unreadable).map(|stopped| stopped.status.clone());
        match outgoing {
            Outgoing::Answer(answer) => answer(unreadable.as_ref()),
            Outgoing::Watcher(watcher) if unreadable.is_none() => self.context.watchers.add(watcher),
            Outgoing::Said(said) if unreadable.is_none() => self.core.hand_out(said, &mut self.context),
            Outgoing::Watcher(_) | Outgoing::Said(_) => {}
        }
    }

    /// More is on the disk, or something went wrong.
    fn written(&mut self, progress: Result<Progress, Fault>) {
        match progress {
            Ok(Progress { fault: Some(fault), .. }) | Err(fault) => return self.stop(&fault),
            Ok(Progress { compaction_failure: Some(failure), compacting: false, .. }) => {
                tracing::warn!(%failure, "the log grows on; the next snapshot is tried later");
            }
            Ok(_) => {}
        }
        self.journal.metrics().commits.inc();
    }

    /// It cannot be seen who has the state: nothing is said until it can.
    fn silence(&mut self, why: Option<&Fault>) {
        if std::mem::replace(&mut self.silenced, true) {
            return;
        }
        let why = why.map_or_else(|| "a look at it does not end".to_owned(), reason_of);
        tracing::error!(why, "it cannot be seen who has this state: nothing is said until it can");
        self.tell_health(Some(&why));
    }

    fn end_silence(&mut self) {
        if std::mem::take(&mut self.silenced) {
            tracing::info!("this process is seen to have its state again");
            self.tell_health(None);
        }
    }

    /// A log that has failed stays so, whatever else there is to say.
    fn tell_health(&self, silence: Option<&str>) {
        match (self.context.stopped(), silence) {
            (Some(stopped), _) => self.vitals.unwell(storage_failed(&stopped.status)),
            (None, Some(why)) => {
                self.vitals.unwell(format!("nothing is said: it cannot be seen who has the state ({why})"))
            }
            (None, None) => self.vitals.well(),
        }
    }

    /// Another process has the state: nothing is said any more, and this one ends.
    fn fenced(&mut self, fault: &Fault) {
        self.outbox.take_all();
        self.context.take_outgoing();
        self.context.watchers.clear();
        let what = fault.to_string();
        if self.drained && self.journal.is_written() {
            return tracing::warn!(what, "it was to end anyhow, and all was written");
        }
        self.vitals.fail(failure_of(fault));
    }

    /// Nothing changes any more. What was not on the disk has not happened, and is not shown either.
    fn stop(&mut self, fault: &(dyn std::error::Error + 'static)) {
        if self.refuse_changes(fault)
            && let Err(error) = self.core.restore(&self.journal, &self.context)
        {
            let error = anyhow::Error::new(error);
            tracing::error!(error = format!("{error:#}"), "what is on the disk cannot be read either");
            self.context.set_unreadable();
        }
    }

    /// Nothing changes any more. Whether what is on the disk may still be shown.
    fn refuse_changes(&mut self, fault: &(dyn std::error::Error + 'static)) -> bool {
        let status = of_fault(fault);
        match fault_of(fault) {
            Some(Fault::Ended { .. }) => {
                self.vitals.fail(CoreFailure::Panicked { part: "the log".to_owned(), what: fault.to_string() });
            }
            // Another process may be able to write: this one gives the place up, and stands by.
            Some(Fault::Remote { .. }) => self.vitals.fail(CoreFailure::Deposed { what: fault.to_string() }),
            Some(fenced) if fenced.is_lost_place() => {
                self.context.stop(Stopped { status, unreadable: true });
                self.fenced(fenced);
                return false;
            }
            _ => {}
        }
        self.vitals.unwell(storage_failed(&status));
        tracing::error!(fault = status.message(), "changes are refused from now on");
        self.journal.metrics().failed.set(1);
        self.hand_out_durable();
        let mut refused = self.outbox.take_all();
        refused.extend(self.context.take_outgoing());
        for outgoing in refused {
            if let Outgoing::Answer(answer) = outgoing {
                answer(Some(&status));
            }
        }
        // They find a state that may be behind the one they saw coming, and watch again.
        self.context.watchers.clear();
        self.context.stop(Stopped { status, unreadable: false });
        true
    }
}

fn storage_failed(status: &Status) -> String {
    format!("storage failed: {}", status.message())
}

/// What the system said; a fault's own text speaks of writing.
fn reason_of(fault: &Fault) -> String {
    match fault {
        Fault::Io { action, place, source } => format!("cannot {action} {place}: {source}"),
        other => other.to_string(),
    }
}

fn fault_of<'a>(error: &'a (dyn std::error::Error + 'static)) -> Option<&'a Fault> {
    match error.downcast_ref::<AppendError>() {
        Some(AppendError::Stopped(fault)) => Some(fault),
        _ => error.downcast_ref(),
    }
}

async fn sleep_until(deadline: Option<Instant>) {
    match deadline {
        Some(deadline) => tokio::time::sleep_until(deadline.into()).await,
        None => std::future::pending().await,
    }
}
