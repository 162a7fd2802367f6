//! The providers that listen: each is told what is asked of it.

use super::handout::{HandOut, Missing, Provider};
use ratn_model::resource::Quantity;
use ratn_model::time::Timestamp;
use ratn_proto::types::Demand;
use ratn_resources::{Pool, SessionId};
use std::collections::BTreeMap;
use std::time::Duration;
use tokio::sync::watch;

/// See the module.
#[derive(Debug)]
pub(super) struct Providers {
    /// The first to come is asked first.
    all: Vec<(Provider, watch::Sender<Vec<Demand>>)>,
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
        kinds: BTreeMap<String, u32>,
        most: usize,
    ) -> Result<watch::Receiver<Vec<Demand>>, usize> {
        self.all.retain(|(_, listener)| !listener.is_closed());
        if self.all.len() >= most {
            return Err(self.all.len());
        }
        let (tell, told) = watch::channel(Vec::new());
        self.all.push((Provider { session, kinds }, tell));
        self.news = true;
        Ok(told)
    }

    /// What providers say has changed.
    pub(super) fn changed(&mut self) {
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
            || (somebody_is_asked() && self.all.iter().any(|(_, listener)| listener.is_closed()))
    }

    /// Tells each what of this is asked of it.
    pub(super) fn tell(&mut self, now: Timestamp, pool: &Pool, demands: &[ratn_resources::Demand]) {
        self.news = false;
        self.all.retain(|(provider, listener)| !listener.is_closed() && pool.has_session(&provider.session));
        let providers: Vec<Provider> = self.all.iter().map(|(provider, _)| provider.clone()).collect();
        let missing = |demand: &ratn_resources::Demand| Missing {
            selector: format!(
                "{:?}",
                ratn_model::resource::Requirement { count: Quantity::ONE, ..demand.requirement.clone() }
            ),
            kinds: demand.kinds.clone(),
            // Whole resources are provided, also for parts of them.
            count: demand.requirement.count.units_up(),
            of: providers
                .iter()
                .map(|p| (pool.provided(&p.session, demand).units(), pool.is_short(&p.session, &demand.kinds)))
                .collect(),
        };
        let missing: Vec<Missing> = demands.iter().map(missing).collect();
        let asked = self.hand_out.hand_out(now, &providers, &missing);
        for (index, (_, listener)) in self.all.iter().enumerate() {
            let of_it = demands.iter().enumerate().filter(|(at, _)| asked[index][*at] > 0);
            let demand = |(at, demand): (usize, &ratn_resources::Demand)| Demand {
                requirement: ratn_model::resource::Requirement {
                    count: asked[index][at].into(),
                    ..demand.requirement.clone()
                },
                kinds: demand.kinds.clone(),
                provided: missing[at].of[index].0.into(),
            };
            let told: Vec<Demand> = of_it.map(demand).collect();
            listener.send_if_modified(|before| {
                let changed = *before != told;
                *before = told;
                changed
            });
        }
    }
}
