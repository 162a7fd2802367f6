//! Watches what other runs certainly need and this run holds: its executive is told, and releases what is only speculative.

use super::Answer;
use super::told::Told;
use ratn_executive::protocol::CERTAIN;
use ratn_model::id::LeaseId;
use ratn_proto::types::WaitingAcquire;
use ratn_worker::client::ResourceClient;
use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};
use tokio::sync::mpsc;

/// Interval between reads of the resource manager's queue, while there are other runs and this run holds something speculatively.
const LOOK_AGAIN: Duration = Duration::from_millis(250);

/// A request that still waits this long after it was reported is reported again: what was given up for it has been released by then, and was not enough.
const TELL_AGAIN: Duration = Duration::from_secs(3);

/// Whether a run holds anything speculatively. Clones share it.
#[derive(Debug, Clone, Default)]
pub(super) struct HoldsSpeculatively(Arc<AtomicBool>);

impl HoldsSpeculatively {
    pub(super) fn set(&self, holds: bool) {
        self.0.store(holds, Ordering::Relaxed);
    }

    fn get(&self) -> bool {
        self.0.load(Ordering::Relaxed)
    }
}

/// The requests that were reported, with the time.
#[derive(Debug, Default)]
struct ToldOf(BTreeMap<String, Instant>);

impl ToldOf {
    /// For each request that is to be reported now, the leases that block it.
    fn of(&mut self, run: &str, waiting: Vec<WaitingAcquire>, now: Instant) -> Vec<Vec<LeaseId>> {
        self.0.retain(|_, told| now.duration_since(*told) < TELL_AGAIN);
        let certain = waiting.into_iter().filter(|one| one.priority >= CERTAIN && one.session != run);
        let news = certain.filter(|one| !one.held_by.is_empty() && !self.0.contains_key(&one.request));
        let news: Vec<WaitingAcquire> = news.collect();
        self.0.extend(news.iter().map(|one| (one.request.clone(), now)));
        news.into_iter().map(|one| one.held_by).collect()
    }
}

/// Watches while other runs are known; ends with the run.
pub(super) async fn listen(
    resources: ResourceClient,
    run: String,
    told: Told,
    holds: HoldsSpeculatively,
    events: mpsc::Sender<Answer>,
) {
    let mut told_of = ToldOf::default();
    loop {
        told.others_after(LOOK_AGAIN).await;
        if !holds.get() {
            continue;
        }
        // The most urgent requests come first, so they are among the at most one hundred in the answer.
        let Ok(waiting) = resources.explain("").await else { continue };
        for leases in told_of.of(&run, waiting, Instant::now()) {
            if events.send(Answer::Wanted(leases)).await.is_err() {
                return;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn of_who_needs_for_certain_what_is_held_is_told_once_in_a_while() {
        let waits = |request: &str, session: &str, priority, lease: Option<u64>| WaitingAcquire {
            request: request.to_owned(),
            session: session.to_owned(),
            priority,
            held_by: lease.into_iter().map(LeaseId).collect(),
            ..WaitingAcquire::default()
        };
        let waiting = [
            waits("own", "me", CERTAIN, Some(1)),
            waits("in case", "other", CERTAIN - 1, Some(2)),
            waits("behind others", "other", CERTAIN, None),
            waits("needed", "other", CERTAIN, Some(3)),
        ];
        let (mut told_of, now) = (ToldOf::default(), Instant::now());
        assert_eq!(told_of.of("me", waiting.to_vec(), now), [[LeaseId(3)]]);
        assert!(told_of.of("me", waiting.to_vec(), now + TELL_AGAIN / 2).is_empty());
        assert_eq!(told_of.of("me", waiting.to_vec(), now + TELL_AGAIN), [[LeaseId(3)]]);
    }
}
