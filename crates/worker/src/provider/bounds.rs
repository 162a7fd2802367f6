//! For each resource that the manager has lost: until when its former holder may still move it. These bounds are kept apart from the
//! desired state, because a resource may be withdrawn meanwhile, and offered again.

use std::collections::BTreeMap;
use std::time::Duration;
use tokio::time::Instant;

/// Ends of the bounds by resource id; those that have passed are removed.
#[derive(Debug, Default)]
pub(super) struct Bounds(BTreeMap<String, Instant>);

impl Bounds {
    /// The former holder may move the resource for `standstill` from now on; without a bound nothing moves.
    pub(super) fn lost(&mut self, id: &str, standstill: Option<Duration>) {
        let now = Instant::now();
        self.0.retain(|_, until| *until > now);
        if let Some(standstill) = standstill {
            let until = self.0.entry(id.to_owned()).or_insert(now);
            *until = (*until).max(now + standstill);
        }
    }

    pub(super) fn may_move(&self, id: &str) -> bool {
        self.0.get(id).is_some_and(|until| Instant::now() < *until)
    }
}
