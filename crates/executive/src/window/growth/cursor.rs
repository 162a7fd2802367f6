//! Cursors, the places where the window grows: one per open end of a path. It holds the environment of the next instance.

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
    /// The youngest instance on its path and the arm of it that it follows; may have retired since.
    pub(super) tail: Option<(InstanceId, usize)>,
    pub(super) line: LineId,
    pub(super) segment: SegmentId,
    /// How many instances of its line are before it.
    pub(super) position: u64,
    pub(super) todo: Todo,
    /// Why it left by an outcome that is not success.
    pub(super) because: Option<Arc<str>>,
    /// States entered and iterations begun since the last instance.
    pub(super) visits: u32,
    /// And since the last node.
    pub(super) idle_visits: u32,
    /// Cursors grow in this order.
    pub(super) order: u64,
}

impl Cursor {
    /// A state is entered or an iteration begun.
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
    /// A state has ended: follow the outcome.
    Leave(StateId, Outcome),
    /// The lists of a composite state have ended: what it does when it is left. Of its variables, those before it stay.
    Exit { state: StateId, visit: u32, outcome: Outcome, variables: usize },
    /// The next iteration of the innermost loop, or its end.
    Iterate,
    /// Waits for the list of a loop, or for the regions of a fork.
    Await(InstanceId),
    /// The path ends.
    Done,
}
