//! Waits: which instance waits for which other one, the queue of instances to be examined again, and timers.
//!
//! An instance that cannot go on waits for exactly one other instance (the first thing found missing) and is examined again
//! when that one goes on. So the work per event depends on what the event touches, not on the size of the window.

use super::graph::Graph;
use crate::span::span;
use ratn_model::id::InstanceId;
use ratn_model::time::Timestamp;
use serde::{Deserialize, Serialize};
use smallvec::SmallVec;
use std::collections::{BTreeSet, VecDeque};

/// What an instance waits for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
pub(crate) enum Wait {
    /// Nothing known; a later event will cause this instance to be examined.
    #[default]
    Nothing,
    /// The output of another instance.
    Data(InstanceId),
    /// The changes by an older instance of the facts that it reads.
    World(InstanceId),
    /// The environment does not look yet as it will at this place: an older instance has yet to change it.
    Environment(InstanceId),
    /// Every older instance must have retired.
    Order,
    /// A sensing node that is sensing what this instance would change.
    Sensing(InstanceId),
    /// A motion that is changing what this instance would sense.
    Writer(InstanceId),
    /// A task resource that an older instance operates on.
    TaskResource(InstanceId),
    /// It senses, and an older instance is a wait that must end first.
    Waiting(InstanceId),
    /// An instance for the same visit on another branch, which computes the same.
    Twin(InstanceId),
    /// A condition on its path.
    Decision(InstanceId),
    /// A result that may still change.
    Settling(InstanceId),
    /// The backoff before its next try.
    Backoff,
    /// The operator.
    Pause,
    /// Room for a projection: speculative nodes leave some to certain ones.
    Room,
    /// Other instances that are to have resources first, by the advice of look-ahead.
    Turn,
    /// The resource manager.
    Resources,
}

impl Wait {
    /// The instance whose progress ends the wait.
    pub(crate) fn on(self) -> Option<InstanceId> {
        match self {
            Wait::Data(id)
            | Wait::World(id)
            | Wait::Environment(id)
            | Wait::Sensing(id)
            | Wait::Writer(id)
            | Wait::TaskResource(id)
            | Wait::Waiting(id)
            | Wait::Twin(id)
            | Wait::Decision(id)
            | Wait::Settling(id) => Some(id),
            Wait::Nothing | Wait::Order | Wait::Backoff | Wait::Pause | Wait::Room | Wait::Turn | Wait::Resources => {
                None
            }
        }
    }

    /// The wait as a sentence about the instance with this path; `named` gives the paths of others.
    pub(crate) fn sentence(self, path: &str, named: impl Fn(InstanceId) -> String) -> String {
        match self {
            Wait::Nothing => format!("{path} has just been expanded"),
            Wait::Data(id) => format!("{path} waits for an output of {}", named(id)),
            Wait::World(id) => format!("{path} waits for {} to be known or done, whose effects it reads", named(id)),
            Wait::Environment(id) => {
                format!("{path} waits for the environment to look as it does at its place: {} changes it", named(id))
            }
            Wait::Order => format!("{path} waits for every older state to have ended"),
            Wait::Sensing(id) => format!("{path} waits for {} to have looked", named(id)),
            Wait::Writer(id) => format!("{path} waits for {} to stop moving", named(id)),
            Wait::TaskResource(id) => format!("{path} waits for {}, which operates on a resource it uses", named(id)),
            Wait::Waiting(id) => format!("{path} looks when {} has waited", named(id)),
            Wait::Twin(id) => format!("{path} waits for {}, which computes the same on another branch", named(id)),
            Wait::Decision(id) => format!("{path} waits for the decision of {}", named(id)),
            Wait::Settling(id) => format!("{path} waits until the result of {} cannot change any more", named(id)),
            Wait::Backoff => format!("{path} waits before it is tried again"),
            Wait::Pause => format!("{path} waits for the operator"),
            Wait::Room => format!("{path} is speculative and leaves room to what is not"),
            Wait::Turn => format!("{path} leaves its resources to others that are to begin first"),
            Wait::Resources => format!("{path} waits for the resource manager"),
        }
    }
}

/// The wait of an instance and its waiters: part of the instance, private to this module.
#[derive(Debug, Default, Serialize, Deserialize)]
pub(crate) struct WaitCell {
    wait: Wait,
    /// Instances to be examined when this one ends, settles, retires or is discarded.
    waiters: SmallVec<[InstanceId; 2]>,
    is_queued: bool,
}

impl WaitCell {
    pub(crate) fn wait(&self) -> Wait {
        self.wait
    }

    pub(crate) fn waiters(&self) -> &[InstanceId] {
        &self.waiters
    }
}

/// Events that time causes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub(crate) enum Timer {
    /// The backoff before the next try is over.
    Retry(InstanceId),
    /// The goal of this attempt has reached its timeout.
    Timeout(InstanceId, u32),
    /// The longest time of a hold is over.
    Hold(InstanceId),
    /// The instance has waited long enough for holders that only improve a result or are speculative.
    Room(InstanceId),
    /// Something inside of this routine is due.
    Inside(InstanceId),
}

impl Timer {
    pub(crate) fn instance(self) -> InstanceId {
        match self {
            Timer::Retry(id) | Timer::Timeout(id, _) | Timer::Hold(id) | Timer::Room(id) | Timer::Inside(id) => id,
        }
    }
}

/// The queue and the timers.
#[derive(Debug, Default, Serialize, Deserialize)]
pub(crate) struct Waits {
    queue: VecDeque<InstanceId>,
    /// Instances that wait for the environment to change; every commit may do that.
    for_environment: BTreeSet<InstanceId>,
    timers: BTreeSet<(Timestamp, Timer)>,
}

