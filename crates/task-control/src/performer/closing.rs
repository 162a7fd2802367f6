//! The end of a run: what it decided is recorded, what it holds is given back, and its session ends.

use super::Performer;
use super::goal::CANCEL_DEADLINE;
use crate::ledger::Confirmed;
use crate::record::{self, Record};
use anyhow::bail;
use ratn_executive::protocol::Event;
use std::sync::Arc;
use std::time::Duration;
use tokio::sync::oneshot;

/// Time limit at the end of a run for everything that is still being recorded.
pub(super) const CLOSE_DEADLINE: Duration = Duration::from_secs(3);
/// Time limit at the end of a run for everything that is still being given back: a lease goes back when its cancelled goals have ended, or are abandoned.
const BACK_DEADLINE: Duration = CANCEL_DEADLINE.saturating_add(Duration::from_secs(1));
/// Time limit at the end of a run for its operations, and for the leases that have to be back before something is used up or deleted: longer than an
/// absent resource manager is waited for.
const RETURN_DEADLINE: Duration = Duration::from_secs(15);

impl Performer {
    /// Waits until all decisions are recorded and all leases given back, and ends the session. Returns the events that the executive has not been
    /// told by then: how far the run's operations are done, and whose effects failed first. An error if a decision is not recorded: the world pool or
    /// the resource manager then know less than what happened.
    pub(crate) async fn close(self) -> (Vec<Event>, anyhow::Result<()>) {
        let (heard, session, recorded) = (self.heard, self.number, Arc::clone(&self.recorded));
        let closed = self.end().await;
        let Confirmed { operation, failed, .. } = *recorded.borrow();
        let done = (operation > heard.operation).then(|| record::recorded(operation, session, Vec::new()));
        let failed = failed.filter(|_| heard.failed.is_none()).map(|(instance, unmade)| {
            let reason = closed.as_ref().err().map_or_else(String::new, ToString::to_string);
            Event::RetirementFailed { instance, reason, unmade }
        });
        (done.into_iter().chain(failed).collect(), closed)
    }

    async fn end(mut self) -> anyhow::Result<()> {
        self.begin_no_more();
        let recording = async {
            let (done, recorded) = oneshot::channel();
            self.records.send(Record::Flush(done)).await.map_err(|_| "the recorder is gone".to_owned())?;
            recorded.await.unwrap_or_else(|_| Err("the recorder is gone".to_owned()))
        };
        // An operation waits for the leases that go back before it, and all of them perhaps for an absent resource manager.
        let operating = self.order.operating.all();
        let mut before = if operating.is_empty() { Vec::new() } else { self.order.returning.all() };
        before.extend(operating);
        let in_time = async {
            let operated = async {
                for one in &before {
                    one.cancelled().await;
                }
            };
            tokio::select! {
                () = operated => {}
                () = self.session.gone() => {}
                () = tokio::time::sleep(RETURN_DEADLINE) => {}
            }
            tokio::time::sleep(CLOSE_DEADLINE).await;
        };
        let recorded = tokio::select! {
            recorded = recording => Ok(recorded),
            () = in_time => Err(self.recording.get()),
        };
        let giving_back = async { while self.giving_back.join_next().await.is_some() {} };
        if tokio::time::timeout(BACK_DEADLINE, giving_back).await.is_err() {
            tracing::warn!("what was left at the end of the run was not given back in time");
        }
        // Whoever gets the resources now changes the world; what was not recorded in time is never recorded.
        self.recorder.abort();
        let _ = self.recorder.await;
        self.session.close().await;
        match recorded {
            Ok(Ok(())) => Ok(()),
            Ok(Err(reason)) => bail!("what the run did is not all recorded: {reason}"),
            Err(waits_for) => bail!("what the run did is not all recorded: {waits_for}"),
        }
    }
}
