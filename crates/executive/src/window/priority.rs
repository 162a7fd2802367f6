//! Dispatch order: not speculative before speculative, then the longest remaining path, then program order.
//!
//! The remaining path of a node is its estimated duration plus the longest of what waits for it: the readers of its
//! outputs, and the next PIA in program order, which may not begin before every older instance has ended. A look ahead may
//! have advised something better. A speculative node counts as much as its path is likely.

use super::Window;
use super::environment::Binding;
use super::instance::{Instance, Role, Status};
use crate::binding;
use crate::context::Context;
use crate::lookahead;
use crate::protocol::Command;
use ratn_model::id::InstanceId;
use ratn_model::resource::{Quantity, Requirement, ResourceOperation};
use std::collections::BTreeMap;

/// From the top: one bit that says "not speculative", milliseconds of remaining path, program order.
const REMAINING_BITS: u32 = 40;
const ORDER_BITS: u32 = 20;

/// Up to this many instances the window is estimated anew whenever it grew; beyond, when it grew by this share.
const ALWAYS_ESTIMATED: usize = 64;
const ESTIMATED_SHARE: usize = 2;

/// A window is looked ahead for so many nodes; what comes later keeps its longest remaining path.
const MAX_TASKS: usize = 2_000;

impl Window {
    /// Estimates durations and remaining paths of everything in the window, if enough has changed.
    pub(super) fn estimate(&mut self, context: &Context<'_>) {
        let enough = if self.instances.len() <= ALWAYS_ESTIMATED {
            self.grown_since_estimate > 0
        } else {
            self.grown_since_estimate * ESTIMATED_SHARE >= self.instances.len()
        };
        if !enough {
            return;
        }
        self.grown_since_estimate = 0;
        let ids = self.instances.ids();
        let size = usize::try_from(ids.end - ids.start).unwrap_or(0);
        // By id: the longest path of those that read its outputs, and of the next PIA behind it.
        let (mut readers, mut pias) = (vec![0.0_f32; size], vec![0.0_f32; size]);
        let place = |id: InstanceId| {
            id.0.checked_sub(ids.start).and_then(|at| usize::try_from(at).ok()).filter(|at| *at < size)
        };
        // A younger instance always has a larger id.
        for id in ids.clone().rev().map(InstanceId) {
            let Some(instance) = self.instances.get(id) else { continue };
            let Some(at) = place(id) else { continue };
            let behind = instance.arms.iter().filter_map(|arm| arm.next);
            let join = match instance.role {
                Role::RegionEnd => self.threads.get(&instance.line).and_then(|t| self.forks.get(&t.fork?)?.join),
                _ => None,
            };
            let pia_s = behind.chain(join).filter_map(place).fold(0.0_f32, |most, next| most.max(pias[next]));
            let duration_s = self.duration_s(context, instance);
            let remaining_s = duration_s + pia_s.max(readers[at]);
            pias[at] = if instance.is_pia() { remaining_s } else { pia_s };
            let environment = &instance.environment;
            let own = self.plan.state(instance.state);
            let needs = match instance.role {
                Role::Node => context.plan.state(instance.state).start_flows.as_slice(),
                _ => own.start_flows.as_slice(),
            };
            let assigned = own.variables.iter().filter_map(|name| match environment.variables.get(name)? {
                Binding::Assigned(producer) => Some(producer),
                Binding::Known(_) => None,
            });
            for producer in needs.iter().filter_map(|state| environment.producer(*state)).chain(assigned) {
                if let Some(at) = place(producer.instance) {
                    readers[at] = readers[at].max(remaining_s);
                }
            }
            if let Some(instance) = self.instances.get_mut(id) {
                instance.duration_s = duration_s;
                if !instance.advised {
                    instance.remaining_s = remaining_s;
                }
            }
        }
    }

    fn duration_s(&self, context: &Context<'_>, instance: &Instance) -> f32 {
        let state = context.program.state(instance.state);
        if instance.role != Role::Node || state.annotations.duration_s.is_none() {
            return instance.duration_s;
        }
        if self.learned.durations_s.contains_key(&state.path) {
            return instance.duration_s;
        }
        let view = self.sight(context).view(instance, None);
        binding::expected_s(state, &view).map_or(instance.duration_s, |seconds| seconds as f32)
    }

    /// The priority of an acquire: larger first.
    pub(super) fn priority(&self, instance: &Instance) -> i64 {
        let certain = i64::from(!self.is_speculative(instance.segment));
        let remaining_s = instance.remaining_s * self.probability(instance.segment);
        let greatest = |bits: u32| (1_i64 << bits) - 1;
        let remaining = (f64::from(remaining_s) * 1000.0).round() as i64;
        let remaining = remaining.clamp(0, greatest(REMAINING_BITS));
        // Ids grow in program order.
        let order = i64::try_from(instance.id.0).unwrap_or(i64::MAX).min(greatest(ORDER_BITS));
        (certain << (REMAINING_BITS + ORDER_BITS)) | (remaining << ORDER_BITS) | (greatest(ORDER_BITS) - order)
    }

    /// A decision was made for its path: it is served before those for which none is.
    pub(super) fn became_certain(&mut self, context: &mut Context<'_>, id: InstanceId) {
        self.ask_again(context, id);
        self.enqueue(id);
    }

