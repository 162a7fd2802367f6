//! What is free of several kinds over time, as a step function: where does something fit first?

use super::network::Demand;

/// Of so many kinds; the last step never ends.
#[derive(Debug, Clone, Default)]
pub(super) struct Profile {
    kinds: usize,
    /// When a step begins; the first at 0.
    times: Vec<u64>,
    /// Per step what is free of each kind.
    free: Vec<u64>,
}

impl Profile {
    /// Everything is free.
    pub(super) fn clear(&mut self, capacity: &[u64]) {
        self.kinds = capacity.len();
        self.times.clear();
        self.times.push(0);
        self.free.clear();
        self.free.extend_from_slice(capacity);
    }

    /// The earliest moment from `from` on at which so much is free for so long.
    pub(super) fn earliest(&self, demands: &[Demand], from: u64, duration: u64) -> u64 {
        if demands.is_empty() {
            return from;
        }
        let mut start = from;
        let mut step = self.step_at(from);
        loop {
            if self.has(step, demands) {
                step += 1;
                if step == self.times.len() || self.times[step] >= start.saturating_add(duration) {
                    return start;
                }
            } else {
                step += 1;
                if step == self.times.len() {
                    // More is asked for than the last step has: it is never free. Whoever compiled the demands bounded them.
                    return start;
                }
                start = self.times[step];
            }
        }
    }

    /// It is taken from `start` for so long.
    pub(super) fn take(&mut self, demands: &[Demand], start: u64, duration: u64) {
        if demands.is_empty() || duration == 0 {
            return;
        }
        let first = self.split(start);
        let last = self.split(start.saturating_add(duration));
        for step in first..last {
            for demand in demands {
                let free = &mut self.free[step * self.kinds + demand.kind as usize];
                *free = free.saturating_sub(demand.units);
            }
        }
    }

    fn has(&self, step: usize, demands: &[Demand]) -> bool {
        let free = &self.free[step * self.kinds..(step + 1) * self.kinds];
        demands.iter().all(|demand| free[demand.kind as usize] >= demand.units)
    }

    /// The step in which a moment is.
    fn step_at(&self, moment: u64) -> usize {
        self.times.partition_point(|time| *time <= moment) - 1
    }

    /// The step that begins at a moment, made where there is none.
    fn split(&mut self, moment: u64) -> usize {
        let step = self.step_at(moment);
        if self.times[step] == moment {
            return step;
        }
        let (from, to) = (step * self.kinds, (step + 1) * self.kinds);
        self.times.insert(step + 1, moment);
        let end = self.free.len();
        self.free.extend_from_within(end - self.kinds..);
        if to < end {
            self.free.copy_within(to..end, to + self.kinds);
        }
        self.free.copy_within(from..to, to);
        step + 1
    }
}
