//! Accounts for fair sharing: how much each session has used of each family of kinds, relative to its share and to the sessions that wait.
//!
//! ```text
//!   while a session holds units:     service += time × units / its share
//!   ahead of those who wait there:   (service - least of theirs) × sum of the shares / units held by them, as time
//!   when it begins to hold or wait:  service ≥ level: idle sessions accumulate no credit
//!   when its turn begins:            service within AHEAD of the least of theirs: any larger difference is forgotten, in both directions
//! ```
//!
//! "Those who wait" are the sessions that need something for certain which the existing resources could satisfy; the level is the least service that
//! they had when one of them last began a turn. Sessions that hold and do not wait, sessions that wait for what does not exist, and capacity that
//! nobody waits for, make no difference to others. Held units count, whatever they were needed for; consumed units do not. Accounts are not
//! persistent: after a restart every session begins anew.
//!
//! Nothing happens by itself: an account is settled when its session gets or releases something. A comparison reads each session once, for all that
//! are compared at that time.
//!
//! If the shares of a caller's sessions that hold or wait exceed a bound in total (`share_per_caller`), they count as this bound together: each share
//! is scaled down by the same factor, and time is scaled with it. What such a session owes is then at most that factor longer, and passes to the
//! caller's next session when the session ends, so that nobody gets more by opening sessions.
//!
//! Source: start-time fair queueing (Goyal, Vin, Cheng 1996), with a bound on the difference between accounts.

use crate::id::{SessionId, WaiterId};
use crate::own_order::{Families, OwnOrder, OwnPlace, Settled};
use crate::turn::{AHEAD, Share};
use ratn_model::resource::Quantity;
use ratn_model::time::Timestamp;
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::Duration;

/// Nanoseconds times units, at a share of 1.
type Service = u128;

/// Maximum number of ended sessions' services that are kept for each caller and family, the largest ones: more than the sessions that a caller
/// usually may have (`sessions_per_caller`).
const MOST_LEFT: usize = 4_096;

/// See the module.
#[derive(Debug, Clone, Default)]
pub(crate) struct Accounts {
    families: BTreeMap<Arc<str>, FamilyAccounts>,
    sessions: BTreeMap<SessionId, OfSession>,
    /// Sessions whose first requests have to be determined anew.
    unsettled: BTreeSet<SessionId>,
    /// Number of accounts and requests that were read.
    looked_at: usize,
}

/// A session's data for all families.
#[derive(Debug, Clone, Default)]
struct OfSession {
    /// The families in which it has an account.
    families: Families,
    order: OwnOrder,
}

#[derive(Debug, Clone, Default)]
struct FamilyAccounts {
    level: Service,
    accounts: BTreeMap<SessionId, Account>,
    /// The number of accounts that hold or wait.
    active: usize,
    /// The sessions that need something for certain at some time, while they are unchanged.
    rivals: Option<(Timestamp, Rivals)>,
    /// The callers with a bound on their shares whose sessions hold or wait.
    callers: BTreeMap<Arc<str>, OfCaller>,
}

/// The sessions of one caller together.
#[derive(Debug, Clone, Default)]
struct OfCaller {
    /// The sum of the shares of those that hold or wait, in thousandths.
    shares: u64,
    beyond: Beyond,
    /// The services of sessions that ended while the shares exceeded the bound, in ascending order; at most [`MOST_LEFT`].
    left: Vec<Service>,
}

/// The factor by which shares exceed their bound, `shares / bound`; at least 1.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Beyond {
    shares: u64,
    bound: u64,
}

/// The account of a session in a family.
#[derive(Debug, Clone, Default)]
struct Account {
    service: Service,
    /// The time up to which the service counts held units.
    settled: Timestamp,
    held: Quantity,
    share: Share,
    /// The caller who opened the session, and the part of its share that counts in that caller's sum, in thousandths.
    caller: Arc<str>,
    counted: u64,
    beyond: Beyond,
    /// Its waiting requests that existing resources could satisfy.
    waiting: BTreeSet<OwnPlace>,
    /// When a request was last served that was the first of these.
    served: Timestamp,
}

