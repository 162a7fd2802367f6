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

/// Maximum number of messages that are ordered together as a batch.
const AT_ONCE: usize = 64;
/// Maximum number of urgent messages that are taken in a row while others wait.
const URGENT_AT_ONCE: usize = 64;
/// Messages that arrive together are written to the log together. A batch that takes longer than this is split: its changes so far are
/// written, and urgent messages are read.
const TURN: Duration = Duration::from_millis(1);
/// Time for pending records to reach the disk before the state is closed.
const LAST_WRITES: Duration = Duration::from_secs(1);

pub(super) struct Actor<C: Core> {
    core: C,
    journal: Journal,
    context: TurnContext<C>,
    outbox: Outbox<Outgoing<C>>,
    drained: bool,
    /// The actor may send nothing for now, and its health says so.
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
        // Urgent messages since the last other message.
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
            // Urgent messages come first, but cannot starve the others.
            let urgent_first = urgent_taken < URGENT_AT_ONCE || !room || inbox.messages.is_empty();
            tokio::select! {
                biased;
                () = over.cancelled() => return self.end().await,
                () = draining.cancelled(), if !self.drained => self.drain(),
                // While the actor may not speak, answers to urgent messages are held back like all others, so urgent messages need room,
                // too.
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
                            // Lets urgent messages that came meanwhile be read.
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

    /// A batch of messages may take long, so each message is a sign of life.
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

    /// Sends what is on the disk by now, and what waited for the rest. A disk or an etcd that hangs does not keep the actor from showing
    /// that it is alive: how long the end may take is decided by the deadline of the process, not by a watchdog.
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
                // What is on the disk is sent before the place is given up.
                Ok(Progress { fault: None, .. }) = self.journal.changed() => self.hand_out_durable(),
                () = tokio::time::sleep(TICK) => {}
            }
            self.vitals.beat();
        };
        match closed {
            // Changes that this causes are not written any more.
            Ok(Ok(())) => self.hand_out_durable(),
            // The process was told to end, and nobody was told of anything that is lost.
            Ok(Err(fault)) if self.journal.is_written() => {
                tracing::info!(%fault, "all was written before");
                self.outbox.take_all();
            }
            Ok(Err(fault)) => drop(self.refuse_changes(&fault)),
            // The runtime is shutting down, and with it the process.
            Err(error) => tracing::debug!(%error, "nobody waits for the state to be closed"),
        }
    }

    /// Waits up to `LAST_WRITES` until everything is on the disk, also the changes that sending causes: a grant whose client is gone is
    /// given back. A closed log accepts nothing.
    async fn write_last(&mut self) {
        let until = Instant::now() + LAST_WRITES;
        while self.context.stopped().is_none() && Instant::now() < until {
            let written = self.journal.is_written();
            self.deliver();
            // Everything was sent, and nothing new came of it.
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

    /// Queues what the state has to say behind everything that is queued already.
    fn collect(&mut self) {
        if self.context.stopped().is_none() {
            self.core.collect(&mut self.context);
        }
    }

    /// Writes what has changed to the journal, and sends what is on the disk, including what that in turn causes.
    fn deliver(&mut self) {
        loop {
            self.collect();
            let written = match self.context.stopped() {
                // Nothing more can be written: whatever is told now is on the disk already.
                Some(_) => Ok(Position(0)),
                None => self.journal.write(self.core.state()),
            };
            match written {
                Ok(position) => {
                    for outgoing in self.context.take_outgoing() {
                        self.outbox.hold(position, outgoing);
                    }
                }
                // The entry has no position yet.
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

    /// More records are on the disk, or writing failed.
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

    /// The writer of the state cannot be confirmed: nothing is sent until it can.
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

    /// A failed log stays reported, whatever else there is to report.
    fn tell_health(&self, silence: Option<&str>) {
        match (self.context.stopped(), silence) {
            (Some(stopped), _) => self.vitals.unwell(storage_failed(&stopped.status)),
            (None, Some(why)) => {
                self.vitals.unwell(format!("nothing is said: it cannot be seen who has the state ({why})"))
            }
            (None, None) => self.vitals.well(),
        }
    }

    /// Another process has the state: this one sends nothing more and ends.
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

    /// No changes from now on. Changes that were not on the disk have not happened, and are not shown either.
    fn stop(&mut self, fault: &(dyn std::error::Error + 'static)) {
        if self.refuse_changes(fault)
            && let Err(error) = self.core.restore(&self.journal, &self.context)
        {
            let error = anyhow::Error::new(error);
            tracing::error!(error = format!("{error:#}"), "what is on the disk cannot be read either");
            self.context.set_unreadable();
        }
    }

    /// No changes from now on. Returns whether the state on the disk may still be shown.
    fn refuse_changes(&mut self, fault: &(dyn std::error::Error + 'static)) -> bool {
        let status = of_fault(fault);
        match fault_of(fault) {
            Some(Fault::Ended { .. }) => {
                self.vitals.fail(CoreFailure::Panicked { part: "the log".to_owned(), what: fault.to_string() });
            }
            // Another process may be able to write: this one gives up its place and stands by.
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
        // Watchers may have been told of changes that are not on the disk; they watch again.
        self.context.watchers.clear();
        self.context.stop(Stopped { status, unreadable: false });
        true
    }
}

fn storage_failed(status: &Status) -> String {
    format!("storage failed: {}", status.message())
}

/// The error of the operating system; the fault's own text speaks of writing.
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
