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
//! Nothing happens by itself: an account is settled when its session gets or gives back. To compare takes a look at each session there.
//!
//! From: start-time fair queueing (Goyal, Vin, Cheng 1996), with a bound on how far apart accounts are.

use crate::id::{SessionId, WaiterId};
use crate::turn::{AHEAD, Share};
use ratn_model::resource::Quantity;
use ratn_model::time::Timestamp;
use std::cmp::Reverse;
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::Duration;

/// Where a request stands among those of its own session: what is certain, then the larger priority, then who came first.
pub(crate) type OwnPlace = (bool, Reverse<i64>, WaiterId);

/// Nanoseconds, times units, for a share of 1.
type Service = u128;

/// See the module.
#[derive(Debug, Clone, Default)]
pub(crate) struct Accounts {
    families: BTreeMap<Arc<str>, FamilyAccounts>,
    /// In which families a session has one.
    sessions: BTreeMap<SessionId, BTreeSet<Arc<str>>>,
}

#[derive(Debug, Clone, Default)]
struct FamilyAccounts {
    level: Service,
    accounts: BTreeMap<SessionId, Account>,
}

/// What a session has and had of a family.
#[derive(Debug, Clone, Default)]
struct Account {
    service: Service,
    /// The service counts what was held until then.
    settled: Timestamp,
    held: Quantity,
    share: Share,
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
    pub(crate) now: Timestamp,
}

/// Those who need something of a family for certain, at a moment.
#[derive(Debug, Clone, Default)]
pub(crate) struct Rivals {
    /// The two that have had the least.
    least: [Option<(Service, SessionId)>; 2],
    /// The sum of their shares, in thousandths.
    shares: u128,
    /// What they hold, in thousandths.
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
        self.service.saturating_add(cost)
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
        Duration::from_nanos(u64::try_from(nanoseconds).unwrap_or(u64::MAX)).min(AHEAD)
    }

    /// The service that is [`AHEAD`] long.
    fn most(&self) -> Service {
        AHEAD.as_nanos() * self.held / self.shares.max(1)
    }
}

impl FamilyAccounts {
    fn rivals(&self, now: Timestamp) -> Rivals {
        let mut rivals = Rivals::default();
        for (session, account) in self.accounts.iter().filter(|(_, account)| account.needs_some()) {
            let service = account.service_at(now);
            rivals.shares += u128::from(account.share.thousandths());
            rivals.held += u128::from(account.held.thousandths());
            let less = |other: &Option<(Service, SessionId)>| other.as_ref().is_none_or(|(other, _)| service < *other);
            if let Some(at) = rivals.least.iter().position(less) {
                rivals.least[at..].rotate_right(1);
                rivals.least[at] = Some((service, session.clone()));
            }
        }
        rivals
    }

    fn beside(&self, rivals: &Rivals, within: &Within<'_>) -> Beside {
        let account = self.accounts.get(within.session);
        let service = match account {
            Some(account) if account.is_active() => account.service_at(within.now),
            account => self.level.max(account.map_or(0, |account| account.service)),
        };
        let others = rivals.least.iter().flatten().find(|(_, session)| session != within.session);
        let (mut shares, mut held) = (rivals.shares, rivals.held);
        if !account.is_some_and(Account::needs_some) {
            shares += u128::from(within.share.thousandths());
            held += account.map_or(0, |account| account.held.thousandths().into());
        }
        let one = u128::from(Quantity::ONE.thousandths());
        Beside { service, least: others.map(|(service, _)| *service), shares, held: held.max(one) }
    }
}

impl Accounts {
    /// Those who wait in a family, now.
    pub(crate) fn rivals(&self, family: &str, now: Timestamp) -> Rivals {
        self.families.get(family).map(|family| family.rivals(now)).unwrap_or_default()
    }

    /// By how much a session is ahead of its rivals in a family, as time; [`AHEAD`] at the most.
    pub(crate) fn ahead(&self, rivals: &Rivals, within: &Within<'_>) -> Duration {
        self.families.get(within.family).map_or(Duration::ZERO, |family| family.beside(rivals, within).ahead())
    }

    /// A turn of a session begins: what it had is no further from what others had than [`AHEAD`].
    pub(crate) fn begins_turn(&mut self, rivals: &Rivals, within: &Within<'_>) {
        let Some(family) = self.families.get_mut(within.family) else { return };
        let beside = family.beside(rivals, within);
        let Some(account) = family.accounts.get_mut(within.session) else { return };
        account.settle(within.now);
        if let Some(least) = beside.least {
            let most = beside.most();
            account.service = account.service.clamp(least.saturating_sub(most), least.saturating_add(most));
        }
        let least = beside.least.map_or(account.service, |least| least.min(account.service));
        family.level = family.level.max(least);
    }

