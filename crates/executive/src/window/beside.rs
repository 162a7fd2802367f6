//! Regions beside each other, and the facts that they share. Lines know nothing of each other: what a region sees ahead of its place is the root
//! with its own changes alone. So what another region makes real is, for what has not come to its place yet, a change from outside: what was
//! computed of it is made again, and what was decided by it is decided again, as the sequential program would have found it there. What is under
//! way at its place goes on, as it would there.

use super::Window;
use super::graph::instance::Instance;
use crate::context::Context;
use crate::protocol::Command;
use ratn_model::fact::{Change, FactPattern, Footprint};
use ratn_model::id::{InstanceId, StateId};

/// A region: the fork, and the state that the region is.
pub(super) type Region = (InstanceId, StateId);

/// Facts that a region has changed and that regions beside it may look at.
pub(super) struct Crossing {
    /// The region, within those around it, the outermost first.
    by: Vec<Region>,
    facts: Vec<FactPattern>,
}

impl Window {
    /// An instance has made these changes real.
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

    /// A routine has made changes real by the commands since these.
    pub(super) fn note_crossings_of_routine(&mut self, context: &Context<'_>, id: InstanceId, since: usize) {
        let changes = context.commands[since..].iter().filter_map(|command| match command {
            Command::Commit { changes, .. } => Some(changes),
            _ => None,
        });
        self.note_crossing(context, id, changes.flatten());
    }

    /// What regions have changed is told to those beside them; whether there was anything.
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
        // What is behind it in its own region has known of it.
        let is_elsewhere = |instance: &&Instance| !regions_around(instance).starts_with(&by);
        let elsewhere: Vec<InstanceId> = self.graph.iter().filter(is_elsewhere).map(|instance| instance.id).collect();
        for id in &elsewhere {
            // What it changes may be made of these facts.
            self.memory.mark(*id);
            let Some(instance) = self.graph.get(*id) else { continue };
            let seen = |fact: &&FactPattern| instance.seen().is_some_and(|seen| seen.overlaps(fact));
            let Some(fact) = facts.iter().find(seen) else { continue };
            if !self.is_at_its_place(instance) && !self.sees_the_same(context, instance) {
                self.came_otherwise(context, *id, false, format!("another region has changed {fact}"));
            }
        }
        self.revise(context);
        self.decide_again(context, elsewhere, &Footprint::Patterns(facts));
    }

    /// Whether the sequential program would be at it, too: all before it in its region has come to its end.
    fn is_at_its_place(&self, instance: &Instance) -> bool {
        instance.is_head && instance.is_under_way() && self.older_beside(instance).is_none()
    }

    /// Of an instance in a region that uses some facts which regions share: an older imprecise PIA that still runs. Before that has ended, the
    /// sequential program would not be at the place of the instance, and might find these facts otherwise when it comes there.
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

/// The regions that an instance is in, the outermost first.
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

/// Whether the sequential program executes one of two instances before the other: they are not in regions beside each other.
pub(super) fn is_in_order(one: &Instance, other: &Instance) -> bool {
    let (one, other) = (regions_around(one), regions_around(other));
    let parting = one.iter().zip(&other).find(|(one, other)| one != other);
    parting.is_none_or(|(one, other)| one.0 != other.0)
}
