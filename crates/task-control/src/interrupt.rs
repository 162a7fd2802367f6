//! The user's request that a run ends, for which every part of the run can wait.

use tokio::sync::watch;

/// How often the user has asked a run to end: the first time it ends in order, the second time at once.
#[derive(Debug, Clone)]
pub struct Interrupt(watch::Receiver<u32>);

/// Asks the runs that share its [`Interrupt`] to end.
#[derive(Debug)]
pub struct Interrupter(watch::Sender<u32>);

impl Interrupter {
    /// Asks again.
    pub fn ask(&self) {
        self.0.send_modify(|times| *times += 1);
    }
}

impl Interrupt {
    /// A pair of asker and receiver. If the asker is dropped, the run goes on to its end.
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
