//! The graph of instances: the contents of the window, their order, their lines and branches, and what retires next.
//!
//! It owns the instances. Others may read them; every change is a method here. It knows nothing of the world, of resources or
//! of how the window grows.
//!
//! | | |
//! |---|---|
//! | `instance`, `instances` | one visit of a state; all of them by id |
//! | `lines` | threads of control and their heads |
//! | `branches` | open decisions, and the probability of each way on |
//! | `prune` | the instances that are lost when a path is left |
//! | `node` | the life of one node |

mod branches;
mod checkpoint;
pub(crate) mod instance;
mod instances;
mod lines;
mod node;
mod prune;

use crate::plan::{Chain, Outcomes};
use crate::window::dispatch::DispatchCell;
use crate::window::growth::environment::{Environment, Link};
use crate::window::memory::Seen;
use crate::window::waits::WaitCell;
use branches::Branches;
use instance::{Arm, Body, Ended, Instance, LineId, Role, SegmentId, Status};
use instances::Instances;
use lines::Lines;
pub(crate) use lines::MAIN;
pub(crate) use prune::Pruned;
use ratn_model::id::InstanceId;
use serde::{Deserialize, Serialize};
use smallvec::smallvec;
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

/// A fork whose join has not retired.
#[derive(Debug, Serialize, Deserialize)]
struct Fork {
    /// The line on which the fork stands.
    line: LineId,
    regions: Vec<LineId>,
    join: Option<InstanceId>,
}

#[derive(Serialize, Deserialize)]
pub(crate) struct Graph {
    instances: Instances,
    lines: Lines,
    branches: Branches,
    forks: BTreeMap<InstanceId, Fork>,
    /// By join, the links of chains that have writers in several regions.
    joins: BTreeMap<InstanceId, Vec<(Chain, Link)>>,
    /// Detached PIAs: imprecise ones that still run although younger instances have retired.
    detached: BTreeSet<InstanceId>,
    /// Instances to be examined: new ones, and new heads.
    touched: Vec<InstanceId>,
}

impl Graph {
    pub(crate) fn new() -> Graph {
        Graph {
            instances: Instances::default(),
            lines: Lines::new(),
            branches: Branches::default(),
            forks: BTreeMap::new(),
            joins: BTreeMap::new(),
            detached: BTreeSet::new(),
            touched: Vec::new(),
        }
    }

    pub(crate) fn get(&self, id: InstanceId) -> Option<&Instance> {
        self.instances.get(id)
    }

    pub(crate) fn contains(&self, id: InstanceId) -> bool {
        self.instances.get(id).is_some()
    }

    /// All instances, oldest id first.
    pub(crate) fn iter(&self) -> impl DoubleEndedIterator<Item = &Instance> {
        self.instances.iter()
    }

    pub(crate) fn len(&self) -> usize {
        self.instances.len()
    }

    /// The range of ids in use, including holes.
    pub(crate) fn ids(&self) -> std::ops::Range<u64> {
        self.instances.ids()
    }

    /// Takes the instances that are new or have become heads since the last call.
    pub(crate) fn take_touched(&mut self) -> Vec<InstanceId> {
        std::mem::take(&mut self.touched)
    }

    /// Whether there are any such instances.
    pub(crate) fn has_touched(&self) -> bool {
        !self.touched.is_empty()
    }

    // ── growing ──

    /// Adds an instance behind the last one of a path; true if it is speculative.
    pub(crate) fn append(&mut self, instance: Box<Instance>, tail: Option<(InstanceId, usize)>) -> bool {
        let (id, line, segment, position) = (instance.id, instance.line, instance.segment, instance.position);
        let is_join = instance.role() == Some(Role::Join);
        self.instances.push(instance);
        // The first instance of a line has no predecessor on it, nor has one that follows a detached PIA.
        let mut is_next = false;
        if let Some((tail, arm)) = tail
            && let Some(older) = self.instances.get_mut(tail)
        {
            is_next = older.role() != Some(Role::Fork) && !older.is_detached();
            if let Some(arm) = older.arms.get_mut(arm) {
                arm.next = Some(id);
            }
        }
        self.touched.push(id);
        if !is_next && !is_join {
            self.set_head_at(line, Some((id, position)));
        }
        self.branches.join(segment, id)
    }

    pub(crate) fn single_arm(&mut self, id: InstanceId, outcomes: Outcomes) {
        if let Some(instance) = self.instances.get_mut(id) {
            let segment = instance.segment;
            instance.arms = smallvec![Arm { outcomes, next: None, segment }];
        }
    }

