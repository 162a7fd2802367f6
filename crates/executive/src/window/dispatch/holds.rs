//! Holds: by the advice of look-ahead, an instance does not ask for resources that it could have, because others are to have them
//! first. Some of the best plans need this; a dispatch that never waits cannot follow them.
//!
//! A hold ends when the others have begun, ended or left the window, with the next advice, and at the latest after a bounded time.

use super::Dispatch;
use crate::lookahead::Held;
use crate::window::graph::Graph;
use ratn_model::id::InstanceId;
use ratn_model::time::Timestamp;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::time::Duration;

/// Holds, by the instance that is held back.
pub(super) type Holds = BTreeMap<InstanceId, Hold>;

/// The instances that begin first, and the hold's latest end.
#[derive(Debug, Serialize, Deserialize)]
pub(super) struct Hold {
    until_begun: Vec<InstanceId>,
    until: Timestamp,
}

impl Dispatch {
    /// Replaces all holds. Returns the instances held before, and the new ones with the latest end of their holds.
    pub(crate) fn hold(
        &mut self,
        graph: &Graph,
        now: Timestamp,
        held: &[Held],
    ) -> (Vec<InstanceId>, Vec<(InstanceId, Timestamp)>) {
        let mut holds = Holds::new();
        for Held { instance, until_begun, at_most_s } in held {
            let after = Duration::try_from_secs_f64(at_most_s.max(0.0));
            let (true, Ok(after)) = (graph.contains(*instance), after) else { continue };
            holds.insert(*instance, Hold { until_begun: until_begun.clone(), until: now + after });
        }
        let before = std::mem::replace(&mut self.holds, holds);
        (before.into_keys().collect(), self.holds.iter().map(|(id, hold)| (*id, hold.until)).collect())
    }

    /// Whether an instance is held for another one.
    pub(crate) fn is_held(&self, graph: &Graph, id: InstanceId) -> bool {
        self.holds.get(&id).is_some_and(|hold| hold.until_begun.iter().any(|other| is_to_begin(graph, *other)))
    }

    /// The instances that are still to begin before it.
    pub(super) fn held_for(&self, graph: &Graph, id: InstanceId) -> impl Iterator<Item = InstanceId> {
        let hold = self.holds.get(&id).into_iter();
        hold.flat_map(|hold| &hold.until_begun).copied().filter(|other| is_to_begin(graph, *other))
    }

    /// Takes the instances whose holds are over, because the others have begun.
    pub(crate) fn take_released(&mut self, graph: &Graph) -> Vec<InstanceId> {
        if self.holds.is_empty() {
            return Vec::new();
        }
        let is_over = |hold: &Hold| !hold.until_begun.iter().any(|other| is_to_begin(graph, *other));
        self.holds.extract_if(.., |_, hold| is_over(hold)).map(|(id, _)| id).collect()
    }

    /// Ends a hold whose time is over; true if it was in force.
    pub(crate) fn let_go(&mut self, id: InstanceId, now: Timestamp) -> bool {
        let is_over = self.holds.get(&id).is_some_and(|hold| hold.until <= now);
        is_over && self.holds.remove(&id).is_some()
    }
}

/// Whether an instance is in the window and has not begun.
fn is_to_begin(graph: &Graph, id: InstanceId) -> bool {
    let has_begun = |instance: &crate::window::graph::instance::Instance| {
        instance.ended().is_some() || instance.node().is_none_or(|node| node.status.since().is_some())
    };
    graph.get(id).is_some_and(|instance| !has_begun(instance))
}
