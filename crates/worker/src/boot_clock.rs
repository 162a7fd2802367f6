//! A clock that counts the time since boot, including the time during which the machine was suspended (`CLOCK_BOOTTIME`). `Instant`
//! (`CLOCK_MONOTONIC`) does not count that time, so a host that wakes up would still believe what has long ended elsewhere.
//!
//! This clock measures every belief that another process may act against: that a session lives, that a lease is held, that this process
//! still owns a state. Pauses, retries and deadlines of calls are measured with `Instant`. Timers do not run while the machine is suspended
//! either, so a belief is checked where it is used, and [`BootClock::sleep_until`] looks at the clock every [`LOOK_INTERVAL`].
//!
//! A virtual machine that its host pauses, or restores from a snapshot, cannot see that in any clock of its own.

use nix::time::{ClockId, clock_gettime};
use std::ops::Add;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

/// Maximum delay until a sleeper notices that the machine has woken up.
pub const LOOK_INTERVAL: Duration = Duration::from_millis(100);

/// A clock that goes on while the machine is suspended. Clones are the same clock.
#[derive(Debug, Clone, Default)]
pub struct BootClock {
    /// Nanoseconds of suspension that a test has simulated.
    suspended: Option<Arc<AtomicU64>>,
}

/// A moment of a [`BootClock`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub struct BootInstant(Duration);

impl BootClock {
    /// For tests: a clock whose suspension can be simulated.
    pub fn suspendable() -> BootClock {
        BootClock { suspended: Some(Arc::default()) }
    }

    /// For tests: simulates that the machine was suspended for `duration` and wakes up now. Only for a clock made by
    /// [`BootClock::suspendable`]; does nothing to any other.
    pub fn suspend(&self, duration: Duration) {
        if let Some(suspended) = &self.suspended {
            suspended.fetch_add(u64::try_from(duration.as_nanos()).unwrap_or(u64::MAX), Ordering::SeqCst);
        }
    }

    /// Now.
    ///
    /// # Panics
    /// If the system has no such clock: Linux has had it since 2.6.39.
    #[expect(clippy::expect_used, reason = "without this clock nothing may be believed, and Linux always has it")]
    pub fn now(&self) -> BootInstant {
        let now = Duration::from(clock_gettime(ClockId::CLOCK_BOOTTIME).expect("CLOCK_BOOTTIME can be read"));
        let suspended = self.suspended.as_ref().map_or(0, |suspended| suspended.load(Ordering::SeqCst));
        BootInstant(now + Duration::from_nanos(suspended))
    }

    /// Returns at `at`; if the machine was suspended then, at most [`LOOK_INTERVAL`] after it has woken up.
    pub async fn sleep_until(&self, at: BootInstant) {
        loop {
            let left = at.saturating_duration_since(self.now());
            if left.is_zero() {
                return;
            }
            tokio::time::sleep(left.min(LOOK_INTERVAL)).await;
        }
    }
}

impl BootInstant {
    /// Duration since `earlier`; zero if this instant is before it.
    #[must_use]
    pub fn saturating_duration_since(self, earlier: BootInstant) -> Duration {
        self.0.saturating_sub(earlier.0)
    }

    /// This instant minus `duration`, but no earlier than the boot.
    #[must_use]
    pub fn saturating_sub(self, duration: Duration) -> BootInstant {
        BootInstant(self.0.saturating_sub(duration))
    }
}

impl Add<Duration> for BootInstant {
    type Output = BootInstant;

    fn add(self, duration: Duration) -> BootInstant {
        BootInstant(self.0 + duration)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn a_sleeper_wakes_up_soon_after_a_suspension_that_is_longer_than_its_sleep() {
        let clock = BootClock::suspendable();
        let hour = Duration::from_secs(3_600);
        let begin = clock.now();
        let sleeper = tokio::spawn({
            let clock = clock.clone();
            async move { clock.sleep_until(begin + hour).await }
        });
        tokio::task::yield_now().await;
        assert!(!sleeper.is_finished());
        clock.suspend(hour);
        assert!(clock.now().saturating_duration_since(begin) >= hour);
        assert!(tokio::time::timeout(Duration::from_secs(20), sleeper).await.is_ok());
        assert_eq!(begin.saturating_duration_since(begin + hour), Duration::ZERO);
    }
}
