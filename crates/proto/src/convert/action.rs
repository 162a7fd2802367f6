//! Goals and their results.

use super::{Malformed, facts, label, name, ports, wire_facts, wire_ports};
use crate::types::{Goal, GoalOutcome};
use crate::v1;
use ratn_model::id::ProjectionId;
use ratn_model::resource::Lease;

impl From<Goal> for v1::Goal {
    fn from(goal: Goal) -> v1::Goal {
        v1::Goal {
            goal_id: goal.id,
            action: goal.action,
            inputs: wire_ports(goal.inputs),
            seed: goal.seed,
            lease: goal.lease.map(v1::Lease::from),
            projection_id: goal.projection.map(|projection| projection.0),
            world_pool_endpoint: goal.world_pool,
            deadline_ms: goal.deadline_ms,
            grace_ms: goal.grace_ms,
        }
    }
}

impl TryFrom<v1::Goal> for Goal {
    type Error = Malformed;

    fn try_from(goal: v1::Goal) -> Result<Goal, Malformed> {
        name(&goal.goal_id, "goal_id")?;
        name(&goal.action, "action")?;
        label(&goal.world_pool_endpoint, "world_pool_endpoint")?;
        Ok(Goal {
            id: goal.goal_id,
            action: goal.action,
            inputs: ports(goal.inputs, "inputs")?,
            seed: goal.seed,
            lease: goal.lease.map(Lease::try_from).transpose().map_err(|m| m.within("lease"))?,
            projection: goal.projection_id.map(ProjectionId),
            world_pool: goal.world_pool_endpoint,
            deadline_ms: goal.deadline_ms,
            grace_ms: goal.grace_ms,
        })
    }
}

impl From<GoalOutcome> for v1::GoalResult {
    fn from(outcome: GoalOutcome) -> v1::GoalResult {
        v1::GoalResult {
            outcome: outcome.outcome,
            outputs: wire_ports(outcome.outputs),
            measured: wire_facts(outcome.measured),
            reason: outcome.reason,
            orphaned: false,
        }
    }
}

impl TryFrom<v1::GoalResult> for GoalOutcome {
    type Error = Malformed;

    fn try_from(result: v1::GoalResult) -> Result<GoalOutcome, Malformed> {
        name(&result.outcome, "outcome")?;
        Ok(GoalOutcome {
            outcome: result.outcome,
            outputs: ports(result.outputs, "outputs")?,
            measured: facts(result.measured, "measured")?,
            reason: result.reason,
        })
    }
}
