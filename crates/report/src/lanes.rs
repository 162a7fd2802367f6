//! Assigns overlapping spans to lanes, so that no two spans in a lane overlap.

/// The lanes of one track.
#[derive(Debug, Clone)]
pub struct Lanes {
    /// Number of lanes.
    count: usize,
    /// A tree of minima. At `places + lane`: until when that lane is taken, infinite for a lane in use or not yet existing; at `n`: the
    /// minimum of `2n` and `2n + 1`.
    taken_to_s: Vec<f64>,
    places: usize,
}

impl Default for Lanes {
    fn default() -> Lanes {
        Lanes { count: 0, taken_to_s: vec![f64::INFINITY; 2], places: 1 }
    }
}

impl Lanes {
    /// Takes the first lane that is free from `from_s` on, until `to_s`; returns its number, and whether it is new.
    pub fn take(&mut self, from_s: f64, to_s: f64) -> (usize, bool) {
        // Times in a log are whole nanoseconds.
        let is_free = |taken_to_s: f64| taken_to_s <= from_s + 1e-10;
        let is_new = !is_free(self.taken_to_s[1]);
        let mut at = 1;
        while !is_new && at < self.places {
            at = 2 * at + usize::from(!is_free(self.taken_to_s[2 * at]));
        }
        let lane = if is_new { self.count } else { at - self.places };
        self.count += usize::from(is_new);
        if lane == self.places {
            self.grow();
        }
        self.free(lane, to_s);
        (lane, is_new)
    }

    /// Frees a lane from `at_s` on.
    pub fn free(&mut self, lane: usize, at_s: f64) {
        let mut at = self.places + lane;
        self.taken_to_s[at] = at_s;
        while at > 1 {
            at /= 2;
            self.taken_to_s[at] = self.taken_to_s[2 * at].min(self.taken_to_s[2 * at + 1]);
        }
    }

    fn grow(&mut self) {
        let lanes = self.taken_to_s.split_off(self.places);
        self.places *= 2;
        self.taken_to_s = vec![f64::INFINITY; 2 * self.places];
        for (lane, to_s) in lanes.into_iter().enumerate() {
            self.free(lane, to_s);
        }
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
        for lane in 3..100 {
            assert_eq!(lanes.take(2.6, f64::from(lane)), (lane as usize, true));
        }
        assert_eq!(
            (lanes.take(9.0, 90.0), lanes.take(9.0, 90.0), lanes.take(9.0, 90.0)),
            ((0, false), (1, false), (2, false))
        );
        assert_eq!((lanes.take(11.0, 90.0), lanes.take(3.5, 4.0)), ((3, false), (100, true)));
    }
}
