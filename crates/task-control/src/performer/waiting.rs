//! The acquires of a run without an answer: in which order they are served, beside those of other runs too, and how long each instance has waited.

use crate::ledger::late_request;
use crate::shell::Urgency;
use ratn_executive::protocol::CERTAIN;
use ratn_model::id::InstanceId;
use ratn_model::resource::{Lease, Requirement};
use std::cmp::Reverse;
use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::{Duration, Instant};
use tokio::sync::oneshot;
use tokio_util::sync::{CancellationToken, DropGuard};

/// A certain acquire that waits longer than this beside other runs comes next; of several, the one that has waited longest.
pub(super) const LONG_BESIDE_OTHERS: Duration = Duration::from_secs(2);
/// The priority of such an acquire; no other acquire has it.
pub(super) const OVERDUE: i64 = i64::MAX;

/// The priority of an acquire among those of all runs: certain or not, then the run's urgency, then its own order.
pub(super) fn beside_others(priority: i64, urgency: Urgency) -> i64 {
    const OWN_BITS: u32 = 60;
    let own = (priority & (CERTAIN - 1)) >> (CERTAIN.trailing_zeros() - OWN_BITS);
    ((priority & CERTAIN) | ((urgency as i64) << OWN_BITS) | own).min(OVERDUE - 1)
}

/// An acquire under way.
#[derive(Debug)]
pub(super) struct Asking {
    pub(super) request: String,
    /// Its number among the run's acquires.
    pub(super) number: u64,
    pub(super) priority: i64,
    pub(super) requirements: Vec<Requirement>,
    pub(super) since: Instant,
    pub(super) withdrawn: CancellationToken,
    /// Cancelled when nothing of the acquire is under way any more: a lease that was granted after the withdrawal has gone back, too.
    pub(super) over: CancellationToken,
    /// Takes a lease in place of the manager's answer; `None` once a lease was handed over.
    hand: Option<oneshot::Sender<Lease>>,
}

/// What the course of an acquire needs of its place among those that wait.
#[derive(Debug)]
pub(super) struct Course {
    /// The request of the same instance that it replaces in the queue; empty if there is none.
    pub(super) instead_of: String,
    /// How long its instance has waited before, with other priorities.
    pub(super) waited: Duration,
    /// Cancelled when it is withdrawn.
    pub(super) withdrawn: CancellationToken,
    /// A lease that is handed over.
    pub(super) handed: oneshot::Receiver<Lease>,
    /// Cancels [`Asking::over`] when its last clone is dropped.
    pub(super) over: Arc<DropGuard>,
}

/// The last request of an instance.
#[derive(Debug, Clone)]
struct LastAsked {
    request: String,
    priority: i64,
}

impl LastAsked {
    /// Its request id in the queue after this time: a certain request that has waited long is repeated under another id.
    fn in_queue(self, waited: Duration) -> String {
        let is_late = self.priority >= CERTAIN && waited >= LONG_BESIDE_OTHERS;
        if is_late { late_request(&self.request) } else { self.request }
    }
}

/// All acquires under way.
#[derive(Debug, Default)]
pub(super) struct Waiting {
    asking: BTreeMap<InstanceId, Asking>,
    /// In the order in which the resource manager serves equal requests.
    order: BTreeMap<(Reverse<i64>, u64), InstanceId>,
    /// Since when each instance has waited without getting what it needs, however often it asked; and its last request.
    since: BTreeMap<InstanceId, (Instant, LastAsked)>,
}

impl Waiting {
    /// An instance asks, or asks again.
    pub(super) fn begin(
        &mut self,
        instance: InstanceId,
        number: u64,
        request: String,
        requirements: Vec<Requirement>,
        priority: i64,
    ) -> Course {
        self.withdraw(instance);
        let (withdrawn, over) = (CancellationToken::new(), CancellationToken::new());
        let ends = Arc::new(over.clone().drop_guard());
        let (hand, handed) = oneshot::channel();
        let now = Instant::now();
        let before = self.since.remove(&instance);
        let began = before.as_ref().map_or(now, |(began, _)| *began);
        let waited = now.duration_since(began);
        self.since.insert(instance, (began, LastAsked { request: request.clone(), priority }));
        self.order.insert((Reverse(priority), number), instance);
        let withdrawal = withdrawn.clone();
        let asking = Asking { request, number, priority, requirements, since: now, withdrawn, over, hand: Some(hand) };
        self.asking.insert(instance, asking);
        let instead_of = before.map_or_else(String::new, |(_, last)| last.in_queue(waited));
        Course { instead_of, waited, withdrawn: withdrawal, handed, over: ends }
    }