/// The session that acts in a family.
#[derive(Debug, Clone)]
pub(crate) struct Within<'a> {
    pub(crate) session: &'a SessionId,
    pub(crate) family: &'a str,
    pub(crate) share: Share,
    /// The caller who opened the session.
    pub(crate) caller: &'a Arc<str>,
    /// The bound on the total share of that caller's sessions, in thousandths; `None` for no bound.
    pub(crate) bound: Option<u64>,
    pub(crate) now: Timestamp,
}

/// The sessions that need something of a family for certain, at some time.
#[derive(Debug, Clone, Default)]
struct Rivals {
    /// The two sessions with the least service.
    least: [Option<(Service, SessionId)>; 2],
    /// The sum of their shares, in thousandths.
    shares: u128,
    /// The units that they hold, in thousandths.
    held: u128,
}

/// One of these sessions.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
struct Rival {
    service: Service,
    share: u128,
    held: u128,
}

/// A session compared with its rivals.
struct Beside {
    service: Service,
    /// The least service of another one; `None` if there is no other.
    least: Option<Service>,
    /// Including its own share.
    shares: u128,
    /// Including its own units; at least one unit.
    held: u128,
    beyond: Beyond,
}

impl Default for Beyond {
    fn default() -> Beyond {
        Beyond { shares: 1, bound: 1 }
    }
}

impl Beyond {
    fn of(shares: u64, bound: Option<u64>) -> Beyond {
        match bound {
            Some(bound) if shares > bound => Beyond { shares, bound: bound.max(1) },
            _ => Beyond::default(),
        }
    }

    fn is_some(self) -> bool {
        self != Beyond::default()
    }

    /// The amount multiplied by this factor.
    fn more(self, amount: u128) -> u128 {
        amount.saturating_mul(self.shares.into()) / u128::from(self.bound)
    }

    /// The share divided by this factor; never zero.
    fn less(self, share: Share) -> u128 {
        (u128::from(share.thousandths()) * u128::from(self.bound) / u128::from(self.shares)).max(1)
    }
}

impl OfCaller {
    /// Keeps the service of a session that has ended.
    fn keep(&mut self, service: Service) {
        let at = self.left.partition_point(|less| *less <= service);
        self.left.insert(at, service);
        if self.left.len() > MOST_LEFT {
            self.left.remove(0);
        }
    }
}

impl Account {
    fn is_active(&self) -> bool {
        !self.held.is_zero() || !self.waiting.is_empty()
    }

    /// Whether it needs something for certain. Certain requests are ordered first.
    fn needs_some(&self) -> bool {
        self.waiting.first().is_some_and(|(speculative, ..)| !speculative)
    }

    fn service_at(&self, now: Timestamp) -> Service {
        let passed = u128::from(now.0.saturating_sub(self.settled.0));
        // Below 2^64 × 2^42; the thousandths cancel.
        let cost = passed * u128::from(self.held.thousandths()) / u128::from(self.share.thousandths());
        self.service.saturating_add(self.beyond.more(cost))
    }

    /// `None` if it needs nothing for certain.
    fn as_rival(&self, now: Timestamp) -> Option<Rival> {
        let (share, held) = (self.beyond.less(self.share), self.held.thousandths().into());
        self.needs_some().then(|| Rival { service: self.service_at(now), share, held })
    }

    fn settle(&mut self, now: Timestamp) {
        self.service = self.service_at(now);
        self.settled = self.settled.max(now);
    }
}

impl Beside {
    /// How far the session is ahead, as time for all of them together.
    fn ahead(&self) -> Duration {
        let Some(least) = self.least else { return Duration::ZERO };
        let nanoseconds = self.service.saturating_sub(least).saturating_mul(self.shares) / self.held;
        let most = self.beyond.more(AHEAD.as_nanos());
        Duration::from_nanos(u64::try_from(nanoseconds.min(most)).unwrap_or(u64::MAX))
    }

