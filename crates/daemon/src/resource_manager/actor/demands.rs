//! What is missing, for those who can provide it.

use super::super::providers::Provisions;
use super::{ResourceCore, ResourceDesk};
use crate::details::retry_later;
use ratn_proto::types::Demand;
use ratn_resources::SessionId;
use std::time::Duration;
use tokio::sync::watch;
use tonic::{Code, Status};

impl ResourceCore {
    pub(super) fn watch_demand(
        &mut self,
        session: SessionId,
        provisions: Provisions,
    ) -> Result<watch::Receiver<Vec<Demand>>, Status> {
        self.providers.join(session, provisions, self.config.max_watchers).map_err(|there| {
            let message = format!("{there} providers watch already");
            retry_later(Code::ResourceExhausted, "TOO_MANY", message, Duration::from_secs(1))
        })
    }

    /// Tells providers what is missing, where that may have changed.
    pub(super) fn spread_demand(&mut self, desk: &ResourceDesk) {
        let now = desk.now();
        let changed = self.pool.take_demand();
        if changed.is_none() && !self.providers.are_due(now) {
            return;
        }
        self.demand = changed.unwrap_or_else(|| std::mem::take(&mut self.demand));
        self.providers.tell(now, &self.pool, &self.demand);
    }
}
