//! Settled: a result that cannot change any more, although it may not have retired. Conditions and loops decide from settled
//! results.

use super::Window;
use super::environment::Binding;
use super::instance::{Instance, Role, Wait};
use super::ready::facts_of;
use crate::context::Context;
use ratn_model::expression::Expr;
use ratn_model::fact::Footprint;
use ratn_model::id::InstanceId;

/// Results of results are followed this far; beyond, one waits for the retirement of what is there.
const MAX_DEPTH: u32 = 64;

impl Window {
    /// Whom to wait for before the result of an instance cannot change any more; `None` when it cannot.
    pub(super) fn unsettled(&self, context: &Context<'_>, id: InstanceId, depth: u32) -> Option<InstanceId> {
        let instance = self.instances.get(id)?;
        if instance.settled.get() {
            return None;
        }
        if instance.ended.is_none() || depth > MAX_DEPTH {
            return Some(id);
        }
        if let Some(decision) = self.undecided(instance) {
            return Some(decision);
        }
        if let Some(producer) = self.producers_of(instance).find_map(|p| self.unsettled(context, p, depth + 1)) {
            return Some(producer);
        }
        if let Some(seen) = &instance.seen {
            let view = self.sight(context).view(instance, None);
            if let Some(writer) = seen.read.iter().find_map(|read| view.writer_of(read)) {
                return Some(writer);
            }
        }
        instance.settled.set(true);
        None
    }

    /// The instances in the window whose outputs an instance reads.
    pub(super) fn producers_of<'a>(&'a self, instance: &'a Instance) -> impl Iterator<Item = InstanceId> + 'a {
        let plan = self.plan.state(instance.state);
        let environment = &instance.environment;
        let is_join = instance.role == Role::Join;
        let flows = plan.flows.iter().filter_map(move |state| {
            let region = is_join.then(|| environment.producers.get(self.plan.len() + state.0 as usize)).flatten();
            region.or_else(|| environment.producer(*state))
        });
        let assigned = plan.variables.iter().filter_map(move |name| match environment.variables.get(name)? {
            Binding::Assigned(producer) => Some(producer),
            Binding::Known(_) => None,
        });
        flows
            .chain(assigned)
            .filter(|producer| producer.real.get().is_none())
            .map(|producer| producer.instance)
            .filter(move |id| *id != instance.id && self.instances.get(*id).is_some())
    }

    /// What a decision from these expressions waits for.
    pub(super) fn undecidable(&self, context: &Context<'_>, instance: &Instance, from: &[Expr]) -> Option<Wait> {
        if let Some(decision) = self.undecided(instance) {
            return Some(Wait::Decision(decision));
        }
        let sight = self.sight(context);
        let flows: Vec<_> = from.iter().flat_map(Expr::flows).collect();
        let variables: Vec<String> = from.iter().flat_map(Expr::variables).map(str::to_owned).collect();
        if let Some(producer) = super::ready::missing(sight, instance, &flows, &variables) {
            return Some(Wait::Data(producer));
        }
        if let Some(producer) = self.producers_of(instance).find_map(|p| self.unsettled(context, p, 0)) {
            return Some(Wait::Settling(producer));
        }
        let view = sight.view(instance, None);
        let facts: Footprint = facts_of(from, &view);
        view.writer_of(&facts).map(Wait::World)
    }
}
