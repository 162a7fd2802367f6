//! Goals and their results.

use super::{Malformed, each, label, name, ports, wire_ports};
use crate::types::{FactRecord, Goal, GoalImproved, GoalOutcome};
use crate::v1;
use ratn_model::id::ProjectionId;
use ratn_model::resource::Lease;
use std::collections::BTreeMap;

/// Maximum number of outputs to keep: the maximum number of ports of an action.
const MAX_KEPT: usize = 128;

impl From<Goal> for v1::Goal {
    fn from(goal: Goal) -> v1::Goal {
        v1::Goal {
            goal_id: goal.id,
            action: goal.action,
            inputs: wire_ports(goal.inputs),
            seed: goal.seed,
            lease: goal.lease.map(|lease| v1::Lease { session_id: goal.session, ..v1::Lease::from(lease) }),
            projection_id: goal.projection.map(|projection| projection.0),
            world_pool_endpoint: goal.world_pool,
            deadline_ms: goal.deadline_ms,
            grace_ms: goal.grace_ms,
            improve: goal.improves.map(|keep| v1::Improve { keep }),
        }
    }
}

impl TryFrom<v1::Goal> for Goal {
    type Error = Malformed;

    fn try_from(goal: v1::Goal) -> Result<Goal, Malformed> {
        name(&goal.goal_id, "goal_id")?;
        name(&goal.action, "action")?;
        label(&goal.world_pool_endpoint, "world_pool_endpoint")?;
        let session = goal.lease.as_ref().map_or_else(String::new, |lease| lease.session_id.clone());
        label(&session, "lease.session_id")?;
        Ok(Goal {
            id: goal.goal_id,
            action: goal.action,
            inputs: ports(goal.inputs, "inputs")?,
            seed: goal.seed,
            lease: goal.lease.map(Lease::try_from).transpose().map_err(|m| m.within("lease"))?,
            session,
            projection: goal.projection_id.map(ProjectionId),
            world_pool: goal.world_pool_endpoint,
            deadline_ms: goal.deadline_ms,
            grace_ms: goal.grace_ms,
            improves: goal.improve.map(|improve| kept(improve.keep)).transpose()?,
        })
    }
}

fn kept(ports: Vec<String>) -> Result<Vec<String>, Malformed> {
    if ports.len() > MAX_KEPT {
        return Err(Malformed::new("improve.keep", format!("names {} outputs: at most {MAX_KEPT}", ports.len())));
    }
    ports.iter().try_for_each(|port| name(port, "improve.keep"))?;
    Ok(ports)
}

impl From<GoalImproved> for v1::GoalImproved {
    fn from(better: GoalImproved) -> v1::GoalImproved {
        v1::GoalImproved { outputs: wire_ports(better.outputs), cost_s: better.cost_s }
    }
}

impl TryFrom<v1::GoalImproved> for GoalImproved {
    type Error = Malformed;

    fn try_from(better: v1::GoalImproved) -> Result<GoalImproved, Malformed> {
        if !better.cost_s.is_finite() {
            return Err(Malformed::new("improved.cost_s", "is no finite number"));
        }
        Ok(GoalImproved { outputs: ports(better.outputs, "improved.outputs")?, cost_s: better.cost_s })
    }
}

impl From<GoalOutcome> for v1::GoalResult {
    fn from(outcome: GoalOutcome) -> v1::GoalResult {
        let evidence: BTreeMap<_, _> = outcome.evidence.into_iter().collect();
        let fact = |(key, value)| v1::Fact {
            measurement: evidence.get(&key).cloned().map(v1::Measurement::from),
            key: Some(v1::FactKey::from(key)),
            value: Some(v1::Value::from(value)),
            ..v1::Fact::default()
        };
        let measured = outcome.measured.into_iter().map(fact).collect();
        v1::GoalResult {
            outcome: outcome.outcome,
            outputs: wire_ports(outcome.outputs),
            measured,
            reason: outcome.reason,
            orphaned: false,
            may_move: false,
        }
    }
}

impl TryFrom<v1::GoalResult> for GoalOutcome {
    type Error = Malformed;

    fn try_from(result: v1::GoalResult) -> Result<GoalOutcome, Malformed> {
        name(&result.outcome, "outcome")?;
        let records: Vec<FactRecord> = each(result.measured, "measured")?;
        let of = |record: &FactRecord| Some((record.key.clone(), record.measured.as_deref()?.clone()));
        Ok(GoalOutcome {
            evidence: records.iter().filter_map(of).collect(),
            outcome: result.outcome,
            outputs: ports(result.outputs, "outputs")?,
            measured: records.into_iter().map(|record| (record.key, record.value)).collect(),
            reason: result.reason,
        })
    }
}
