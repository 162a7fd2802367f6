//! What leaves the actor: answers, grants and events wait until the records of what they tell of are on the disk. When those cannot be
//! written nothing changes any more, and what can be read is the state that is on the disk.

use super::Actor;
use super::message::Answer;
use crate::details::of_fault;
use crate::metrics;
use crate::outbox::send_answer;
use crate::resource_manager::outgoing::Outgoing;
use crate::resource_manager::{journal, status, wire};
use ratn_resources::{Change, Notice, Pool};
use ratn_storage::{Fault, Progress};
use tokio::sync::oneshot;
use tonic::Status;

impl Actor {
    /// Answers when what the answer tells of is on the disk.
    pub(super) fn reply<T: Send + 'static>(&mut self, answer: Answer<T>, result: Result<T, Status>) {
        self.outgoing.push(Outgoing::Answer(send_answer(answer, result)));
    }

    /// As [`Actor::reply`], to one who only looks; without an answer they ask again.
    pub(super) fn tell<T: Send + 'static>(&mut self, answer: oneshot::Sender<T>, told: T) {
        self.outgoing.push(Outgoing::Answer(Box::new(move |stopped| {
            if stopped.is_none() {
                let _ = answer.send(told);
            }
        })));
    }

    /// What the pool has to say goes behind what was to be said before.
    pub(super) fn collect(&mut self) {
        self.outgoing.extend(self.pool.take_notices().into_iter().map(Outgoing::Notice));
    }

    /// Writes down what has changed, and hands out what is on the disk, including what that in turn leads to.
    pub(super) fn deliver(&mut self) {
        while self.stopped.is_none() {
            self.collect();
            if let Err(error) = self.journal.write(&mut self.pool) {
                return self.stop(&error);
            }
            let position = self.journal.last();
            for outgoing in self.outgoing.drain(..) {
                self.outbox.hold(position, outgoing);
            }
            let reached = |position| self.journal.reached(position);
            let Some(outgoing) = self.outbox.waits_for().filter(|at| reached(*at)).and_then(|_| self.outbox.take())
            else {
                return;
            };
            self.hand_out(outgoing);
        }
        for outgoing in std::mem::take(&mut self.outgoing) {
            self.hand_out(outgoing);
        }
    }

    pub(super) fn hand_out(&mut self, outgoing: Outgoing) {
        match outgoing {
            Outgoing::Answer(answer) => answer(None),
            Outgoing::Watcher(watcher) => self.watchers.push(watcher),
            Outgoing::Notice(Notice::Event(event)) => {
                if let Change::LeaseEnded { lease, .. } = &event.change {
                    self.shared.remove(lease);
                }
                wire::events(&event).into_iter().for_each(|event| self.publish(event));
            }
            Outgoing::Notice(Notice::Granted { waiter, lease }) => {
                let id = lease.id;
                match self.answer(waiter, Ok(lease)) {
                    0 => self.give_back(id),
                    1 => {}
                    calls => drop(self.shared.insert(id, calls)),
                }
            }
            Outgoing::Notice(Notice::Refused { waiter, refusal }) => {
                self.answer(waiter, Err(status::of_refusal(&refusal)));
            }
        }
    }

    /// More is on the disk, or something went wrong.
    pub(super) fn written(&mut self, progress: Result<Progress, Fault>) {
        match progress {
            Ok(Progress { fault: Some(fault), .. }) | Err(fault) => self.stop(&fault),
            Ok(Progress { compaction_failure: Some(failure), compacting: false, .. }) => {
                tracing::warn!(%failure, "the log grows on; the next snapshot is tried later");
            }
            Ok(_) => {}
        }
        if let (None, Some(metrics)) = (&self.stopped, metrics::get()) {
            metrics.journal.commits.inc();
        }
    }

    /// Nothing changes any more. What was not on the disk has not happened.
    pub(super) fn stop(&mut self, fault: &dyn std::error::Error) {
        let stopped = of_fault(fault);
        tracing::error!(fault = stopped.message(), "changes are refused from now on");
        if let Some(metrics) = metrics::get() {
            metrics.journal.failed.set(1);
        }
        // What was let out before was on the disk.
        let mut refused = std::mem::take(&mut self.outgoing);
        while let Some(outgoing) = self.outbox.take() {
            refused.push(outgoing);
        }
        for outgoing in refused {
            if let Outgoing::Answer(answer) = outgoing {
                answer(Some(&stopped));
            }
        }
        for (_, call) in std::mem::take(&mut self.calls).into_values().flatten() {
            let _ = call.send(Err(stopped.clone()));
        }
        self.tickets.clear();
        self.shared.clear();
        // They find a state that may be behind the one they saw coming, and watch again.
        self.watchers.clear();
        match journal::read(&self.journal, self.config.limits.clone()) {
            Ok(pool) => self.pool = pool.with_kinds(self.config.hierarchy()),
            Err(error) => {
                let error = anyhow::Error::new(error);
                tracing::error!(error = format!("{error:#}"), "what is on the disk cannot be read either");
                self.pool = Pool::new(self.config.limits.clone());
            }
        }
        self.stopped = Some(stopped);
    }
}
