//! Where the window grows: one cursor per open end of a path. It holds the environment of the next instance.

use super::environment::Environment;
use super::instance::{Line, Segment};
use crate::plan::Outcome;
use ratn_model::id::{InstanceId, StateId};
use std::sync::Arc;

/// An open end.
#[derive(Debug, Clone)]
pub(crate) struct Cursor {
    pub(crate) environment: Environment,
    /// The youngest instance on its path and the arm of it that it follows; may have retired since.
    pub(crate) tail: Option<(InstanceId, usize)>,
    pub(crate) line: Line,
    pub(crate) segment: Segment,
    /// How many instances of its line are before it.
    pub(crate) position: u64,
    pub(crate) todo: Todo,
    /// How likely its path is taken.
    pub(crate) probability: f32,
    /// Why it left by an outcome that is not success.
    pub(crate) because: Option<Arc<str>>,
    /// Steps since an instance came of one.
    pub(crate) idle: usize,
    /// Cursors grow in this order.
    pub(crate) order: u64,
}

/// What a cursor does next.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Todo {
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
