//! What other runs wait for and need for certain, and this run holds: its executive hears of it, and gives up what is only speculative.

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

/// So often the queue of the resource manager is looked at, beside other runs and while anything is held in case it is needed.
const LOOK_AGAIN: Duration = Duration::from_millis(250);

/// Who still waits so long after it was told of is told of again: what was given up for it has come back by then, and was not enough.
const TELL_AGAIN: Duration = Duration::from_secs(3);

/// Whether a run holds anything in case it is needed. Clones share it.
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

/// Who was told of, by request.
#[derive(Debug, Default)]
struct ToldOf(BTreeMap<String, Instant>);

impl ToldOf {
    /// The leases in the way of each that is to be told of now.
    fn of(&mut self, run: &str, waiting: Vec<WaitingAcquire>, now: Instant) -> Vec<Vec<LeaseId>> {
        self.0.retain(|_, told| now.duration_since(*told) < TELL_AGAIN);
        let certain = waiting.into_iter().filter(|one| one.priority >= CERTAIN && one.session != run);
        let news = certain.filter(|one| !one.held_by.is_empty() && !self.0.contains_key(&one.request));
        let news: Vec<WaitingAcquire> = news.collect();
        self.0.extend(news.iter().map(|one| (one.request.clone(), now)));
        news.into_iter().map(|one| one.held_by).collect()
    }
}

/// Looks while other runs are known of; ends with the run.
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
        // The most urgent come first, so those are among the hundred that are told.
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
