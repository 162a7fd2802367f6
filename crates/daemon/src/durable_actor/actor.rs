//! The actor's turns.

use super::desk::{Desk, Outgoing, Stopped};
use super::inbox::Inbox;
use super::outbox::Outbox;
use super::{Core, Journal};
use crate::details::of_fault;
use crate::metrics;
use ratn_storage::{Fault, Progress};
use std::time::{Duration, Instant};
use tokio::sync::watch;
use tokio_util::sync::CancellationToken;

/// Messages that are put into an order together.
const AT_ONCE: usize = 64;
/// What came together is written down together, and nothing else is looked at meanwhile, unless that takes longer than this.
const TURN: Duration = Duration::from_millis(1);

pub(super) struct Actor<C: Core> {
    core: C,
    journal: Journal,
    desk: Desk<C>,
    outbox: Outbox<Outgoing<C>>,
    drained: bool,
}

impl<C: Core> Actor<C> {
    pub(super) fn new(core: C, journal: Journal) -> Actor<C> {
        Actor { core, journal, desk: Desk::new(), outbox: Outbox::default(), drained: false }
    }

    pub(super) async fn run(
        mut self,
        mut inbox: Inbox<C>,
        mut signals: watch::Receiver<C::Signal>,
        draining: CancellationToken,
        over: CancellationToken,
    ) {
        let mut arrived = Vec::new();
        loop {
            let deadline = self.core.next_deadline(&self.desk).map(|at| self.desk.instant(at));
            let (running, room) = (self.desk.stopped().is_none(), !self.outbox.is_full());
            tokio::select! {
                biased;
                () = over.cancelled() => return self.end(),
                () = draining.cancelled(), if !self.drained => self.drain(),
                Some(urgent) = inbox.urgent.recv() => self.receive_urgent(urgent),
                Ok(()) = signals.changed() => self.core.signal(&signals.borrow_and_update(), &mut self.desk),
                progress = self.journal.changed(), if running => self.written(progress),
                () = sleep_until(deadline) => self.core.advance(&mut self.desk),
                count = inbox.messages.recv_many(&mut arrived, AT_ONCE), if room => {
                    if count == 0 {
                        return self.end();
                    }
                    C::order(&mut arrived);
                    let mut turn = Instant::now();
                    for message in arrived.drain(..) {
                        while let Ok(urgent) = inbox.urgent.try_recv() {
                            self.receive_urgent(urgent);
                        }
                        let alone = C::is_large(&message);
                        self.core.receive(message, &mut self.desk);
                        self.collect();
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
            self.core.turned(&mut self.desk);
        }
    }

    fn receive_urgent(&mut self, urgent: C::Urgent) {
        self.core.receive_urgent(urgent, &mut self.desk);
        self.collect();
    }

    fn drain(&mut self) {
        self.drained = true;
        self.core.drain(&mut self.desk);
        self.collect();
    }

    /// Lets out what is on the disk by now, and what the rest of it was waiting for.
    fn end(mut self) {
        self.deliver();
        match self.journal.close() {
            Ok(()) => self.deliver(),
            Err(fault) => self.stop(&fault),
        }
    }

    /// What the state has to say goes behind what was to be said before.
    fn collect(&mut self) {
        if self.desk.stopped().is_none() {
            self.core.collect(&mut self.desk);
        }
    }

    /// Writes down what has changed, and hands out what is on the disk, including what that in turn leads to.
    fn deliver(&mut self) {
        while self.desk.stopped().is_none() {
            self.collect();
            if let Err(error) = self.journal.write(self.core.state()) {
                return self.stop(&error);
            }
            let position = self.journal.last();
            for outgoing in self.desk.take_outgoing() {
                self.outbox.hold(position, outgoing);
            }
            let Some(outgoing) = self.take_durable() else { return };
            self.hand_out(outgoing);
        }
        for outgoing in self.desk.take_outgoing() {
            self.hand_out(outgoing);
        }
    }

    fn take_durable(&mut self) -> Option<Outgoing<C>> {
        let first = self.outbox.waits_for()?;
        if self.journal.reached(first) { self.outbox.take() } else { None }
    }

    fn hand_out(&mut self, outgoing: Outgoing<C>) {
        let unreadable = self.desk.stopped().filter(|stopped| stopped.unreadable).map(|stopped| stopped.status.clone());
        match outgoing {
            Outgoing::Answer(answer) => answer(unreadable.as_ref()),
            Outgoing::Watcher(watcher) if unreadable.is_none() => self.desk.watchers.add(watcher),
            Outgoing::Said(said) if unreadable.is_none() => self.core.hand_out(said, &mut self.desk),
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
        if let Some(metrics) = metrics::get() {
            metrics.journal.commits.inc();
        }
    }

    /// Nothing changes any more. What was not on the disk has not happened.
    fn stop(&mut self, fault: &dyn std::error::Error) {
        let status = of_fault(fault);
        tracing::error!(fault = status.message(), "changes are refused from now on");
        if let Some(metrics) = metrics::get() {
            metrics.journal.failed.set(1);
        }
        while let Some(outgoing) = self.take_durable() {
            self.hand_out(outgoing);
        }
        let mut refused = self.outbox.take_all();
        refused.extend(self.desk.take_outgoing());
        for outgoing in refused {
            if let Outgoing::Answer(answer) = outgoing {
                answer(Some(&status));
            }
        }
        // They find a state that may be behind the one they saw coming, and watch again.
        self.desk.watchers.clear();
        self.desk.stop(Stopped { status, unreadable: false });
        if let Err(error) = self.core.restore(&self.journal, &self.desk) {
            let error = anyhow::Error::new(error);
            tracing::error!(error = format!("{error:#}"), "what is on the disk cannot be read either");
            self.desk.set_unreadable();
        }
    }
}

async fn sleep_until(deadline: Option<Instant>) {
    match deadline {
        Some(deadline) => tokio::time::sleep_until(deadline.into()).await,
        None => std::future::pending().await,
    }
}
