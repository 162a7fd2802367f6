//! Growing the window: a cursor walks the program along its transitions and appends instances, until the horizon.
//!
//! An instance with several ways on gets an arm for each; each arm has a cursor. What follows the same condition on both arms
//! is expanded twice: they are two futures.

use super::Window;
use super::cursor::{Cursor, Todo};
use super::environment::{Binding, Frame, Iteration, Link, Producer};
use super::instance::{Arm, Instance, Role, Segment, Status, Wait, gives_outputs};
use super::plan::{Outcome, Predicate};
use super::segment::Branch;
use crate::analysis::NodeNature;
use crate::context::{Context, in_circles};
use crate::protocol::Note;
use ratn_model::expression::scope::NothingKnown;
use ratn_model::id::{InstanceId, StateId};
use ratn_model::program::{ABORTED, Program, SUCCESS, State, StateKind, Target};
use ratn_model::time::Timestamp;
use ratn_model::value::Value;
use smallvec::{SmallVec, smallvec};
use std::cell::Cell;
use std::sync::{Arc, OnceLock};

/// A path that goes on for so many steps without doing anything goes in circles.
const MAX_IDLE_STEPS: usize = 10_000;

/// Duration assumed of a node that says none, in seconds.
const DEFAULT_DURATION_S: f32 = 1.0;

