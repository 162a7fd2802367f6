//! Who only looks: the sessions there are, and why an acquire waits.

use super::{ResourceCore, ResourceDesk};
use crate::details::status as status_with;
use crate::resource_manager::wire;
use ratn_proto::types::{SessionStatus, WaitingAcquire};
use ratn_resources::WaiterId;
use std::sync::Arc;
use tonic::{Code, Status};

/// Waiters that are explained together at the most.
const EXPLAINED: usize = 100;

impl ResourceCore {
    pub(super) fn sessions(&self, desk: &ResourceDesk) -> Vec<SessionStatus> {
        let now = desk.now();
        self.pool.sessions().into_iter().map(|session| wire::session(session, now)).collect()
    }

    pub(super) fn explain(&self, caller: &Arc<str>, request_id: &str) -> Result<(Vec<WaitingAcquire>, usize), Status> {
        let waiters = if request_id.is_empty() {
            self.pool.first_waiters(EXPLAINED)
        } else {
            let waiter = self.pool.waiter_of(caller, request_id).ok_or_else(|| {
                let message = format!("no acquire of request id `{request_id}` waits: it was answered, or never asked");
                status_with(Code::NotFound, "WAITER_UNKNOWN", message)
            })?;
            vec![waiter]
        };
        let explained = |id: WaiterId| {
            let (request_id, request) = self.pool.waiter(id)?;
            Some(wire::waiting(request_id, request, &self.pool.explain(id)?))
        };
        Ok((waiters.into_iter().filter_map(explained).collect(), self.pool.waiting()))
    }
}
