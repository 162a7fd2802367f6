//! Who opened which session: nobody else may speak for it, except an operator.
//!
//! ```text
//!   unknown ─ first ping of a caller ─▶ theirs ─ no ping for a TTL, or closed ─▶ unknown
//! ```
//! Pings of others are refused before they reach the pool, so a session here lives as long as it does there. What the pool forgot
//! otherwise (a restart) is owned anew by whoever opens it again.

use crate::access::Caller;
use crate::details::status;
use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};
use tonic::{Code, Status};

/// Beyond this many, sessions that have expired are forgotten before another is remembered; should all live, it is refused.
const MAX_SESSIONS: usize = 100_000;

/// Shared by all connections.
#[derive(Debug, Clone, Default)]
pub(crate) struct Owners {
    sessions: Arc<Mutex<BTreeMap<String, Owned>>>,
}

#[derive(Debug)]
struct Owned {
    by: Arc<str>,
    until: Instant,
}

impl Owners {
    /// A ping of a session that lives for `ttl` from now, zero to end it: the first makes it the caller's.
    pub(crate) fn ping(&self, caller: &Caller, session: &str, ttl: Duration, now: Instant) -> Result<(), Status> {
        let mut sessions = self.sessions.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(owned) = sessions.get_mut(session).filter(|owned| owned.until > now) {
            if owned.by != caller.name && !caller.is_operator() {
                return Err(not_yours(caller, session, &owned.by));
            }
            owned.until = now + ttl;
            return Ok(());
        }
        if ttl.is_zero() {
            sessions.remove(session);
            return Ok(());
        }
        if sessions.len() >= MAX_SESSIONS {
            sessions.retain(|_, owned| owned.until > now);
            if sessions.len() >= MAX_SESSIONS {
                let message = format!("sessions: the limit of {MAX_SESSIONS} is reached, try again later");
                return Err(status(Code::ResourceExhausted, "TOO_MANY", message));
            }
        }
        sessions.insert(session.to_owned(), Owned { by: caller.name.clone(), until: now + ttl });
        Ok(())
    }

    /// Whether the caller may speak for a session. Without one they speak as an operator.
    pub(crate) fn check(&self, caller: &Caller, session: &str, now: Instant) -> Result<(), Status> {
        if caller.is_operator() {
            return Ok(());
        }
        if session.is_empty() {
            let message = format!("{caller} says no session: only an operator may do that");
            return Err(status(Code::PermissionDenied, "NOT_YOURS", message));
        }
        let sessions = self.sessions.lock().unwrap_or_else(PoisonError::into_inner);
        match sessions.get(session) {
            Some(owned) if owned.until > now && owned.by != caller.name => Err(not_yours(caller, session, &owned.by)),
            // Whether it is unknown is for the pool to say.
            _ => Ok(()),
        }
    }
}

fn not_yours(caller: &Caller, session: &str, owner: &str) -> Status {
    status(Code::PermissionDenied, "NOT_YOURS", format!("session `{session}` belongs to {owner}, not to {caller}"))
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;
    use crate::access::Role;

    const TTL: Duration = Duration::from_secs(1);

    fn caller(name: &str, role: Role) -> Caller {
        Caller { name: name.into(), roles: [role].as_slice().into() }
    }

    #[test]
    fn a_session_is_only_its_openers_until_it_ends() {
        let (owners, now) = (Owners::default(), Instant::now());
        let (a, b, root) = (caller("a", Role::Task), caller("b", Role::Agent), caller("root", Role::Operator));
        owners.ping(&a, "s", TTL, now).unwrap();
        for refused in [
            owners.check(&b, "s", now),
            owners.ping(&b, "s", TTL, now),
            owners.ping(&b, "s", Duration::ZERO, now),
            owners.check(&b, "", now),
        ] {
            assert_eq!(refused.unwrap_err().code(), Code::PermissionDenied);
        }
        owners.check(&a, "s", now).unwrap();
        owners.check(&root, "s", now).unwrap();
        owners.check(&root, "", now).unwrap();
        owners.check(&b, "s", now + TTL).unwrap();
        owners.ping(&b, "s", TTL, now + TTL).unwrap();
        assert!(owners.check(&a, "s", now + TTL).is_err());
    }

    #[test]
    fn a_closed_session_is_anybodys() {
        let (owners, now) = (Owners::default(), Instant::now());
        owners.ping(&caller("a", Role::Task), "s", TTL, now).unwrap();
        owners.ping(&caller("a", Role::Task), "s", Duration::ZERO, now).unwrap();
        owners.ping(&caller("b", Role::Task), "s", TTL, now).unwrap();
    }
}