    /// An acquire has no place among those that wait any more; its instance may ask again.
    pub(super) fn withdraw(&mut self, instance: InstanceId) -> Option<Asking> {
        let asking = self.asking.remove(&instance)?;
        self.order.remove(&(Reverse(asking.priority), asking.number));
        Some(asking)
    }

    /// An acquire has its answer.
    pub(super) fn answered(&mut self, instance: InstanceId) -> Option<Asking> {
        self.forget(instance);
        self.withdraw(instance)
    }

    /// An instance has ended: it does not ask again.
    pub(super) fn forget(&mut self, instance: InstanceId) {
        self.since.remove(&instance);
    }

    pub(super) fn get(&self, instance: InstanceId) -> Option<&Asking> {
        self.asking.get(&instance)
    }

    /// The waiting acquires, in the order in which they are served.
    pub(super) fn in_order(&self) -> impl Iterator<Item = (InstanceId, &Asking)> {
        self.order.values().filter_map(|instance| Some((*instance, self.asking.get(instance)?)))
    }

    /// The acquire that has waited longest for an answer.
    pub(super) fn longest(&self) -> Option<(InstanceId, &Asking)> {
        let longest = self.asking.iter().min_by_key(|(_, asking)| asking.since)?;
        Some((*longest.0, longest.1))
    }

    /// Hands a lease to a waiting instance; `None` if the instance does not wait.
    ///
    /// # Errors
    /// If it already has its answer or another lease.
    pub(super) fn hand(&mut self, to: InstanceId, lease: &Lease) -> Option<Result<(), ()>> {
        let hand = self.asking.get_mut(&to)?.hand.take();
        Some(hand.ok_or(()).and_then(|hand| hand.send(lease.clone()).map_err(drop)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_certain_comes_first_then_the_urgent_run_then_the_own_order() {
        let (certain, speculative) = (CERTAIN | 5, CERTAIN - 1);
        let order = [
            (i64::MAX, Urgency::High),
            (certain | 8, Urgency::High),
            (certain, Urgency::High),
            (i64::MAX, Urgency::Normal),
            (certain, Urgency::Low),
            (speculative, Urgency::High),
            (speculative, Urgency::Low),
        ];
        let ranks = order.map(|(priority, urgency)| beside_others(priority, urgency));
        assert!(ranks.is_sorted_by(|a, b| a > b), "{ranks:?}");
        assert!(ranks[0] < OVERDUE && ranks[4] >= CERTAIN && ranks[5] < CERTAIN);
    }

    #[test]
    fn an_instance_that_asks_again_names_the_request_under_which_it_is_in_the_queue() {
        let after = |priority: i64, waited: Duration| LastAsked { request: "r".to_owned(), priority }.in_queue(waited);
        let long = LONG_BESIDE_OTHERS;
        assert_eq!(after(CERTAIN, Duration::ZERO), "r");
        assert_eq!(after(CERTAIN, long), late_request("r"), "it has asked once more");
        assert_eq!(after(CERTAIN - 1, long), "r", "what is speculative does not");
        let mut waiting = Waiting::default();
        let mut ask = |number: u64| {
            let request = format!("r/{number}");
            waiting.begin(InstanceId(1), number, request, Vec::new(), CERTAIN).instead_of
        };
        assert_eq!([ask(1), ask(2)], ["", "r/1"]);
        waiting.answered(InstanceId(1));
        assert_eq!(waiting.begin(InstanceId(1), 3, "r/3".to_owned(), Vec::new(), CERTAIN).instead_of, "");
    }
}
