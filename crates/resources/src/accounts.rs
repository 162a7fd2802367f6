//! Accounts: how much each session has had, by family of kinds, as a clock that runs ahead of time where it was more than its share.
//!
//! ```text
//!   while a session holds some of a family:  clock += time × units held / units there × shares of all who are active / its own share
//!   when it asks for some:                   clock  = now, where it is behind: an idle session saves nothing up
//!   always:                                  clock ≤ now + AHEAD
//! ```
//!
//! Active is who holds or waits for something of the family. Where all of it is held all the time, and everybody has the own share, every
//! clock keeps pace with time. What is held counts, not what it was needed for; what is consumed does not. Not written down: after a restart
//! everybody begins anew.
//!
//! Nothing happens by itself: an account is settled when its session asks, gets or gives back, in the time of a look-up.

use crate::id::SessionId;
use crate::turn::{AHEAD, Share};
use ratn_model::resource::Quantity;
use ratn_model::time::Timestamp;
use std::collections::BTreeMap;
use std::sync::Arc;

/// See the module.
#[derive(Debug, Clone, Default)]
pub(crate) struct Accounts {
    sessions: BTreeMap<SessionId, BTreeMap<Arc<str>, Account>>,
    families: BTreeMap<Arc<str>, Active>,
}

/// What a session has and had of a family.
#[derive(Debug, Clone, Default)]
struct Account {
    clock: Timestamp,
    /// The clock counts what was held until then.
    settled: Timestamp,
    held: Quantity,
    /// Its share, as long as it is active.
    share: Share,
    /// How many of its requests wait, by step.
    waiting: BTreeMap<u32, usize>,
}

/// All sessions that are active in a family.
#[derive(Debug, Clone, Default, PartialEq)]
struct Active {
    /// The sum of their shares, in thousandths.
    shares: u64,
    sessions: usize,
    /// How many of them wait.
    waiting: usize,
}

/// Who does something in a family, of which there are so many units.
#[derive(Debug, Clone)]
pub(crate) struct Within<'a> {
    pub(crate) session: &'a SessionId,
    pub(crate) family: &'a str,
    pub(crate) share: Share,
    pub(crate) units: Quantity,
    pub(crate) now: Timestamp,
}

impl Account {
    fn is_active(&self) -> bool {
        !self.held.is_zero() || !self.waiting.is_empty()
    }

    /// Counts what was held until now, of so many units, beside sessions with so many shares in all.
    fn settle(&mut self, now: Timestamp, units: Quantity, shares: u64) {
        let passed = u128::from(now.0.saturating_sub(self.settled.0));
        self.settled = self.settled.max(now);
        if self.held.is_zero() || passed == 0 {
            return;
        }
        // Of what there was it may hold more than there is.
        let units = u128::from(units.max(self.held).thousandths());
        let (held, share) = (u128::from(self.held.thousandths()), u128::from(self.share.thousandths()));
        // Below 2^64 × 2^42 × 2^64 in all, divided before it is multiplied with the shares.
        let cost = passed * held / units * u128::from(shares) / share;
        let clock = u128::from(self.clock.0).saturating_add(cost);
        self.clock = Timestamp(u64::try_from(clock).unwrap_or(u64::MAX)).min(now + AHEAD);
    }
}

impl Accounts {
    /// A session asks: its clock in the family, which is now at least.
    pub(crate) fn ask(&mut self, within: &Within<'_>) -> Timestamp {
        let now = within.now;
        let Some(account) = self.sessions.get_mut(within.session).and_then(|own| own.get_mut(within.family)) else {
            return now;
        };
        let shares = self.families.get(within.family).map_or(0, |active| active.shares);
        account.settle(now, within.units, shares);
        account.clock = account.clock.max(now);
        account.clock
    }

    /// Where nobody else waits in a family: the last step at which this session does, if it does; else `None`.
    pub(crate) fn alone(&self, session: &SessionId, family: &str) -> Option<Option<u32>> {
        let own = self.sessions.get(session).and_then(|own| own.get(family));
        let last = own.and_then(|account| account.waiting.last_key_value()).map(|(step, _)| *step);
        let waiting = self.families.get(family).map_or(0, |active| active.waiting);
        (waiting == usize::from(last.is_some())).then_some(last)
    }

