//! A token bucket: how often something may happen, and how much of it at once.

use std::time::Instant;

/// What may be taken at once, refilled with time.
#[derive(Debug, Clone, Copy)]
pub struct TokenBucket {
    left: f64,
    refilled: Instant,
}

impl TokenBucket {
    /// As many as may come at once.
    pub fn full(most: u32, now: Instant) -> TokenBucket {
        TokenBucket { left: f64::from(most), refilled: now }
    }

    /// One of them, if there is one; `per_s` come back in a second, up to `most`.
    pub fn take(&mut self, per_s: u32, most: u32, now: Instant) -> bool {
        self.left = self.level(per_s, most, now);
        self.refilled = now;
        let taken = self.left >= 1.0;
        if taken {
            self.left -= 1.0;
        }
        taken
    }

    /// Whether nothing is taken of it any more.
    pub fn is_full(&self, per_s: u32, most: u32, now: Instant) -> bool {
        self.level(per_s, most, now) >= f64::from(most)
    }

    fn level(&self, per_s: u32, most: u32, now: Instant) -> f64 {
        let passed = now.saturating_duration_since(self.refilled).as_secs_f64();
        (self.left + passed * f64::from(per_s)).min(f64::from(most))
    }
}
