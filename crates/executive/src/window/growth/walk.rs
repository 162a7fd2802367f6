//! Walking the program: a cursor enters a state, leaves it by an outcome, and follows that outcome's target.

use super::Growth;
use super::append::What;
use super::cursor::Todo;
use super::environment::{Binding, Frame, Iteration, Link};
use crate::context::Context;
use crate::plan::{Outcome, Predicate};
use crate::window::graph::Graph;
use crate::window::graph::instance::Role;
use ratn_model::expression::scope::NothingKnown;
use ratn_model::id::StateId;
use ratn_model::program::{Program, SUCCESS, StateKind, Target, is_failure};
use std::sync::Arc;

impl Growth {
    pub(super) fn enter(&mut self, graph: &mut Graph, context: &mut Context<'_>, index: usize, id: StateId) {
        let state = context.program.state(id);
        let plan = context.plan;
        let own = plan.state(id);
        self.cursors[index].count_visit();
        self.forget_passed_over(context.program, index, Some(id));
        let visit = self.count_visit(context, index, id);
        if own.is_node {
            let instance = self.append(graph, context, index, state, What::Node, (visit, None));
            return self.branch_by_outcome(graph, context, index, instance, id);
        }
        for inside in &own.read_inside {
            let producers = &mut self.cursors[index].environment.producers;
            for slot in [inside.0 as usize, plan.len() + inside.0 as usize] {
                if producers.get(slot).is_some() {
                    producers.set(slot, None);
                }
            }
        }
        let constant = |value: &ratn_model::expression::Expr| value.evaluate(&NothingKnown).ok();
        let bound: Vec<_> = state.variables.iter().map(|(name, value)| (name, constant(value))).collect();
        let base = self.cursors[index].environment.variables.len();
        let computed = bound.iter().any(|(_, value)| value.is_none());
        let entry = (computed || !state.annotations.requires.is_empty()).then(|| {
            let entry = self.append(graph, context, index, state, What::marker(Role::Entry), (visit, None));
            graph.single_arm(entry, 1);
            graph.get(entry).and_then(|entry| entry.producer.clone())
        });
        for (name, value) in bound {
            let binding = match (value, entry.as_ref().and_then(Option::as_ref)) {
                (Some(value), _) => Binding::Known(value),
                (None, Some(producer)) => Binding::Assigned(producer.clone()),
                (None, None) => continue,
            };
            self.cursors[index].environment.variables.declare(name, binding);
        }
        let path: Arc<str> = self.cursors[index].environment.path(&state.name, visit, None).into();
        let path = if id == Program::ROOT { Arc::from("") } else { path };
        match &state.kind {
            StateKind::Action { .. } => {}
            StateKind::Sequence { children, .. } => {
                self.begin_list(index, id, visit, path, base, children);
                if context.program.is_pass(id) && !children.is_empty() {
                    self.note_earlier(index, children);
                }
            }
            StateKind::ForEach { .. } => {
                let instance = self.append(graph, context, index, state, What::marker(Role::Loop), (visit, None));
                graph.single_arm(instance, 1);
                self.cursors[index].todo = Todo::Await(instance);
            }
            StateKind::While { body_first, .. } => {
                // The first iteration counts on from here.
                let before = if *body_first { 0 } else { usize::MAX };
                let iteration = Iteration { index: before, elements: None };
                // Scoped variables of the loop exist in every iteration.
                let inside = base + state.variables.len();
                let frame = self.frame(index, id, visit, path, inside, Some(iteration));
                self.cursors[index].environment.frames = Some(frame);
                if *body_first {
                    self.begin_iteration(index, context.program);
                } else {
                    self.cursors[index].todo = Todo::Iterate;
                }
            }
            StateKind::Condition { .. } => {
                let instance = self.append(graph, context, index, state, What::marker(Role::Condition), (visit, None));
                self.branch_on_condition(graph, context, index, instance, visit);
            }
            StateKind::Concurrency { regions, .. } => {
                self.fork(graph, context, index, state, (visit, &path, base), regions);
            }
        }
    }

    fn count_visit(&mut self, context: &Context<'_>, index: usize, id: StateId) -> u32 {
        let Some(frame) = &self.cursors[index].environment.frames else { return 1 };
        if !context.plan.state(frame.owner).repeats {
            return 1;
        }
        let Some(frame) = self.top_frame(index) else { return 1 };
        match frame.visits.iter_mut().find(|(state, _)| *state == id) {
            Some((_, count)) => {
                *count += 1;
                *count
            }
            None => {
                frame.visits.push((id, 1));
                1
            }
        }
    }

    pub(super) fn top_frame(&mut self, index: usize) -> Option<&mut Frame> {
        self.cursors[index].environment.frames.as_mut().map(Arc::make_mut)
    }

