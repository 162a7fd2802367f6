//! Pause and single step: whether PIAs may begin.

use serde::{Deserialize, Serialize};

/// What the operator lets begin.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
pub(crate) enum Hold {
    /// Everything.
    #[default]
    Running,
    /// So many PIAs; then it is a pause.
    Paused(u32),
}

impl Hold {
    /// Whether another PIA may begin.
    pub(crate) fn lets_begin(self) -> bool {
        self != Hold::Paused(0)
    }

    /// A PIA has begun.
    pub(crate) fn has_begun(&mut self) {
        if let Hold::Paused(steps) = self {
            *steps = steps.saturating_sub(1);
        }
    }

    /// One more may begin, and then no more.
    pub(crate) fn step(&mut self) {
        *self = match self {
            Hold::Running => Hold::Paused(1),
            Hold::Paused(steps) => Hold::Paused(steps.saturating_add(1)),
        };
    }
}
