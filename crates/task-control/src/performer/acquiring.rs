//! What a run has asked for and has no answer to, and each acquire's way: from asking the resource manager to the event of its answer, or
//! of the lease that another node of the run has handed over meanwhile.

use super::{Answer, LONG_BESIDE_OTHERS, OVERDUE, Whom, Withdrawal};
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
use std::cmp::Reverse;
use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};
use tokio::sync::mpsc::error::SendError;
use tokio::sync::{mpsc, oneshot};
use tokio_util::sync::{CancellationToken, DropGuard};

/// What the resource manager says where the deadline of an acquire has passed.
const TOO_LATE: &str = "NOT_GRANTED_IN_TIME";

/// An acquire under way.
#[derive(Debug)]
pub(super) struct Asking {
    pub(super) request: String,
    /// Of the run's acquires.
    pub(super) number: u64,
    pub(super) priority: i64,
    pub(super) requirements: Vec<Requirement>,
    pub(super) since: Instant,
    pub(super) withdrawn: CancellationToken,
    /// Is cancelled when nothing of it is on its way any more: also what was granted although it is withdrawn has gone back.
    pub(super) over: CancellationToken,
    /// Takes a lease in place of the manager's answer; `None` once it has one.
    pub(super) hand: Option<oneshot::Sender<Lease>>,
}

#[cfg(test)]
impl Asking {
    pub(super) fn for_tests(
        number: u64,
        requirements: Vec<Requirement>,
        priority: i64,
    ) -> (Asking, oneshot::Receiver<Lease>) {
        let (hand, handed) = oneshot::channel();
        let (since, withdrawn) = (Instant::now(), CancellationToken::new());
        let request = format!("r/{number}");
        let over = CancellationToken::new();
        (Asking { request, number, priority, requirements, since, withdrawn, over, hand: Some(hand) }, handed)
    }
}

/// All acquires under way.
#[derive(Debug, Default)]
pub(super) struct Waiting {
    asking: BTreeMap<InstanceId, Asking>,
    /// In the order in which the resource manager serves those that want the same.
    order: BTreeMap<(Reverse<i64>, u64), InstanceId>,
}

impl Waiting {
    pub(super) fn insert(&mut self, instance: InstanceId, asking: Asking) {
        self.remove(instance);
        self.order.insert((Reverse(asking.priority), asking.number), instance);
        self.asking.insert(instance, asking);
    }

    pub(super) fn remove(&mut self, instance: InstanceId) -> Option<Asking> {
        let asking = self.asking.remove(&instance)?;
        self.order.remove(&(Reverse(asking.priority), asking.number));
        Some(asking)
    }

    pub(super) fn get(&self, instance: InstanceId) -> Option<&Asking> {
        self.asking.get(&instance)
    }

    /// Who waits, whoever comes first before the others.
    pub(super) fn in_order(&self) -> impl Iterator<Item = (InstanceId, &Asking)> {
        self.order.values().filter_map(|instance| Some((*instance, self.asking.get(instance)?)))
    }

    /// Who has waited longest for an answer.
    pub(super) fn longest(&self) -> Option<(InstanceId, &Asking)> {
        let longest = self.asking.iter().min_by_key(|(_, asking)| asking.since)?;
        Some((*longest.0, longest.1))
    }

    /// Hands a lease to one that waits; nothing where it does not.
    ///
    /// # Errors
    /// Where it has its answer, or another lease, already.
    pub(super) fn hand(&mut self, to: InstanceId, lease: &Lease) -> Option<Result<(), ()>> {
        let hand = self.asking.get_mut(&to)?.hand.take();
        Some(hand.ok_or(()).and_then(|hand| hand.send(lease.clone()).map_err(drop)))
    }
}

/// What performs goals says where it is: a resource of that kind that does not is nobody's to give a goal to, whoever made it.
fn of_performers(catalogue: &Catalogue, requirement: &mut Requirement) {
    let performs = catalogue.providers.values().any(|provider| provider.resource == requirement.kind);
    if performs && requirement.operation == ResourceOperation::Block {
        requirement.conditions.push(Condition::has(ENDPOINT_ATTRIBUTE));
    }
}

