//! Who is held back: by what a look-ahead advised, an instance does not ask for resources that it could have, because others are to
//! have them first. A dispatch that never waits cannot come to some of the best plans.
//!
//! Nobody is held back for ever: a hold ends when the others have begun, ended or gone, with the next advice, and after a bounded time.

use super::Dispatch;
use crate::lookahead::Held;
use crate::window::graph::Graph;
use ratn_model::id::InstanceId;
use ratn_model::time::Timestamp;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::time::Duration;

/// By who is held back.
pub(super) type Holds = BTreeMap<InstanceId, Hold>;

/// For whom, and until when at most.
#[derive(Debug, Serialize, Deserialize)]
pub(super) struct Hold {
    until_begun: Vec<InstanceId>,
    until: Timestamp,
}

impl Dispatch {
    /// Takes over who is to be held back: who was so far, and when the holds of the new ones end at the latest.
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

    /// Whether somebody is to begin before it.
    pub(crate) fn is_held(&self, graph: &Graph, id: InstanceId) -> bool {
        self.holds.get(&id).is_some_and(|hold| hold.until_begun.iter().any(|other| is_to_begin(graph, *other)))
    }

    /// For whom it is held back, of those that have not begun.
    pub(super) fn held_for(&self, graph: &Graph, id: InstanceId) -> impl Iterator<Item = InstanceId> {
        let hold = self.holds.get(&id).into_iter();
        hold.flat_map(|hold| &hold.until_begun).copied().filter(|other| is_to_begin(graph, *other))
    }

    /// Those that are no longer held back, because the others have begun.
    pub(crate) fn take_released(&mut self, graph: &Graph) -> Vec<InstanceId> {
        if self.holds.is_empty() {
            return Vec::new();
        }
        let is_over = |hold: &Hold| !hold.until_begun.iter().any(|other| is_to_begin(graph, *other));
        self.holds.extract_if(.., |_, hold| is_over(hold)).map(|(id, _)| id).collect()
    }

    /// A hold has lasted as long as it may; whether it was in force.
    pub(crate) fn let_go(&mut self, id: InstanceId, now: Timestamp) -> bool {
        let is_over = self.holds.get(&id).is_some_and(|hold| hold.until <= now);
        is_over && self.holds.remove(&id).is_some()
    }
}

/// Whether it is there and has not begun.
fn is_to_begin(graph: &Graph, id: InstanceId) -> bool {
    let has_begun = |instance: &crate::window::graph::instance::Instance| {
        instance.ended().is_some() || instance.node().is_none_or(|node| node.status.since().is_some())
    };
    graph.get(id).is_some_and(|instance| !has_begun(instance))
}
