//! Expansion: from the tree of states to instances, along every branch that may be taken.
//!
//! A cursor is a place in the program from which the window grows. At a condition it splits; at a loop it waits for the
//! list. It stops at the horizon and behind too many undecided conditions, and goes on as older instances retire.

use crate::analysis::NodeNature;
use crate::binding::child_path;
use crate::context::Context;
use crate::protocol::Note;
use crate::window::Window;
use crate::window::instance::{Environment, Instance, Role, Status, Wait};
use imbl::OrdMap;
use ratn_model::fact::Footprint;
use ratn_model::id::{InstanceId, StateId};
use ratn_model::program::{Program, State, StateKind};
use ratn_model::value::Value;
use std::sync::Arc;

/// How many undecided conditions a path may have behind which it is still expanded.
pub(crate) const MAX_UNDECIDED: usize = 3;

/// Duration assumed of a node that says none, in seconds.
const DEFAULT_DURATION_S: f64 = 1.0;

#[derive(Clone)]
pub(crate) struct Cursor {
    frames: Vec<Frame>,
    environment: Environment,
    /// The youngest instance on its path; may have retired since.
    pub(crate) tail: Option<InstanceId>,
    /// The branch it is on, when `tail` is an undecided condition.
    pub(crate) assumption: Option<bool>,
    /// The loop whose list it waits for.
    waits_for: Option<InstanceId>,
}

#[derive(Clone)]
enum Frame {
    /// Children of a composite (for a condition: of one branch; for a loop: of one iteration).
    List { state: StateId, which: Which, next: usize, path: String },
    /// The iterations of a loop; what `$name` meant before it.
    Loop { state: StateId, elements: Arc<Vec<Value>>, next: usize, path: String, before: OrdMap<String, Value> },
}

#[derive(Clone, Copy, PartialEq, Eq)]
enum Which {
    Children,
    Body,
    Then,
    Otherwise,
}

impl Cursor {
    /// At the beginning of the program.
    pub(crate) fn start(parameters: impl IntoIterator<Item = (String, Value)>) -> Cursor {
        let environment = Environment { variables: parameters.into_iter().collect(), producers: OrdMap::new() };
        let root = Frame::List { state: Program::ROOT, which: Which::Children, next: 0, path: String::new() };
        Cursor { frames: vec![root], environment, tail: None, assumption: None, waits_for: None }
    }

    /// The loop's list is known.
    pub(crate) fn unroll(&mut self, window: InstanceId, state: StateId, elements: Vec<Value>, path: String) {
        if self.waits_for == Some(window) {
            self.waits_for = None;
            let before = self.environment.variables.clone();
            self.frames.push(Frame::Loop { state, elements: Arc::new(elements), next: 0, path, before });
        }
    }

    /// The producers that what it will expand can still name.
    pub(crate) fn producers(&self) -> impl Iterator<Item = InstanceId> {
        self.environment.producers.values().copied()
    }
}

fn list(program: &Program, state: StateId, which: Which) -> &[StateId] {
    match (&program.state(state).kind, which) {
        (StateKind::Sequence { children, .. }, _) => children,
        (StateKind::ForEach { body, .. }, _) => body,
        (StateKind::Condition { then, .. }, Which::Then) => then,
        (StateKind::Condition { otherwise, .. }, _) => otherwise,
        _ => &[],
    }
}

impl Window {
    /// Grows the window at every cursor as far as it may; whether it grew.
    pub(crate) fn expand(&mut self, context: &mut Context<'_>) -> bool {
        let mut grew = false;
        let mut index = 0;
        while index < self.cursors.len() {
            while self.may_grow(context.program, index) && self.step(context, index) {
                grew = true;
            }
            index += 1;
        }
        self.cursors.retain(|cursor| !cursor.frames.is_empty());
        grew
    }

    fn may_grow(&self, program: &Program, index: usize) -> bool {
        let cursor = &self.cursors[index];
        if cursor.frames.is_empty() || cursor.waits_for.is_some() {
            return false;
        }
        let (mut length, mut undecided) = (0, 0);
        let mut at = cursor.tail.and_then(|tail| self.instances.alive.get(&tail));
        while let Some(instance) = at {
            length += 1;
            undecided += usize::from(instance.is_undecided());
            at = instance.older.and_then(|older| self.instances.alive.get(&older));
        }
        length < program.horizon.max(1) && undecided <= MAX_UNDECIDED
    }

