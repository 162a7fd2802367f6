//! Pruning a path that is left: the instances behind it, their branches, their lines.

use super::Graph;
use super::instance::{LineId, Role, SegmentId};
use ratn_model::id::InstanceId;
use smallvec::smallvec;
use std::collections::BTreeSet;

/// Everything that is lost with a path that is not taken. The instances are still in the graph, so that their work can be stopped
/// first.
#[derive(Debug, Default)]
pub(crate) struct Pruned {
    /// Oldest first.
    pub(crate) instances: BTreeSet<InstanceId>,
    pub(crate) segments: BTreeSet<SegmentId>,
    pub(crate) lines: BTreeSet<LineId>,
    /// Lost ends of regions, with their fork, which stays.
    pub(crate) region_ends: Vec<(InstanceId, InstanceId)>,
    /// Forks that stay, but whose join is lost.
    pub(crate) without_join: Vec<InstanceId>,
    /// The instance behind which nothing is left and nothing may grow.
    pub(crate) behind: Option<InstanceId>,
    /// The line on which nothing may go on growing as before.
    pub(crate) stopped_line: Option<LineId>,
}

impl Graph {
    /// Takes an arm of a decision; the others are lost. Also returns what has become certain.
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
            // The line has passed it: everything that has not retired is behind it.
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

    /// Stops a line: adds its head to `heads`, and those of the regions that it waits for. Returns the lines of these regions.
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

    /// Collects what is lost, along the arms from these instances and behind lost segments.
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
            // Segments behind a lost segment are lost, with their instances.
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