    /// Adds an arm to a decision, with its probability; returns the arm's segment.
    pub(crate) fn open_arm(&mut self, id: InstanceId, outcomes: Outcomes, share: f64) -> SegmentId {
        let parent = self.instances.get(id).map_or(0, |instance| instance.segment);
        let segment = self.branches.open(parent, id, share);
        if let Some(instance) = self.instances.get_mut(id) {
            instance.arms.push(Arm { outcomes, next: None, segment });
        }
        segment
    }

    /// Adds a region, which is at this place of the program, behind a fork; returns its line and the number of its arm.
    pub(crate) fn open_region(&mut self, id: InstanceId, place: u64) -> (LineId, usize) {
        let line = self.lines.open(id, place);
        let mut arm = 0;
        if let Some(fork) = self.instances.get_mut(id) {
            arm = fork.arms.len();
            fork.arms.push(Arm { outcomes: 0, next: None, segment: fork.segment });
            let around = fork.line;
            let record = || Fork { line: around, regions: Vec::new(), join: None };
            self.forks.entry(id).or_insert_with(record).regions.push(line);
        }
        (line, arm)
    }

    /// Notes a fork, also one without regions.
    pub(crate) fn note_fork(&mut self, id: InstanceId) {
        if let Some(line) = self.instances.get(id).map(|fork| fork.line) {
            self.forks.entry(id).or_insert_with(|| Fork { line, regions: Vec::new(), join: None });
        }
    }

    /// Sets the join of a fork. `links` are the links of chains that have writers in several regions.
    pub(crate) fn join_fork(
        &mut self,
        fork: InstanceId,
        join: InstanceId,
        environment: Environment,
        links: Vec<(Chain, Link)>,
    ) {
        self.joins.insert(join, links);
        if let Some(instance) = self.instances.get_mut(join) {
            instance.environment = environment;
        }
        self.single_arm(join, Outcomes::MAX);
        let Some(record) = self.forks.get_mut(&fork) else { return };
        record.join = Some(join);
        let line = record.line;
        if self.lines.lacks_head(line) && !self.contains(fork) {
            self.set_head(line, Some(join));
        }
    }

    /// The links of chains that have writers in several regions before this join.
    pub(crate) fn joined(&self, join: InstanceId) -> Option<&[(Chain, Link)]> {
        self.joins.get(&join).map(Vec::as_slice)
    }

    /// Whether the fork is known: its join has not retired.
    pub(crate) fn has_fork(&self, fork: InstanceId) -> bool {
        self.forks.contains_key(&fork)
    }

    /// The join behind the region of a line.
    pub(crate) fn join_behind(&self, line: LineId) -> Option<InstanceId> {
        self.forks.get(&self.lines.fork(line)?)?.join
    }

    /// The fork at which the region of a line began, and the region's number.
    pub(crate) fn region(&self, line: LineId) -> Option<(InstanceId, usize)> {
        let fork = self.lines.fork(line)?;
        let place = self.forks.get(&fork)?.regions.iter().position(|region| *region == line)?;
        Some((fork, place))
    }

    // ── branches ──

    /// Whether a decision on the way to a segment is open.
    pub(crate) fn is_speculative(&self, segment: SegmentId) -> bool {
        self.branches.is_open(segment)
    }

    pub(crate) fn has_branches(&self) -> bool {
        !self.branches.is_empty()
    }

    /// The oldest open decision on the way to an instance.
    pub(crate) fn undecided(&self, instance: &Instance) -> Option<InstanceId> {
        self.branches.undecided(instance.segment)
    }

    /// Probability of a segment; 1 if it is certain.
    pub(crate) fn probability(&self, segment: SegmentId) -> f64 {
        self.branches.probability(segment)
    }

    /// Whether the segment lies on the most likely way of every open decision before it.
    pub(crate) fn is_likeliest(&self, segment: SegmentId) -> bool {
        self.branches.is_likeliest(segment)
    }

    /// Whether a path in this segment may grow.
    pub(crate) fn is_awake(&self, segment: SegmentId) -> bool {
        self.branches.is_awake(segment)
    }

    /// Lets branches grow, the most likely ones first, up to `width`.
    pub(crate) fn awaken(&mut self, width: usize) {
        self.branches.awaken(width);
    }

    /// Whether two segments are the same stretch: both certain, or the same number.
    pub(crate) fn is_same_stretch(&self, a: SegmentId, b: SegmentId) -> bool {
        a == b || !(self.is_speculative(a) || self.is_speculative(b))
    }

    // ── lines ──

    pub(crate) fn has_line(&self, line: LineId) -> bool {
        self.lines.contains(line)
    }

    /// The position up to which a line has retired.
    pub(crate) fn floor(&self, line: LineId) -> u64 {
        self.lines.floor(line)
    }

    pub(crate) fn next_active_line(&self, after: Option<LineId>) -> Option<LineId> {
        self.lines.next_active(after)
    }