    /// The service that corresponds to [`AHEAD`].
    fn most(&self) -> Service {
        AHEAD.as_nanos() * self.held / self.shares.max(1)
    }
}

impl FamilyAccounts {
    /// Determines the rivals at some time, unless known; returns the number of accounts read.
    fn find_rivals(&mut self, now: Timestamp) -> usize {
        if self.rivals.as_ref().is_some_and(|(at, _)| *at == now) {
            return 0;
        }
        let mut rivals = Rivals::default();
        for (session, account) in &self.accounts {
            let Some(Rival { service, share, held }) = account.as_rival(now) else { continue };
            rivals.shares += share;
            rivals.held += held;
            let less = |other: &Option<(Service, SessionId)>| other.as_ref().is_none_or(|(other, _)| service < *other);
            if let Some(at) = rivals.least.iter().position(less) {
                rivals.least[at..].rotate_right(1);
                rivals.least[at] = Some((service, session.clone()));
            }
        }
        self.rivals = Some((now, rivals));
        self.accounts.len()
    }

    /// Updates the rivals when one of them changes. If those with the least service stay known, the other accounts need not be read.
    fn rival_changes(&mut self, session: &SessionId, now: Timestamp, before: Option<Rival>, after: Option<Rival>) {
        if before == after {
            return;
        }
        let Some((at, rivals)) = &mut self.rivals else { return };
        let [_, second] = &rivals.least;
        let had_least = rivals.least.iter().flatten().any(|(_, other)| other == session);
        let has_less = |rival: Rival| second.as_ref().is_none_or(|(service, _)| rival.service < *service);
        if *at != now || had_least || after.is_some_and(has_less) {
            self.rivals = None;
            return;
        }
        let (before, after) = (before.unwrap_or_default(), after.unwrap_or_default());
        rivals.shares = (rivals.shares + after.share).saturating_sub(before.share);
        rivals.held = (rivals.held + after.held).saturating_sub(before.held);
    }

    fn beside(&self, rivals: &Rivals, within: &Within<'_>) -> Beside {
        let account = self.accounts.get(within.session);
        let service = match account {
            Some(account) if account.is_active() => account.service_at(within.now),
            account => self.level.max(account.map_or(0, |account| account.service)),
        };
        let others = rivals.least.iter().flatten().find(|(_, session)| session != within.session);
        let beyond = self.callers.get(within.caller).map_or_else(Beyond::default, |of| of.beyond);
        let (mut shares, mut held) = (rivals.shares, rivals.held);
        if !account.is_some_and(Account::needs_some) {
            shares += beyond.less(within.share);
            held += account.map_or(0, |account| account.held.thousandths().into());
        }
        let one = u128::from(Quantity::ONE.thousandths());
        Beside { service, least: others.map(|(service, _)| *service), shares, held: held.max(one), beyond }
    }

    /// Updates the amount that an account contributes to its caller's sum, which may change the factor for all accounts of that caller; returns the
    /// number of accounts read.
    fn count(&mut self, within: &Within<'_>, before: u64, after: u64) -> usize {
        if before == after {
            return 0;
        }
        let of = self.callers.entry(within.caller.clone()).or_default();
        of.shares = of.shares.saturating_sub(before) + after;
        let beyond = Beyond::of(of.shares, within.bound);
        let has_changed = of.beyond != beyond;
        of.beyond = beyond;
        if of.shares == 0 {
            self.callers.remove(within.caller);
        }
        if !has_changed {
            return 0;
        }
        for account in self.accounts.values_mut().filter(|account| account.caller == *within.caller) {
            account.settle(within.now);
            account.beyond = beyond;
        }
        self.rivals = None;
        self.accounts.len()
    }
}

