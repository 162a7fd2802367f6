//! The wish of a user that a run ends, as something that every part of it can wait for.

use tokio::sync::watch;

/// How often the user has asked a run to end: the first time in order, the second time at once.
#[derive(Debug, Clone)]
pub struct Interrupt(watch::Receiver<u32>);

/// Asks the runs to end that were given its [`Interrupt`].
#[derive(Debug)]
pub struct Interrupter(watch::Sender<u32>);

impl Interrupter {
    /// Asks once more.
    pub fn ask(&self) {
        self.0.send_modify(|times| *times += 1);
    }
}

impl Interrupt {
    /// One, and who asks over it. Without anybody who asks, a run goes on to its end.
    pub fn new() -> (Interrupter, Interrupt) {
        let (asks, times) = watch::channel(0);
        (Interrupter(asks), Interrupt(times))
    }

    /// Whether the user asked.
    pub fn asked(&self) -> bool {
        *self.0.borrow() > 0
    }

    /// Resolves once the user has asked `times` times.
    pub async fn asked_times(&self, times: u32) {
        let mut count = self.0.clone();
        if count.wait_for(|n| *n >= times).await.is_err() {
            std::future::pending::<()>().await;
        }
    }
}
