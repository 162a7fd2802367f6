//! The scheduling problem of look-ahead: the nodes that have not ended, what they wait for and which resources they need.

use ratn_model::id::InstanceId;
use ratn_model::resource::Quantity;
use std::collections::BTreeMap;

/// The rest of a window, as it is most likely to go on: of an undecided condition only the likelier branch.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Problem {
    /// In program order.
    pub tasks: Vec<Task>,
    /// Capacity of each resource kind, including what is in use; a kind that is not listed has no limit.
    pub capacity: BTreeMap<String, Quantity>,
}

/// An instance that has not ended.
#[derive(Debug, Clone, PartialEq)]
pub struct Task {
    /// The instance.
    pub instance: InstanceId,
    /// Duration, of a running task the remaining one, in seconds of the robot's time; 0 for markers.
    pub duration_s: f64,
    /// It already holds its resources.
    pub is_running: bool,
    /// The resources that it blocks from begin to end: kind and amount, acquired all at once.
    pub demands: Vec<(String, Quantity)>,
    /// Its predecessors, as places in [`Problem::tasks`]: they must have ended before it may ask for resources. They are the producers of
    /// its inputs, the writers of the facts that it reads, and for a PIA everything older.
    pub after: Vec<usize>,
    /// By earlier advice it is held back until these have begun, as places in [`Problem::tasks`].
    pub held_for: Vec<usize>,
    /// A condition on its path is undecided: it is served after all certain tasks.
    pub is_speculative: bool,
    /// Its present urgency in seconds: the longest remaining path, or earlier advice.
    pub urgency_s: f64,
    /// Probability of its path, in (0, 1]; a speculative task is served by its urgency times this.
    pub probability: f64,
}

/// Error: the problem cannot be planned.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum ProblemError {
    /// A duration or a probability is not a usable number.
    #[error("{instance}: its duration of {duration_s} s or its probability of {probability} is not a usable number")]
    Number {
        /// The instance.
        instance: InstanceId,
        /// The duration.
        duration_s: f64,
        /// The probability.
        probability: f64,
    },
    /// A task waits for a task that does not exist.
    #[error("{instance} waits for task {after}, and there are only {tasks}")]
    Unknown {
        /// The task that waits.
        instance: InstanceId,
        /// The place that it waits for.
        after: usize,
        /// Number of tasks.
        tasks: usize,
    },
    /// Tasks wait for each other.
    #[error("{instance} waits, over others, for itself")]
    Circular {
        /// One of these tasks.
        instance: InstanceId,
    },
}
