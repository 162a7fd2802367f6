//! The result cache. The same visit of a state on two branches computes the same once; a result that was discarded serves
//! again when the same is asked for.
//!
//! The seed stands for run, path with visits, and try: with equal seeds, inputs and facts the result is the same.

use super::Window;
use super::environment::ASSIGNED;
use super::instance::{Ended, Instance, Seen, Status, Wait};
use crate::binding::Seed;
use crate::context::Context;
use crate::plan::NodeNature;
use crate::protocol::Note;
use ratn_model::id::InstanceId;
use ratn_model::program::StateKind;
use std::collections::{BTreeMap, VecDeque};

/// This many results are kept.
const MAX_RESULTS: usize = 1024;

/// Results by seed, and who computes what.
#[derive(Debug, Default)]
pub(crate) struct Twins {
    results: BTreeMap<u64, Vec<(Seen, Ended)>>,
    order: VecDeque<u64>,
    /// Speculative instances by seed.
    computing: BTreeMap<u64, Vec<InstanceId>>,
}

impl Window {
    /// Takes over a result that is there, or waits for the one that is being computed; whether it did.
    pub(super) fn reuse(&mut self, context: &mut Context<'_>, id: InstanceId) -> bool {
        let Some(instance) = self.instances.get(id) else { return false };
        let speculative = self.is_speculative(instance.segment);
        if !is_cacheable(context, instance) || (!speculative && self.twins.order.is_empty()) {
            return false;
        }
        let seed = self.seed(context, instance);
        let Some(seen) = instance.seen.as_deref() else { return false };
        let same = |other: &Seen| other.is_like(seen);
        let known = self.twins.results.get(&seed).and_then(|all| all.iter().find(|(other, _)| same(other)));
        let mut found = known.map(|(_, ended)| ended.clone());
        let mut busy = None;
        for other in self.twins.computing.get(&seed).into_iter().flatten().filter(|other| **other != id) {
            let Some(other) = self.instances.get(*other) else { continue };
            if !other.seen.as_deref().is_some_and(same) {
                continue;
            }
            match &other.ended {
                Some(ended) => found = found.or_else(|| Some((**ended).clone())),
                None if other.is_under_way() => busy = Some(other.id),
                None => {}
            }
        }
        if let Some(mut ended) = found {
            // What it assigns may be made of what differs between the branches.
            ended.outputs.retain(|port, _| !port.starts_with(ASSIGNED));
            if let Err(problem) = self.assign(context, id, &mut ended) {
                ended = Ended { changes: ended.changes, ..Ended::aborted(problem) };
            }
            context.note(Note::Reused { instance: id });
            context.note(Note::Finished { instance: id, outcome: ended.outcome.clone() });
            self.end_instance(id, ended);
            return true;
        }
        if let Some(busy) = busy {
            self.wait(id, Wait::Twin(busy));
            return true;
        }
        if speculative {
            let computing = self.twins.computing.entry(seed).or_default();
            computing.retain(|other| *other != id && self.instances.get(*other).is_some());
            computing.push(id);
        }
        false
    }

    /// A result that is about to be discarded is kept.
    pub(super) fn remember(&mut self, context: &Context<'_>, id: InstanceId) {
        let Some(instance) = self.instances.get(id) else { return };
        let (Some(seen), Some(ended), Status::Finished) = (&instance.seen, &instance.ended, instance.status) else {
            return;
        };
        // A failure to begin is no result.
        if !is_cacheable(context, instance) || self.is_ending || !ended.reason.is_empty() && ended.outputs.is_empty() {
            return;
        }
        let seed = self.seed(context, instance);
        let result = ((**seen).clone(), (**ended).clone());
        self.twins.results.entry(seed).or_default().push(result);
        self.twins.order.push_back(seed);
        if self.twins.order.len() > MAX_RESULTS
            && let Some(oldest) = self.twins.order.pop_front()
            && let Some(results) = self.twins.results.get_mut(&oldest)
        {
            results.remove(0);
            if results.is_empty() {
                self.twins.results.remove(&oldest);
            }
        }
    }

    /// What a visit's random choices are derived from.
    pub(super) fn seed(&self, context: &Context<'_>, instance: &Instance) -> u64 {
        let state = context.program.state(instance.state);
        let mut seed = Seed::of(context.seed);
        let environment = &instance.environment;
        environment.path_parts(&state.name, instance.visit, instance.iteration, |part| seed.add(part.as_bytes()));
        seed.of_try(if state.annotations.deterministic { 1 } else { instance.tries })
    }
}

fn is_cacheable(context: &Context<'_>, instance: &Instance) -> bool {
    instance.nature == NodeNature::Computes
        && matches!(context.program.state(instance.state).kind, StateKind::Action { .. })
}
