//! The course of an acquire: from the request to the resource manager to the event of its answer, or of the lease that another node of the run has
//! handed over meanwhile.

use super::goals::Doubtful;
use super::waiting::{LONG_BESIDE_OTHERS, OVERDUE};
use super::{Answer, Whom, Withdrawal};
use crate::decided::{REFUSED_PATIENCE, Unanswered, insist};
use crate::ledger::late_request;
use crate::performer::told::Told;
use crate::record::said;
use ratn_executive::protocol::{CERTAIN, Event};
use ratn_model::catalogue::Catalogue;
use ratn_model::condition::Condition;
use ratn_model::id::{InstanceId, LeaseId};
use ratn_model::resource::{Lease, Requirement, ResourceOperation};
use ratn_proto::types::ENDPOINT_ATTRIBUTE;
use ratn_proto::v1::HolderNote;
use ratn_worker::client::retry_until_answered;
use ratn_worker::client::{AcquireOptions, CallError, ResourceClient};
use ratn_worker::session::Trust;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;
use tokio::sync::mpsc::error::SendError;
use tokio::sync::{mpsc, oneshot};
use tokio_util::sync::{CancellationToken, DropGuard};

/// Reason code: the deadline of an acquire has passed.
const TOO_LATE: &str = "NOT_GRANTED_IN_TIME";

/// A goal can be given only to a resource that says its endpoint, so the acquire of a performer's kind requires one, whoever created the resource.
fn of_performers(catalogue: &Catalogue, requirement: &mut Requirement) {
    let performs = catalogue.providers.values().any(|provider| provider.resource == requirement.kind);
    if performs && requirement.operation == ResourceOperation::Block {
        requirement.conditions.push(Condition::has(ENDPOINT_ATTRIBUTE));
    }
}

/// The course of one acquire.
pub(super) struct Acquiring {
    pub(super) instance: InstanceId,
    pub(super) requirements: Vec<Requirement>,
    pub(super) catalogue: Arc<Catalogue>,
    pub(super) options: AcquireOptions,
    /// How long its instance has waited before, with other priorities.
    pub(super) waited: Duration,
    /// The request is sent when these operations of the run are done: each token is cancelled then.
    pub(super) after: Vec<CancellationToken>,
    pub(super) withdrawn: CancellationToken,
    pub(super) handed: oneshot::Receiver<Lease>,
    pub(super) resources: ResourceClient,
    pub(super) trust: Trust,
    pub(super) told: Told,
    /// A lease that is handed over may have been that of a goal that was lost.
    pub(super) doubtful: Doubtful,
    pub(super) whom: Whom,
    /// Cancels [`super::waiting::Asking::over`] when its last clone is dropped.
    pub(super) over: Arc<DropGuard>,
}

enum Got {
    Handed(Lease),
    Answer(Result<(Lease, Vec<HolderNote>), CallError>),
    /// The acquire was withdrawn.
    Nothing,
}

impl Acquiring {
    /// Waits for the answer and sends it to the shell. If a lease is handed over at once, the resource manager is not asked.
    pub(super) async fn ask(mut self, events: mpsc::Sender<Answer>) {
        if let Ok(lease) = self.handed.try_recv() {
            self.tell(Event::Granted { instance: self.instance, lease }, &events).await;
            return;
        }
        self.requirements.iter_mut().for_each(|one| of_performers(&self.catalogue, one));
        if !self.operations_are_done().await {
            // The request was not sent. A lease that was handed over before the withdrawal goes back.
            self.handed.close();
            if let Ok(lease) = self.handed.try_recv() {
                self.tell(Event::Granted { instance: self.instance, lease }, &events).await;
            }
            return;
        }
        let unheard = AtomicBool::new(false);
        let got = self.got(&unheard).await;
        // From now on a lease can no longer be handed over.
        self.handed.close();
        let got = match (self.handed.try_recv(), got) {
            // A grant by the manager at the same moment goes back with the withdrawal.
            (Ok(lease), _) | (_, Got::Handed(lease)) => Got::Handed(lease),
            (_, got) => got,
        };
        let event = match got {
            Got::Nothing => {
                self.withdraw().await;
                return;
            }
            Got::Handed(lease) => {
                self.tell(Event::Granted { instance: self.instance, lease }, &events).await;
                self.withdraw().await;
                return;
            }
            Got::Answer(answer) => {
                if answer.is_err() && unheard.into_inner() {
                    // An answer that was lost before the refusal may have been a grant.
                    self.withdraw().await;
                }
                let Some(event) = self.event_of(answer).await else { return };
                event
            }
        };
        self.tell(event, &events).await;
    }