    /// A request of it waits from now on.
    pub(crate) fn waits(&mut self, within: &Within<'_>, step: u32) {
        self.change(within, |account| *account.waiting.entry(step).or_default() += 1);
    }

    /// A request of it does not any more.
    pub(crate) fn waits_no_more(&mut self, within: &Within<'_>, step: u32) {
        self.change(within, |account| {
            if let Some(count) = account.waiting.get_mut(&step) {
                *count -= 1;
                if *count == 0 {
                    account.waiting.remove(&step);
                }
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
    pub(crate) fn has_share(
        &mut self,
        session: &SessionId,
        share: Share,
        now: Timestamp,
        units: impl Fn(&str) -> Quantity,
    ) {
        let families: Vec<Arc<str>> =
            self.sessions.get(session).into_iter().flat_map(|own| own.keys()).cloned().collect();
        for family in families {
            let within = Within { session, family: &family, share, units: units(&family), now };
            self.change(&within, |_| {});
        }
    }

    /// Nothing of a session is left.
    pub(crate) fn forget(&mut self, session: &SessionId) {
        let left = self.sessions.remove(session).unwrap_or_default();
        debug_assert!(!left.values().any(Account::is_active), "{session} has ended and is active");
    }

    fn change(&mut self, within: &Within<'_>, change: impl FnOnce(&mut Account)) {
        let Within { session, family, share, units, now } = within;
        if !self.sessions.contains_key(*session) {
            self.sessions.insert((*session).clone(), BTreeMap::new());
        }
        let Some(own) = self.sessions.get_mut(*session) else { return };
        let known = own.get_key_value(*family).map(|(name, _)| name);
        let known = known.or_else(|| self.families.get_key_value(*family).map(|(name, _)| name));
        let name: Arc<str> = known.map_or_else(|| (*family).into(), Arc::clone);
        let account =
            own.entry(name.clone()).or_insert_with(|| Account { clock: *now, settled: *now, ..Account::default() });
        let active = self.families.entry(name.clone()).or_default();
        account.settle(*now, *units, active.shares);
        active.without(account);
        change(account);
        account.share = *share;
        active.with(account);
        if !account.is_active() && account.clock <= *now {
            own.remove(&name);
        }
        if active.sessions == 0 {
            self.families.remove(&name);
        }
        if own.is_empty() {
            self.sessions.remove(*session);
        }
    }

    /// Whether the sums are those of the accounts, and each account has what its session holds and waits for.
    pub(crate) fn agree(&self, has: &BTreeMap<(SessionId, Arc<str>), (Quantity, usize)>) -> Result<(), String> {
        let mut families: BTreeMap<Arc<str>, Active> = BTreeMap::new();
        let mut active = 0;
        for (session, own) in &self.sessions {
            for (family, account) in own.iter().filter(|(_, account)| account.is_active()) {
                families.entry(family.clone()).or_default().with(account);
                active += 1;
                let waiting: usize = account.waiting.values().sum();
                let known = has.get(&(session.clone(), family.clone()));
                if known != Some(&(account.held, waiting)) {
                    return Err(format!(
                        "{session} has {known:?} of {family}, and its account says otherwise: {account:?}"
                    ));
                }
            }
        }
        match families == self.families && active == has.len() {
            true => Ok(()),
            false => Err("the accounts of a family are not those of its sessions".to_owned()),
        }
    }
}

impl Active {
    fn with(&mut self, account: &Account) {
        if account.is_active() {
            self.shares += account.share.thousandths();
            self.sessions += 1;
            self.waiting += usize::from(!account.waiting.is_empty());
        }
    }

    fn without(&mut self, account: &Account) {
        if account.is_active() {
            self.shares -= account.share.thousandths();
            self.sessions -= 1;
            self.waiting -= usize::from(!account.waiting.is_empty());
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

    struct Bench {
        accounts: Accounts,
        sessions: [SessionId; 2],
        shares: [Share; 2],
    }

    impl Bench {
        fn new(shares: [f64; 2]) -> Bench {
            let shares = shares.map(|share| Share::new(share).unwrap());
            Bench { accounts: Accounts::default(), sessions: ["a", "b"].map(SessionId::from), shares }
        }

        /// Of two arms.
        fn when(&mut self, seconds: u64, who: usize, what: impl FnOnce(&mut Accounts, &Within<'_>)) {
            let (session, share) = (&self.sessions[who], self.shares[who]);
            let within = Within { session, family: "Arm", share, units: Quantity::whole(2), now: at(seconds) };
            what(&mut self.accounts, &within);
        }

        fn clock(&mut self, seconds: u64, who: usize) -> Timestamp {
            let mut clock = Timestamp(0);
            self.when(seconds, who, |accounts, within| clock = accounts.ask(within));
            clock
        }
    }

    #[test]
    fn a_clock_advances_by_what_is_held_beside_the_shares_of_others() {
        let mut bench = Bench::new([1.0, 3.0]);
        bench.when(10, 1, |accounts, within| accounts.waits(within, 1));
        bench.when(10, 0, |accounts, within| accounts.holds(within, Quantity::ONE));
        // Half of what there is, a quarter of the shares: twice as fast as time.
        assert_eq!(bench.clock(20, 0), at(30));
        bench.when(20, 1, |accounts, within| accounts.waits_no_more(within, 1));
        // Nobody else is active: half as fast.
        assert_eq!(bench.clock(40, 0), at(40));
        bench.when(40, 0, |accounts, within| accounts.holds_no_more(within, Quantity::ONE));
        assert_eq!(bench.accounts.agree(&BTreeMap::new()), Ok(()));
        assert!(bench.accounts.sessions.is_empty(), "what is not ahead of time is not kept");
    }

    #[test]
    fn a_clock_is_never_behind_time_for_who_asks_and_never_far_ahead() {
        let mut bench = Bench::new([0.1, 10.0]);
        bench.when(0, 1, |accounts, within| accounts.waits(within, 1));
        bench.when(0, 0, |accounts, within| accounts.holds(within, Quantity::ONE));
        assert_eq!(bench.clock(100, 0), at(100) + AHEAD);
        bench.when(100, 0, |accounts, within| accounts.holds_no_more(within, Quantity::ONE));
        assert_eq!(bench.clock(130, 0), at(100) + AHEAD, "it goes on being ahead");
        assert_eq!(bench.clock(1_000, 0), at(1_000), "and has nothing of what it did not use");
        assert_eq!(bench.clock(1_000, 1), at(1_000));
    }

    #[test]
    fn who_waits_alone_is_told_the_last_step_of_its_own() {
        let mut bench = Bench::new([1.0, 1.0]);
        let alone = |bench: &Bench, who: usize| bench.accounts.alone(&bench.sessions[who], "Arm");
        assert_eq!(alone(&bench, 0), Some(None));
        for step in [3, 5, 4] {
            bench.when(0, 0, |accounts, within| accounts.waits(within, step));
        }
        assert_eq!((alone(&bench, 0), alone(&bench, 1)), (Some(Some(5)), None));
        bench.when(0, 1, |accounts, within| accounts.waits(within, 6));
        assert_eq!(alone(&bench, 0), None);
        // Who holds and does not wait is in nobody's way.
        bench.when(0, 1, |accounts, within| accounts.holds(within, Quantity::ONE));
        bench.when(0, 1, |accounts, within| accounts.waits_no_more(within, 6));
        assert_eq!((alone(&bench, 0), alone(&bench, 1)), (Some(Some(5)), None));
    }

    #[test]
    fn another_share_counts_from_when_it_is_said() {
        let mut bench = Bench::new([1.0, 1.0]);
        bench.when(0, 1, |accounts, within| accounts.waits(within, 0));
        bench.when(0, 0, |accounts, within| accounts.holds(within, Quantity::whole(2)));
        let (session, share) = (bench.sessions[0].clone(), Share::new(3.0).unwrap());
        bench.accounts.has_share(&session, share, at(10), |_| Quantity::whole(2));
        bench.shares[0] = share;
        // 10 s at twice the pace, then 30 s at 4/3 of it.
        assert_eq!(bench.clock(40, 0), at(60));
    }
}
