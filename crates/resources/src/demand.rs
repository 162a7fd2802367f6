//! Demand: resources that requests wait for and that do not exist yet, or have been held for long (`growth.rs`); it is reported to the providers that
//! could create them. Also the reasons why a provider does not.
//!
//! Demand describes the present: it ends with its waiters, or when what they want exists. Neither demand nor the providers' reasons are persistent;
//! both are reported again after a restart.

use crate::error::{PoolError, malformed};
use crate::group::{Group, Key};
use crate::growth::{Provided, Queued};
use crate::id::SessionId;
use crate::pool::Pool;
use crate::queue::Place;
use ratn_model::resource::{Quantity, Requirement};
use ratn_model::time::Timestamp;
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

/// Maximum number of selectors reported to providers: others follow when what these lack exists. Callers take turns.
const SELECTORS: usize = 256;
/// Maximum size of the reported selectors.
const DEMAND_BYTES: usize = 1 << 20;
/// Maximum number of waiters examined per selector if counting is not enough; the most urgent ones.
const LOOKED_AT: usize = 64;
/// Maximum number of kinds that one session may report as unavailable.
const SHORTAGES: usize = 64;
/// Maximum number of characters of a reason; longer ones are cut.
const REASON_LENGTH: usize = 512;

/// The most urgent waiter of a selector, the selector, the missing amount, and the queued amount.
type Lacking<'a> = (Place, &'a Key, Quantity, Quantity);

/// The demand for one selector.
#[derive(Debug, Clone, PartialEq)]
pub struct Demand {
    /// The selector; its count is the missing amount in addition to what exists, which may be zero.
    pub requirement: Requirement,
    /// The amount that requests have long waited for although existing resources would satisfy them.
    pub queued: Quantity,
    /// The kinds that would satisfy it: its kind and the subclasses.
    pub kinds: Vec<String>,
}

impl Pool {
    /// The missing resources that these kinds would satisfy, if this may have changed since the last call.
    pub fn take_demand(&mut self, provided: &Arc<Provided>) -> Option<Vec<Demand>> {
        if !Arc::ptr_eq(&self.queue.provided, provided) && self.queue.provided != *provided {
            self.queue.provided = Arc::clone(provided);
            self.queue.demand_changed = true;
        }
        if !self.queue.demand_changed && !self.queue.growth.is_due() {
            return None;
        }
        let (queued, news) = self.look_for_growth();
        if !std::mem::take(&mut self.queue.demand_changed) && !news {
            return None;
        }
        let mut turns: Vec<_> =
            self.callers.waited_for().map(|selectors| self.lacking(selectors, &queued).into_iter()).collect();
        let (mut told, mut missing, mut bytes) = (BTreeSet::new(), Vec::new(), 0);
        while missing.len() < SELECTORS && bytes < DEMAND_BYTES && !turns.is_empty() {
            turns.retain_mut(|selectors| {
                // If several callers lack the same, only the first of them uses a turn for it.
                let next = selectors.find(|(_, key, ..)| told.insert(Key::clone(key)));
                let Some((_, key, missing_here, queued_here)) = next.filter(|_| missing.len() < SELECTORS) else {
                    return false;
                };
                bytes += key.len();
                missing.extend(self.queue.groups.get(key).map(|group| self.demand(group, missing_here, queued_here)));
                true
            });
        }
        Some(missing)
    }

    /// The selectors that lack something provided, with the missing and the queued amounts; at most as many as are reported, the most urgent first.
    fn lacking<'a>(&'a self, selectors: impl Iterator<Item = &'a Key>, queued: &Queued) -> Vec<Lacking<'a>> {
        let kinds = self.resources.kinds();
        let lacking = selectors.filter_map(|key| {
            let group = self.queue.groups.get(key)?;
            let (queued, waits) =
                queued.get(key).map_or((Quantity::ZERO, None), |(amount, first)| (*amount, Some(first)));
            let first = *group.lacking.first().into_iter().chain(waits).min()?;
            let is_provided =
                kinds.subclasses(&group.selector.kind).any(|kind| self.queue.provided.kinds.contains(kind));
            let missing =
                if is_provided && !group.lacking.is_empty() { self.missing(key, group) } else { Quantity::ZERO };
            (!missing.is_zero() || !queued.is_zero()).then_some((first, key, missing, queued))
        });
        let mut lacking: Vec<_> = lacking.collect();
        if lacking.len() > SELECTORS {
            lacking.select_nth_unstable(SELECTORS);
            lacking.truncate(SELECTORS);
        }
        lacking.sort_unstable();
        lacking
    }

    /// How much more would have to exist for the waiter of a group that lacks most.
    fn missing(&self, key: &Key, group: &Group) -> Quantity {
        let counts = |(_, place): &&(Quantity, Place)| !group.several.contains(place);
        let counted =
            if group.divisible == 0 { group.by_amount.iter().rev().take(LOOKED_AT).find(counts) } else { None };
        let counted = counted.map(|(amount, _)| amount.saturating_sub(group.existing)).unwrap_or_default();
        let found = |place: &Place| self.queue.get(place.1).map(|waiter| waiter.missing_of(key));
        let is_looked_at = |place: &&Place| group.divisible > 0 || group.several.contains(*place);
        let looked_at = group.lacking.iter().filter(is_looked_at).take(LOOKED_AT);
        looked_at.filter_map(found).max().unwrap_or_default().max(counted)
    }

    fn demand(&self, group: &Group, missing: Quantity, queued: Quantity) -> Demand {
        let kinds = self.resources.kinds().subclasses(&group.selector.kind).map(str::to_owned).collect();
        Demand { requirement: Requirement { count: missing, ..group.selector.clone() }, queued, kinds }
    }

    /// A provider reports why there are no more resources of a kind, for those who wait for it; an empty reason withdraws the report. It ends with
    /// the session.
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
        self.check_kind(kind)?;
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

    /// Why there are no more of what a requirement wants, as reported by the providers.
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