    /// One step of a cursor; false when it cannot go on now.
    fn step(&mut self, context: &mut Context<'_>, index: usize) -> bool {
        let program = context.program;
        let Some(frame) = self.cursors[index].frames.last_mut() else { return false };
        match frame {
            Frame::List { state, which, next, path } => {
                let children = list(program, *state, *which);
                if let Some(child) = children.get(*next) {
                    *next += 1;
                    let path = child_path(path, &program.state(*child).name);
                    self.enter(context, index, program.state(*child), path);
                    return true;
                }
                let (state, which, path) = (*state, *which, path.clone());
                self.cursors[index].frames.pop();
                if which != Which::Body {
                    self.exit(context, index, program.state(state), path);
                }
            }
            Frame::Loop { state, elements, next, path, before } => {
                let Some(element) = elements.get(*next).cloned() else {
                    let (state, path, before) = (*state, path.clone(), before.clone());
                    self.cursors[index].frames.pop();
                    self.cursors[index].environment.variables = before;
                    self.exit(context, index, program.state(state), path);
                    return true;
                };
                let (state, iteration, path) = (*state, *next, format!("{path}[{next}]"));
                *next += 1;
                if let StateKind::ForEach { variable, index: counter, .. } = &program.state(state).kind {
                    let variables = &mut self.cursors[index].environment.variables;
                    variables.insert(variable.clone(), element);
                    if let Some(counter) = counter {
                        variables.insert(counter.clone(), Value::Int(iteration as i64));
                    }
                }
                self.cursors[index].frames.push(Frame::List { state, which: Which::Body, next: 0, path });
            }
        }
        true
    }

    fn enter(&mut self, context: &mut Context<'_>, index: usize, state: &State, path: String) {
        if matches!(state.kind, StateKind::Action { .. }) || state.annotations.routine {
            let id = self.append(context, index, state, Role::Node, path);
            self.cursors[index].environment.producers.insert(state.id, id);
            return;
        }
        if !state.annotations.requires.is_empty() {
            self.append(context, index, state, Role::Entry, path.clone());
        }
        match &state.kind {
            StateKind::Action { .. } | StateKind::While { .. } | StateKind::Concurrency { .. } => {}
            StateKind::Sequence { .. } => {
                let frame = Frame::List { state: state.id, which: Which::Children, next: 0, path };
                self.cursors[index].frames.push(frame);
            }
            StateKind::ForEach { .. } => {
                let id = self.append(context, index, state, Role::Loop, path);
                self.cursors[index].waits_for = Some(id);
            }
            StateKind::Condition { .. } => {
                self.append(context, index, state, Role::Condition, path.clone());
                let branch = |which| Frame::List { state: state.id, which, next: 0, path: path.clone() };
                let mut other = self.cursors[index].clone();
                other.assumption = Some(false);
                other.frames.push(branch(Which::Otherwise));
                let cursor = &mut self.cursors[index];
                cursor.assumption = Some(true);
                cursor.frames.push(branch(Which::Then));
                self.cursors.push(other);
            }
        }
    }

    /// A composite state is left with success: what it still does at its end.
    fn exit(&mut self, context: &mut Context<'_>, index: usize, state: &State, path: String) {
        let outputs = matches!(&state.kind, StateKind::Sequence { outputs, .. } if !outputs.is_empty());
        let effects = state.annotations.effects.values().any(|effects| !effects.is_empty());
        if outputs || effects || !context.analysis.state(state.id).operations.is_empty() {
            let id = self.append(context, index, state, Role::Exit, path.clone());
            self.cursors[index].environment.producers.insert(state.id, id);
        }
        if state.id == Program::ROOT {
            self.append(context, index, state, Role::End, path);
        }
    }

    fn append(
        &mut self,
        context: &mut Context<'_>,
        index: usize,
        state: &State,
        role: Role,
        path: String,
    ) -> InstanceId {
        let id = context.new_instance();
        let cursor = &mut self.cursors[index];
        let older = cursor.tail.filter(|tail| self.instances.alive.contains_key(tail));
        let assumption = cursor.assumption.take();
        cursor.tail = Some(id);
        let environment = cursor.environment.clone();
        if let Some(instance) = older.and_then(|older| self.instances.alive.get_mut(&older)) {
            instance.next.push(id);
        } else {
            self.oldest = Some(id);
        }
        let nature = match role {
            Role::Node => context.analysis.state(state.id).nature,
            _ => NodeNature::Computes,
        };
        let instance = Instance {
            id,
            state: state.id,
            role,
            nature,
            path: path.clone(),
            environment,
            older,
            assumption,
            next: Vec::new(),
            status: Status::Expanded,
            wait: Wait::Nothing,
            attempt: 1,
            crashes: 0,
            lease: None,
            projection: None,
            ended: None,
            settled: false,
            routine: None,
            duration_s: if role == Role::Node { DEFAULT_DURATION_S } else { 0.0 },
            remaining_s: 0.0,
            reads: Footprint::NOTHING,
            senses: Footprint::NOTHING,
            writes: Footprint::NOTHING,
            seen: None,
        };
        self.instances.alive.insert(id, instance);
        if role == Role::Node {
            let speculative = self.is_speculative(id);
            context.note(Note::Expanded { instance: id, state: state.id, path, speculative });
        }
        id
    }
}
