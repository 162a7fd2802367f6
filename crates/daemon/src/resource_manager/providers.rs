//! The providers that listen: each is told what is asked of it.

use super::handout::{HandOut, Missing, Part};
use ratn_model::condition::Condition;
use ratn_model::resource::{Quantity, Requirement};
use ratn_model::time::Timestamp;
use ratn_model::value::Value;
use ratn_proto::types::{Demand, ENDPOINT_ATTRIBUTE};
use ratn_resources::{Pool, SessionId};
use std::borrow::Cow;
use std::collections::BTreeMap;
use std::time::Duration;
use tokio::sync::watch;

/// What somebody can provide.
#[derive(Debug, Default)]
pub(super) struct Provisions {
    /// Kinds, and how many of each at the most.
    pub(super) kinds: BTreeMap<String, u32>,
    /// What all of it has in common.
    pub(super) attributes: BTreeMap<String, Value>,
}

/// Who can provide.
#[derive(Debug)]
struct Provider {
    session: SessionId,
    provisions: Provisions,
    /// Kinds of which there can only be so many for now.
    bounds: BTreeMap<String, u32>,
    listener: watch::Sender<Vec<Demand>>,
}

impl Provider {
    /// Of how many more it can be asked; nothing where none that it has would do.
    fn room(&self, demand: &ratn_resources::Demand, provided: u32) -> Option<u32> {
        if !demand.requirement.accepts(|name| self.provisions.attributes.get(name).map(Cow::Borrowed)) {
            return None;
        }
        let kinds = demand.kinds.iter().filter_map(|kind| Some((kind, *self.provisions.kinds.get(kind)?)));
        let most = |(kind, most): (&String, u32)| self.bounds.get(kind).map_or(most, |bound| most.min(*bound));
        kinds.map(most).reduce(u32::saturating_add).map(|most| most.saturating_sub(provided))
    }
}

/// See the module.
#[derive(Debug)]
pub(super) struct Providers {
    /// The first to come is asked first.
    all: Vec<Provider>,
    hand_out: HandOut,
    /// Something is to be told that nobody was told yet.
    news: bool,
}

impl Providers {
    /// Nobody yet; each has so long to come closer to what is asked of it.
    pub(super) fn new(patience: Duration) -> Providers {
        Providers { all: Vec::new(), hand_out: HandOut::new(patience), news: false }
    }

    /// One more listens; how many there are where that is `most` already.
    pub(super) fn join(
        &mut self,
        session: SessionId,
        provisions: Provisions,
        most: usize,
    ) -> Result<watch::Receiver<Vec<Demand>>, usize> {
        self.all.retain(|provider| !provider.listener.is_closed());
        if self.all.len() >= most {
            return Err(self.all.len());
        }
        let (listener, told) = watch::channel(Vec::new());
        self.all.push(Provider { session, provisions, bounds: BTreeMap::new(), listener });
        self.news = true;
        Ok(told)
    }

    /// Whether a session is asked for a kind.
    pub(super) fn provides(&self, session: &SessionId, kind: &str) -> bool {
        let is_asked =
            |provider: &&Provider| !provider.listener.is_closed() && provider.provisions.kinds.contains_key(kind);
        self.all.iter().filter(is_asked).any(|provider| provider.session == *session)
    }

    /// Of this kind there can only be so many of a provider for now, or as many as it said at first.
    pub(super) fn bound(&mut self, session: &SessionId, kind: &str, most: Option<u32>) {
        for provider in self.all.iter_mut().filter(|provider| provider.session == *session) {
            match most {
                Some(most) => provider.bounds.insert(kind.to_owned(), most),
                None => provider.bounds.remove(kind),
            };
        }
        self.news = true;
    }

    /// When something changes by time alone.
    pub(super) fn deadline(&self) -> Option<Timestamp> {
        self.hand_out.deadline()
    }

    /// Whether something is to be told though nothing else is missing than before.
    pub(super) fn are_due(&self, now: Timestamp) -> bool {
        let somebody_is_asked = || self.deadline().is_some();
        self.news
            || self.deadline().is_some_and(|at| at <= now)
            || (somebody_is_asked() && self.all.iter().any(|provider| provider.listener.is_closed()))
    }

    /// Tells each what of this is asked of it.
    pub(super) fn tell(&mut self, now: Timestamp, pool: &Pool, demands: &[ratn_resources::Demand]) {
        self.news = false;
        let demands: &[ratn_resources::Demand] = &demands.iter().cloned().map(of_performers).collect::<Vec<_>>();
        self.all.retain(|provider| !provider.listener.is_closed() && pool.has_session(&provider.session));
        let part = |provider: &Provider, demand: &ratn_resources::Demand| {
            let provided = pool.provided(&provider.session, demand).units();
            Part { provided, room: provider.room(demand, provided) }
        };
        let missing = |demand: &ratn_resources::Demand| Missing {
            selector: format!("{:?}", Requirement { count: Quantity::ONE, ..demand.requirement.clone() }),
            // Whole resources are provided, also for parts of them.
            count: demand.requirement.count.units_up(),
            of: self.all.iter().map(|provider| part(provider, demand)).collect(),
        };
        let missing: Vec<Missing> = demands.iter().map(missing).collect();
        let sessions: Vec<SessionId> = self.all.iter().map(|provider| provider.session.clone()).collect();
        let asked = self.hand_out.hand_out(now, &sessions, &missing);
        for (index, provider) in self.all.iter().enumerate() {
            let of_it = demands.iter().enumerate().filter(|(at, _)| asked[index][*at] > 0);
            let demand = |(at, demand): (usize, &ratn_resources::Demand)| Demand {
                requirement: Requirement { count: asked[index][at].into(), ..demand.requirement.clone() },
                kinds: demand.kinds.clone(),
                provided: missing[at].of[index].provided.into(),
            };
            let told: Vec<Demand> = of_it.map(demand).collect();
            provider.listener.send_if_modified(|before| {
                let changed = *before != told;
                *before = told;
                changed
            });
        }
    }
}

/// What a provider provides says where it is, once it is there: who asks for that is asked for like everybody else.
fn of_performers(mut demand: ratn_resources::Demand) -> ratn_resources::Demand {
    demand.requirement.conditions.retain(|condition| *condition != Condition::has(ENDPOINT_ATTRIBUTE));
    demand
}
