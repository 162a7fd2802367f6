//! The listening providers: each is told what it is asked for.

use super::handout::HandOut;
use super::round::Round;
use ratn_model::time::Timestamp;
use ratn_model::value::Value;
use ratn_proto::types::{Demand, Provision};
use ratn_resources::{Pool, Provided, SessionId};
use std::borrow::Cow;
use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;
use tokio::sync::watch;

/// Maximum number of resources and providers read in one turn: a millisecond or two.
const LOOKS: usize = 10_000;
/// If there is more to tell, other work gets this much time first.
const A_MOMENT: Duration = Duration::from_millis(1);

/// What a provider offers.
#[derive(Debug, Default)]
pub(super) struct Provisions {
    /// By kind.
    pub(super) kinds: BTreeMap<String, Provision>,
    /// Attributes common to all of it.
    pub(super) attributes: BTreeMap<String, Value>,
}

/// A provider.
#[derive(Debug)]
pub(super) struct Provider {
    pub(super) session: SessionId,
    provisions: Provisions,
    /// Temporary maximum numbers of some kinds.
    bounds: BTreeMap<String, u32>,
    listener: watch::Sender<Vec<Demand>>,
}

impl Provider {
    /// How many more it can be asked for; `None` if nothing that it offers would satisfy the demand.
    pub(super) fn room(&self, demand: &ratn_resources::Demand, provided: u32) -> Option<u32> {
        self.room_of(demand, provided, |_| true)
    }

    /// The same for requests that wait for held resources.
    pub(super) fn room_to_grow(&self, demand: &ratn_resources::Demand, provided: u32) -> Option<u32> {
        self.room_of(demand, provided, |provision| provision.grows)
    }

    fn room_of(&self, demand: &ratn_resources::Demand, provided: u32, of: impl Fn(&Provision) -> bool) -> Option<u32> {
        if !demand.requirement.accepts(|name| self.provisions.attributes.get(name).map(Cow::Borrowed)) {
            return None;
        }
        let provision = |kind| self.provisions.kinds.get(kind).filter(|provision| of(provision));
        let kinds = demand.kinds.iter().filter_map(|kind| Some((kind, provision(kind)?.most)));
        let most = |(kind, most): (&String, u32)| self.bounds.get(kind).map_or(most, |bound| most.min(*bound));
        kinds.map(most).reduce(u32::saturating_add).map(|most| most.saturating_sub(provided))
    }

    /// Tells it what it is asked for, if that has changed.
    pub(super) fn tell(&self, told: Vec<Demand>) {
        self.listener.send_if_modified(|before| {
            let changed = *before != told;
            *before = told;
            changed
        });
    }
}

/// See the module.
#[derive(Debug)]
pub(super) struct Providers {
    /// Providers in order of arrival; the first is asked first.
    all: Vec<Provider>,
    hand_out: HandOut,
    /// The round in which they are being told.
    round: Option<Round>,
    /// What any of them offers.
    provided: Arc<Provided>,
    /// Something has changed that the providers have not been told.
    news: bool,
}

impl Providers {
    /// No providers yet. Each has `patience` to make progress. After a request has waited `grow_after` for held resources, they are asked for more.
    pub(super) fn new(patience: Duration, grow_after: Duration) -> Providers {
        let provided = Arc::new(Provided { patience: grow_after, ..Provided::default() });
        Providers { all: Vec::new(), hand_out: HandOut::new(patience), round: None, provided, news: false }
    }

    /// Adds a provider; an error with the number of providers if that is `most` already.
    pub(super) fn join(
        &mut self,
        session: SessionId,
        provisions: Provisions,
        most: usize,
    ) -> Result<watch::Receiver<Vec<Demand>>, usize> {
        // Closed ones are removed in the next round.
        let there = self.all.iter().filter(|provider| !provider.listener.is_closed()).count();
        if there >= most {
            return Err(there);
        }
        let (listener, told) = watch::channel(Vec::new());
        self.all.push(Provider { session, provisions, bounds: BTreeMap::new(), listener });
        self.note_what_is_provided();
        self.news = true;
        Ok(told)
    }

    /// Whether a session provides a kind.
    pub(super) fn provides(&self, session: &SessionId, kind: &str) -> bool {
        let is_asked =
            |provider: &&Provider| !provider.listener.is_closed() && provider.provisions.kinds.contains_key(kind);
        self.all.iter().filter(is_asked).any(|provider| provider.session == *session)
    }

