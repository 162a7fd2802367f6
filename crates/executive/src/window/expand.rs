//! Growing the window: a cursor walks the program along its transitions and appends instances, until the horizon.
//!
//! What is appended: `append`. Loops: `iterate`. Where there are several ways on: `branch`. Regions: `concurrency`.

use super::Window;
use super::cursor::Todo;
use super::environment::{Binding, Frame, Iteration};
use super::instance::Role;
use crate::context::{Context, in_circles};
use crate::plan::{Outcome, Predicate};
use ratn_model::expression::scope::NothingKnown;
use ratn_model::id::StateId;
use ratn_model::program::{ABORTED, Program, SUCCESS, StateKind, Target};
use std::sync::Arc;

/// A path that goes on for so many steps without doing anything goes in circles.
const MAX_IDLE_STEPS: usize = 10_000;

impl Window {
    /// Grows at every cursor that may; whether anything came of it.
    pub(super) fn expand(&mut self, context: &mut Context<'_>) -> bool {
        let mut grew = false;
        'again: loop {
            if !self.forks.is_empty() {
                self.join_regions(context);
            }
            if self.branches.is_empty()
                && let [only] = self.cursors.as_slice()
                && only.todo != Todo::Done
            {
                while matches!(self.cursors.as_slice(), [only] if only.todo != Todo::Done)
                    && self.may_grow(context.program, 0)
                {
                    grew = true;
                    self.step(context, 0);
                }
                if let [only] = self.cursors.as_slice()
                    && only.todo != Todo::Done
                    && self.forks.is_empty()
                {
                    return grew;
                }
                self.cursors.retain(|cursor| cursor.todo != Todo::Done);
            }
            for index in self.awake() {
                let cursors = self.cursors.len();
                while self.may_grow(context.program, index) {
                    grew = true;
                    self.step(context, index);
                    if self.cursors.len() != cursors || self.cursors[index].todo == Todo::Done {
                        self.cursors.retain(|cursor| cursor.todo != Todo::Done);
                        continue 'again;
                    }
                }
            }
            return grew;
        }
    }

    /// The cursors on certain paths and on expanded branches. Branches are expanded, the likelier ones first, until there are
    /// as many as the speculation width says.
    fn awake(&mut self) -> Vec<usize> {
        let mut expanded = self.branches.values().filter(|branch| branch.expanded).count();
        while expanded < self.speculation_width {
            let dormant = self.branches.iter().filter(|(_, branch)| !branch.expanded);
            let likeliest = dormant.max_by(|(a, x), (b, y)| x.probability.total_cmp(&y.probability).then(b.cmp(a)));
            let Some(segment) = likeliest.map(|(segment, _)| *segment) else { break };
            if let Some(branch) = self.branches.get_mut(&segment) {
                branch.expanded = true;
            }
            expanded += 1;
        }
        let mut all: Vec<usize> = (0..self.cursors.len())
            .filter(|index| self.branches.get(&self.cursors[*index].segment).is_none_or(|branch| branch.expanded))
            .collect();
        all.sort_by_key(|index| self.cursors[*index].order);
        all
    }

    fn may_grow(&self, program: &Program, index: usize) -> bool {
        let cursor = &self.cursors[index];
        if matches!(cursor.todo, Todo::Await(_) | Todo::Done) {
            return false;
        }
        let floor = self.threads.get(&cursor.line).map_or(0, |thread| thread.floor);
        cursor.position < floor + program.horizon.max(1) as u64
    }

    fn step(&mut self, context: &mut Context<'_>, index: usize) {
        let cursor = &mut self.cursors[index];
        cursor.idle += 1;
        if cursor.idle > MAX_IDLE_STEPS {
            let path = cursor.environment.frames.as_ref().map_or("", |frame| &frame.path);
            cursor.because = Some(in_circles(path).into());
            self.end_of_task(context, index, ABORTED);
            return;
        }
        match std::mem::replace(&mut cursor.todo, Todo::Done) {
            Todo::Enter(state) => self.enter(context, index, state),
            Todo::Leave(state, outcome) => self.follow(context, index, state, outcome),
            Todo::Exit { state, visit, outcome, variables } => {
                self.exit(context, index, state, visit, outcome, variables);
            }
            Todo::Iterate => self.iterate(context, index),
            todo @ (Todo::Await(_) | Todo::Done) => self.cursors[index].todo = todo,
        }
    }

    fn enter(&mut self, context: &mut Context<'_>, index: usize, id: StateId) {
        let state = context.program.state(id);
        let plan = self.plan.clone();
        let own = plan.state(id);
        let visit = self.count_visit(index, id);
        if own.is_node {
            let instance = self.append(context, index, state, Role::Node, visit, None, 0);
            self.branch_by_outcome(context, index, instance, id);
            return;
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
            let entry = self.append(context, index, state, Role::Entry, visit, None, 0);
            self.single_arm(index, entry);
            self.instances.get(entry).and_then(|i| i.producer.clone())
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
            StateKind::Sequence { children, .. } => self.begin_list(index, id, visit, path, base, children),
            StateKind::ForEach { .. } => {
                let instance = self.append(context, index, state, Role::Loop, visit, None, 0);
                self.single_arm(index, instance);
                self.cursors[index].todo = Todo::Await(instance);
            }
            StateKind::While { body_first, .. } => {
                let frame = self.frame(index, id, visit, path, base, Some(Iteration { index: 0, elements: None }));
                self.cursors[index].environment.frames = Some(frame);
                if *body_first {
                    self.begin_iteration(index, context.program);
                } else {
                    self.cursors[index].todo = Todo::Iterate;
                    if let Some(frame) = self.top_frame(index)
                        && let Some(iteration) = &mut frame.iteration
                    {
                        // Iterating counts on from here.
                        iteration.index = usize::MAX;
                    }
                }
            }
            StateKind::Condition { .. } => {
                let instance = self.append(context, index, state, Role::Condition, visit, None, 0);
                self.branch_on_condition(context, index, instance, visit);
            }
            StateKind::Concurrency { regions, .. } => {
                self.fork(context, index, state, visit, &path, base, regions);
            }
        }
    }

    fn count_visit(&mut self, index: usize, id: StateId) -> u32 {
        let plan = self.plan.clone();
        let Some(frame) = &self.cursors[index].environment.frames else { return 1 };
        if !plan.state(frame.owner).repeats {
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
        Arc::new(Frame { below, owner, visit, path, visits: Vec::new(), iteration, variables, fork: None })
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
    fn follow(&mut self, context: &mut Context<'_>, index: usize, id: StateId, outcome: Outcome) {
        let plan = self.plan.clone();
        if id == Program::ROOT {
            let name = plan.state(id).outcomes[outcome].clone();
            self.end_of_task(context, index, &name);
            return;
        }
        let by = match &plan.state(id).targets[outcome] {
            Target::State(next) => {
                self.cursors[index].todo = Todo::Enter(*next);
                return;
            }
            Target::Outcome(by) => by,
        };
        let Some(frame) = self.cursors[index].environment.frames.clone() else { return };
        if let Some(fork) = frame.fork {
            self.end_region(context, index, fork, id, by);
            return;
        }
        let is_loop =
            matches!(context.program.state(frame.owner).kind, StateKind::ForEach { .. } | StateKind::While { .. });
        if is_loop && by == SUCCESS {
            self.cursors[index].todo = Todo::Iterate;
            return;
        }
        let outcome = plan.state(frame.owner).outcome(by).unwrap_or_else(|| plan.state(frame.owner).outcomes.len() - 2);
        self.leave_frame(index, outcome);
    }

    /// The innermost list has ended by an outcome of its owner.
    pub(super) fn leave_frame(&mut self, index: usize, outcome: Outcome) {
        let cursor = &mut self.cursors[index];
        let Some(frame) = cursor.environment.frames.clone() else { return };
        cursor.environment.frames = frame.below.clone();
        let variables = frame.variables;
        cursor.todo = Todo::Exit { state: frame.owner, visit: frame.visit, outcome, variables };
    }

    fn exit(
        &mut self,
        context: &mut Context<'_>,
        index: usize,
        id: StateId,
        visit: u32,
        outcome: Outcome,
        variables: usize,
    ) {
        let plan = self.plan.clone();
        let own = plan.state(id);
        // The task's own variables are seen by its outputs.
        let kept = if id == Program::ROOT { usize::MAX } else { variables };
        if own.exits & (1 << outcome) != 0 {
            let state = context.program.state(id);
            let instance = self.append(context, index, state, Role::Exit, visit, None, outcome);
            self.single_arm(index, instance);
            self.cursors[index].environment.variables.truncate(kept);
            let links: Vec<Predicate> = own.effect_predicates[outcome]
                .iter()
                .chain(if outcome == 0 { &own.operated[..] } else { &[] })
                .copied()
                .collect();
            self.come_after(index, instance, id, outcome, false, &links);
        }
        let cursor = &mut self.cursors[index];
        cursor.environment.variables.truncate(kept);
        cursor.todo = Todo::Leave(id, outcome);
    }

    fn end_of_task(&mut self, context: &mut Context<'_>, index: usize, outcome: &str) {
        let plan = self.plan.clone();
        let root = plan.state(Program::ROOT);
        let outcome = root.outcome(outcome).unwrap_or(root.outcomes.len() - 2);
        self.append(context, index, context.program.state(Program::ROOT), Role::End, 1, None, outcome);
        self.cursors[index].todo = Todo::Done;
    }
}
