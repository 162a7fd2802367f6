//! Anytime results: they are improved until they are needed.
//!
//! ```text
//! goal ── first result ── better ── better ──┬─ a motion begins that uses it        ┐
//!           │ finished: instances           ├─ its resources are wanted or deleted  ├─ harvested: the best result counts,
//!           ▼ that use it go on             ├─ it is discarded, or made again       │  its resources are given back
//!                                           ├─ a motion begins that it would see     │
//!                                           └─ its provider has no better one       ┘
//! ```
//! Outputs that may have been used before a motion begins stay as in the first result ([`crate::plan`], `improves`). So an improvement never causes
//! anything to be made again, and the effects on the world do not depend on the time of the harvest.

use super::Window;
use super::graph::instance::{Ended, Instance, Status};
use super::improving::Improvement;
use super::waits::Timer;
use crate::binding::{self, Outputs};
use crate::context::Context;
use crate::executive::removed;
use crate::protocol::Command;
use ratn_model::fact::Footprint;
use ratn_model::id::InstanceId;
use ratn_model::program::{SUCCESS, StateKind};
use std::collections::BTreeSet;

/// An instance waits this long, in seconds, before improving or speculative holders give way, if it was not known that the resources do not suffice
/// for both.
const PATIENCE_S: f64 = 0.1;

impl Window {
    /// A goal has a result and goes on improving. The first result finishes its instance, later ones are kept until they are used.
    pub(super) fn improved(&mut self, context: &mut Context<'_>, id: InstanceId, attempt: u32, outputs: Outputs) {
        if self.improving.is(id, attempt) {
            return self.keep_best(context, id, outputs);
        }
        let Some(instance) = self.graph.get(id) else { return };
        let is_running =
            instance.node().is_some_and(|node| node.attempt == attempt && matches!(node.status, Status::Running(_)));
        let StateKind::Action { outputs: declared, .. } = &context.program.state(instance.state).kind else { return };
        let may = context.plan.state(instance.state).improves.is_some();
        // An incomplete result is ignored: the goal goes on and reports a result at its end.
        if !is_running || !may || binding::missing_output(declared, &outputs).is_some() {
            return;
        }
        let Some(producer) = instance.producer.clone() else { return };
        let state = instance.state;
        let senses = if instance.is_sensing() { self.senses(context, instance) } else { Footprint::NOTHING };
        let held = self.graph.take_held(id);
        self.improving.begin(id, Improvement { state, attempt, held, senses, producer, best: None });
        let answer = Ended::with(SUCCESS, outputs);
        self.keep_answer(context, id, &answer);
        self.finish(context, id, answer);
        if self.graph.get(id).is_some_and(|instance| instance.outputs().is_none()) {
            // The values that it assigns could not be evaluated.
            return self.harvest(context, id);
        }
        // Instances may have waited for its resources since before it had a result.
        let asking: Vec<InstanceId> = self.dispatch.active().filter(|id| self.asks(*id)).collect();
        asking.into_iter().for_each(|id| self.make_room(context, id));
    }

    /// A goal that was improving its result has ended, in whatever way: its last result counts.
    pub(super) fn improvement_ended(&mut self, context: &mut Context<'_>, id: InstanceId) {
        if let Some(improvement) = self.settle_best(id) {
            release(context, id, &improvement);
        }
    }

    /// Keeps better outputs, if they are complete and do not change an output that may have been used.
    fn keep_best(&mut self, context: &Context<'_>, id: InstanceId, outputs: Outputs) {
        let Some(improvement) = self.improving.get_mut(id) else { return };
        let StateKind::Action { outputs: declared, .. } = &context.program.state(improvement.state).kind else {
            return;
        };
        let Some(kept) = &context.plan.state(improvement.state).improves else { return };
        let first = improvement.producer.outputs().or_else(|| self.graph.get(id)?.outputs());
        let is_kept = first.is_some_and(|first| kept.iter().all(|port| first.get(port) == outputs.get(port)));
        if is_kept && binding::missing_output(declared, &outputs).is_none() {
            improvement.best = Some(outputs);
        }
    }

    /// Stops improving, because the result is used, its resources are wanted, or it is discarded: cancels the goal; its best result counts. Does
    /// nothing if it is not improving.
    pub(super) fn harvest(&mut self, context: &mut Context<'_>, id: InstanceId) {
        if let Some(improvement) = self.settle_best(id) {
            context.commands.push(Command::Cancel { instance: id, attempt: improvement.attempt });
            release(context, id, &improvement);
        }
    }

    /// Makes the best outputs the final ones.
    fn settle_best(&mut self, id: InstanceId) -> Option<Improvement> {
        let mut improvement = self.improving.end(id)?;
        let Some(best) = improvement.best.take() else { return Some(improvement) };
        let with_best = |first: &Outputs| {
            let mut all = first.clone();
            all.extend(best);
            all
        };
        if let Some(first) = improvement.producer.real.get() {
            let _ = improvement.producer.better.set(with_best(first));
        } else if let Some(better) = self.graph.get(id).and_then(|instance| instance.outputs()).map(with_best) {
            self.graph.improve(id, better);
        }
        Some(improvement)
    }