    /// Limits a provider to `most` of this kind for now; `None` restores its original number.
    pub(super) fn bound(&mut self, session: &SessionId, kind: &str, most: Option<u32>) {
        for provider in self.all.iter_mut().filter(|provider| provider.session == *session) {
            match most {
                Some(most) => provider.bounds.insert(kind.to_owned(), most),
                None => provider.bounds.remove(kind),
            };
        }
        self.news = true;
    }

    /// What the providers may be asked for.
    pub(super) fn provided(&self) -> &Arc<Provided> {
        &self.provided
    }

    fn note_what_is_provided(&mut self) {
        let all = || self.all.iter().flat_map(|provider| &provider.provisions.kinds);
        let kinds = all().map(|(kind, _)| kind.clone()).collect();
        let growing = all().filter(|(_, provision)| provision.grows).map(|(kind, _)| kind.clone()).collect();
        let provided = Provided { kinds, growing, patience: self.provided.patience };
        if provided != *self.provided {
            self.provided = Arc::new(provided);
        }
    }

    /// When something changes by time alone, or when to continue a round.
    pub(super) fn deadline(&self, now: Timestamp) -> Option<Timestamp> {
        let more = self.round.is_some() || self.news;
        more.then_some(now + A_MOMENT).or_else(|| self.hand_out.deadline())
    }

    /// Whether something has to be told although the demand is unchanged.
    fn are_due(&self, now: Timestamp) -> bool {
        let deadline = self.hand_out.deadline();
        self.news
            || deadline.is_some_and(|at| at <= now)
            || (deadline.is_some() && self.all.iter().any(|provider| provider.listener.is_closed()))
    }

    /// The demand has changed: everybody has to be told.
    pub(super) fn are_to_be_told(&mut self) {
        self.news = true;
    }

