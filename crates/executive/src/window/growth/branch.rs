//! Expands the ways on from a decision: an arm, a segment and a cursor for each, the most likely first.
//!
//! States behind a condition are expanded once for each arm, because these are two possible futures.

use super::Growth;
use super::cursor::{Cursor, Todo};
use super::environment::{Iteration, Link};
use crate::context::Context;
use crate::plan::{Outcome, Outcomes};
use crate::window::graph::Graph;
use ratn_model::id::{InstanceId, StateId};
use ratn_model::program::{ABORTED, PREEMPTED, Program, SUCCESS, StateKind, VIOLATED};
use ratn_model::wait::TIMEOUT;
use std::sync::Arc;

/// Probability of a handled failure relative to another outcome, unless it was learned.
const FAILURE: f64 = 0.1;
/// Lower limit of an outcome's probability, whatever was learned.
const LEAST_SHARE: f64 = 0.01;

impl Growth {
    /// Expands both lists of a condition.
    pub(super) fn branch_on_condition(
        &mut self,
        graph: &mut Graph,
        context: &Context<'_>,
        index: usize,
        instance: InstanceId,
        visit: u32,
    ) {
        let Some(id) = graph.get(instance).map(|instance| instance.state) else { return };
        let state = context.program.state(id);
        let StateKind::Condition { then, otherwise, .. } = &state.kind else { return };
        let environment = &self.cursors[index].environment;
        let path: Arc<str> = environment.path(&state.name, visit, None).into();
        let base = environment.variables.len() - state.variables.len();
        for (cursor, taken) in self.branch(graph, context, index, instance, id, &[(0, 1, "then"), (1, 2, "else")]) {
            let list = if taken == 0 { then } else { otherwise };
            self.begin_list(cursor, id, visit, path.clone(), base, list);
        }
    }

    /// Expands another iteration of a `while`, and its end, behind its test.
    pub(super) fn branch_on_test(
        &mut self,
        graph: &mut Graph,
        context: &Context<'_>,
        index: usize,
        test: InstanceId,
        visit: u32,
        number: usize,
    ) {
        let Some(owner) = graph.get(test).map(|test| test.state) else { return };
        let state = context.program.state(owner);
        let environment = &self.cursors[index].environment;
        let path: Arc<str> = environment.path(&state.name, visit, None).into();
        let path = if owner == Program::ROOT { Arc::from("") } else { path };
        let base = environment.variables.len();
        let inside = self.frame(index, owner, visit, path, base, Some(Iteration { index: number, elements: None }));
        for (cursor, taken) in self.branch(graph, context, index, test, owner, &[(0, 1, "again"), (1, 2, "done")]) {
            if taken == 0 {
                self.cursors[cursor].environment.frames = Some(inside.clone());
                self.begin_iteration(cursor, context.program);
            } else {
                self.cursors[cursor].todo = Todo::Exit { state: owner, visit, outcome: 0, variables: base };
            }
        }
    }

    /// Expands the arms of a node: one per target of the outcomes that are computed ahead.
    pub(super) fn branch_by_outcome(
        &mut self,
        graph: &mut Graph,
        context: &Context<'_>,
        index: usize,
        instance: InstanceId,
        id: StateId,
    ) {
        let own = context.plan.state(id);
        let link = |outcome, vague| Link { writer: instance, outcome, vague };
        match own.arms.as_slice() {
            [] => self.cursors[index].todo = Todo::Done,
            [arm] => {
                graph.single_arm(instance, arm.outcomes);
                let link = link(arm.outcome, !arm.same_effects);
                self.come_after(graph, context, index, instance, link, (&own.writes, &own.written));
                self.cursors[index].todo = Todo::Leave(id, arm.outcome);
            }
            arms => {
                let ways: Vec<(Outcome, Outcomes, &str)> =
                    arms.iter().map(|arm| (arm.outcome, arm.outcomes, &*own.outcomes[arm.outcome])).collect();
                let cursors = self.branch(graph, context, index, instance, id, &ways);
                let path = graph.get(instance).map(|instance| Arc::from(instance.path(context.program)));
                for ((cursor, outcome), arm) in cursors.into_iter().zip(arms) {
                    if &*own.outcomes[outcome] != SUCCESS {
                        self.cursors[cursor].because.clone_from(&path);
                    }
                    let link = link(outcome, !arm.same_effects);
                    self.come_after(graph, context, cursor, instance, link, (&own.writes, &own.written));
                    self.cursors[cursor].todo = Todo::Leave(id, outcome);
                }
            }
        }
    }

    /// Replaces a cursor by one per way on, each on a segment of its own, with the outcomes that it stands for.
    fn branch(
        &mut self,
        graph: &mut Graph,
        context: &Context<'_>,
        index: usize,
        instance: InstanceId,
        id: StateId,
        ways: &[(Outcome, Outcomes, &str)],
    ) -> Vec<(usize, Outcome)> {
        let learned = self.learned_outcomes.get(&context.program.state(id).path);
        let shares: Vec<f64> = ways
            .iter()
            .map(|(_, _, name)| match learned {
                Some(shares) => shares.get(*name).copied().filter(|s| s.is_finite()).unwrap_or(0.0).max(LEAST_SHARE),
                None if matches!(*name, ABORTED | PREEMPTED | VIOLATED | TIMEOUT) => FAILURE,
                None => 1.0,
            })
            .collect();
        let total: f64 = shares.iter().sum();
        let template = self.cursors[index].clone();
        let mut cursors = Vec::with_capacity(ways.len());
        for (number, ((outcome, outcomes, _), share)) in ways.iter().zip(shares).enumerate() {
            let segment = graph.open_arm(instance, *outcomes, share / total);
            let order = self.next_order();
            let cursor = Cursor { tail: Some((instance, number)), segment, order, ..template.clone() };
            if number == 0 {
                self.cursors[index] = cursor;
                cursors.push((index, *outcome));
            } else {
                self.cursors.push(cursor);
                cursors.push((self.cursors.len() - 1, *outcome));
            }
        }
        cursors
    }
}
