//! Accounts: how much each session has had of each family of kinds, for its share, beside those who wait with it.
//!
//! ```text
//!   while a session holds some:      service += time × units / its share
//!   ahead of those who wait there:   (service - least of theirs) × sum of the shares / units that they hold, as time
//!   when it begins to hold or wait:  service ≥ level: an idle session saves nothing up
//!   when its turn begins:            service within AHEAD of the least of theirs: what is beyond is forgotten, either way
//! ```
//!
//! Those who wait are the sessions that need something for certain which what exists would do for; the level is the least that they had when
//! one of them last began a turn. Who holds and does not wait, who waits for what does not exist, and how much there is that nobody waits
//! for, make no difference to others. What is held counts, not what it was needed for; what is consumed does not. Not written down: after a
//! restart everybody begins anew.
//!
//! Nothing happens by itself: an account is settled when its session gets or gives back. To compare takes a look at each session there, once
//! for all that are compared at a moment.
//!
//! The shares of a caller's sessions that hold or wait count as its bound together where they are more (`share_per_caller`): as if each were so
//! many times smaller, time for time. What such a caller's session owes is then as many times longer at the most, and goes to the next session of
//! the caller where it ends, so that nobody has more by opening sessions.
//!
//! From: start-time fair queueing (Goyal, Vin, Cheng 1996), with a bound on how far apart accounts are.

use crate::id::{SessionId, WaiterId};
use crate::own_order::{Families, OwnOrder, OwnPlace, Settled};
use crate::turn::{AHEAD, Share};
use ratn_model::resource::Quantity;
use ratn_model::time::Timestamp;
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::Duration;

/// Nanoseconds, times units, for a share of 1.
type Service = u128;

/// So much of what ended sessions had is kept for each caller and family, the most of it: more sessions than a caller usually may have
/// (`sessions_per_caller`).
const MOST_LEFT: usize = 4_096;

/// See the module.
#[derive(Debug, Clone, Default)]
pub(crate) struct Accounts {
    families: BTreeMap<Arc<str>, FamilyAccounts>,
    sessions: BTreeMap<SessionId, OfSession>,
    /// Those of whom it is to be found out which of their requests are first ones.
    unsettled: BTreeSet<SessionId>,
    /// At so many accounts and requests was looked.
    looked_at: usize,
}

/// What a session has in all families together.
#[derive(Debug, Clone, Default)]
struct OfSession {
    /// In which families it has an account.
    families: Families,
    order: OwnOrder,
}

#[derive(Debug, Clone, Default)]
struct FamilyAccounts {
    level: Service,
    accounts: BTreeMap<SessionId, Account>,
    /// So many of them hold or wait.
    active: usize,
    /// Those who need something for certain at a moment, as long as nothing of it has changed.
    rivals: Option<(Timestamp, Rivals)>,
    /// Those whose sessions have a bound together and hold or wait.
    callers: BTreeMap<Arc<str>, OfCaller>,
}

/// What the sessions of a caller are together.
#[derive(Debug, Clone, Default)]
struct OfCaller {
    /// The sum of the shares of those that hold or wait, in thousandths.
    shares: u64,
    beyond: Beyond,
    /// What sessions had that have ended while the shares were beyond the bound, the most last; [`MOST_LEFT`] at the most.
    left: Vec<Service>,
}

/// How far shares are beyond their bound: as many times as `shares` is `bound`, which is never less than once.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Beyond {
    shares: u64,
    bound: u64,
}

/// What a session has and had of a family.
#[derive(Debug, Clone, Default)]
struct Account {
    service: Service,
    /// The service counts what was held until then.
    settled: Timestamp,
    held: Quantity,
    share: Share,
    /// Whose it is, and what of its share is in the sum of that caller, in thousandths.
    caller: Arc<str>,
    counted: u64,
    beyond: Beyond,
    /// Its requests that wait and for which what exists would do.
    waiting: BTreeSet<OwnPlace>,
    /// When the last one was served that was the first of them.
    served: Timestamp,
}

/// Who does something in a family.
#[derive(Debug, Clone)]
pub(crate) struct Within<'a> {
    pub(crate) session: &'a SessionId,
    pub(crate) family: &'a str,
    pub(crate) share: Share,
    /// Who opened the session.
    pub(crate) caller: &'a Arc<str>,
    /// What the shares of all sessions of that caller are together at the most, in thousandths; none where it has no bound.
    pub(crate) bound: Option<u64>,
    pub(crate) now: Timestamp,
}

/// Those who need something of a family for certain, at a moment.
#[derive(Debug, Clone, Default)]
struct Rivals {
    /// The two that have had the least.
    least: [Option<(Service, SessionId)>; 2],
    /// The sum of their shares, in thousandths.
    shares: u128,
    /// What they hold, in thousandths.
    held: u128,
}

/// What one of them is beside the others.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
struct Rival {
    service: Service,
    share: u128,
    held: u128,
}

/// How one session stands beside its rivals.
struct Beside {
    service: Service,
    /// The least that another one has had; nothing where there is none.
    least: Option<Service>,
    /// With its own.
    shares: u128,
    /// The same, one unit at the least.
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

    /// So many times as much.
    fn more(self, amount: u128) -> u128 {
        amount.saturating_mul(self.shares.into()) / u128::from(self.bound)
    }

    /// So many times less, as a share: never nothing.
    fn less(self, share: Share) -> u128 {
        (u128::from(share.thousandths()) * u128::from(self.bound) / u128::from(self.shares)).max(1)
    }
}

impl OfCaller {
    /// A session has ended that had so much.
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

    /// Whether it needs something for certain. What is certain is first.
    fn needs_some(&self) -> bool {
        self.waiting.first().is_some_and(|(speculative, ..)| !speculative)
    }

