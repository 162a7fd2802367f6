//! The units that perform goals. A unit performs one goal at a time. If the executive gives it a second one, a real provider would refuse it,
//! and the simulated run fails.

use ratn_executive::protocol::Goal;
use ratn_model::id::{InstanceId, LeaseId, StateId};
use ratn_model::program::{Program, WORLD_MODEL};
use ratn_model::resource::{ResourceClass, ResourceOperation};
use ratn_resources::Pool;
use std::collections::BTreeMap;
use std::sync::Arc;

/// The busy units.
pub(super) struct Busy {
    program: Arc<Program>,
    states: BTreeMap<InstanceId, StateId>,
    /// By unit: instance, attempt and lease of its goal.
    goals: BTreeMap<String, (InstanceId, u32, LeaseId)>,
}

impl Busy {
    pub(super) fn new(program: Arc<Program>) -> Busy {
        Busy { program, states: BTreeMap::new(), goals: BTreeMap::new() }
    }

    pub(super) fn expanded(&mut self, instance: InstanceId, state: StateId) {
        self.states.insert(instance, state);
    }

    /// Gives a goal to the units that its state blocks; an error is the other goal of a unit that is busy.
    pub(super) fn begin(
        &mut self,
        pool: &Pool,
        instance: InstanceId,
        attempt: u32,
        goal: &Goal,
    ) -> Result<(), (String, InstanceId)> {
        let (Some(state), Some(lease)) = (self.states.get(&instance), &goal.lease) else { return Ok(()) };
        let blocks = self.program.state(*state).annotations.resources.iter();
        let blocks = blocks.filter(|line| line.operation == ResourceOperation::Block && line.kind != WORLD_MODEL);
        for unit in blocks.filter_map(|line| lease.resource(&line.kind)) {
            // Resources that several nodes may hold at once perform no goals.
            let is_shared = |id: &str| pool.get(id).is_some_and(|r| r.divisible || r.class == ResourceClass::World);
            if is_shared(&unit.id) {
                continue;
            }
            if let Some((other, ..)) = self.goals.insert(unit.id.clone(), (instance, attempt, lease.id))
                && other != instance
            {
                return Err((unit.id.clone(), other));
            }
        }
        Ok(())
    }

    /// A goal has ended or was cancelled.
    pub(super) fn end(&mut self, instance: InstanceId, attempt: u32) {
        self.goals.retain(|_, goal| (goal.0, goal.1) != (instance, attempt));
    }

    /// A lease is released. The error is the instance whose goal under it has neither ended nor been cancelled, because nobody would cancel it
    /// any more.
    pub(super) fn given_back(&mut self, lease: LeaseId) -> Result<(), InstanceId> {
        let under_way = self.goals.values().find(|goal| goal.2 == lease).map(|goal| goal.0);
        self.goals.retain(|_, goal| goal.2 != lease);
        under_way.map_or(Ok(()), Err)
    }
}
