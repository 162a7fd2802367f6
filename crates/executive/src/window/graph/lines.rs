//! Lines: threads of control, the task's and one per region. Each line retires in program order, so each has a head.

use ratn_model::id::InstanceId;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::ops::Bound::{Excluded, Unbounded};

/// A thread of control: the task's, or a region's. They are in the order in which the regions are written.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub(crate) struct LineId {
    /// The place of the region in the program ([`crate::plan::StatePlan::place`]).
    place: u64,
    /// Its number among all lines.
    number: u64,
}

impl LineId {
    /// The place of its region in the program.
    pub(crate) fn place(self) -> u64 {
        self.place
    }
}

/// The task's own line.
pub(crate) const MAIN: LineId = LineId { place: 0, number: 0 };

/// One thread of control.
#[derive(Debug, Default, Serialize, Deserialize)]
struct Line {
    /// The oldest instance that has not retired.
    head: Option<InstanceId>,
    /// The position of the head, or that of the next instance.
    floor: u64,
    /// Number of regions of the last retired fork that have not ended; the line waits for them.
    open_regions: usize,
    /// Whether its fork has retired.
    is_active: bool,
    /// The fork at which it begins.
    fork: Option<InstanceId>,
    /// Number of states entered and iterations begun since the last node that was started.
    idle_visits: u32,
}

#[derive(Debug, Serialize, Deserialize)]
pub(super) struct Lines {
    all: BTreeMap<LineId, Line>,
    last: u64,
}

impl Lines {
    /// The task's line only.
    pub(super) fn new() -> Lines {
        Lines { all: BTreeMap::from([(MAIN, Line { is_active: true, ..Line::default() })]), last: 0 }
    }

    /// Adds the line of a region at this place of the program; it begins when its fork retires.
    pub(super) fn open(&mut self, fork: InstanceId, place: u64) -> LineId {
        self.last += 1;
        let line = LineId { place, number: self.last };
        self.all.insert(line, Line { fork: Some(fork), ..Line::default() });
        line
    }

    pub(super) fn contains(&self, line: LineId) -> bool {
        self.all.contains_key(&line)
    }

    /// The next line after `after` whose fork has retired.
    pub(super) fn next_active(&self, after: Option<LineId>) -> Option<LineId> {
        let from = after.map_or(Unbounded, Excluded);
        self.all.range((from, Unbounded)).find(|(_, line)| line.is_active).map(|(id, _)| *id)
    }

    pub(super) fn head(&self, line: LineId) -> Option<InstanceId> {
        self.all.get(&line).filter(|line| line.open_regions == 0)?.head
    }

    pub(super) fn heads(&self) -> impl Iterator<Item = InstanceId> + '_ {
        self.all.values().filter_map(|line| line.head)
    }

    /// The position up to which a line has retired.
    pub(super) fn floor(&self, line: LineId) -> u64 {
        self.all.get(&line).map_or(0, |line| line.floor)
    }

    pub(super) fn fork(&self, line: LineId) -> Option<InstanceId> {
        self.all.get(&line)?.fork
    }

    /// Sets the head of a line and its position; returns whether the head may retire now.
    pub(super) fn set_head(&mut self, line: LineId, head: Option<(InstanceId, u64)>) -> bool {
        let Some(line) = self.all.get_mut(&line) else { return false };
        line.head = head.map(|(id, _)| id);
        if let Some((_, position)) = head {
            line.floor = position;
        }
        head.is_some() && line.is_active && line.open_regions == 0
    }

    /// Everything on the line up to a position has retired.
    pub(super) fn pass(&mut self, line: LineId, position: u64) {
        if let Some(line) = self.all.get_mut(&line) {
            line.head = None;
            line.floor = position + 1;
        }
    }

    /// Removes an instance as the head of its line, if it was the head.
    pub(super) fn leave_head(&mut self, line: LineId, id: InstanceId) {
        if let Some(line) = self.all.get_mut(&line).filter(|line| line.head == Some(id)) {
            line.head = None;
        }
    }

    /// The fork of a line has retired: returns the line's head.
    pub(super) fn activate(&mut self, line: LineId) -> Option<InstanceId> {
        let line = self.all.get_mut(&line)?;
        line.is_active = true;
        line.head
    }

    pub(super) fn wait_for_regions(&mut self, line: LineId, regions: usize) {
        if let Some(line) = self.all.get_mut(&line) {
            line.open_regions = regions;
        }
    }

    /// A region of the line has ended; true if it was the last.
    pub(super) fn region_ended(&mut self, line: LineId) -> bool {
        let Some(line) = self.all.get_mut(&line) else { return false };
        line.open_regions = line.open_regions.saturating_sub(1);
        line.open_regions == 0
    }

    /// Whether a line has come to what is not expanded yet, perhaps a join.
    pub(super) fn lacks_head(&self, line: LineId) -> bool {
        self.all.get(&line).is_some_and(|line| line.open_regions == 0 && line.head.is_none())
    }

    /// The line stops waiting for regions; returns its head.
    pub(super) fn stop(&mut self, line: LineId) -> Option<InstanceId> {
        let line = self.all.get_mut(&line)?;
        line.open_regions = 0;
        line.head
    }

    pub(super) fn remove(&mut self, line: LineId) -> Option<InstanceId> {
        self.all.remove(&line)?.fork
    }

    /// Number of states entered and iterations begun since the last node that was started.
    pub(super) fn idle_visits(&self, line: LineId) -> u32 {
        self.all.get(&line).map_or(0, |line| line.idle_visits)
    }

    /// An instance has retired after this number of visits; a started one resets the count.
    pub(super) fn count_visits(&mut self, line: LineId, visits: u32, started: bool) {
        if let Some(line) = self.all.get_mut(&line) {
            line.idle_visits = if started { 0 } else { line.idle_visits.saturating_add(visits) };
        }
    }
}
