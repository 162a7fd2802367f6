//! Until when what a provider has lost at the manager may still move for who held it there. That outlives what is desired: a resource may be
//! withdrawn meanwhile, and wanted again.

use std::collections::BTreeMap;
use std::time::Duration;
use tokio::time::Instant;

/// By id of a resource; what has passed is forgotten.
#[derive(Debug, Default)]
pub(super) struct Bounds(BTreeMap<String, Instant>);

impl Bounds {
    /// Who held it may move it for so long from now on; nobody does where it has no bound for standstill.
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
