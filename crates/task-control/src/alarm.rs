//! One timer for everything that a run does at a moment. It is set anew only where another moment comes first, so that an answer that
//! arrives costs no timer.

use std::pin::Pin;
use std::time::Instant;
use tokio::time::Sleep;

/// Rings at a moment. Made within a tokio runtime.
#[derive(Debug)]
pub(super) struct Alarm(Pin<Box<Sleep>>);

impl Alarm {
    /// One that rings then.
    pub(super) fn at(moment: Instant) -> Alarm {
        Alarm(Box::pin(tokio::time::sleep_until(moment.into())))
    }

    /// It rings then, and not before; at once where that is past.
    pub(super) fn set(&mut self, moment: Instant) {
        if self.0.deadline() != moment.into() {
            self.0.as_mut().reset(moment.into());
        }
    }

    /// Resolves when it rings, and again until it is set anew.
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
        // Waited for twice, and given up once.
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