    /// The head of a line, unless the line waits for regions.
    pub(crate) fn head_of(&self, line: LineId) -> Option<InstanceId> {
        self.lines.head(line)
    }

    /// Whether a line has come to what is not expanded yet.
    pub(crate) fn lacks_head(&self, line: LineId) -> bool {
        self.lines.lacks_head(line)
    }

    /// The heads of the lines that have begun and wait for no region.
    pub(crate) fn active_heads(&self) -> impl Iterator<Item = &Instance> {
        let lines = std::iter::successors(self.next_active_line(None), |line| self.next_active_line(Some(*line)));
        lines.filter_map(|line| self.get(self.head_of(line)?))
    }

    /// The heads of all lines, including those that have not begun.
    pub(crate) fn heads(&self) -> impl Iterator<Item = &Instance> {
        self.lines.heads().filter_map(|id| self.instances.get(id))
    }

    /// The reason why a path is left by the outcome of a state is known: it was only known which state that is.
    pub(crate) fn explain(&mut self, path: &str, because: &Arc<str>) {
        let markers = self.instances.iter_mut().filter_map(|instance| match &mut instance.body {
            Body::Marker(marker) => Some(marker),
            Body::Node(_) => None,
        });
        for marker in markers.filter(|marker| marker.because.as_deref() == Some(path)) {
            marker.because = Some(because.clone());
        }
    }

    /// Detached PIAs, oldest first.
    pub(crate) fn detached(&self) -> &BTreeSet<InstanceId> {
        &self.detached
    }

    pub(crate) fn set_head(&mut self, line: LineId, head: Option<InstanceId>) {
        let head = head.and_then(|id| Some((id, self.instances.get(id)?.position)));
        self.set_head_at(line, head);
    }

    fn set_head_at(&mut self, line: LineId, head: Option<(InstanceId, u64)>) {
        if self.lines.set_head(line, head)
            && let Some((id, _)) = head
            && let Some(instance) = self.instances.get_mut(id)
        {
            instance.is_head = true;
            self.touched.push(id);
        }
    }

    /// A line has retired up to a position; sets its next head.
    pub(crate) fn advance(&mut self, line: LineId, position: u64, next: Option<InstanceId>) {
        self.lines.pass(line, position);
        self.set_head(line, next);
    }

    /// A fork has retired: begins its regions.
    pub(crate) fn begin_regions(&mut self, id: InstanceId, line: LineId, position: u64) {
        self.lines.pass(line, position);
        let Some(fork) = self.forks.get(&id) else { return };
        let (regions, join) = (fork.regions.clone(), fork.join);
        self.lines.wait_for_regions(line, regions.len());
        for region in &regions {
            let head = self.lines.activate(*region);
            self.set_head(*region, head);
        }
        if regions.is_empty() {
            self.set_head(line, join);
        }
    }

    pub(crate) fn end_region(&mut self, region: LineId) {
        let Some(fork) = self.lines.remove(region).and_then(|fork| self.forks.get(&fork)) else { return };
        let (line, join) = (fork.line, fork.join);
        if self.lines.region_ended(line) {
            self.set_head(line, join);
        }
    }

    /// Number of states entered and iterations begun on a line since the last node that was started, up to what has retired.
    pub(crate) fn idle_visits(&self, line: LineId) -> u32 {
        self.lines.idle_visits(line)
    }

    /// An instance has retired after this number of visits; a started one resets the count.
    pub(crate) fn count_visits(&mut self, line: LineId, visits: u32, started: bool) {
        self.lines.count_visits(line, visits, started);
    }

    /// Detaches a running imprecise PIA, so that younger instances may begin.
    pub(crate) fn pass_over(&mut self, id: InstanceId) {
        let Some((node, line, position, next)) = self.instances.get_mut(id).and_then(|instance| {
            let (line, position, next) = (instance.line, instance.position, instance.arms.first()?.next);
            match &mut instance.body {
                Body::Node(node) => Some((node, line, position, next)),
                Body::Marker(_) => None,
            }
        }) else {
            return;
        };
        node.is_detached = true;
        self.detached.insert(id);
        self.advance(line, position, next);
    }

    /// The path of a running PIA was left: it runs to its end, and nothing follows it.
    pub(crate) fn orphan(&mut self, id: InstanceId) {
        let Some(instance) = self.instances.get_mut(id) else { return };
        instance.arms.clear();
        if let Body::Node(node) = &mut instance.body {
            node.is_detached = true;
        }
        let line = instance.line;
        self.detached.insert(id);
        self.lines.leave_head(line, id);
    }

    // ── ending ──

