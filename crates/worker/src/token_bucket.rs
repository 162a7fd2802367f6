//! A token bucket: limits the rate of events, and the size of a burst.

use std::time::Instant;

/// The tokens, which are refilled with time.
#[derive(Debug, Clone, Copy)]
pub struct TokenBucket {
    left: f64,
    refilled: Instant,
}

impl TokenBucket {
    /// A full bucket of `most` tokens.
    pub fn full(most: u32, now: Instant) -> TokenBucket {
        TokenBucket { left: f64::from(most), refilled: now }
    }

    /// Takes a token, if there is one; `per_s` tokens are refilled per second, up to `most`.
    pub fn take(&mut self, per_s: u32, most: u32, now: Instant) -> bool {
        self.left = self.level(per_s, most, now);
        self.refilled = now;
        let taken = self.left >= 1.0;
        if taken {
            self.left -= 1.0;
        }
        taken
    }

    /// Whether the bucket is full again.
    pub fn is_full(&self, per_s: u32, most: u32, now: Instant) -> bool {
        self.level(per_s, most, now) >= f64::from(most)
    }

    fn level(&self, per_s: u32, most: u32, now: Instant) -> f64 {
        let passed = now.saturating_duration_since(self.refilled).as_secs_f64();
        (self.left + passed * f64::from(per_s)).min(f64::from(most))
    }
}