impl Accounts {
    /// How far a session is ahead of its rivals in a family, as time; at most [`AHEAD`] times the factor by which the shares of its caller exceed
    /// their bound.
    pub(crate) fn ahead(&mut self, within: &Within<'_>) -> Duration {
        self.beside(within).map_or(Duration::ZERO, |beside| beside.ahead())
    }

    /// Begins a turn of a session: limits its service to within [`AHEAD`] of the services of others.
    pub(crate) fn begins_turn(&mut self, within: &Within<'_>) {
        let Some(beside) = self.beside(within) else { return };
        let Some(family) = self.families.get_mut(within.family) else { return };
        let Some(account) = family.accounts.get_mut(within.session) else { return };
        let before = account.as_rival(within.now);
        account.settle(within.now);
        if let Some(least) = beside.least {
            let most = beside.most();
            let owed = least.saturating_add(beside.beyond.more(most));
            account.service = account.service.clamp(least.saturating_sub(most), owed);
        }
        let least = beside.least.map_or(account.service, |least| least.min(account.service));
        family.level = family.level.max(least);
        let after = account.as_rival(within.now);
        family.rival_changes(within.session, within.now, before, after);
    }

    fn beside(&mut self, within: &Within<'_>) -> Option<Beside> {
        let family = self.families.get_mut(within.family)?;
        self.looked_at += family.find_rivals(within.now);
        let (_, rivals) = family.rivals.as_ref()?;
        Some(family.beside(rivals, within))
    }

    /// Returns and resets the number of accounts and requests that were read.
    pub(crate) fn take_looks(&mut self) -> usize {
        std::mem::take(&mut self.looked_at)
    }

    /// A request that takes units of these families begins to wait; [`Accounts::waits`] has been called for each family.
    pub(crate) fn joins(&mut self, session: &SessionId, families: Families, own: OwnPlace) {
        if !families.is_empty() && self.sessions.entry(session.clone()).or_default().order.insert(families, own) {
            self.unsettled.insert(session.clone());
        }
    }

    /// The reverse of `joins`. To be called before [`Accounts::waits_no_more`].
    pub(crate) fn parts(&mut self, session: &SessionId, families: &Families, own: &OwnPlace) {
        if self.sessions.get_mut(session).is_some_and(|of| of.order.remove(families, own)) {
            self.unsettled.insert(session.clone());
        }
    }

    /// How the first requests of one session have changed since requests of it came and went; `None` if all sessions are settled.
    pub(crate) fn settle_next(&mut self) -> Option<Settled> {
        let session = self.unsettled.pop_first()?;
        let settled = self.sessions.get_mut(&session).map(|of| of.order.settle()).unwrap_or_default();
        self.looked_at += settled.looked_at;
        Some(settled)
    }

