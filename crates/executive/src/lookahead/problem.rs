//! The scheduling problem of a look-ahead: the nodes that have not ended, what they wait for and what they occupy.

use ratn_model::id::InstanceId;
use ratn_model::resource::Quantity;
use std::collections::BTreeMap;

/// The rest of a window, as it is most likely to go on: of an undecided condition only the likelier branch.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Problem {
    /// In program order.
    pub tasks: Vec<Task>,
    /// How much of each resource kind there is, whoever holds it; of a kind that is not listed there is enough.
    pub capacity: BTreeMap<String, Quantity>,
}

/// An instance that has not ended.
#[derive(Debug, Clone, PartialEq)]
pub struct Task {
    /// Which.
    pub instance: InstanceId,
    /// How long it takes, of a running one how long it still takes, in seconds of the robot's time; 0 of what only decides.
    pub duration_s: f64,
    /// It holds its resources already.
    pub is_running: bool,
    /// What it blocks: kind and amount, all at once, from its begin to its end.
    pub demands: Vec<(String, Quantity)>,
    /// The tasks that must have ended before it may ask for resources, as places in [`Problem::tasks`]: producers of its inputs, the writers
    /// of what it reads, and for a PIA everything that must have ended before it.
    pub after: Vec<usize>,
    /// By what was advised before, it does not ask for resources before these have begun, as places in [`Problem::tasks`].
    pub held_for: Vec<usize>,
    /// A condition on its path is undecided: it is served after everything for which none is.
    pub is_speculative: bool,
    /// By what it is served now, in seconds: the longest remaining path, or what was advised before.
    pub urgency_s: f64,
    /// How likely its path is, in (0, 1]; what is speculative is served by its urgency times this.
    pub probability: f64,
}

/// A problem that cannot be planned.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum ProblemError {
    /// A duration or a probability is not a usable number.
    #[error("{instance}: its duration of {duration_s} s or its probability of {probability} is not a usable number")]
    Number {
        /// Whose.
        instance: InstanceId,
        /// The duration.
        duration_s: f64,
        /// The probability.
        probability: f64,
    },
    /// It waits for a task that is not there.
    #[error("{instance} waits for task {after}, and there are only {tasks}")]
    Unknown {
        /// Who.
        instance: InstanceId,
        /// For which place.
        after: usize,
        /// How many there are.
        tasks: usize,
    },
    /// Tasks wait for each other.
    #[error("{instance} waits, over others, for itself")]
    Circular {
        /// One of them.
        instance: InstanceId,
    },
}
