//! A round: what is missing is handed out to the providers, and each is told what is asked of it.
//!
//! ```text
//!   begins ──▶ for each demand: count what each provides, hand it out ──▶ tell each provider ──▶ over
//! ```
//! With hundreds of selectors, providers and thousands of resources that takes long, so a turn does a part of it and the next one goes
//! on. What comes up meanwhile is for the next round.

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
    /// Of the providers that it is for.
    sessions: Vec<SessionId>,
    /// Of the first demands, what is asked of each provider, and what it provides of it.
    handed_out: Vec<Vec<Asked>>,
    /// Of the next one, what was counted so far.
    counted: Option<ProvidedCount>,
    /// So many providers were told.
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
    /// Of what is missing now, for these providers.
    pub(super) fn begin(providers: &[Provider], demands: &[ratn_resources::Demand], hand_out: &mut HandOut) -> Round {
        let sessions: Vec<SessionId> = providers.iter().map(|provider| provider.session.clone()).collect();
        hand_out.begin(&sessions);
        let demands = demands.iter().cloned().map(of_performers).collect();
        Round { demands, sessions, handed_out: Vec::new(), counted: None, told: 0 }
    }

    /// Goes on by about so many looks at resources and providers; whether it is over.
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

/// What is asked of each provider for one demand: what is missing, and of those that grow what is waited for beside it.
fn handed_out(
    now: Timestamp,
    demand: &ratn_resources::Demand,
    (sessions, providers, provided): (&[SessionId], &[Provider], &[u32]),
    hand_out: &mut HandOut,
) -> Vec<Asked> {
    let selector = format!("{:?}", Requirement { count: Quantity::ONE, ..demand.requirement.clone() });
    // Whole resources are provided, also for parts of them.
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
    // Who waits for more than exists waits for what is held as well.
    let more = queued.saturating_sub(missing);
    let handed_out_queued = handed_out(&format!("{selector}, held"), more, &|index, provider| {
        let room = provider.room_to_grow(demand, provided[index])?;
        Some(room.saturating_sub(handed_out_missing[index]))
    });
    let asked = |((missing, queued), provided): ((u32, u32), &u32)| Asked { missing, queued, provided: *provided };
    handed_out_missing.iter().copied().zip(handed_out_queued).zip(provided).map(asked).collect()
}

/// What a provider provides says where it is, once it is there: who asks for that is asked for like everybody else.
fn of_performers(mut demand: ratn_resources::Demand) -> ratn_resources::Demand {
    demand.requirement.conditions.retain(|condition| *condition != Condition::has(ENDPOINT_ATTRIBUTE));
    demand
}
