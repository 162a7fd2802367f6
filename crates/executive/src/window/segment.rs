//! Segments: the stretches of the window between two decisions that are not made yet.
//!
//! A segment that is not in the table is certain. Decisions are made only on certain paths, so the table is a tree that is
//! pruned from its root, and nothing has to be told when a decision above is made.

use super::Window;
use super::instance::{Instance, Segment};
use ratn_model::id::InstanceId;

/// One arm of a decision that is not made.
#[derive(Debug, Clone)]
pub(crate) struct Branch {
    pub(crate) parent: Segment,
    /// The instance that decides.
    pub(crate) decision: InstanceId,
    pub(crate) probability: f32,
    /// It may be expanded: there are as many as the speculation width at most.
    pub(crate) expanded: bool,
    pub(crate) members: Vec<InstanceId>,
}

impl Window {
    /// Whether a decision on the way to a segment is not made.
    pub(super) fn is_speculative(&self, segment: Segment) -> bool {
        self.branches.contains_key(&segment)
    }

    /// The oldest decision on the way to an instance that is not made.
    pub(super) fn undecided(&self, instance: &Instance) -> Option<InstanceId> {
        let mut branch = self.branches.get(&instance.segment)?;
        while let Some(parent) = self.branches.get(&branch.parent) {
            branch = parent;
        }
        Some(branch.decision)
    }

    /// Whether no decision on the way to a segment is more likely to go another way.
    pub(super) fn is_likeliest(&self, segment: Segment) -> bool {
        let mut at = segment;
        while let Some(branch) = self.branches.get(&at) {
            let better = |(other, arm): (&Segment, &Branch)| {
                arm.decision == branch.decision
                    && (arm.probability > branch.probability || (arm.probability == branch.probability && *other < at))
            };
            if self.branches.iter().any(better) {
                return false;
            }
            at = branch.parent;
        }
        true
    }

    /// How likely an instance's path is taken.
    pub(super) fn probability(&self, segment: Segment) -> f32 {
        self.branches.get(&segment).map_or(1.0, |branch| branch.probability)
    }

    /// Two segments are the same stretch: both certain, or one and the same.
    pub(super) fn is_same_stretch(&self, a: Segment, b: Segment) -> bool {
        a == b || !(self.is_speculative(a) || self.is_speculative(b))
    }
}