impl Waits {
    /// The instance waits. Without an instance to wait for, a later event causes it to be examined.
    pub(crate) fn wait(&mut self, graph: &mut Graph, id: InstanceId, wait: Wait) {
        let Some(cell) = graph.waiting(id) else { return };
        let before = std::mem::replace(&mut cell.wait, wait);
        if matches!(before, Wait::Sensing(_)) && !matches!(wait, Wait::Sensing(_)) {
            // Sensing nodes had let this motion go first; it is not about to begin any more.
            self.wake(graph, id);
        }
        if matches!(wait, Wait::Environment(_)) {
            self.for_environment.insert(id);
        }
        if let Some(on) = wait.on() {
            match graph.waiting(on) {
                Some(other) => {
                    if other.waiters.last() != Some(&id) {
                        other.waiters.push(id);
                    }
                }
                // That instance has left the window meanwhile.
                None => self.enqueue(graph, id),
            }
        }
    }

    /// Examines all instances that wait for this one.
    pub(crate) fn wake(&mut self, graph: &mut Graph, id: InstanceId) {
        let Some(cell) = graph.waiting(id) else { return };
        let mut waiters = std::mem::take(&mut cell.waiters);
        // In program order, without duplicates, whatever the order of their waits.
        waiters.sort_unstable();
        waiters.dedup();
        for waiter in waiters {
            self.enqueue(graph, waiter);
        }
    }

    /// Puts an instance into the queue, to be examined.
    pub(crate) fn enqueue(&mut self, graph: &mut Graph, id: InstanceId) {
        if let Some(cell) = graph.waiting(id)
            && !cell.is_queued
        {
            cell.is_queued = true;
            self.queue.push_back(id);
        }
    }

    /// Takes the next instance to be examined.
    pub(crate) fn next(&mut self, graph: &mut Graph) -> Option<InstanceId> {
        for id in graph.take_touched() {
            self.enqueue(graph, id);
        }
        while let Some(id) = self.queue.pop_front() {
            if let Some(cell) = graph.waiting(id) {
                cell.is_queued = false;
                return Some(id);
            }
        }
        None
    }

    /// Takes an instance out of the queue, to be examined now; false if it is not in the queue.
    pub(crate) fn takes(&mut self, graph: &mut Graph, id: InstanceId) -> bool {
        for touched in graph.take_touched() {
            self.enqueue(graph, touched);
        }
        let Some(cell) = graph.waiting(id).filter(|cell| cell.is_queued) else { return false };
        cell.is_queued = false;
        self.queue.retain(|queued| *queued != id);
        true
    }

    /// The environment has changed: instances that wait for that are examined.
    pub(crate) fn environment_changed(&mut self, graph: &mut Graph) {
        for id in std::mem::take(&mut self.for_environment) {
            self.enqueue(graph, id);
        }
    }

    /// Whether an instance is to be examined.
    pub(crate) fn is_due(&self, graph: &Graph) -> bool {
        !self.queue.is_empty() || graph.has_touched()
    }

    /// Sets a timer that is due after so many seconds; returns its time.
    pub(crate) fn set_timer(&mut self, now: Timestamp, after_s: f64, timer: Timer) -> Timestamp {
        let after = span(after_s);
        let at: Timestamp = now + after;
        self.set_timer_at(at, timer);
        at
    }

    /// Sets a timer for a moment.
    pub(crate) fn set_timer_at(&mut self, at: Timestamp, timer: Timer) {
        self.timers.insert((at, timer));
    }

    /// The timers that are due first, if they are by now.
    pub(crate) fn first_due(&self, now: Timestamp) -> impl Iterator<Item = (Timestamp, Timer)> {
        let first = self.timers.first().map(|(at, _)| *at).filter(|at| *at <= now);
        self.timers.iter().copied().take_while(move |(at, _)| Some(*at) == first)
    }

    pub(crate) fn remove_timer(&mut self, at: Timestamp, timer: Timer) {
        self.timers.remove(&(at, timer));
    }

    /// Whether a timer is set, for any moment.
    pub(crate) fn has_timer(&self, timer: Timer) -> bool {
        self.timers.iter().any(|(_, set)| *set == timer)
    }

    /// Removes a timer, whatever moment it is set for.
    pub(crate) fn forget_timer(&mut self, timer: Timer) {
        self.timers.retain(|(_, set)| *set != timer);
    }

    /// Checks, when the queue is empty, that every waiting instance is registered with the one that it waits for.
    pub(crate) fn check_invariants(&self, graph: &Graph) -> Result<(), String> {
        for instance in graph.iter() {
            let cell = &instance.waiting;
            if cell.is_queued {
                return Err(format!("{} is still to be looked at", instance.id));
            }
            let is_waiting = match instance.node() {
                Some(node) => matches!(node.status, super::graph::instance::Status::Expanded),
                None => instance.ended().is_none(),
            };
            if !is_waiting {
                continue;
            }
            match cell.wait.on() {
                Some(on) => match graph.get(on) {
                    None => return Err(format!("{} waits for {on}, which is not in the window", instance.id)),
                    Some(other) if !other.waiting.waiters.contains(&instance.id) => {
                        return Err(format!("{} waits for {on}, which does not know", instance.id));
                    }
                    Some(_) => {}
                },
                None if cell.wait == Wait::Nothing => {
                    return Err(format!("{} has not been looked at", instance.id));
                }
                None => {}
            }
        }
        Ok(())
    }
}
