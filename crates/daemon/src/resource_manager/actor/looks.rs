//! Requests that only read: the open sessions, and why an acquire waits. Each turn answers a part, and the call asks for the next.

use super::{ResourceCore, ResourceTurn};
use crate::details::status as status_with;
use crate::resource_manager::wire;
use ratn_model::time::Timestamp;
use ratn_proto::types::{SessionStatus, WaitingAcquire};
use ratn_resources::{Explanation, WaiterId};
use std::sync::Arc;
use tonic::{Code, Status};

/// Maximum number of waiters that are explained together.
const EXPLAINED: usize = 100;

/// Maximum number of resources and waiters read for explanations in one turn.
const LOOKS: usize = 20_000;
/// Maximum total number of leases, waiters and resources of the sessions listed in one turn.
const LISTED_AT_ONCE: usize = 4_096;

impl ResourceCore {
    pub(super) fn sessions(&self, after: &str, context: &ResourceTurn) -> Vec<SessionStatus> {
        let now = context.now();
        let some = self.pool.sessions_after(after, LISTED_AT_ONCE, wire::NAMED);
        some.into_iter().map(|session| wire::session(session, now)).collect()
    }

    pub(super) fn waiters(&self, caller: &Arc<str>, request_id: &str) -> Result<(Vec<WaiterId>, usize), Status> {
        let waiters = if request_id.is_empty() {
            self.pool.first_waiters(EXPLAINED)
        } else {
            let waiter = self.pool.waiter_of(caller, request_id).ok_or_else(|| {
                let message = format!("no acquire of request id `{request_id}` waits: it was answered, or never asked");
                status_with(Code::NotFound, "WAITER_UNKNOWN", message)
            })?;
            vec![waiter]
        };
        Ok((waiters, self.pool.waiting()))
    }

    pub(super) fn explain(&self, waiters: &[WaiterId], now: Timestamp) -> (Vec<WaitingAcquire>, usize) {
        let (explanations, done) = self.pool.explain_some(waiters, LOOKS);
        let explained = |why: &Explanation| {
            let (request_id, request) = self.pool.waiter(why.waiter)?;
            Some(wire::waiting(request_id, request, why, now))
        };
        (explanations.iter().filter_map(explained).collect(), done)
    }
}