    fn service_at(&self, now: Timestamp) -> Service {
        let passed = u128::from(now.0.saturating_sub(self.settled.0));
        // Below 2^64 × 2^42, and thousandths by thousandths.
        let cost = passed * u128::from(self.held.thousandths()) / u128::from(self.share.thousandths());
        self.service.saturating_add(self.beyond.more(cost))
    }

    /// Nothing where it needs nothing for certain.
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
    /// By how much it is ahead, as time for all of them together.
    fn ahead(&self) -> Duration {
        let Some(least) = self.least else { return Duration::ZERO };
        let nanoseconds = self.service.saturating_sub(least).saturating_mul(self.shares) / self.held;
        let most = self.beyond.more(AHEAD.as_nanos());
        Duration::from_nanos(u64::try_from(nanoseconds.min(most)).unwrap_or(u64::MAX))
    }

    /// The service that is [`AHEAD`] long.
    fn most(&self) -> Service {
        AHEAD.as_nanos() * self.held / self.shares.max(1)
    }
}

impl FamilyAccounts {
    /// Finds the rivals of a moment, unless they are known; at how many accounts was looked for that.
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

    /// One of them is another one at a moment. Where that leaves those who have had the least, the others need no look.
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

    /// What is counted of an account for its caller is another amount, and may put all accounts of that caller further beyond their bound, or
    /// less far; at how many accounts was looked for that.
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
    /// By how much a session is ahead of its rivals in a family, as time; [`AHEAD`] at the most, and as many times that as the shares of
    /// its caller are beyond their bound.
    pub(crate) fn ahead(&mut self, within: &Within<'_>) -> Duration {
        self.beside(within).map_or(Duration::ZERO, |beside| beside.ahead())
    }

    /// A turn of a session begins: what it had is no further from what others had than [`AHEAD`].
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

    /// At how many accounts and requests was looked since this was asked last.
    pub(crate) fn take_looks(&mut self) -> usize {
        std::mem::take(&mut self.looked_at)
    }

    /// A request of a session that takes something of these families waits from now on, as [`Accounts::waits`] has said of each.
    pub(crate) fn joins(&mut self, session: &SessionId, families: Families, own: OwnPlace) {
        if !families.is_empty() && self.sessions.entry(session.clone()).or_default().order.insert(families, own) {
            self.unsettled.insert(session.clone());
        }
    }

    /// The same of one that does not any more. To be said before [`Accounts::waits_no_more`].
    pub(crate) fn parts(&mut self, session: &SessionId, families: &Families, own: &OwnPlace) {
        if self.sessions.get_mut(session).is_some_and(|of| of.order.remove(families, own)) {
            self.unsettled.insert(session.clone());
        }
    }

    /// How the first requests of a session are others since requests of it have come and gone; nothing where that is settled for all.
    pub(crate) fn settle_next(&mut self) -> Option<Settled> {
        let session = self.unsettled.pop_first()?;
        let settled = self.sessions.get_mut(&session).map(|of| of.order.settle()).unwrap_or_default();
        self.looked_at += settled.looked_at;
        Some(settled)
    }

    /// Whether a request of a session that takes something of these families is a first one, or would be.
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

    /// When the last request of a session was served that was its first in a family.
    pub(crate) fn served(&self, session: &SessionId, family: &str) -> Timestamp {
        self.account(session, family).map_or(Timestamp(0), |account| account.served)
    }

    fn account(&self, session: &SessionId, family: &str) -> Option<&Account> {
        self.families.get(family)?.accounts.get(session)
    }

    /// A request of it waits from now on.
    pub(crate) fn waits(&mut self, within: &Within<'_>, own: OwnPlace) {
        self.change(within, |account| {
            account.waiting.insert(own);
        });
    }

    /// A request of it does not any more; it was served, as its first, or was not.
    pub(crate) fn waits_no_more(&mut self, within: &Within<'_>, own: OwnPlace, served: bool) {
        self.change(within, |account| {
            account.waiting.remove(&own);
            if served {
                account.served = within.now;
            }
        });
    }

    /// It holds so much more.
    pub(crate) fn holds(&mut self, within: &Within<'_>, amount: Quantity) {
        self.change(within, |account| account.held += amount);
    }

    /// It holds so much less.
    pub(crate) fn holds_no_more(&mut self, within: &Within<'_>, amount: Quantity) {
        self.change(within, |account| account.held = account.held.saturating_sub(amount));
    }

    /// It has another share from now on, in every family, or its caller another bound.
    pub(crate) fn has_share(&mut self, within: &Within<'_>) {
        for family in self.sessions.get(within.session).map(|of| of.families.clone()).unwrap_or_default() {
            self.change(&Within { family: &family, ..within.clone() }, |_| {});
        }
    }

    /// Nothing of a session is left.
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
        // It is where anybody begins.
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

    /// Whether each account has what its session holds and waits for.
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
        // 5 s of one unit for a share of 1, of 4 in all.
        assert_eq!((bench.ahead(15, 0), bench.ahead(15, 1)), (20, 0));
        // Another share, and who merely holds or waits for what may not be needed, make no difference.
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
        // The other one comes when the first has had it for long: they begin alike.
        bench.when(1_000, 1, |accounts, within| accounts.waits(within, own(2)));
        assert_eq!((bench.ahead(1_000, 0), bench.ahead(1_000, 1)), (0, 0));
        // After another 500 s with it, the first owes 60 s at the most.
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
        // Three of them count as a third each.
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
        // As after a restart: nobody has pinged yet.
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
        // 4 s at a share of 1, then 3 s at 3, of 4 in all.
        assert_eq!(bench.ahead(7, 0), 20);
    }
}
