//! Demand: which resources are missing, reported to the providers that can supply them.

use super::super::providers::Provisions;
use super::super::status::of_error;
use super::{ResourceCore, ResourceTurn};
use crate::details::{retry_later, status};
use ratn_model::time::Timestamp;
use ratn_proto::types::Demand;
use ratn_resources::{PoolError, SessionId};
use std::time::Duration;
use tokio::sync::watch;
use tonic::{Code, Status};

impl ResourceCore {
    pub(super) fn watch_demand(
        &mut self,
        session: SessionId,
        provisions: Provisions,
    ) -> Result<watch::Receiver<Vec<Demand>>, Status> {
        if !self.pool.has_session(&session) {
            return Err(of_error(&PoolError::UnknownSession { session }));
        }
        self.providers.join(session, provisions, self.config.max_watchers).map_err(|there| {
            let message = format!("{there} providers watch already");
            retry_later(Code::ResourceExhausted, "TOO_MANY", message, Duration::from_secs(1))
        })
    }

    /// A provider reports that it can provide at most `most` of a kind; an empty reason withdraws the report.
    pub(super) fn report_shortage(
        &mut self,
        now: Timestamp,
        session: &SessionId,
        kind: &str,
        most: u32,
        reason: &str,
    ) -> Result<(), Status> {
        if !reason.is_empty() && !self.providers.provides(session, kind) {
            let message = format!(
                "{session} is not asked for `{kind}`: watch demand with it among the provisions, and report then"
            );
            return Err(status(Code::FailedPrecondition, "NOT_A_PROVIDER", message));
        }
        self.pool.report_shortage(now, session, kind, reason).map_err(|error| of_error(&error))?;
        self.providers.bound(session, kind, (!reason.is_empty()).then_some(most));
        Ok(())
    }

    /// Tells providers what is missing or waited for, if that may have changed.
    pub(super) fn spread_demand(&mut self, context: &ResourceTurn) {
        if let Some(demand) = self.pool.take_demand(self.providers.provided()) {
            self.demand = demand;
            self.providers.are_to_be_told();
        }
        self.providers.tell(context.now(), &self.pool, &self.demand);
    }
}
