//! Pruning a path that is left: the instances behind it, their branches, their lines.

use super::Graph;
use super::instance::{LineId, Role, SegmentId};
use ratn_model::id::InstanceId;
use smallvec::smallvec;
use std::collections::BTreeSet;

/// What a path that is not taken takes with it. The instances are still in the graph: whoever discards them ends first what they do.
#[derive(Debug, Default)]
pub(crate) struct Pruned {
    /// Oldest first.
    pub(crate) instances: BTreeSet<InstanceId>,
    pub(crate) segments: BTreeSet<SegmentId>,
    pub(crate) lines: BTreeSet<LineId>,
    /// Ends of regions that are lost although their fork is not.
    pub(crate) region_ends: Vec<(InstanceId, InstanceId)>,
    /// Forks whose join is lost although they are not.
    pub(crate) without_join: Vec<InstanceId>,
    /// Nothing that follows this instance is left, and nothing may grow there.
    pub(crate) behind: Option<InstanceId>,
    /// Nothing may grow on this line as it did.
    pub(crate) stopped_line: Option<LineId>,
}

impl Graph {
    /// A decision is made: the other arms are lost. With what has become certain.
    pub(crate) fn take_arm(&mut self, id: InstanceId, taken: usize) -> (Pruned, Vec<InstanceId>) {
        let Some(instance) = self.instances.get_mut(id).filter(|instance| instance.arms.len() > taken) else {
            return Default::default();
        };
        let mut arms = std::mem::take(&mut instance.arms);
        let kept = arms.swap_remove(taken);
        let segment = kept.segment;
        instance.arms = smallvec![kept];
        let mut pruned = Pruned { segments: arms.iter().map(|arm| arm.segment).collect(), ..Pruned::default() };
        self.prune(arms.iter().filter_map(|arm| arm.next).collect(), &mut pruned);
        (pruned, self.branches.take(segment))
    }

    /// Everything behind an instance is lost.
    pub(crate) fn cut_behind(&mut self, id: InstanceId) -> Pruned {
        let mut pruned = Pruned { behind: Some(id), ..Pruned::default() };
        let Some(instance) = self.instances.get_mut(id) else { return pruned };
        let arms = std::mem::take(&mut instance.arms);
        let (own, line, position, is_detached) =
            (instance.segment, instance.line, instance.position, instance.is_detached());
        pruned.segments = arms.iter().map(|arm| arm.segment).filter(|segment| *segment != own).collect();
        let mut next: Vec<InstanceId> = arms.iter().filter_map(|arm| arm.next).collect();
        if is_detached {
            // Its line went on without it: what has not retired is behind it.
            pruned.lines = self.stop_line(line, &mut next);
            pruned.stopped_line = Some(line);
            let beside = self.detached.iter().filter_map(|id| self.instances.get(*id));
            let behind = beside.filter(|other| {
                pruned.lines.contains(&other.line) || (other.line == line && other.position > position)
            });
            next.extend(behind.map(|other| other.id));
        }
        self.prune(next, &mut pruned);
        pruned
    }

    /// Adds to `heads` what a line has come to, also in the regions that it waits for, and waits for them no more: their lines.
    fn stop_line(&mut self, line: LineId, heads: &mut Vec<InstanceId>) -> BTreeSet<LineId> {
        let mut regions = BTreeSet::new();
        let mut open = vec![line];
        while let Some(line) = open.pop() {
            heads.extend(self.lines.stop(line));
            let instances = &self.instances;
            for (_, fork) in self.forks.extract_if(.., |id, fork| fork.line == line && instances.get(*id).is_none()) {
                heads.extend(fork.join);
                regions.extend(&fork.regions);
                open.extend(fork.regions);
            }
        }
        regions
    }

    /// Follows the arms from these instances, and from segments that are lost.
    fn prune(&mut self, from: Vec<InstanceId>, pruned: &mut Pruned) {
        let mut open = from;
        loop {
            while let Some(id) = open.pop() {
                let Some(instance) = self.instances.get(id) else { continue };
                if !pruned.instances.insert(id) {
                    continue;
                }
                for arm in &instance.arms {
                    open.extend(arm.next);
                    if arm.segment != instance.segment {
                        pruned.segments.insert(arm.segment);
                    }
                }
                match instance.role() {
                    Some(Role::Fork) => {
                        if let Some(fork) = self.forks.remove(&id) {
                            pruned.lines.extend(&fork.regions);
                            open.extend(fork.join);
                        }
                    }
                    Some(Role::RegionEnd) => {
                        if let Some(of) = self.lines.fork(instance.line)
                            && let Some(fork) = self.forks.get_mut(&of)
                        {
                            pruned.region_ends.push((of, id));
                            if let Some(join) = fork.join.take() {
                                open.push(join);
                                pruned.without_join.push(of);
                            }
                        }
                    }
                    _ => {}
                }
            }
            // Segments below a lost one are lost, and so is what stands on them.
            let behind = self.branches.behind(&pruned.segments, &pruned.instances);
            if behind.is_empty() {
                break;
            }
            pruned.segments.extend(behind);
        }
        self.branches.remove_all(&pruned.segments);
        for line in &pruned.lines {
            self.lines.remove(*line);
        }
        pruned.without_join.retain(|fork| self.forks.contains_key(fork));
    }
}