    pub(crate) fn end(&mut self, id: InstanceId, ended: Ended) {
        let Some(instance) = self.instances.get_mut(id) else { return };
        match &mut instance.body {
            Body::Node(node) => node.status = Status::Finished(Box::new(ended)),
            Body::Marker(marker) => marker.ended = Some(Box::new(ended)),
        }
    }

    /// Discards a result: the instance begins, or decides, again.
    pub(crate) fn reopen(&mut self, id: InstanceId) {
        let Some(instance) = self.instances.get_mut(id) else { return };
        match &mut instance.body {
            Body::Node(node) => {
                node.status = Status::Expanded;
                node.seen = None;
                node.answer = None;
                node.attempt += 1;
            }
            Body::Marker(marker) => (marker.ended, marker.seen) = (None, None),
        }
    }

    /// Sets the inputs of a result.
    pub(crate) fn set_seen(&mut self, id: InstanceId, seen: Option<Seen>) {
        let Some(instance) = self.instances.get_mut(id) else { return };
        let seen = seen.map(Box::new);
        match &mut instance.body {
            Body::Node(node) => node.seen = seen,
            Body::Marker(marker) => marker.seen = seen,
        }
    }

    /// Marks a result as settled: it can no longer change.
    pub(crate) fn settle(&mut self, id: InstanceId) {
        if let Some(instance) = self.instances.get_mut(id) {
            instance.is_settled = true;
        }
    }

    /// The world has changed from outside: no result is settled any more, except what is real.
    pub(crate) fn unsettle_all(&mut self) {
        self.instances.iter_mut().for_each(|instance| instance.is_settled = false);
    }

    /// Takes an instance out of the window.
    pub(crate) fn remove(&mut self, id: InstanceId) -> Option<Box<Instance>> {
        let instance = self.instances.remove(id)?;
        self.detached.remove(&id);
        self.lines.leave_head(instance.line, id);
        if instance.role() == Some(Role::Join) {
            self.joins.remove(&id);
            self.forks.retain(|_, fork| fork.join != Some(id));
        }
        Some(instance)
    }

    fn get_mut(&mut self, id: InstanceId) -> Option<&mut Instance> {
        self.instances.get_mut(id)
    }

    /// The urgency of an instance, for [`crate::window::dispatch`].
    pub(crate) fn dispatching(&mut self, id: InstanceId) -> Option<&mut DispatchCell> {
        self.instances.get_mut(id).map(|instance| &mut instance.dispatch)
    }

    /// The wait of an instance and its waiters, for [`crate::window::waits`].
    pub(crate) fn waiting(&mut self, id: InstanceId) -> Option<&mut WaitCell> {
        self.instances.get_mut(id).map(|instance| &mut instance.waiting)
    }

    // ── invariants ──

    /// Checks the graph: links lead both ways, every instance can be reached, heads are where they should be.
    pub(crate) fn check_invariants(&self) -> Result<(), String> {
        self.branches.check_invariants(|id| self.contains(id))?;
        let mut reached: BTreeSet<InstanceId> = self.detached.clone();
        for id in &self.detached {
            let is_there = self.get(*id).is_some_and(Instance::is_detached);
            if !is_there {
                return Err(format!("{id} runs beside its line, and is not in the window or does not know"));
            }
        }
        let heads = self.lines.heads();
        reached.extend(heads);
        for (id, fork) in &self.forks {
            reached.extend(fork.join);
            if !self.contains(*id) && !self.lines.contains(fork.line) {
                return Err(format!("fork {id} has retired on line {:?}, which is gone", fork.line));
            }
        }
        for instance in self.iter() {
            for arm in &instance.arms {
                let Some(next) = arm.next else { continue };
                let Some(next) = self.get(next) else {
                    if instance.is_detached() {
                        // The instance that follows it on its line may have retired before it.
                        continue;
                    }
                    return Err(format!("{} is followed by {next}, which is not in the window", instance.id));
                };
                if next.id <= instance.id {
                    return Err(format!("{} is followed by {}, which is older", instance.id, next.id));
                }
                reached.insert(next.id);
            }
            if instance.arms.len() > 1 && instance.role() != Some(Role::Fork) {
                let open = instance.arms.iter().all(|arm| self.branches.is_open(arm.segment));
                if !open {
                    return Err(format!("{} has several ways on, and not all are open branches", instance.id));
                }
            }
            if !self.lines.contains(instance.line) && !instance.is_orphan() {
                return Err(format!("{} is on line {:?}, which is gone", instance.id, instance.line));
            }
        }
        match self.iter().find(|instance| !reached.contains(&instance.id)) {
            Some(lost) => Err(format!("nobody can reach {} on line {:?}", lost.id, lost.line)),
            None => Ok(()),
        }
    }
}