/// One acquire's way.
pub(super) struct Acquiring {
    pub(super) instance: InstanceId,
    pub(super) requirements: Vec<Requirement>,
    pub(super) catalogue: Arc<Catalogue>,
    pub(super) options: AcquireOptions,
    /// So long its instance has waited before, with other priorities.
    pub(super) waited: Duration,
    /// It leaves when these operations of the run are done: each token is cancelled then.
    pub(super) after: Vec<CancellationToken>,
    pub(super) withdrawn: CancellationToken,
    pub(super) handed: oneshot::Receiver<Lease>,
    pub(super) resources: ResourceClient,
    pub(super) trust: Trust,
    pub(super) told: Told,
    pub(super) whom: Whom,
    /// Tells [`Asking::over`] when the last of it is dropped.
    pub(super) over: Arc<DropGuard>,
}

enum Got {
    Handed(Lease),
    Answer(Result<(Lease, Vec<HolderNote>), CallError>),
    /// It is not wanted any more.
    Nothing,
}

impl Acquiring {
    /// Until its answer, which goes to the shell. The resource manager is not asked where a lease is handed over at once.
    pub(super) async fn ask(mut self, events: mpsc::Sender<Answer>) {
        if let Ok(lease) = self.handed.try_recv() {
            self.tell(Event::Granted { instance: self.instance, lease }, &events).await;
            return;
        }
        self.requirements.iter_mut().for_each(|one| of_performers(&self.catalogue, one));
        if !self.operations_are_done().await {
            // It has not asked yet. What was handed to it before it was withdrawn goes back.
            self.handed.close();
            if let Ok(lease) = self.handed.try_recv() {
                self.tell(Event::Granted { instance: self.instance, lease }, &events).await;
            }
            return;
        }
        let unheard = AtomicBool::new(false);
        let got = self.got(&unheard).await;
        // Whoever hands something over from now on keeps it.
        self.handed.close();
        let got = match (self.handed.try_recv(), got) {
            // What the manager granted at the same moment goes back with the withdrawal.
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

    /// Waits for the operations that it comes behind; false where it is withdrawn before they are done.
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
        let release = || self.resources.release(lease);
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
                    // It goes on waiting, with the time that it has waited. When it is needed for certain, it asks anew.
                    Err(error) if self.options.speculative && error.reason() == TOO_LATE => continue,
                    answer => return Got::Answer(answer),
                },
                // Others are not let pass any more.
                () = self.told.others_after(late), if may_be_late => {}
            }
            tokio::select! {
                biased;
                Ok(lease) = &mut self.handed, if !self.handed.is_terminated() => return Got::Handed(lease),
                () = self.withdrawn.cancelled() => return Got::Nothing,
                // What is asked for twice would be had twice.
                () = withdraw(&self.resources, &self.trust, &self.options.request) => {}
            }
            // Another request: a manager that was started again has not heard of the first, and refuses what was withdrawn before it came.
            let late = late_request(&self.options.request);
            self.options.instead_of = std::mem::replace(&mut self.options.request, late);
            self.options.priority = OVERDUE;
        }
    }

    /// The call is dropped; what was granted meanwhile goes back.
    async fn withdraw(&self) {
        withdraw(&self.resources, &self.trust, &self.options.request).await;
    }

    /// What an answer of the resource manager is to the executive, once the run has been told what whoever had the resources before left.
    /// `None` where it is not wanted any more before that: then it goes back, and what was left stays to be told to whoever comes next.
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

/// Why nothing was granted; the bound that was reached is in the resource manager's words, with its name.
fn refused(error: &CallError) -> String {
    let reason = said(error);
    match (error.is_crash(), error.again_after()) {
        (false, Some(_)) => {
            format!("{reason} ({}; it was asked again for {} s)", error.reason(), REFUSED_PATIENCE.as_secs())
        }
        _ => reason,
    }
}
