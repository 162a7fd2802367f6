//! Branches: the possible ways on from open decisions. The segment of a branch extends to the next decision.
//!
//! A segment behind no open decision is certain. Decisions are made on certain paths only, so the open branches form a tree that
//! is pruned from its root. The probability of a branch is *conditional* on its parent being taken. So with each decision,
//! everything behind it becomes more likely without further work.

use super::instance::SegmentId;
use ratn_model::id::InstanceId;
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, BTreeSet};

/// Lower limit of a path's probability, so that it can be divided and compared.
const LEAST_PROBABILITY: f64 = 1e-30;

/// One possible way on from a decision.
#[derive(Debug, Clone, Serialize, Deserialize)]
struct Branch {
    parent: SegmentId,
    /// The deciding instance.
    decision: InstanceId,
    /// Probability of this way, among all ways on from this decision.
    share: f64,
    /// Whether it may be expanded.
    is_expanded: bool,
    members: Vec<InstanceId>,
}

#[derive(Debug, Default, Serialize, Deserialize)]
pub(super) struct Branches {
    all: BTreeMap<SegmentId, Branch>,
    /// Number of branches that may be expanded.
    expanded: usize,
    last: SegmentId,
}

impl Branches {
    /// Adds a way on from a decision.
    pub(super) fn open(&mut self, parent: SegmentId, decision: InstanceId, share: f64) -> SegmentId {
        self.last += 1;
        let branch = Branch { parent, decision, share, is_expanded: false, members: Vec::new() };
        self.all.insert(self.last, branch);
        self.last
    }

    /// Takes a branch: its segment becomes certain. Returns its members.
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

    pub(super) fn is_open(&self, segment: SegmentId) -> bool {
        self.all.contains_key(&segment)
    }

    /// Adds an instance to the segment in which it was expanded; true if it is speculative.
    pub(super) fn join(&mut self, segment: SegmentId, id: InstanceId) -> bool {
        match self.all.get_mut(&segment) {
            Some(branch) => {
                branch.members.push(id);
                true
            }
            None => false,
        }
    }

    /// The oldest open decision on the way to a segment.
    pub(super) fn undecided(&self, segment: SegmentId) -> Option<InstanceId> {
        self.way(segment).last().map(|branch| branch.decision)
    }

    /// The open branches on the way to a segment, the nearest first.
    fn way(&self, segment: SegmentId) -> impl Iterator<Item = &Branch> {
        std::iter::successors(self.all.get(&segment), |branch| self.all.get(&branch.parent))
    }

    /// Probability of a segment; 1 if it is certain.
    pub(super) fn probability(&self, segment: SegmentId) -> f64 {
        self.way(segment).map(|branch| branch.share).product::<f64>().max(LEAST_PROBABILITY)
    }

    /// Whether the segment lies on the most likely way of every open decision before it.
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

    /// Whether a segment may grow: it is certain, or its branch may be expanded.
    pub(super) fn is_awake(&self, segment: SegmentId) -> bool {
        self.all.get(&segment).is_none_or(|branch| branch.is_expanded)
    }

    /// Lets branches be expanded, the most likely ones first, up to `width`.
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

    /// The branches behind lost segments or decisions, except those already lost.
    pub(super) fn behind(&self, segments: &BTreeSet<SegmentId>, lost: &BTreeSet<InstanceId>) -> Vec<SegmentId> {
        let is_behind = |(segment, branch): &(&SegmentId, &Branch)| {
            !segments.contains(segment) && (segments.contains(&branch.parent) || lost.contains(&branch.decision))
        };
        self.all.iter().filter(is_behind).map(|(segment, _)| *segment).collect()
    }

    /// Checks the tree.
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
