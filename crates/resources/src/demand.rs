//! Demand: resources that requests wait for and that do not exist yet, or are held for long (`growth.rs`), for the providers that could
//! create them; and why a provider does not.
//!
//! Demand is of now: it goes when its waiters do, or when what they want is there. It is not written down, nor is what providers
//! say of it; both are said again after a restart.

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

/// Selectors that providers are told of: those who wait for others come up when what these lack is there. Callers have them in turn.
const SELECTORS: usize = 256;
/// Bytes of what they ask for that providers are told of.
const DEMAND_BYTES: usize = 1 << 20;
/// Waiters of one selector that are looked at where it is not enough to count, the most urgent ones.
const LOOKED_AT: usize = 64;
/// Kinds of which one session may say that it cannot provide them.
const SHORTAGES: usize = 64;
/// Characters of a reason; the rest is cut off.
const REASON_LENGTH: usize = 512;

/// The most urgent one that waits for a selector, what is missing of that, and what is queued for.
type Lacking<'a> = (Place, &'a Key, Quantity, Quantity);

/// What one selector lacks.
#[derive(Debug, Clone, PartialEq)]
pub struct Demand {
    /// What is selected; its count is how much is missing beside those that exist, which may be nothing.
    pub requirement: Requirement,
    /// How much has been waited for for long although what exists would do.
    pub queued: Quantity,
    /// The kinds that would do: its kind, and those below.
    pub kinds: Vec<String>,
}

impl Pool {
    /// What is missing now of what these kinds would do for, where that may be something else than at the last call.
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
                // Of several callers who lack the same, one has had their turn for it.
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

    /// Which of these selectors lack something that is provided, how much, and how much is queued for; as many as are told of, the most
    /// urgent first.
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

    /// How much more there would have to be for the waiter of a group that lacks most.
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