    /// Tells each provider what it is asked for, if anything has changed: as much as fits into one turn.
    pub(super) fn tell(&mut self, now: Timestamp, pool: &Pool, demands: &[ratn_resources::Demand]) {
        if self.round.is_none() {
            if !self.are_due(now) {
                return;
            }
            self.news = false;
            let there = self.all.len();
            self.all.retain(|provider| !provider.listener.is_closed() && pool.has_session(&provider.session));
            if self.all.len() < there {
                self.note_what_is_provided();
            }
            self.round = Some(Round::begin(&self.all, demands, &mut self.hand_out));
        }
        if let Some(round) = &mut self.round
            && round.go_on(now, pool, &self.all, &mut self.hand_out, LOOKS)
        {
            self.round = None;
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;
    use ratn_model::resource::{Quantity, Requirement, ResourceClass, ResourceOperation};
    use ratn_resources::{Limits, ResourceSpec};

    const NOW: Timestamp = Timestamp(0);

    /// Sessions `0`, `1`, ... that listen and each provide `planners` planners on their own host.
    fn providers(count: usize, planners: usize) -> (Pool, Providers, Vec<watch::Receiver<Vec<Demand>>>) {
        let mut pool = Pool::new(Limits::default());
        let mut providers = Providers::new(Duration::from_secs(15), Duration::from_millis(250));
        let mut told = Vec::new();
        for number in 0..count {
            let session = SessionId::from(number.to_string().as_str());
            pool.keep_alive(NOW, &session, "provider", Duration::from_secs(60)).unwrap();
            let spec =
                || ResourceSpec::new(ResourceClass::Process, "Planner").attribute("host", Value::Int(number as i64));
            (0..planners).for_each(|_| drop(pool.create(NOW, Some(&session), spec()).unwrap()));
            let attributes = (0..256).map(|size| (format!("size-{size}"), Value::Bool(true))).collect();
            let provisions = Provisions {
                kinds: [("Planner".to_owned(), Provision { most: 100_000, grows: true })].into(),
                attributes,
            };
            told.push(providers.join(session, provisions, count).unwrap());
        }
        (pool, providers, told)
    }

    /// `count` selectors of planners, each lacking one.
    fn demands(count: usize) -> Vec<ratn_resources::Demand> {
        let demand = |number: usize| {
            let mut requirement = Requirement::new(ResourceOperation::Block, "Planner");
            requirement.attributes.insert(format!("size-{number}"), Value::Bool(true));
            ratn_resources::Demand { requirement, queued: Quantity::ZERO, kinds: vec!["Planner".to_owned()] }
        };
        (0..count).map(demand).collect()
    }

    /// Runs a complete round; returns the number of turns.
    fn turns(pool: &Pool, providers: &mut Providers, demands: &[ratn_resources::Demand]) -> usize {
        providers.are_to_be_told();
        let mut turns = 0;
        while turns == 0 || providers.deadline(NOW) == Some(NOW + A_MOMENT) {
            providers.tell(NOW, pool, demands);
            turns += 1;
        }
        turns
    }

    #[test]
    fn what_many_providers_are_told_of_many_selectors_is_told_over_several_turns() {
        let (pool, mut providers, told) = providers(256, 16);
        let demands = demands(256);
        // 256 selectors times 4,096 resources, each read once for all providers; then 256 selectors are handed out to 256 providers, and each of
        // these is told.
        let (counted, asked) = (256 * 4_096, 2 * 256 * 257);
        let turns = turns(&pool, &mut providers, &demands);
        assert!(((counted + asked) / LOOKS..(counted + asked) / LOOKS + 30).contains(&turns), "{turns}");
        let asked: Vec<usize> = told.iter().map(|told| told.borrow().len()).collect();
        assert_eq!((asked[0], asked[1..].iter().sum::<usize>()), (256, 0), "the first has room for all of it");
        assert!(told[0].borrow().iter().all(|demand| demand.requirement.count.units() == 1));
        let again = self::turns(&pool, &mut providers, &demands);
        assert_eq!(again, turns);
    }

    #[test]
    fn what_is_held_and_waited_for_is_asked_of_those_that_grow_beside_what_is_missing() {
        let (mut pool, mut providers, told) = providers(2, 1);
        let session = SessionId::from("driver");
        pool.keep_alive(NOW, &session, "provider", Duration::from_secs(60)).unwrap();
        let kinds = [("Planner".to_owned(), Provision { most: 9, grows: false })].into();
        let driver = providers.join(session, Provisions { kinds, attributes: BTreeMap::new() }, 10).unwrap();
        assert_eq!(providers.provided().growing, providers.provided().kinds);
        let demand = |missing: u32, queued: u32| ratn_resources::Demand {
            requirement: Requirement { count: missing.into(), ..Requirement::new(ResourceOperation::Block, "Planner") },
            queued: queued.into(),
            kinds: vec!["Planner".to_owned()],
        };
        let mut asked = |missing, queued| {
            turns(&pool, &mut providers, &[demand(missing, queued)]);
            let one = |told: &watch::Receiver<Vec<Demand>>| {
                let told = told.borrow();
                told.first().map(|demand| (demand.requirement.count.units(), demand.queued.units()))
            };
            assert_eq!((one(&told[1]), one(&driver)), (None, None), "the first has room for all of it");
            one(&told[0])
        };
        assert_eq!(asked(0, 3), Some((3, 3)));
        assert_eq!(asked(1, 3), Some((3, 2)), "who lacks one waits for three as well");
        assert_eq!(asked(2, 1), Some((2, 0)));
        assert_eq!(asked(0, 0), None);
    }

    #[test]
    fn one_that_comes_while_others_are_told_is_told_in_the_next_round() {
        let (mut pool, mut providers, told) = providers(2, 3_000);
        let demands = demands(4);
        providers.are_to_be_told();
        providers.tell(NOW, &pool, &demands);
        assert!(told[0].borrow().is_empty(), "it is not all counted yet");
        let session = SessionId::from("late");
        pool.keep_alive(NOW, &session, "provider", Duration::from_secs(60)).unwrap();
        let provisions = Provisions {
            kinds: [("Arm".to_owned(), Provision { most: 1, grows: false })].into(),
            attributes: BTreeMap::new(),
        };
        let late = providers.join(session, provisions, 10).unwrap();
        assert!(providers.provided().kinds.contains("Arm"));
        while providers.deadline(NOW) == Some(NOW + A_MOMENT) {
            providers.tell(NOW, &pool, &demands);
        }
        assert_eq!((told[0].borrow().len(), late.borrow().len()), (4, 0));
        let arm = ratn_resources::Demand {
            requirement: Requirement::new(ResourceOperation::Block, "Arm"),
            queued: Quantity::ZERO,
            kinds: vec!["Arm".to_owned()],
        };
        turns(&pool, &mut providers, &[arm]);
        assert_eq!((told[0].borrow().len(), late.borrow().len()), (0, 1));
        // A provider that has left is not asked any more, and its kinds are not provided.
        drop(late);
        turns(&pool, &mut providers, &demands);
        assert!(!providers.provided().kinds.contains("Arm"));
    }
}
