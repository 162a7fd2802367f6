//! Cursors: the places where the window grows, one per open end of a path. A cursor holds the environment of the next
//! instance.

use super::environment::Environment;
use crate::plan::Outcome;
use crate::window::graph::instance::{LineId, SegmentId};
use ratn_model::id::{InstanceId, StateId};
use serde::{Deserialize, Serialize};
use std::sync::Arc;

/// An open end.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(super) struct Cursor {
    #[serde(skip)]
    pub(super) environment: Environment,
    /// The youngest instance on its path, and its arm that the cursor follows; the instance may have retired.
    pub(super) tail: Option<(InstanceId, usize)>,
    pub(super) line: LineId,
    pub(super) segment: SegmentId,
    /// Number of instances before it on its line.
    pub(super) position: u64,
    pub(super) todo: Todo,
    /// Reason why the path left by an outcome that is not success.
    pub(super) because: Option<Arc<str>>,
    /// Number of states entered and iterations begun since the last instance.
    pub(super) visits: u32,
    /// The same since the last node.
    pub(super) idle_visits: u32,
    /// Cursors with smaller numbers grow first.
    pub(super) order: u64,
}

impl Cursor {
    /// Counts a state entered or an iteration begun.
    pub(super) fn count_visit(&mut self) {
        self.visits += 1;
        self.idle_visits += 1;
    }
}

/// What a cursor does next.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) enum Todo {
    /// Visit a state.
    Enter(StateId),
    /// A state has ended with this outcome: follow it.
    Leave(StateId, Outcome),
    /// The lists of a composite state have ended: append its exit. The first `variables` variables stay in scope.
    Exit { state: StateId, visit: u32, outcome: Outcome, variables: usize },
    /// The next iteration of the innermost loop, or its end.
    Iterate,
    /// Wait for the list of a loop, or for the regions of a fork.
    Await(InstanceId),
    /// The path ends.
    Done,
}
