//! Branches: the ways on from decisions that are not made. The segment of a branch is the stretch up to the next decision.
//!
//! A segment without an open branch is certain. Decisions are made on certain paths only, so the open branches are a tree that is
//! pruned from its root. A branch knows how likely it is *given* that its parent is taken: when a decision is made, everything
//! behind it becomes likelier by itself.

use super::instance::SegmentId;
use ratn_model::id::InstanceId;
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, BTreeSet};

/// No path counts as less likely than this: its share stays a number that can be divided and compared.
const LEAST_PROBABILITY: f64 = 1e-30;

/// One way on from a decision.
#[derive(Debug, Clone, Serialize, Deserialize)]
struct Branch {
    parent: SegmentId,
    /// The instance that decides.
    decision: InstanceId,
    /// How likely it is taken, of all ways on from this decision.
    share: f64,
    /// It may be expanded.
    is_expanded: bool,
    members: Vec<InstanceId>,
}

/// The branches that are open.
#[derive(Debug, Default, Serialize, Deserialize)]
pub(super) struct Branches {
    all: BTreeMap<SegmentId, Branch>,
    /// How many may be expanded.
    expanded: usize,
    last: SegmentId,
}

impl Branches {
    /// Opens a way on from a decision.
    pub(super) fn open(&mut self, parent: SegmentId, decision: InstanceId, share: f64) -> SegmentId {
        self.last += 1;
        let branch = Branch { parent, decision, share, is_expanded: false, members: Vec::new() };
        self.all.insert(self.last, branch);
        self.last
    }

    /// The branch is taken: its segment is certain from now on. Its members.
    pub(super) fn take(&mut self, segment: SegmentId) -> Vec<InstanceId> {
        self.remove(segment).map(|branch| branch.members).unwrap_or_default()
    }

    fn remove(&mut self, segment: SegmentId) -> Option<Branch> {
        let branch = self.all.remove(&segment)?;
        self.expanded -= usize::from(branch.is_expanded);
        Some(branch)
    }

    pub(super) fn remove_all(&mut self, segments: &BTreeSet<SegmentId>) {
        for segment in segments {
            self.remove(*segment);
        }
    }

    pub(super) fn is_empty(&self) -> bool {
        self.all.is_empty()
    }

    /// Whether the decision on the way to a segment is not made.
    pub(super) fn is_open(&self, segment: SegmentId) -> bool {
        self.all.contains_key(&segment)
    }

    /// Puts an instance into the segment it was expanded in. Whether it is speculative.
    pub(super) fn join(&mut self, segment: SegmentId, id: InstanceId) -> bool {
        match self.all.get_mut(&segment) {
            Some(branch) => {
                branch.members.push(id);
                true
            }
            None => false,
        }
    }

    /// The oldest decision on the way to a segment that is not made.
    pub(super) fn undecided(&self, segment: SegmentId) -> Option<InstanceId> {
        self.way(segment).last().map(|branch| branch.decision)
    }

    /// The open branches on the way to a segment, the nearest first.
    fn way(&self, segment: SegmentId) -> impl Iterator<Item = &Branch> {
        std::iter::successors(self.all.get(&segment), |branch| self.all.get(&branch.parent))
    }

    /// How likely a segment is taken: 1 where it is certain.
    pub(super) fn probability(&self, segment: SegmentId) -> f64 {
        self.way(segment).map(|branch| branch.share).product::<f64>().max(LEAST_PROBABILITY)
    }

    /// Whether no decision on the way to a segment is more likely to go another way.
    pub(super) fn is_likeliest(&self, segment: SegmentId) -> bool {
        let mut at = segment;
        while let Some(branch) = self.all.get(&at) {
            let better = |(other, arm): (&SegmentId, &Branch)| {
                arm.decision == branch.decision
                    && (arm.share > branch.share || (arm.share == branch.share && *other < at))
            };
            if self.all.iter().any(better) {
                return false;
            }
            at = branch.parent;
        }
        true
    }

    /// Whether a branch that may be expanded, or none, is open for a segment.
    pub(super) fn is_awake(&self, segment: SegmentId) -> bool {
        self.all.get(&segment).is_none_or(|branch| branch.is_expanded)
    }

    /// Lets branches be expanded, the likelier ones first, until there are `width`.
    pub(super) fn awaken(&mut self, width: usize) {
        while self.expanded < width && self.expanded < self.all.len() {
            let asleep = self.all.iter().filter(|(_, branch)| !branch.is_expanded);
            let ranked = asleep.map(|(segment, _)| (self.probability(*segment), *segment));
            let Some((_, segment)) = ranked.max_by(|(p, a), (q, b)| p.total_cmp(q).then(b.cmp(a))) else { break };
            if let Some(branch) = self.all.get_mut(&segment) {
                branch.is_expanded = true;
                self.expanded += 1;
            }
        }
    }

    /// The branches behind lost segments or decisions that are not among the lost ones yet.
    pub(super) fn behind(&self, segments: &BTreeSet<SegmentId>, lost: &BTreeSet<InstanceId>) -> Vec<SegmentId> {
        let is_behind = |(segment, branch): &(&SegmentId, &Branch)| {
            !segments.contains(segment) && (segments.contains(&branch.parent) || lost.contains(&branch.decision))
        };
        self.all.iter().filter(is_behind).map(|(segment, _)| *segment).collect()
    }

    /// What is wrong with the tree, if anything.
    pub(super) fn check_invariants(&self, is_alive: impl Fn(InstanceId) -> bool) -> Result<(), String> {
        for (segment, branch) in &self.all {
            if !is_alive(branch.decision) {
                return Err(format!("segment {segment} waits for {}, which is not in the window", branch.decision));
            }
            if branch.parent >= *segment {
                return Err(format!("segment {segment} is behind {}, which is younger", branch.parent));
            }
        }
        let expanded = self.all.values().filter(|branch| branch.is_expanded).count();
        if expanded != self.expanded {
            return Err(format!("{expanded} branches are expanded, {} are counted", self.expanded));
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_branch_becomes_likelier_when_a_decision_before_it_is_made() {
        let mut branches = Branches::default();
        let decision = InstanceId(1);
        let mut segments = vec![0];
        for _ in 0..200 {
            let parent = *segments.last().unwrap_or(&0);
            segments.push(branches.open(parent, decision, 0.5));
        }
        let last = *segments.last().unwrap_or(&0);
        assert!(branches.probability(last) > 0.0, "it stays a usable number, however deep");
        for taken in &segments[1..200] {
            branches.take(*taken);
        }
        assert!((branches.probability(last) - 0.5).abs() < 1e-12, "one decision is left");
        branches.take(last);
        assert!((branches.probability(last) - 1.0).abs() < 1e-12);
    }
}