    pub(super) fn frame(
        &self,
        index: usize,
        owner: StateId,
        visit: u32,
        path: Arc<str>,
        variables: usize,
        iteration: Option<Iteration>,
    ) -> Arc<Frame> {
        let below = self.cursors[index].environment.frames.clone();
        Arc::new(Frame {
            below,
            owner,
            visit,
            path,
            visits: Vec::new(),
            iteration,
            variables,
            fork: None,
            earlier: Vec::new(),
        })
    }

    /// Begins a list of a composite state that is no loop.
    pub(super) fn begin_list(
        &mut self,
        index: usize,
        owner: StateId,
        visit: u32,
        path: Arc<str>,
        variables: usize,
        list: &[StateId],
    ) {
        let Some(first) = list.first() else {
            self.cursors[index].todo = Todo::Exit { state: owner, visit, outcome: 0, variables };
            return;
        };
        let frame = self.frame(index, owner, visit, path, variables, None);
        let cursor = &mut self.cursors[index];
        cursor.environment.frames = Some(frame);
        cursor.todo = Todo::Enter(*first);
    }

    /// Follows an outcome of a state that has ended.
    pub(super) fn follow(
        &mut self,
        graph: &mut Graph,
        context: &mut Context<'_>,
        index: usize,
        id: StateId,
        outcome: Outcome,
    ) {
        let plan = context.plan;
        if id == Program::ROOT {
            let name = &plan.state(id).outcomes[outcome];
            return self.end_of_task(graph, context, index, name);
        }
        let by = match &plan.state(id).targets[outcome] {
            Target::State(next) => {
                let cursor = &mut self.cursors[index];
                cursor.todo = Todo::Enter(*next);
                // What goes on remembers its last failure.
                let by = &*plan.state(id).outcomes[outcome];
                cursor.because = cursor.because.take().filter(|_| by == SUCCESS || is_failure(by));
                return;
            }
            Target::Outcome(by) => by,
        };
        self.forget_passed_over(context.program, index, None);
        let Some(frame) = &self.cursors[index].environment.frames else { return };
        let owner = frame.owner;
        if frame.fork.is_some() {
            return self.end_region(graph, context, index, id, by);
        }
        let is_loop = matches!(context.program.state(owner).kind, StateKind::ForEach { .. } | StateKind::While { .. });
        if is_loop && by == SUCCESS {
            self.cursors[index].todo = Todo::Iterate;
            return;
        }
        let own = plan.state(owner);
        let outcome = own.outcome(by).unwrap_or_else(|| own.outcomes.len() - 2);
        self.leave_frame(index, outcome);
    }

    /// Leaves the innermost list, and its owner by this outcome.
    pub(super) fn leave_frame(&mut self, index: usize, outcome: Outcome) {
        let cursor = &mut self.cursors[index];
        let Some(frame) = cursor.environment.frames.clone() else { return };
        cursor.environment.frames = frame.below.clone();
        let variables = frame.variables;
        cursor.todo = Todo::Exit { state: frame.owner, visit: frame.visit, outcome, variables };
    }

    #[expect(clippy::too_many_arguments, reason = "all of it is one activation")]
    pub(super) fn exit(
        &mut self,
        graph: &mut Graph,
        context: &mut Context<'_>,
        index: usize,
        id: StateId,
        visit: u32,
        outcome: Outcome,
        variables: usize,
    ) {
        let own = context.plan.state(id);
        // The task's outputs may use the task's own variables.
        let state = context.program.state(id);
        let of_loop = if state.is_loop() { state.variables.len() } else { 0 };
        let kept = if id == Program::ROOT { usize::MAX } else { variables.saturating_sub(of_loop) };
        if own.exits & (1 << outcome) != 0 {
            let what = What::Marker(Role::Exit, outcome);
            let instance = self.append(graph, context, index, state, what, (visit, None));
            graph.single_arm(instance, 1);
            self.cursors[index].environment.variables.truncate(kept);
            let operated: &[Predicate] = if outcome == 0 { &own.operated } else { &[] };
            let writes: Vec<Predicate> = own.effect_predicates[outcome].iter().chain(operated).copied().collect();
            let link = Link { writer: instance, outcome, vague: false };
            let written = &own.effects_written[outcome];
            self.come_after(graph, context, index, instance, link, (&writes, written));
        }
        let cursor = &mut self.cursors[index];
        cursor.environment.variables.truncate(kept);
        cursor.todo = Todo::Leave(id, outcome);
    }

    pub(super) fn end_of_task(&mut self, graph: &mut Graph, context: &mut Context<'_>, index: usize, outcome: &str) {
        let root = context.plan.state(Program::ROOT);
        let outcome = root.outcome(outcome).unwrap_or(root.outcomes.len() - 2);
        let state = context.program.state(Program::ROOT);
        self.append(graph, context, index, state, What::Marker(Role::End, outcome), (1, None));
        self.cursors[index].todo = Todo::Done;
    }
}