    /// Who waits for the resource manager asks again if its priority has changed.
    fn ask_again(&mut self, context: &mut Context<'_>, id: InstanceId) {
        let Some(instance) = self.instances.get(id) else { return };
        if instance.status != Status::Acquiring {
            return;
        }
        let priority = self.priority(instance);
        if priority == instance.asked_with {
            return;
        }
        let state = context.program.state(instance.state);
        let wanted = &context.plan.state(instance.state).requirements;
        if wanted.iter().any(|r| r.operation == ResourceOperation::Consume) {
            // A grant that crosses the withdrawal has used it up already: asking twice would use it up twice.
            return;
        }
        let view = self.sight(context).view(instance, None);
        let Ok(requirements) = binding::requirements(state, wanted, &view) else { return };
        drop(view);
        context.commands.push(Command::Withdraw { instance: id });
        context.commands.push(Command::Acquire { instance: id, requirements, priority });
        if let Some(instance) = self.instances.get_mut(id) {
            instance.asked_with = priority;
        }
        self.preempt_for(context, id);
    }

    /// A look ahead found a better order.
    pub(super) fn advise(&mut self, context: &mut Context<'_>, urgency_s: &[(InstanceId, f64)]) {
        for (id, seconds) in urgency_s {
            if let Some(instance) = self.instances.get_mut(*id)
                && seconds.is_finite()
            {
                instance.remaining_s = *seconds as f32;
                instance.advised = true;
            }
        }
        let asking: Vec<InstanceId> = self.active.iter().copied().collect();
        for id in asking {
            self.ask_again(context, id);
        }
    }

    /// A speculative node leaves room for projections to those that are not.
    pub(super) fn leaves_room(&self, context: &Context<'_>, instance: &Instance, requirements: &[Requirement]) -> bool {
        let kind = ratn_model::program::WORLD_MODEL;
        if !self.is_speculative(instance.segment) || !requirements.iter().any(|r| r.kind == kind) {
            return true;
        }
        let Some(capacity) = self.capacity.get(kind) else { return true };
        let others = self.active.iter().filter_map(|id| self.instances.get(*id));
        let taken = others
            .filter(|other| self.is_speculative(other.segment))
            .filter(|other| context.plan.state(other.state).needs_world)
            .count();
        let rooms = capacity.units() as usize;
        rooms <= 1 || taken + 1 < rooms
    }

    /// Speculative holders give way to a node that is not speculative, where they keep it from its resources.
    pub(super) fn preempt_for(&mut self, context: &mut Context<'_>, id: InstanceId) {
        let Some(instance) = self.instances.get(id) else { return };
        if self.is_speculative(instance.segment) || self.branches.is_empty() {
            return;
        }
        let needs = |state| -> Vec<(String, Quantity)> {
            let blocks = context.plan.state(state).requirements.iter();
            let blocks = blocks.filter(|r| r.operation == ResourceOperation::Block);
            blocks.map(|r| (r.kind.clone(), r.count)).collect()
        };
        for (kind, _) in needs(instance.state) {
            let Some(capacity) = self.capacity.get(&kind).copied() else { continue };
            let mut taken = Quantity::ZERO;
            let mut speculative: Vec<(i64, InstanceId, Quantity)> = Vec::new();
            for other in self.active.iter().filter_map(|id| self.instances.get(*id)) {
                let count: Quantity = needs(other.state).iter().filter(|(k, _)| *k == kind).map(|(_, n)| *n).sum();
                let certain = !self.is_speculative(other.segment);
                // What is not speculative and waits shall be served, too.
                if !count.is_zero() && (certain || other.lease.is_some()) {
                    taken += count;
                    if !certain {
                        speculative.push((self.priority(other), other.id, count));
                    }
                }
            }
            speculative.sort_unstable();
            for (_, holder, count) in speculative {
                if taken <= capacity {
                    break;
                }
                taken = taken.saturating_sub(count);
                context.note(crate::protocol::Note::Preempted { instance: holder, by: id });
                self.step_back(context, holder, super::instance::Wait::Nothing);
                self.enqueue(holder);
            }
        }
    }

    /// What is still to be done, as a scheduling problem: of an undecided condition the likelier branch.
    pub(crate) fn outlook(&self, context: &Context<'_>) -> lookahead::Problem {
        let mut places: BTreeMap<InstanceId, usize> = BTreeMap::new();
        let mut tasks: Vec<lookahead::Task> = Vec::new();
        // Per line, the last PIA and what came since: a PIA waits for all of it.
        let mut since: BTreeMap<u64, Vec<usize>> = BTreeMap::new();
        let open = |instance: &&Instance| {
            instance.role == Role::Node && instance.ended.is_none() && self.is_likeliest(instance.segment)
        };
        for instance in self.instances.iter().filter(open).take(MAX_TASKS) {
            let analysis = context.plan.state(instance.state);
            let blocks = analysis.requirements.iter().filter(|r| r.operation == ResourceOperation::Block);
            let runs = matches!(instance.status, Status::Granted | Status::Projecting | Status::Running);
            let elapsed_s = if runs { context.now.since(instance.began).as_secs_f64() } else { 0.0 };
            let mut after: Vec<usize> = Vec::new();
            if !runs {
                after.extend(self.producers_of(instance).filter_map(|producer| places.get(&producer)));
                after.extend(instance.wait.on().and_then(|on| places.get(&on)));
                if instance.is_pia() {
                    after.extend(since.get(&instance.line).into_iter().flatten());
                }
                after.sort_unstable();
                after.dedup();
            }
            let line = since.entry(instance.line).or_default();
            if instance.is_pia() {
                line.clear();
            }
            line.push(tasks.len());
            places.insert(instance.id, tasks.len());
            tasks.push(lookahead::Task {
                instance: instance.id,
                duration_s: (f64::from(instance.duration_s) - elapsed_s).max(0.0),
                is_running: runs,
                is_speculative: self.is_speculative(instance.segment),
                urgency_s: f64::from(instance.remaining_s),
                probability: f64::from(self.probability(instance.segment)),
                demands: blocks.map(|r| (r.kind.clone(), r.count)).collect(),
                after,
            });
        }
        lookahead::Problem { tasks, capacity: self.capacity.clone() }
    }
}
