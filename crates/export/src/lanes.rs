//! Spans that overlap, laid into lanes in which they do not.

/// The lanes of one track.
#[derive(Debug, Default)]
pub(crate) struct Lanes {
    /// Until when each is taken; infinite for one in use.
    taken_to_s: Vec<f64>,
}

impl Lanes {
    /// The first lane that is free from a moment on, taken until another one; its number, and whether it is new.
    pub(crate) fn take(&mut self, from_s: f64, to_s: f64) -> (usize, bool) {
        // Moments of a log are whole nanoseconds.
        let free = self.taken_to_s.iter().position(|taken| *taken <= from_s + 1e-10);
        let lane = free.unwrap_or(self.taken_to_s.len());
        match free {
            Some(lane) => self.taken_to_s[lane] = to_s,
            None => self.taken_to_s.push(to_s),
        }
        (lane, free.is_none())
    }

    /// A lane is free from a moment on.
    pub(crate) fn free(&mut self, lane: usize, at_s: f64) {
        self.taken_to_s[lane] = at_s;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_overlaps_is_in_another_lane_and_what_follows_in_the_first_that_is_free() {
        let mut lanes = Lanes::default();
        assert_eq!(lanes.take(0.0, f64::INFINITY), (0, true));
        assert_eq!(lanes.take(1.0, 2.0), (1, true));
        assert_eq!(lanes.take(2.0, 3.0), (1, false));
        lanes.free(0, 2.5);
        assert_eq!(lanes.take(2.6, 4.0), (0, false));
        assert_eq!(lanes.take(2.6, 4.0), (2, true));
    }
}