    /// Waits for the operations before this acquire; false if it is withdrawn before they are done.
    async fn operations_are_done(&self) -> bool {
        for operation in &self.after {
            tokio::select! {
                biased;
                () = self.withdrawn.cancelled() => return false,
                () = operation.cancelled() => {}
            }
        }
        true
    }

    async fn tell(&self, event: Event, events: &mpsc::Sender<Answer>) {
        let withdrawn = Some(Withdrawal { token: self.withdrawn.clone(), over: Arc::clone(&self.over) });
        let sent = events.send(Answer::Event { event: Box::new(event), withdrawn }).await;
        // The run has ended, and may be about to delete what was granted.
        if let Err(SendError(Answer::Event { event, .. })) = sent
            && let Event::Granted { lease, .. } = *event
        {
            self.give_back(lease.id).await;
        }
    }

    async fn give_back(&self, lease: LeaseId) {
        let at_rest = self.doubtful.goes_back_at_rest(lease);
        let release = || self.resources.release_with_note(lease, String::new(), at_rest);
        if let Err(undone) = insist(&self.trust, Unanswered::Waits, release).await {
            tracing::warn!(instance = %self.instance, "a lease that is not used was not given back: {undone}");
        }
    }

    async fn got(&mut self, unheard: &AtomicBool) -> Got {
        loop {
            let ask = || async {
                let asked = self.resources.acquire_with_notes(self.requirements.clone(), self.options.clone());
                let answer = asked.await;
                unheard.fetch_or(answer.as_ref().is_err_and(CallError::is_crash), Ordering::Relaxed);
                answer
            };
            let may_be_late = (CERTAIN..OVERDUE).contains(&self.options.priority);
            let late = LONG_BESIDE_OTHERS.saturating_sub(self.waited);
            tokio::select! {
                biased;
                Ok(lease) = &mut self.handed, if !self.handed.is_terminated() => return Got::Handed(lease),
                () = self.withdrawn.cancelled() => return Got::Nothing,
                // A manager that does not answer is waited for until the run gives its session up ([`super::Performer::lost`]).
                answer = retry_until_answered(REFUSED_PATIENCE, ask) => match answer {
                    // A speculative acquire goes on waiting, with the time that it has waited. If it becomes certain, it is requested anew.
                    Err(error) if self.options.speculative && error.reason() == TOO_LATE => continue,
                    answer => return Got::Answer(answer),
                },
                // It has waited too long beside other runs: asks again as overdue.
                () = self.told.others_after(late), if may_be_late => {}
            }
            tokio::select! {
                biased;
                Ok(lease) = &mut self.handed, if !self.handed.is_terminated() => return Got::Handed(lease),
                () = self.withdrawn.cancelled() => return Got::Nothing,
                // The first request is withdrawn, because both could be granted.
                () = withdraw(&self.resources, &self.trust, &self.options.request) => {}
            }
            // A new request id: a restarted manager has not heard of the first request, and refuses a request that was withdrawn before it came.
            let late = late_request(&self.options.request);
            self.options.instead_of = std::mem::replace(&mut self.options.request, late);
            self.options.priority = OVERDUE;
        }
    }

    /// Withdraws the request; a lease that was granted meanwhile goes back.
    async fn withdraw(&self) {
        withdraw(&self.resources, &self.trust, &self.options.request).await;
    }

    /// The event of an answer of the resource manager, once the run has been told the notes of earlier holders. `None` if the acquire is withdrawn
    /// before: then the lease goes back, and the notes remain for its next holder.
    async fn event_of(&self, answer: Result<(Lease, Vec<HolderNote>), CallError>) -> Option<Event> {
        let instance = self.instance;
        let (lease, notes) = match answer {
            Ok(granted) => granted,
            Err(error) => return Some(Event::Refused { instance, reason: refused(&error) }),
        };
        let event = tokio::select! {
            told = self.told.until(&notes, &self.whom) => match told {
                Ok(()) => return Some(Event::Granted { instance, lease }),
                Err(reason) => Some(Event::Refused { instance, reason }),
            },
            () = self.withdrawn.cancelled() => None,
        };
        self.give_back(lease.id).await;
        event
    }
}

async fn withdraw(resources: &ResourceClient, trust: &Trust, request: &str) {
    if let Err(undone) = insist(trust, Unanswered::Waits, || resources.withdraw(request)).await {
        tracing::warn!(request, "an acquire was not withdrawn: {undone}");
    }
}

/// The reason of a refusal; a bound that was reached is named in the resource manager's words.
fn refused(error: &CallError) -> String {
    let reason = said(error);
    match (error.is_crash(), error.again_after()) {
        (false, Some(_)) => {
            format!("{reason} ({}; it was asked again for {} s)", error.reason(), REFUSED_PATIENCE.as_secs())
        }
        _ => reason,
    }
}