    /// Whether a request of a session that takes units of these families is a first one, or would be.
    pub(crate) fn is_first<'a>(
        &self,
        session: &SessionId,
        families: impl IntoIterator<Item = &'a str>,
        own: &OwnPlace,
    ) -> bool {
        self.sessions.get(session).is_none_or(|of| of.order.is_first(families, own))
    }

    /// The first request of each session in a family.
    pub(crate) fn firsts(&self, family: &str) -> Vec<WaiterId> {
        let sessions = self.families.get(family).into_iter().flat_map(|family| family.accounts.keys());
        sessions.filter_map(|session| self.sessions.get(session)?.order.first_of(family)).collect()
    }

    /// When a request of a session was last served that was its first in a family.
    pub(crate) fn served(&self, session: &SessionId, family: &str) -> Timestamp {
        self.account(session, family).map_or(Timestamp(0), |account| account.served)
    }

    fn account(&self, session: &SessionId, family: &str) -> Option<&Account> {
        self.families.get(family)?.accounts.get(session)
    }

    /// A request of the session begins to wait.
    pub(crate) fn waits(&mut self, within: &Within<'_>, own: OwnPlace) {
        self.change(within, |account| {
            account.waiting.insert(own);
        });
    }

    /// A request of the session no longer waits; `served` if it was served as the first.
    pub(crate) fn waits_no_more(&mut self, within: &Within<'_>, own: OwnPlace, served: bool) {
        self.change(within, |account| {
            account.waiting.remove(&own);
            if served {
                account.served = within.now;
            }
        });
    }

    /// The session holds this amount more.
    pub(crate) fn holds(&mut self, within: &Within<'_>, amount: Quantity) {
        self.change(within, |account| account.held += amount);
    }

    /// The session holds this amount less.
    pub(crate) fn holds_no_more(&mut self, within: &Within<'_>, amount: Quantity) {
        self.change(within, |account| account.held = account.held.saturating_sub(amount));
    }

    /// The session has another share from now on, in every family, or its caller another bound.
    pub(crate) fn has_share(&mut self, within: &Within<'_>) {
        for family in self.sessions.get(within.session).map(|of| of.families.clone()).unwrap_or_default() {
            self.change(&Within { family: &family, ..within.clone() }, |_| {});
        }
    }

    /// Removes everything of a session.
    pub(crate) fn forget(&mut self, session: &SessionId) {
        for name in self.sessions.remove(session).unwrap_or_default().families {
            let Some(family) = self.families.get_mut(&name) else { continue };
            let left = family.accounts.remove(session);
            let is_active = left.as_ref().is_some_and(Account::is_active);
            debug_assert!(!is_active, "{session} has ended and is active");
            family.active -= usize::from(is_active);
            family.rivals = None;
            let owed = left.filter(|left| left.service > family.level);
            let of_caller = owed.as_ref().and_then(|left| family.callers.get_mut(&left.caller));
            if let Some((left, of)) = owed.as_ref().zip(of_caller.filter(|of| of.beyond.is_some())) {
                of.keep(left.service);
            }
            if family.accounts.is_empty() {
                self.families.remove(&name);
            }
        }
    }

    fn change(&mut self, within: &Within<'_>, change: impl FnOnce(&mut Account)) {
        let Within { session, family, share, caller, bound, now } = within;
        let known = self.families.get_key_value(*family);
        let name: Arc<str> = known.map_or_else(|| (*family).into(), |(name, _)| name.clone());
        let family = self.families.entry(name.clone()).or_default();
        let is_new = !family.accounts.contains_key(*session);
        if is_new {
            let beyond = family.callers.get(*caller).map_or_else(Beyond::default, |of| of.beyond);
            let account = Account { settled: *now, caller: (*caller).clone(), beyond, ..Account::default() };
            family.accounts.insert((*session).clone(), account);
            self.sessions.entry((*session).clone()).or_default().families.insert(name.clone());
        }
        let Some(account) = family.accounts.get_mut(*session) else { return };
        let (was_active, before) = (account.is_active(), account.as_rival(*now));
        account.settle(*now);
        if !was_active {
            account.service = account.service.max(family.level);
        }
        account.share = *share;
        change(account);
        if is_new && account.beyond.is_some() && !account.waiting.is_empty() {
            let owed = family.callers.get_mut(*caller).and_then(|of| of.left.pop());
            account.service = account.service.max(owed.unwrap_or_default());
        }
        let (is_active, service, after) = (account.is_active(), account.service, account.as_rival(*now));
        let counted = if is_active && bound.is_some() { share.thousandths() } else { 0 };
        let counted_before = std::mem::replace(&mut account.counted, counted);
        family.active = family.active + usize::from(is_active) - usize::from(was_active);
        family.rival_changes(session, *now, before, after);
        self.looked_at += family.count(within, counted_before, counted);
        if is_active {
            return;
        }
        if family.active == 0 {
            family.level = family.level.max(service);
        }
        let level = family.level;
        if service > level {
            return;
        }
        // A new account would begin with the same service.
        family.accounts.remove(*session);
        if family.accounts.is_empty() {
            self.families.remove(&name);
        }
        if let Some(of) = self.sessions.get_mut(*session) {
            of.families.remove(&name);
            if of.families.is_empty() {
                self.sessions.remove(*session);
            }
        }
    }

    /// Whether the accounts match what their sessions hold and wait for.
    pub(crate) fn agree(&self, has: &BTreeMap<(SessionId, Arc<str>), (Quantity, usize)>) -> Result<(), String> {
        let mut active = 0;
        for (name, family) in &self.families {
            let mut shares = BTreeMap::<_, u64>::new();
            for account in family.accounts.values().filter(|account| account.counted > 0) {
                *shares.entry(&account.caller).or_default() += account.counted;
            }
            if !shares.into_iter().eq(family.callers.iter().map(|(caller, of)| (caller, of.shares))) {
                return Err(format!("the shares of callers of {name} are not the sum of those of their sessions"));
            }
            for (session, account) in &family.accounts {
                if !self.sessions.get(session).is_some_and(|of| of.families.contains(name)) {
                    return Err(format!("{session} does not know of its account of {name}"));
                }
                if !account.is_active() {
                    continue;
                }
                active += 1;
                let known = has.get(&(session.clone(), name.clone()));
                if known != Some(&(account.held, account.waiting.len())) {
                    return Err(format!(
                        "{session} has {known:?} of {name}, and its account says otherwise: {account:?}"
                    ));
                }
            }
        }
        let accounts = self.families.values().map(|family| family.accounts.len()).sum::<usize>();
        let listed = self.sessions.values().map(|of| of.families.len()).sum::<usize>();
        let counted = self.families.values().map(|family| family.active).sum::<usize>();
        if counted != active || !self.unsettled.is_empty() {
            return Err(
                "so many accounts are not active, or it is not settled whose requests are first ones".to_owned()
            );
        }
        match active == has.len() && accounts == listed {
            true => Ok(()),
            false => Err("somebody who holds or waits has no account, or one is listed that is not there".to_owned()),
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;
    use crate::limits::Limits;
    use crate::pool::Pool;
    use crate::queue::AcquireRequest;
    use crate::resource::ResourceSpec;
    use crate::session::Speaker;
    use ratn_model::resource::{Requirement, ResourceClass, ResourceOperation};
    use std::cmp::Reverse;

    fn at(seconds: u64) -> Timestamp {
        Timestamp(seconds * 1_000_000_000)
    }

    fn own(number: u64) -> OwnPlace {
        (false, Reverse(0), WaiterId(number))
    }

    struct Bench {
        accounts: Accounts,
        sessions: [SessionId; 3],
        shares: [Share; 3],
    }

    impl Bench {
        fn new(shares: [f64; 3]) -> Bench {
            let shares = shares.map(|share| Share::new(share).unwrap());
            Bench { accounts: Accounts::default(), sessions: ["a", "b", "c"].map(SessionId::from), shares }
        }

        fn when<T>(&mut self, seconds: u64, who: usize, what: impl FnOnce(&mut Accounts, &Within<'_>) -> T) -> T {
            let (session, share) = (&self.sessions[who], self.shares[who]);
            let within =
                Within { session, family: "Arm", share, caller: &Arc::default(), bound: None, now: at(seconds) };
            what(&mut self.accounts, &within)
        }

        fn ahead(&mut self, seconds: u64, who: usize) -> u64 {
            self.when(seconds, who, |accounts, within| accounts.ahead(within).as_secs())
        }
    }

    #[test]
    fn who_has_had_more_for_its_share_is_ahead_of_those_who_wait() {
        let mut bench = Bench::new([1.0, 3.0, 100.0]);
        bench.when(10, 1, |accounts, within| accounts.waits(within, own(1)));
        bench.when(10, 0, |accounts, within| accounts.holds(within, Quantity::ONE));
        // 5 s of one unit at a share of 1, of 4 in total.
        assert_eq!((bench.ahead(15, 0), bench.ahead(15, 1)), (20, 0));
        // Another share, or a session that only holds, or waits speculatively, makes no difference.
        bench.when(15, 2, |accounts, within| accounts.holds(within, Quantity::whole(7)));
        bench.when(15, 2, |accounts, within| accounts.waits(within, (true, Reverse(0), WaiterId(2))));
        assert_eq!((bench.ahead(15, 0), bench.ahead(15, 1)), (20, 0));
        assert_eq!(bench.ahead(100, 0), AHEAD.as_secs());
        bench.when(100, 1, |accounts, within| accounts.waits_no_more(within, own(1), false));
        assert_eq!(bench.ahead(100, 0), 0, "nobody waits");
    }

    #[test]
    fn nobody_saves_up_what_it_does_not_use_nor_owes_more_than_ahead() {
        let mut bench = Bench::new([1.0, 1.0, 1.0]);
        bench.when(0, 0, |accounts, within| accounts.holds(within, Quantity::ONE));
        bench.when(1_000, 0, |accounts, within| accounts.waits(within, own(1)));
        bench.when(1_000, 0, |accounts, within| accounts.begins_turn(within));
        // The other session comes when the first has long held the unit: they begin equally.
        bench.when(1_000, 1, |accounts, within| accounts.waits(within, own(2)));
        assert_eq!((bench.ahead(1_000, 0), bench.ahead(1_000, 1)), (0, 0));
        // After another 500 s with the unit, the first owes at most 60 s.
        bench.when(1_500, 0, |accounts, within| accounts.begins_turn(within));
        bench.when(1_500, 0, |accounts, within| accounts.holds_no_more(within, Quantity::ONE));
        bench.when(1_500, 1, |accounts, within| accounts.holds(within, Quantity::ONE));
        assert_eq!((bench.ahead(1_500, 0), bench.ahead(1_530, 0)), (60, 0));
    }

    #[test]
    fn what_is_where_anybody_begins_is_not_kept() {
        let mut bench = Bench::new([1.0, 1.0, 1.0]);
        bench.when(0, 0, |accounts, within| accounts.holds(within, Quantity::ONE));
        bench.when(9, 0, |accounts, within| accounts.holds_no_more(within, Quantity::ONE));
        assert_eq!(bench.accounts.agree(&BTreeMap::new()), Ok(()));
        assert!(bench.accounts.sessions.is_empty() && bench.accounts.families.is_empty());
        bench.when(9, 1, |accounts, within| accounts.waits(within, own(1)));
        bench.when(9, 0, |accounts, within| accounts.holds(within, Quantity::ONE));
        bench.when(19, 0, |accounts, within| accounts.holds_no_more(within, Quantity::ONE));
        assert_eq!(bench.ahead(19, 0), 20, "it is known while another one waits");
        let session = bench.sessions[0].clone();
        bench.accounts.forget(&session);
        assert_eq!(bench.ahead(19, 0), 0);
    }

    #[test]
    fn a_caller_that_turns_out_to_be_an_operator_has_no_bound_from_then_on() {
        let (mut accounts, caller) = (Accounts::default(), Arc::from("root"));
        let sessions = ["a", "b"].map(SessionId::from);
        let each = |accounts: &mut Accounts, seconds, bound, act: &dyn Fn(&mut Accounts, &Within<'_>)| {
            for session in &sessions {
                let within =
                    Within { session, family: "Arm", share: Share::ONE, caller: &caller, bound, now: at(seconds) };
                act(accounts, &within);
            }
            accounts.families.get("Arm").map(|family| family.callers.get("root").map(|of| (of.shares, of.beyond)))
        };
        let waits = |accounts: &mut Accounts, within: &Within<'_>| accounts.waits(within, own(1));
        let beyond = Beyond { shares: 2_000, bound: 1_000 };
        assert_eq!(each(&mut accounts, 0, Some(1_000), &waits), Some(Some((2_000, beyond))));
        let says_again = |accounts: &mut Accounts, within: &Within<'_>| accounts.has_share(within);
        assert_eq!(each(&mut accounts, 1, None, &says_again), Some(None));
        assert!(accounts.families["Arm"].accounts.values().all(|account| !account.beyond.is_some()));
    }

    #[test]
    fn what_sessions_had_that_have_ended_is_kept_of_those_that_had_the_most() {
        const ROUNDS: u64 = 5_000;
        let (mut accounts, caller) = (Accounts::default(), Arc::from("adam"));
        let adams = |accounts: &mut Accounts,
                     session: &SessionId,
                     seconds: u64,
                     act: fn(&mut Accounts, &Within<'_>, Quantity)| {
            let (family, share, bound) = ("Arm", Share::ONE, Some(1_000));
            act(accounts, &Within { session, family, share, caller: &caller, bound, now: at(seconds) }, Quantity::ONE);
        };
        for session in &["a", "b"].map(SessionId::from) {
            adams(&mut accounts, session, 0, Accounts::holds);
        }
        let mut now = 0;
        for round in 1..=ROUNDS {
            let session = SessionId::from(format!("s-{round}").as_str());
            adams(&mut accounts, &session, now, Accounts::holds);
            now += round;
            adams(&mut accounts, &session, now, Accounts::holds_no_more);
            accounts.forget(&session);
        }
        let left = &accounts.families["Arm"].callers["adam"].left;
        // With three sessions, each counts as a third.
        let least = 3 * at(ROUNDS + 1 - MOST_LEFT as u64).0;
        assert_eq!((left.len(), left[0] / 1_000), (MOST_LEFT, Service::from(least) / 1_000));
        assert!(left.is_sorted());
    }

    #[test]
    fn who_becomes_an_operator_or_is_none_any_more_is_counted_as_that_with_the_next_ping() {
        let mut pool = Pool::new(Limits { share_per_caller: 1, ..Limits::default() });
        let sessions = ["a", "b"].map(SessionId::from);
        let says = |pool: &mut Pool, for_anybody| {
            let speaker = Speaker { name: "root".into(), for_anybody };
            for session in &sessions {
                pool.keep_alive_as(at(0), &speaker, session, "root", Duration::from_secs(9)).unwrap();
            }
        };
        let counted = |pool: &Pool| pool.accounts.families["Arm"].callers.get("root").map(|of| of.shares);
        pool.create(at(0), None, ResourceSpec::new(ResourceClass::Module, "Arm").capacity(2)).unwrap();
        says(&mut pool, true);
        for session in &sessions {
            let arm = Requirement::new(ResourceOperation::Block, "Arm");
            pool.acquire(at(0), AcquireRequest::new(session.clone(), vec![arm])).unwrap();
        }
        assert_eq!(counted(&pool), None, "an operator has no bound");
        says(&mut pool, false);
        assert_eq!(counted(&pool), Some(2_000));
        // As after a restart: no session has pinged yet.
        pool.sessions.values_mut().for_each(|session| session.for_anybody = None);
        pool.open_accounts();
        assert_eq!(counted(&pool), Some(2_000));
        says(&mut pool, true);
        assert_eq!(counted(&pool), None);
        pool.check_invariants().unwrap();
    }

    #[test]
    fn another_share_counts_from_when_it_is_said() {
        let mut bench = Bench::new([1.0, 1.0, 1.0]);
        bench.when(0, 1, |accounts, within| accounts.waits(within, own(1)));
        bench.when(0, 0, |accounts, within| accounts.holds(within, Quantity::ONE));
        bench.shares[0] = Share::new(3.0).unwrap();
        bench.when(4, 0, |accounts, within| accounts.has_share(within));
        // 4 s at a share of 1, then 3 s at 3, of 4 in total.
        assert_eq!(bench.ahead(7, 0), 20);
    }
}
