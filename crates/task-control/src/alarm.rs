//! A single timer for all timed work of a run. It is reset only if the next deadline changes, so that an arriving answer costs no timer operation.

use std::pin::Pin;
use std::time::Instant;
use tokio::time::Sleep;

/// A timer that fires at a set time. Must be created within a tokio runtime.
#[derive(Debug)]
pub(super) struct Alarm(Pin<Box<Sleep>>);

impl Alarm {
    /// A timer that fires at this time.
    pub(super) fn at(moment: Instant) -> Alarm {
        Alarm(Box::pin(tokio::time::sleep_until(moment.into())))
    }

    /// Sets the time at which the timer fires, in place of the previous one; a past time fires at once.
    pub(super) fn set(&mut self, moment: Instant) {
        if self.0.deadline() != moment.into() {
            self.0.as_mut().reset(moment.into());
        }
    }

    /// Resolves when the timer fires, and again on each call until it is reset.
    pub(super) async fn rings(&mut self) {
        self.0.as_mut().await;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::time::Duration;

    #[tokio::test]
    async fn it_rings_at_the_moment_that_it_was_set_to_last_until_it_is_set_anew() {
        let began = Instant::now();
        let mut alarm = Alarm::at(began + Duration::from_secs(60));
        let soon = began + Duration::from_millis(20);
        alarm.set(soon);
        // Awaited twice, the first time with a timeout.
        let _ = tokio::time::timeout(Duration::from_millis(1), alarm.rings()).await;
        alarm.set(soon);
        alarm.rings().await;
        assert!(Instant::now() >= soon);
        alarm.rings().await;
        alarm.set(began + Duration::from_secs(60));
        assert!(tokio::time::timeout(Duration::from_millis(1), alarm.rings()).await.is_err());
        alarm.set(began);
        alarm.rings().await;
    }
}