    /// A motion begins: stops improving results that it uses, and sensing of what it may change, because the motion would be seen. True if any was
    /// stopped.
    pub(super) fn harvest_for(&mut self, context: &mut Context<'_>, id: InstanceId) -> bool {
        if self.improving.is_empty() {
            return false;
        }
        let Some(instance) = self.graph.get(id).filter(|instance| instance.is_pia()) else { return false };
        let flows = context.plan.state(instance.state).flows.iter();
        let used: Vec<InstanceId> =
            flows.filter_map(|state| instance.environment.producer(*state)).map(|producer| producer.instance).collect();
        let would_see = self.would_see(context, instance);
        let before = context.commands.len();
        used.into_iter().chain(would_see).for_each(|producer| self.harvest(context, producer));
        context.commands.len() > before
    }

    /// Instances that are still sensing facts which this instance may change.
    fn would_see(&self, context: &Context<'_>, instance: &Instance) -> Vec<InstanceId> {
        let looking = self.improving.iter().filter(|(_, improvement)| !improvement.senses.is_nothing());
        let mut looking = looking.peekable();
        if looking.peek().is_none() {
            return Vec::new();
        }
        let writes = self.writes(context, instance);
        looking.filter(|(_, improvement)| improvement.senses.overlaps(&writes)).map(|(id, _)| id).collect()
    }

    /// Harvests the instances that hold resources which this event deletes or consumes.
    pub(super) fn harvest_what_is_removed(&mut self, context: &mut Context<'_>) {
        if self.improving.is_empty() {
            return;
        }
        let kinds: BTreeSet<String> = context.commands.iter().flat_map(removed).map(|one| one.kind.clone()).collect();
        let holds = |improvement: &Improvement| {
            let held = &context.plan.state(improvement.state).requirements;
            held.iter().any(|held| kinds.iter().any(|kind| context.program.may_be_one(kind, &held.kind)))
        };
        let holders = self.improving.iter().filter(|(_, improvement)| holds(improvement));
        let holders: Vec<InstanceId> = holders.map(|(id, _)| id).collect();
        let Some(first) = context.commands.iter().position(|command| removed(command).next().is_some()) else { return };
        let behind = context.commands.split_off(first);
        holders.into_iter().for_each(|id| self.harvest(context, id));
        context.commands.extend(behind);
    }

    /// The run is over: harvests everything.
    pub(super) fn harvest_all(&mut self, context: &mut Context<'_>) {
        let all: Vec<InstanceId> = self.improving.iter().map(|(id, _)| id).collect();
        all.into_iter().for_each(|id| self.harvest(context, id));
    }

    /// An instance is about to ask for resources. If these do not suffice for it and for holders that only improve a result, the latter give way
    /// now; if that is not known, they and the speculative holders give way after a while.
    pub(super) fn make_room(&mut self, context: &mut Context<'_>, id: InstanceId) {
        if !self.improving.is_empty() {
            let in_the_way = self.dispatch.too_much(&self.graph, context.plan, &self.improving, id);
            in_the_way.into_iter().for_each(|other| self.harvest(context, other));
        }
        let holds = self.holders_of_what(context, id).next().is_some();
        if holds || !self.dispatch.perhaps_in_the_way(&self.graph, context.plan, id).is_empty() {
            self.set_timer(context, PATIENCE_S, Timer::Room(id));
        }
    }

    /// An instance has waited for resources for a while: holders that only improve a result, or are speculative, give way.
    pub(super) fn make_way_for(&mut self, context: &mut Context<'_>, id: InstanceId) {
        if self.asks(id) {
            let holders: Vec<InstanceId> = self.holders_of_what(context, id).collect();
            holders.into_iter().for_each(|other| self.harvest(context, other));
            let speculative = self.dispatch.perhaps_in_the_way(&self.graph, context.plan, id);
            speculative.into_iter().for_each(|holder| self.preempt(context, holder, Some(id)));
        }
    }

    /// Whether an instance waits for resources; includes a routine that asks for a new lease.
    fn asks(&self, id: InstanceId) -> bool {
        match self.graph.node(id).map(|node| &node.status) {
            Some(Status::Acquiring { .. }) => true,
            Some(Status::RunningRoutine(interpreter, _)) => interpreter.asks(),
            _ => false,
        }
    }

    /// Instances that only improve a result and hold a kind that this instance wants.
    fn holders_of_what<'a>(
        &'a self,
        context: &'a Context<'_>,
        id: InstanceId,
    ) -> impl Iterator<Item = InstanceId> + 'a {
        let wanted = self.graph.get(id).map(|instance| &context.plan.state(instance.state).requirements);
        let is_wanted = move |kind: &str| {
            wanted.is_some_and(|wanted| wanted.iter().any(|wanted| context.program.may_be_one(&wanted.kind, kind)))
        };
        let holds = move |improvement: &Improvement| {
            context.plan.state(improvement.state).requirements.iter().any(|held| is_wanted(&held.kind))
        };
        self.improving.iter().filter(move |(_, improvement)| holds(improvement)).map(|(id, _)| id)
    }
}

fn release(context: &mut Context<'_>, id: InstanceId, improvement: &Improvement) {
    let (lease, projection) = (improvement.held.lease.as_ref().map(|lease| lease.id), improvement.held.projection);
    if lease.is_some() || projection.is_some() {
        context.commands.push(Command::Release { instance: id, lease, projection });
    }
}