    /// Whether a request would be the first of its session in a family, or is.
    pub(crate) fn is_first(&self, session: &SessionId, family: &str, own: &OwnPlace) -> bool {
        let first = self.account(session, family).and_then(|account| account.waiting.first());
        first.is_none_or(|first| own <= first)
    }

    /// The first request of a session in a family, and the one behind it.
    pub(crate) fn first_two(&self, session: &SessionId, family: &str) -> impl Iterator<Item = WaiterId> {
        self.account(session, family).into_iter().flat_map(|account| account.waiting.iter().take(2)).map(|own| own.2)
    }

    /// The first request of each session in a family.
    pub(crate) fn firsts(&self, family: &str) -> Vec<WaiterId> {
        let accounts = self.families.get(family).into_iter().flat_map(|family| family.accounts.values());
        accounts.filter_map(|account| account.waiting.first()).map(|own| own.2).collect()
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

    /// It has another share from now on.
    pub(crate) fn has_share(&mut self, session: &SessionId, share: Share, now: Timestamp) {
        for family in self.sessions.get(session).cloned().unwrap_or_default() {
            self.change(&Within { session, family: &family, share, now }, |_| {});
        }
    }

    /// Nothing of a session is left.
    pub(crate) fn forget(&mut self, session: &SessionId) {
        for name in self.sessions.remove(session).unwrap_or_default() {
            let Some(family) = self.families.get_mut(&name) else { continue };
            let left = family.accounts.remove(session);
            debug_assert!(!left.is_some_and(|left| left.is_active()), "{session} has ended and is active");
            if family.accounts.is_empty() {
                self.families.remove(&name);
            }
        }
    }

    fn change(&mut self, within: &Within<'_>, change: impl FnOnce(&mut Account)) {
        let Within { session, family, share, now } = within;
        let known = self.families.get_key_value(*family);
        let name: Arc<str> = known.map_or_else(|| (*family).into(), |(name, _)| name.clone());
        let family = self.families.entry(name.clone()).or_default();
        if !family.accounts.contains_key(*session) {
            family.accounts.insert((*session).clone(), Account { settled: *now, ..Account::default() });
            self.sessions.entry((*session).clone()).or_default().insert(name.clone());
        }
        let Some(account) = family.accounts.get_mut(*session) else { return };
        account.settle(*now);
        if !account.is_active() {
            account.service = account.service.max(family.level);
        }
        account.share = *share;
        change(account);
        let (is_active, service) = (account.is_active(), account.service);
        if is_active {
            return;
        }
        if !family.accounts.values().any(Account::is_active) {
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
        if let Some(families) = self.sessions.get_mut(*session) {
            families.remove(&name);
            if families.is_empty() {
                self.sessions.remove(*session);
            }
        }
    }

    /// Whether each account has what its session holds and waits for.
    pub(crate) fn agree(&self, has: &BTreeMap<(SessionId, Arc<str>), (Quantity, usize)>) -> Result<(), String> {
        let mut active = 0;
        for (name, family) in &self.families {
            for (session, account) in &family.accounts {
                if !self.sessions.get(session).is_some_and(|families| families.contains(name)) {
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
        let listed = self.sessions.values().map(BTreeSet::len).sum::<usize>();
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
            what(&mut self.accounts, &Within { session, family: "Arm", share, now: at(seconds) })
        }

        fn ahead(&mut self, seconds: u64, who: usize) -> u64 {
            let ahead = |accounts: &mut Accounts, within: &Within<'_>| {
                accounts.ahead(&accounts.rivals("Arm", within.now), within).as_secs()
            };
            self.when(seconds, who, ahead)
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
        bench.when(1_000, 0, |accounts, within| accounts.begins_turn(&accounts.rivals("Arm", within.now), within));
        // The other one comes when the first has had it for long: they begin alike.
        bench.when(1_000, 1, |accounts, within| accounts.waits(within, own(2)));
        assert_eq!((bench.ahead(1_000, 0), bench.ahead(1_000, 1)), (0, 0));
        // After another 500 s with it, the first owes 60 s at the most.
        bench.when(1_500, 0, |accounts, within| accounts.begins_turn(&accounts.rivals("Arm", within.now), within));
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
    fn another_share_counts_from_when_it_is_said() {
        let mut bench = Bench::new([1.0, 1.0, 1.0]);
        bench.when(0, 1, |accounts, within| accounts.waits(within, own(1)));
        bench.when(0, 0, |accounts, within| accounts.holds(within, Quantity::ONE));
        let (session, share) = (bench.sessions[0].clone(), Share::new(3.0).unwrap());
        bench.accounts.has_share(&session, share, at(4));
        bench.shares[0] = share;
        // 4 s at a share of 1, then 3 s at 3, of 4 in all.
        assert_eq!(bench.ahead(7, 0), 20);
    }
}
