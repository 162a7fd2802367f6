//! What other runs wait for and need for certain, and this run holds: its executive hears of it, and gives up what is only speculative.

use super::Answer;
use super::told::Told;
use ratn_executive::protocol::CERTAIN;
use ratn_worker::client::ResourceClient;
use std::time::Duration;
use tokio::sync::mpsc;

/// So often the queue of the resource manager is looked at beside other runs. Who still waits is told of again.
const LOOK_AGAIN: Duration = Duration::from_millis(250);

/// Looks from the moment on that other runs are known of; ends with the run.
pub(super) async fn listen(resources: ResourceClient, run: String, told: Told, events: mpsc::Sender<Answer>) {
    told.others_after(Duration::ZERO).await;
    loop {
        tokio::time::sleep(LOOK_AGAIN).await;
        // The most urgent come first, so those are among the hundred that are told.
        let Ok(waiting) = resources.explain("").await else { continue };
        let certain = waiting.into_iter().filter(|one| one.priority >= CERTAIN && one.session != run);
        for leases in certain.map(|one| one.held_by).filter(|leases| !leases.is_empty()) {
            if events.send(Answer::Wanted(leases)).await.is_err() {
                return;
            }
        }
    }
}
