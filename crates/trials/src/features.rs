//! What random programs are made of. A failure is looked into with as little as still shows it.

/// What random programs are made of, beside sequences, hierarchies, loops over lists, conditions, routines and all three kinds
/// of actions.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Features {
    /// Custom outcomes, handlers of failures, jumps forward and back.
    pub transitions: bool,
    /// `while` and `do … while`.
    pub whiles: bool,
    /// Concurrencies whose regions do not conflict.
    pub regions: bool,
    /// Concurrencies whose first region ends the others.
    pub preemptive: bool,
    /// Scoped variables, assignments, defaults of ports.
    pub variables: bool,
    /// Tries after failures, and timeouts of goals that never answer.
    pub retries: bool,
    /// Numeric preconditions, quantified effects, effects per custom outcome.
    pub effects: bool,
    /// Measured facts that are not as predicted.
    pub measured: bool,
    /// Results that do not depend on the seed; small widths; exceptional outcomes.
    pub speculation: bool,
    /// What the safety theorem excludes: imprecise exceptions, unordered resources, regions that share facts.
    pub weak: bool,
}

impl Features {
    /// The whole model, under the assumptions of the safety theorem.
    pub const ALL: Features = Features {
        transitions: true,
        whiles: true,
        regions: true,
        preemptive: true,
        variables: true,
        retries: true,
        effects: true,
        measured: true,
        speculation: true,
        weak: false,
    };

    /// Sequences, hierarchies, loops over lists, conditions, routines and actions alone.
    pub const BASIC: Features = Features {
        transitions: false,
        whiles: false,
        regions: false,
        preemptive: false,
        variables: false,
        retries: false,
        effects: false,
        measured: false,
        speculation: false,
        weak: false,
    };

    /// The whole model, without those assumptions.
    pub const WEAK: Features = Features { weak: true, ..Features::ALL };
}
