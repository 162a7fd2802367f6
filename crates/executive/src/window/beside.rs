//! Facts that concurrent regions share. Lines do not see each other: what a region computes ahead is based on the root and on its own changes.
//! So a commit by another region is a change from outside for everything that has not come to its place yet: computations and decisions based on
//! the old values are made again, with the values that the sequential program would find there. A node that is under way at its place goes on,
//! as in the sequential program.

use super::Window;
use super::graph::instance::Instance;
use crate::context::Context;
use crate::protocol::Command;
use ratn_model::fact::{Change, FactPattern, Footprint};
use ratn_model::id::{InstanceId, StateId};

/// A region: its fork, and the state that is the region.
pub(super) type Region = (InstanceId, StateId);

/// Shared facts that a region has changed, for the regions beside it.
pub(super) struct Crossing {
    /// The region that changed them, with those around it, the outermost first.
    by: Vec<Region>,
    facts: Vec<FactPattern>,
}

impl Window {
    /// Notes shared facts among committed changes.
    pub(super) fn note_crossing<'c>(
        &mut self,
        context: &Context<'_>,
        id: InstanceId,
        changes: impl Iterator<Item = &'c Change>,
    ) {
        if context.plan.crossing.is_nothing() {
            return;
        }
        let by = self.graph.get(id).map(regions_around).unwrap_or_default();
        let crosses = |fact: &FactPattern| Footprint::Patterns(vec![fact.clone()]).overlaps(&context.plan.crossing);
        let facts: Vec<FactPattern> = changes.map(Change::pattern).filter(crosses).collect();
        if !by.is_empty() && !facts.is_empty() {
            self.crossings.push(Crossing { by, facts });
        }
    }

    /// Notes shared facts that a routine has committed, from command `since` on.
    pub(super) fn note_crossings_of_routine(&mut self, context: &Context<'_>, id: InstanceId, since: usize) {
        let changes = context.commands[since..].iter().filter_map(|command| match command {
            Command::Commit { changes, .. } => Some(changes),
            _ => None,
        });
        self.note_crossing(context, id, changes.flatten());
    }

    /// Notifies the other regions of changed shared facts; true if there were any.
    pub(super) fn tell_of_crossings(&mut self, context: &mut Context<'_>) -> bool {
        let mut any = false;
        while !self.crossings.is_empty() && self.end.is_none() {
            any = true;
            for crossing in std::mem::take(&mut self.crossings) {
                self.tell_of_crossing(context, crossing);
            }
        }
        any
    }

    fn tell_of_crossing(&mut self, context: &mut Context<'_>, Crossing { by, facts }: Crossing) {
        self.follow_root(context);
        self.graph.unsettle_all();
        // Instances in its own region have taken these changes into account.
        let is_elsewhere = |instance: &&Instance| !regions_around(instance).starts_with(&by);
        let elsewhere: Vec<InstanceId> = self.graph.iter().filter(is_elsewhere).map(|instance| instance.id).collect();
        for id in &elsewhere {
            // Its effects may depend on these facts.
            self.memory.mark(*id);
            let Some(instance) = self.graph.get(*id) else { continue };
            let seen = |fact: &&FactPattern| instance.seen().is_some_and(|seen| seen.overlaps(fact));
            let Some(fact) = facts.iter().find(seen) else { continue };
            if !self.sees_the_same(context, instance) && !self.goes_on(context, *id) {
                self.came_otherwise(context, *id, false, format!("another region has changed {fact}"));
            }
        }
        self.revise(context);
        self.decide_again(context, elsewhere, &Footprint::Patterns(facts));
    }

    /// The older imprecise PIA that an instance must wait for, because the instance is in a region and uses shared facts. While that PIA runs,
    /// the sequential program would not be at the instance's place yet, and could find other facts there later.
    pub(super) fn beside_of_shared(
        &self,
        context: &Context<'_>,
        instance: &Instance,
        uses: [&Footprint; 2],
    ) -> Option<InstanceId> {
        if !uses.into_iter().any(|facts| facts.overlaps(&context.plan.crossing)) || regions_around(instance).is_empty()
        {
            return None;
        }
        self.older_beside(instance)
    }
}

/// The regions around an instance, the outermost first.
fn regions_around(instance: &Instance) -> Vec<Region> {
    let mut regions = Vec::new();
    let mut inner = instance.state;
    let mut frames = instance.environment.frames.as_deref();
    while let Some(frame) = frames {
        regions.extend(frame.fork.map(|fork| (fork, inner)));
        (inner, frames) = (frame.owner, frame.below.as_deref());
    }
    regions.reverse();
    regions
}

/// Whether the sequential program orders two instances: they are not in concurrent regions.
pub(super) fn is_in_order(one: &Instance, other: &Instance) -> bool {
    let (one, other) = (regions_around(one), regions_around(other));
    let parting = one.iter().zip(&other).find(|(one, other)| one != other);
    parting.is_none_or(|(one, other)| one.0 != other.0)
}
