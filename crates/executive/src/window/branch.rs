//! Ways that a decision can take: an arm, a segment and a cursor for each, the likeliest first.
//!
//! What follows the same condition on both arms is expanded twice: they are two futures.

use super::Window;
use super::cursor::{Cursor, Todo};
use super::environment::Iteration;
use super::instance::{Arm, Segment};
use super::segment::Branch;
use crate::context::Context;
use crate::plan::Outcome;
use ratn_model::id::{InstanceId, StateId};
use ratn_model::program::{ABORTED, PREEMPTED, Program, StateKind};
use smallvec::smallvec;
use std::sync::Arc;

/// How likely a connected failure is, unless it was learned.
const FAILURE: f32 = 0.1;

impl Window {
    /// Both lists of a condition, from where it stands.
    pub(super) fn branch_on_condition(
        &mut self,
        context: &Context<'_>,
        index: usize,
        instance: InstanceId,
        visit: u32,
    ) {
        let Some(id) = self.instances.get(instance).map(|instance| instance.state) else { return };
        let state = context.program.state(id);
        let StateKind::Condition { then, otherwise, .. } = &state.kind else { return };
        let environment = &self.cursors[index].environment;
        let path: Arc<str> = environment.path(&state.name, visit, None).into();
        let base = environment.variables.len() - state.variables.len();
        let decisions = [(0, "then"), (1, "else")];
        for (cursor, taken) in self.branch(context, index, instance, id, &decisions) {
            let list = if taken == 0 { then } else { otherwise };
            self.begin_list(cursor, id, visit, path.clone(), base, list);
        }
    }

    /// Another iteration of a `while`, and its end, from where its test stands.
    pub(super) fn branch_on_test(
        &mut self,
        context: &Context<'_>,
        index: usize,
        test: InstanceId,
        visit: u32,
        number: usize,
    ) {
        let Some(owner) = self.instances.get(test).map(|test| test.state) else { return };
        let state = context.program.state(owner);
        let environment = &self.cursors[index].environment;
        let path: Arc<str> = environment.path(&state.name, visit, None).into();
        let path = if owner == Program::ROOT { Arc::from("") } else { path };
        let base = environment.variables.len();
        let inside = self.frame(index, owner, visit, path, base, Some(Iteration { index: number, elements: None }));
        let decisions = [(0, "again"), (1, "done")];
        for (cursor, taken) in self.branch(context, index, test, owner, &decisions) {
            if taken == 0 {
                self.cursors[cursor].environment.frames = Some(inside.clone());
                self.begin_iteration(cursor, context.program);
            } else {
                let ended = &mut self.cursors[cursor];
                ended.todo = Todo::Exit { state: owner, visit, outcome: 0, variables: base };
            }
        }
    }

    /// The arms of a node: one per target of the outcomes that are computed ahead.
    pub(super) fn branch_by_outcome(&mut self, context: &Context<'_>, index: usize, instance: InstanceId, id: StateId) {
        let plan = self.plan.clone();
        let own = plan.state(id);
        let links = own.writes.as_slice();
        match own.arms.as_slice() {
            [] => self.cursors[index].todo = Todo::Done,
            [arm] => {
                self.single_arm(index, instance);
                if let Some(instance) = self.instances.get_mut(instance) {
                    instance.arms[0].outcomes = arm.outcomes;
                    instance.arms[0].outcome = arm.outcome;
                }
                self.come_after(index, instance, id, arm.outcome, !arm.same_effects, links);
                self.cursors[index].todo = Todo::Leave(id, arm.outcome);
            }
            arms => {
                let decisions: Vec<(Outcome, &str)> =
                    arms.iter().map(|arm| (arm.outcome, &*own.outcomes[arm.outcome])).collect();
                for (cursor, outcome) in self.branch(context, index, instance, id, &decisions) {
                    let Some(arm) = arms.iter().find(|arm| arm.outcome == outcome) else { continue };
                    if let Some(instance) = self.instances.get_mut(instance)
                        && let Some(own) = instance.arms.iter_mut().find(|own| own.outcome == outcome)
                    {
                        own.outcomes = arm.outcomes;
                    }
                    self.come_after(cursor, instance, id, outcome, !arm.same_effects, links);
                    self.cursors[cursor].todo = Todo::Leave(id, outcome);
                }
            }
        }
    }

    pub(super) fn single_arm(&mut self, index: usize, instance: InstanceId) {
        let segment = self.cursors[index].segment;
        if let Some(instance) = self.instances.get_mut(instance) {
            instance.arms = smallvec![Arm { outcomes: 1, outcome: 0, next: None, segment }];
        }
    }

    /// One cursor per decision, each on a segment of its own, the likeliest first; cursors with what they stand for.
    fn branch(
        &mut self,
        context: &Context<'_>,
        index: usize,
        instance: InstanceId,
        id: StateId,
        decisions: &[(Outcome, &str)],
    ) -> Vec<(usize, Outcome)> {
        let learned = self.learned.outcomes.get(&context.program.state(id).path);
        let shares: Vec<f32> = decisions
            .iter()
            .map(|(_, name)| match learned {
                Some(shares) => shares.get(*name).map_or(0.01, |share| *share as f32).max(0.01),
                None if matches!(*name, ABORTED | PREEMPTED) => FAILURE,
                None => 1.0,
            })
            .collect();
        let total: f32 = shares.iter().sum();
        let mut cursors = Vec::new();
        let template = self.cursors[index].clone();
        for (number, ((outcome, _), share)) in decisions.iter().zip(shares).enumerate() {
            let probability = template.probability * share / total;
            let segment = self.new_segment(Branch {
                parent: template.segment,
                decision: instance,
                probability,
                expanded: false,
                members: Vec::new(),
            });
            if let Some(instance) = self.instances.get_mut(instance) {
                instance.arms.push(Arm { outcomes: 1 << outcome, outcome: *outcome, next: None, segment });
            }
            self.next_order += 1;
            let cursor = Cursor {
                tail: Some((instance, number)),
                segment,
                probability,
                order: self.next_order,
                ..template.clone()
            };
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

    pub(super) fn new_segment(&mut self, branch: Branch) -> Segment {
        self.next_segment += 1;
        self.branches.insert(self.next_segment, branch);
        self.next_segment
    }
}