/// How likely a connected failure is, unless it was learned.
const FAILURE: f32 = 0.1;

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

    fn top_frame(&mut self, index: usize) -> Option<&mut Frame> {
        self.cursors[index].environment.frames.as_mut().map(Arc::make_mut)
    }

    fn frame(
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

    /// The list of a loop is known: its iterations begin.
    pub(super) fn unroll(&mut self, context: &Context<'_>, waits_for: InstanceId, elements: Vec<Value>) {
        let Some(index) = self.cursors.iter().position(|cursor| cursor.todo == Todo::Await(waits_for)) else { return };
        let Some(instance) = self.instances.get(waits_for) else { return };
        let (state, visit) = (context.program.state(instance.state), instance.visit);
        let path: Arc<str> = self.cursors[index].environment.path(&state.name, visit, None).into();
        let base = self.cursors[index].environment.variables.len();
        let iteration = Iteration { index: usize::MAX, elements: Some(Arc::new(elements)) };
        let frame = self.frame(index, state.id, visit, path, base, Some(iteration));
        let cursor = &mut self.cursors[index];
        cursor.environment.frames = Some(frame);
        cursor.todo = Todo::Iterate;
    }

    /// The innermost loop goes on to its next iteration, or ends.
    fn iterate(&mut self, context: &mut Context<'_>, index: usize) {
        let program = context.program;
        let Some(frame) = self.top_frame(index) else { return };
        let (owner, visit, base) = (frame.owner, frame.visit, frame.variables);
        let Some(iteration) = &mut frame.iteration else { return };
        iteration.index = iteration.index.wrapping_add(1);
        let (number, elements) = (iteration.index, iteration.elements.clone());
        frame.visits.clear();
        match elements {
            Some(elements) if number < elements.len() => self.begin_iteration(index, program),
            Some(_) => self.leave_frame(index, 0),
            None => {
                let state = program.state(owner);
                // The test stands where the loop stands, not in its body.
                let environment = &mut self.cursors[index].environment;
                environment.variables.truncate(base);
                let inside = environment.frames.clone();
                environment.frames = inside.as_ref().and_then(|frame| frame.below.clone());
                environment.test = Some(Box::new((owner, Iteration { index: number, elements: None })));
                let test = self.append(context, index, state, Role::Test, visit, Some(number), 0);
                self.cursors[index].environment.test = None;
                self.branch_on_test(context, index, test, visit, number);
            }
        }
    }

    /// The first state of the innermost loop's body is next.
    fn begin_iteration(&mut self, index: usize, program: &Program) {
        let Some(frame) = &self.cursors[index].environment.frames else { return };
        let body = match &program.state(frame.owner).kind {
            StateKind::ForEach { body, .. } | StateKind::While { body, .. } => body.first(),
            _ => None,
        };
        let base = frame.variables;
        self.cursors[index].environment.variables.truncate(base);
        self.cursors[index].todo = body.map_or(Todo::Iterate, |first| Todo::Enter(*first));
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
    fn leave_frame(&mut self, index: usize, outcome: Outcome) {
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

    /// The environment behind an instance that ends by an outcome.
    pub(super) fn come_after(
        &mut self,
        index: usize,
        instance: InstanceId,
        id: StateId,
        outcome: Outcome,
        vague: bool,
        writes: &[Predicate],
    ) {
        let producer = self.instances.get(instance).and_then(|i| i.producer.clone());
        for predicate in writes {
            let link = Link { writer: instance, outcome, vague };
            self.cursors[index].environment.writers.set(*predicate, Some(link));
        }
        self.produce(index, producer, id, outcome);
    }

    /// Its outputs and what it assigns are seen from here on.
    pub(super) fn produce(&mut self, index: usize, producer: Option<Arc<Producer>>, id: StateId, outcome: Outcome) {
        let plan = self.plan.clone();
        let own = plan.state(id);
        let environment = &mut self.cursors[index].environment;
        let good = gives_outputs(&own.outcomes[outcome]);
        if let Some(producer) = producer {
            if own.is_read && good {
                environment.producers.set(id.0 as usize, Some(producer.clone()));
            }
            if good || own.is_routine {
                for name in &own.assigns {
                    environment.variables.assign(name, Binding::Assigned(producer.clone()));
                }
            }
        }
    }

    /// The arms of a node: one per target of the outcomes that are computed ahead.
    fn branch_by_outcome(&mut self, context: &Context<'_>, index: usize, instance: InstanceId, id: StateId) {
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
                None if matches!(*name, ABORTED | ratn_model::program::PREEMPTED) => FAILURE,
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

    #[expect(clippy::too_many_arguments, reason = "all of it is one visit")]
    pub(super) fn append(
        &mut self,
        context: &mut Context<'_>,
        index: usize,
        state: &State,
        role: Role,
        visit: u32,
        iteration: Option<usize>,
        leaves_by: Outcome,
    ) -> InstanceId {
        let id = context.new_instance();
        let plan = self.plan.clone();
        let own = plan.state(state.id);
        let cursor = &mut self.cursors[index];
        cursor.idle = 0;
        let (line, segment, position) = (cursor.line, cursor.segment, cursor.position);
        cursor.position += 1;
        let environment = cursor.environment.clone();
        let tail = cursor.tail.replace((id, 0));
        let left_because = cursor.because.clone();
        let writes_outputs = match role {
            Role::Node | Role::Exit => own.is_read || !own.assigns.is_empty(),
            Role::Entry | Role::RegionEnd => true,
            _ => false,
        };
        // The first of a line, and what follows one that others were let pass, is nobody's next in line.
        let mut is_next = false;
        if let Some((tail, arm)) = tail
            && let Some(older) = self.instances.get_mut(tail)
        {
            is_next = older.role != Role::Fork && !older.detached;
            if let Some(arm) = older.arms.get_mut(arm) {
                arm.next = Some(id);
            }
        }
        let nature = match role {
            Role::Node => context.analysis.state(state.id).nature,
            _ => NodeNature::Computes,
        };
        let duration_s = match role {
            Role::Node => self.learned.durations_s.get(&state.path).map_or(DEFAULT_DURATION_S, |s| *s as f32),
            _ => 0.0,
        };
        self.instances.push(Instance {
            id,
            state: state.id,
            visit,
            iteration,
            role,
            nature,
            environment,
            producer: writes_outputs.then(|| Arc::new(Producer { instance: id, real: OnceLock::new() })),
            line,
            segment,
            position,
            arms: SmallVec::new(),
            leaves_by,
            left_because,
            is_head: false,
            detached: false,
            queued: false,
            status: Status::Expanded,
            wait: Wait::Nothing,
            attempt: 1,
            tries: 1,
            has_acted: false,
            crashes: 0,
            not_before: Timestamp(0),
            began: Timestamp(0),
            lease: None,
            projection: None,
            ended: None,
            settled: Cell::new(false),
            routine: None,
            seen: None,
            waiters: SmallVec::new(),
            users: SmallVec::new(),
            duration_s,
            remaining_s: duration_s,
            advised: false,
            asked_with: 0,
        });
        if !is_next && role != Role::Join {
            self.set_head(line, Some(id));
        }
        let speculative = match self.branches.get_mut(&segment) {
            Some(branch) => {
                branch.members.push(id);
                true
            }
            None => false,
        };
        if role == Role::Node {
            let path = self.path(context.program, id);
            context.note(Note::Expanded { instance: id, state: state.id, path, speculative });
        }
        self.grown_since_estimate += 1;
        self.enqueue(id);
        id
    }
}
