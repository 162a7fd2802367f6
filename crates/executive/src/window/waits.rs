//! Waits: which instance waits for which other one, the queue of instances to be examined again, and timers.
//!
//! An instance that cannot go on waits for exactly one other (the first thing found missing) and is looked at again when that
//! one goes on: the work per event is proportional to what it touches, not to the window.

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
    /// Nothing that is known; an event of its own, or somebody, will re-examine it.
    #[default]
    Nothing,
    /// The output of another instance.
    Data(InstanceId),
    /// What an older instance makes of the facts it reads.
    World(InstanceId),
    /// The environment does not look yet as it will at this place of the program: an older instance has yet to change it.
    Environment(InstanceId),
    /// Every older instance must have retired.
    Order,
    /// A sensing node is looking at what it would change.
    Sensing(InstanceId),
    /// A motion is changing what it would look at.
    Writer(InstanceId),
    /// A task resource that an older instance operates on.
    TaskResource(InstanceId),
    /// It senses, and an older instance waits: it looks when that is over.
    Waiting(InstanceId),
    /// The same visit on another branch is computing the same.
    Twin(InstanceId),
    /// A condition on its path.
    Decision(InstanceId),
    /// A result that may still change.
    Settling(InstanceId),
    /// Its next try.
    Backoff,
    /// The operator.
    Pause,
    /// Room: what is speculative leaves some to what is not.
    Room,
    /// Others that are to have resources first, by what a look-ahead advised.
    Turn,
    /// The resource manager.
    Resources,
}

impl Wait {
    /// The instance whose going on ends the wait.
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

    /// As a sentence about the instance of this path; `named` gives the paths of others.
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

/// What an instance waits for and who waits for it: part of the instance, private to this module.
#[derive(Debug, Default, Serialize, Deserialize)]
pub(crate) struct WaitCell {
    wait: Wait,
    /// To be looked at again when this ends, settles, retires or is discarded.
    waiters: SmallVec<[InstanceId; 2]>,
    is_queued: bool,
}

impl WaitCell {
    /// What it waits for.
    pub(crate) fn wait(&self) -> Wait {
        self.wait
    }

    /// Who waits for it.
    pub(crate) fn waiters(&self) -> &[InstanceId] {
        &self.waiters
    }
}

/// What happens by itself.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub(crate) enum Timer {
    /// The pause before the next try is over.
    Retry(InstanceId),
    /// The goal of this attempt has had its time.
    Timeout(InstanceId, u32),
    /// It has been held back as long as it may be.
    Hold(InstanceId),
    /// It has waited long enough for what is held only to improve a result, or is speculative.
    Room(InstanceId),
    /// The task has had its time.
    Deadline,
}

/// The queue and the timers.
#[derive(Debug, Default, Serialize, Deserialize)]
pub(crate) struct Waits {
    queue: VecDeque<InstanceId>,
    /// Those that wait for the environment to look otherwise: whatever becomes real may do that.
    for_environment: BTreeSet<InstanceId>,
    timers: BTreeSet<(Timestamp, Timer)>,
}

impl Waits {
    /// It waits. Without an instance to wait for, an event or somebody else re-examines it.
    pub(crate) fn wait(&mut self, graph: &mut Graph, id: InstanceId, wait: Wait) {
        let Some(cell) = graph.waiting(id) else { return };
        let before = std::mem::replace(&mut cell.wait, wait);
        if matches!(before, Wait::Sensing(_)) && !matches!(wait, Wait::Sensing(_)) {
            // Sensing nodes let a motion go first that is about to begin; now it is not.
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
                // It went on meanwhile.
                None => self.enqueue(graph, id),
            }
        }
    }

    /// Whoever waits for it is looked at again.
    pub(crate) fn wake(&mut self, graph: &mut Graph, id: InstanceId) {
        let Some(cell) = graph.waiting(id) else { return };
        let mut waiters = std::mem::take(&mut cell.waiters);
        // In program order, whoever asked first, and however often.
        waiters.sort_unstable();
        waiters.dedup();
        for waiter in waiters {
            self.enqueue(graph, waiter);
        }
    }

    /// It is to be looked at.
    pub(crate) fn enqueue(&mut self, graph: &mut Graph, id: InstanceId) {
        if let Some(cell) = graph.waiting(id)
            && !cell.is_queued
        {
            cell.is_queued = true;
            self.queue.push_back(id);
        }
    }

    /// The next to be looked at.
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

    /// The environment has changed: whoever waits for that is looked at again.
    pub(crate) fn environment_changed(&mut self, graph: &mut Graph) {
        for id in std::mem::take(&mut self.for_environment) {
            self.enqueue(graph, id);
        }
    }

    /// Whether somebody is to be looked at.
    pub(crate) fn is_due(&self, graph: &Graph) -> bool {
        !self.queue.is_empty() || graph.has_touched()
    }

    /// Something happens after so many seconds: when.
    pub(crate) fn set_timer(&mut self, now: Timestamp, after_s: f64, timer: Timer) -> Timestamp {
        let after = span(after_s);
        let at: Timestamp = now + after;
        self.set_timer_at(at, timer);
        at
    }

    /// Something happens at a moment.
    pub(crate) fn set_timer_at(&mut self, at: Timestamp, timer: Timer) {
        self.timers.insert((at, timer));
    }

    /// The next timer that is due.
    pub(crate) fn next_due(&mut self, now: Timestamp) -> Option<Timer> {
        let (at, _) = self.timers.first()?;
        if *at > now {
            return None;
        }
        self.timers.pop_first().map(|(_, timer)| timer)
    }

    /// What is wrong, if anything, when nothing is to be looked at any more: everybody waits for somebody older who knows it.
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
