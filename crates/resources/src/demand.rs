//! Demand: what waiters want beyond all that exists, for those who could provide it; and why they do not.
//!
//! Demand is of now: it goes when its waiters do, or when what they want is there. It is not written down, nor is what providers
//! say of it; both are said again after a restart.

use crate::assignment::{Assignment, Available};
use crate::error::{PoolError, malformed};
use crate::group::Key;
use crate::id::SessionId;
use crate::pool::Pool;
use ratn_model::resource::{Quantity, Requirement};
use ratn_model::time::Timestamp;
use std::collections::BTreeMap;

/// Waiters that are looked at, the first of the queue: who is behind them comes up when they have gone.
const LOOKED_AT: usize = 256;
/// Resources that are looked at for them: of who is behind, it is found out when those before have gone.
const RESOURCES_LOOKED_AT: usize = 100_000;
/// Bytes of what they ask for that providers are told of.
const DEMAND_BYTES: usize = 1 << 20;
/// Kinds of which one session may say that it cannot provide them.
const SHORTAGES: usize = 64;
/// Characters of a reason; the rest is cut off.
const REASON_LENGTH: usize = 512;

/// What one selector lacks.
#[derive(Debug, Clone, PartialEq)]
pub struct Demand {
    /// What is selected; its count is how much is missing beside those that exist.
    pub requirement: Requirement,
    /// The kinds that would do: its kind, and those below.
    pub kinds: Vec<String>,
}

impl Pool {
    /// What is missing now, where that may be something else than at the last call.
    pub fn take_demand(&mut self) -> Option<Vec<Demand>> {
        if !std::mem::take(&mut self.queue.demand_changed) {
            return None;
        }
        let mut missing = BTreeMap::<&Key, (&Requirement, Quantity)>::new();
        let (mut looked_at, mut bytes) = (0, 0);
        for (_, id) in self.queue.hopeless.iter().take(LOOKED_AT) {
            if looked_at >= RESOURCES_LOOKED_AT || bytes >= DEMAND_BYTES {
                break;
            }
            let Some(waiter) = self.queue.get(*id) else { continue };
            let requirements: Vec<&Requirement> = waiter.request.requirements.iter().collect();
            bytes += waiter.groups.iter().map(|key| key.len()).sum::<usize>();
            let assignment = Assignment::of(&self.resources, Available::Existing, &requirements);
            looked_at += assignment.looked_at;
            for (index, amount) in assignment.missing.into_iter().enumerate().filter(|(_, amount)| !amount.is_zero()) {
                let (_, most) = missing.entry(&waiter.groups[index]).or_insert((requirements[index], amount));
                *most = amount.max(*most);
            }
        }
        let demand = |(requirement, amount): (&Requirement, Quantity)| Demand {
            kinds: self.resources.kinds().subclasses(&requirement.kind).map(str::to_owned).collect(),
            requirement: Requirement { count: amount, ..requirement.clone() },
        };
        Some(missing.into_values().map(demand).collect())
    }

    /// How much of what a demand selects a session provides already.
    pub fn provided(&self, session: &SessionId, demand: &Demand) -> Quantity {
        let fitting = self.resources.fitting(&demand.requirement).map(|(_, resource)| resource);
        fitting.filter(|resource| resource.owner.as_ref() == Some(session)).map(|r| r.quantity()).sum()
    }

    /// A provider says why there are no more of a kind, to those who wait for it; an empty reason takes that back. It goes with the
    /// session.
    ///
    /// # Errors
    /// An unknown session, a malformed kind, too many kinds.
    pub fn report_shortage(
        &mut self,
        now: Timestamp,
        session: &SessionId,
        kind: &str,
        reason: &str,
    ) -> Result<(), PoolError> {
        self.begin(now);
        self.session(session)?;
        self.check_name("kind", kind)?;
        if reason.is_empty() {
            let of_session = self.shortages.get_mut(session);
            of_session.map(|kinds| kinds.remove(kind));
            return Ok(());
        }
        let kinds = self.shortages.entry(session.clone()).or_default();
        if kinds.len() >= SHORTAGES && !kinds.contains_key(kind) {
            return Err(malformed("shortage", &format!("of at most {SHORTAGES} kinds")));
        }
        let reason = reason.chars().map(|c| if c.is_control() { ' ' } else { c }).take(REASON_LENGTH).collect();
        kinds.insert(kind.to_owned(), reason);
        Ok(())
    }

    /// Why there are no more of what a requirement wants, in the words of the providers.
    pub(crate) fn shortages_of(&self, requirement: &Requirement) -> Vec<String> {
        let kinds = self.resources.kinds();
        let of_session = |(session, shortages): (&SessionId, &BTreeMap<String, String>)| {
            let name = self.sessions.get(session).map_or("", |session| session.name.as_str()).to_owned();
            let of_kind = shortages.iter().filter(|(kind, _)| kinds.is_a(kind, &requirement.kind));
            of_kind.map(|(_, reason)| format!("{name}: {reason}")).collect::<Vec<String>>()
        };
        self.shortages.iter().flat_map(of_session).collect()
    }
}
