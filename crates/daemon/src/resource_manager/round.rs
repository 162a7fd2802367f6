//! A round: demands are handed out to the providers, and each is told what it is asked for.
//!
//! ```text
//!   begins ──▶ for each demand: count what each provides, hand it out ──▶ tell each provider ──▶ ends
//! ```
//! With hundreds of selectors and providers and thousands of resources this takes long, so each turn does a part of it. Changes in the meantime are
//! left for the next round.

use super::handout::{HandOut, Missing, Part};
use super::providers::Provider;
use ratn_model::condition::Condition;
use ratn_model::resource::{Quantity, Requirement};
use ratn_model::time::Timestamp;
use ratn_proto::types::{Demand, ENDPOINT_ATTRIBUTE};
use ratn_resources::{Pool, ProvidedCount, SessionId};

/// See the module.
#[derive(Debug)]
pub(super) struct Round {
    demands: Vec<ratn_resources::Demand>,
    /// The sessions of the providers in the round.
    sessions: Vec<SessionId>,
    /// For the demands handed out so far: what each provider is asked for, and what it provides already.
    handed_out: Vec<Vec<Asked>>,
    /// For the next demand: the count so far.
    counted: Option<ProvidedCount>,
    /// The number of providers that were told.
    told: usize,
}

#[derive(Debug, Clone, Copy)]
struct Asked {
    missing: u32,
    queued: u32,
    provided: u32,
}

impl Asked {
    fn amount(self) -> u32 {
        self.missing.saturating_add(self.queued)
    }
}

impl Round {
    /// Begins a round with the present demands, for these providers.
    pub(super) fn begin(providers: &[Provider], demands: &[ratn_resources::Demand], hand_out: &mut HandOut) -> Round {
        let sessions: Vec<SessionId> = providers.iter().map(|provider| provider.session.clone()).collect();
        hand_out.begin(&sessions);
        let demands = demands.iter().cloned().map(of_performers).collect();
        Round { demands, sessions, handed_out: Vec::new(), counted: None, told: 0 }
    }

    /// Continues with about `looks` reads of resources and providers; returns whether the round has ended.
    pub(super) fn go_on(
        &mut self,
        now: Timestamp,
        pool: &Pool,
        providers: &[Provider],
        hand_out: &mut HandOut,
        mut looks: usize,
    ) -> bool {
        while let Some(demand) = self.demands.get(self.handed_out.len()) {
            if looks == 0 {
                return false;
            }
            let counted = self.counted.get_or_insert_with(|| ProvidedCount::new(demand.requirement.clone()));
            let looked_at = pool.count_provided(counted, looks);
            if looked_at == looks {
                return false;
            }
            looks = (looks - looked_at).saturating_sub(1 + self.sessions.len());
            let provided: Vec<u32> = self.sessions.iter().map(|session| counted.of(session).units()).collect();
            self.handed_out.push(handed_out(now, demand, (&self.sessions, providers, &provided), hand_out));
            self.counted = None;
        }
        for (index, provider) in providers.iter().enumerate().take(self.sessions.len()).skip(self.told) {
            if looks == 0 {
                return false;
            }
            looks = looks.saturating_sub(1 + self.demands.len());
            provider.tell(self.asked_of(index));
            self.told += 1;
        }
        hand_out.end();
        true
    }

    fn asked_of(&self, provider: usize) -> Vec<Demand> {
        let all = self.demands.iter().zip(&self.handed_out).map(|(demand, asked)| (demand, asked[provider]));
        let of_it = all.filter(|(_, asked)| asked.amount() > 0);
        let demand = |(demand, asked): (&ratn_resources::Demand, Asked)| Demand {
            requirement: Requirement { count: asked.amount().into(), ..demand.requirement.clone() },
            kinds: demand.kinds.clone(),
            provided: asked.provided.into(),
            queued: asked.queued.into(),
        };
        of_it.map(demand).collect()
    }
}

/// What each provider is asked for one demand: what is missing, and from growing providers also what is queued for.
fn handed_out(
    now: Timestamp,
    demand: &ratn_resources::Demand,
    (sessions, providers, provided): (&[SessionId], &[Provider], &[u32]),
    hand_out: &mut HandOut,
) -> Vec<Asked> {
    let selector = format!("{:?}", Requirement { count: Quantity::ONE, ..demand.requirement.clone() });
    // Providers provide whole resources, also for fractions.
    let (missing, queued) = (demand.requirement.count.units_up(), demand.queued.units_up());
    let mut handed_out = |selector: &str, count: u32, room: &dyn Fn(usize, &Provider) -> Option<u32>| {
        if count == 0 {
            return vec![0; sessions.len()];
        }
        let part = |(index, provider)| Part { provided: provided[index], room: room(index, provider) };
        let of = providers.iter().take(sessions.len()).enumerate().map(part).collect();
        hand_out.hand_out(now, sessions, &Missing { selector: selector.into(), count, of })
    };
    let handed_out_missing = handed_out(&selector, missing, &|index, provider| provider.room(demand, provided[index]));
    // Those who wait for more than exists also wait for held resources.
    let more = queued.saturating_sub(missing);
    let handed_out_queued = handed_out(&format!("{selector}, held"), more, &|index, provider| {
        let room = provider.room_to_grow(demand, provided[index])?;
        Some(room.saturating_sub(handed_out_missing[index]))
    });
    let asked = |((missing, queued), provided): ((u32, u32), &u32)| Asked { missing, queued, provided: *provided };
    handed_out_missing.iter().copied().zip(handed_out_queued).zip(provided).map(asked).collect()
}

/// A resource gets its endpoint only when it exists: demand that requires an endpoint is treated like any other.
fn of_performers(mut demand: ratn_resources::Demand) -> ratn_resources::Demand {
    demand.requirement.conditions.retain(|condition| *condition != Condition::has(ENDPOINT_ATTRIBUTE));
    demand
}
