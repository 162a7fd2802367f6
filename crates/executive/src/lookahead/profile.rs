//! The free amounts of several kinds over time, as a step function; finds the first gap into which a task fits.

use super::packed::Lanes;
use std::ops::Range;

/// A resource profile over the kinds that have lanes; the last step never ends.
#[derive(Debug, Clone, Default)]
pub(super) struct Profile {
    lanes: Lanes,
    /// When a step begins; the first at 0.
    times: Vec<u64>,
    /// The free amounts of each step, [`Lanes::words`] words each.
    free: Vec<u64>,
}

impl Profile {
    pub(super) fn new(lanes: Lanes) -> Profile {
        Profile { lanes, times: Vec::new(), free: Vec::new() }
    }

    /// Empties it.
    pub(super) fn clear(&mut self) {
        self.times.clear();
        self.free.clear();
    }

    /// Adds a step: from this moment on, later than all before, `free` is free.
    pub(super) fn then(&mut self, from: u64, free: &[u64]) {
        self.times.push(from);
        self.free.extend_from_slice(free);
    }

    /// Takes an amount for a duration at the earliest possible moment from `from` on; returns that moment.
    pub(super) fn take(&mut self, wanted: &[u64], from: u64, duration: u64) -> u64 {
        let Some((start, first, last)) = self.earliest(wanted, from, duration) else { return from };
        if duration == 0 {
            return start;
        }
        let end = start.saturating_add(duration);
        if self.times.get(last + 1) != Some(&end) {
            self.split(last, end);
        }
        let is_within = self.times[first] != start;
        if is_within {
            self.split(first, start);
        }
        for step in first..=last {
            let words = self.words_of(step + usize::from(is_within));
            for (free, wanted) in self.free[words].iter_mut().zip(wanted) {
                *free = free.wrapping_sub(*wanted);
            }
        }
        start
    }

    /// The earliest moment, its step and the step in which the duration ends; `None` if it never fits, which bounded demands
    /// exclude.
    fn earliest(&self, wanted: &[u64], from: u64, duration: u64) -> Option<(u64, usize, usize)> {
        let mut first = self.times.partition_point(|time| *time <= from) - 1;
        let (mut start, mut end, mut step) = (from, from.saturating_add(duration), first);
        loop {
            let has = self.lanes.has(&self.free[self.words_of(step)], wanted);
            let next = self.times.get(step + 1);
            if !has {
                (start, first) = (*next?, step + 1);
                end = start.saturating_add(duration);
            } else if next.is_none_or(|next| *next >= end) {
                return Some((start, first, step));
            }
            step += 1;
        }
    }

    fn words_of(&self, step: usize) -> Range<usize> {
        let words = self.lanes.words();
        step * words..(step + 1) * words
    }

    /// Splits a step at a moment; both parts have the same free amounts.
    fn split(&mut self, step: usize, moment: u64) {
        self.times.insert(step + 1, moment);
        let (words, end) = (self.words_of(step), self.free.len());
        self.free.extend_from_within(end - words.len()..);
        self.free.copy_within(words.start..end - words.len(), words.end);
    }
}
