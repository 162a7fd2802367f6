//! The walk over the tree of states: which node comes next, and what composite states do at their ends.

use super::{Frame, Interpreter, Progress};
use crate::binding::{self, Outputs, child_path};
use crate::context::Context;
use crate::effects;
use ratn_model::id::{InstanceId, StateId};
use ratn_model::program::{ABORTED, PREEMPTED, SUCCESS, State, StateKind};
use ratn_model::value::Value;

impl Interpreter {
    /// Leaves sequences that are done, until an action has begun or all is done.
    pub(super) fn advance(&mut self, context: &mut Context<'_>) -> Progress {
        loop {
            if self.current.is_some() {
                return Progress::Busy;
            }
            let step = match self.frames.last_mut() {
                None => return Progress::Ended { outcome: SUCCESS.to_owned(), reason: String::new() },
                Some(Frame::List { children, next, path, .. }) if *next < children.len() => {
                    *next += 1;
                    Some((children[*next - 1], path.clone()))
                }
                Some(Frame::Loop { state, elements, next, path }) if *next < elements.len() => {
                    *next += 1;
                    let (index, element) = (*next - 1, elements[*next - 1].clone());
                    let (state, path) = (*state, format!("{path}[{index}]"));
                    self.iterate(context, state, index, element, path);
                    None
                }
                Some(_) => match self.exit(context) {
                    Ok(()) => None,
                    Err(reason) => return self.leave(context, ABORTED, reason),
                },
            };
            if let Some((child, path)) = step {
                let path = child_path(&path, &context.program.state(child).name);
                if let Err(reason) = self.enter(context, child, &path) {
                    return self.leave(context, ABORTED, reason);
                }
            }
        }
    }

    pub(super) fn iterate(
        &mut self,
        context: &Context<'_>,
        state: StateId,
        index: usize,
        element: Value,
        path: String,
    ) {
        if let StateKind::ForEach { variable, index: counter, body, .. } = &context.program.state(state).kind {
            self.unbind(variable, counter.as_deref());
            self.variables.push((variable.clone(), element));
            if let Some(counter) = counter {
                self.variables.push((counter.clone(), Value::Int(index as i64)));
            }
            self.frames.push(Frame::List { state, children: body.clone(), next: 0, path });
        }
    }

    pub(super) fn unbind(&mut self, variable: &str, counter: Option<&str>) {
        while self.variables.last().is_some_and(|(n, _)| n == variable || Some(n.as_str()) == counter) {
            self.variables.pop();
        }
    }

    pub(super) fn enter(&mut self, context: &mut Context<'_>, id: StateId, path: &str) -> Result<(), String> {
        let program = context.program;
        let state = program.state(id);
        let unmet = self.with_scope(context, None, |scope| binding::unmet(state, scope)).map_err(|e| e.reason())?;
        if let Some(reason) = unmet {
            return Err(reason);
        }
        match &state.kind {
            StateKind::Action { .. } => return self.begin(context, id, path),
            StateKind::Sequence { children, .. } => {
                let children = children.clone();
                self.frames.push(Frame::List { state: id, children, next: 0, path: path.to_owned() });
            }
            StateKind::ForEach { collection, .. } => {
                match self.with_scope(context, None, |s| collection.evaluate(s)).map_err(|e| e.to_string())? {
                    Value::List(elements) => {
                        self.frames.push(Frame::Loop { state: id, elements, next: 0, path: path.to_owned() });
                    }
                    other => return Err(format!("{path} loops over a {}, not a list", other.type_name())),
                }
            }
            StateKind::While { .. } | StateKind::Concurrency { .. } => {
                return Err(format!("{path}: no such state is executed yet"));
            }
            StateKind::Condition { predicate, then, otherwise } => {
                let taken = self.with_scope(context, None, |s| predicate.holds(s)).map_err(|e| e.to_string())?;
                let children = if taken { then.clone() } else { otherwise.clone() };
                self.frames.push(Frame::List { state: id, children, next: 0, path: path.to_owned() });
            }
        }
        Ok(())
    }

    /// The innermost frame is done: its state's outputs, effects and resource operations happen.
    pub(super) fn exit(&mut self, context: &mut Context<'_>) -> Result<(), String> {
        let Some(frame) = self.frames.pop() else { return Ok(()) };
        let program = context.program;
        let id = match frame {
            Frame::List { state, .. } | Frame::Loop { state, .. } => state,
        };
        match (&program.state(id).kind, frame) {
            (StateKind::ForEach { .. }, Frame::List { .. }) => return Ok(()),
            (StateKind::ForEach { variable, index, .. }, Frame::Loop { .. }) => {
                self.unbind(variable, index.as_deref());
            }
            (StateKind::Sequence { outputs, .. }, _) => {
                let mut written = Outputs::new();
                for output in outputs {
                    let value = self.with_scope(context, None, |s| output.value.evaluate(s));
                    written.insert(output.name.clone(), value.map_err(|e| format!("output `{}`: {e}", output.name))?);
                }
                self.outputs.insert(id, written);
            }
            _ => {}
        }
        self.hierarchy_effects(context, program.state(id), SUCCESS)?;
        self.operate(context, program.state(id), InstanceId(0), self.outputs.get(&id).cloned())
    }

    /// A hierarchy's own effects for an outcome.
    pub(super) fn hierarchy_effects(
        &mut self,
        context: &mut Context<'_>,
        state: &State,
        outcome: &str,
    ) -> Result<(), String> {
        let Some(declared) = state.annotations.effects.get(outcome) else { return Ok(()) };
        let outputs = self.outputs.get(&state.id).cloned();
        let changes = self
            .with_scope(context, outputs.as_ref(), |s| effects::actual(Some(declared), outcome, &[], s))
            .map_err(|e| e.to_string())?;
        self.apply(context, InstanceId(0), changes)
    }

    /// An outcome that is not success leaves every state around by the same name.
    pub(super) fn leave(&mut self, context: &mut Context<'_>, outcome: &str, mut reason: String) -> Progress {
        if self.current.is_some() {
            let frames = std::mem::take(&mut self.frames);
            self.abort(context);
            self.frames = frames;
        }
        while let Some(frame) = self.frames.pop() {
            let id = match frame {
                Frame::List { state, .. } | Frame::Loop { state, .. } => state,
            };
            let state = context.program.state(id);
            if matches!(state.kind, StateKind::Sequence { .. })
                && let Err(problem) = self.hierarchy_effects(context, state, outcome)
            {
                reason = format!("{reason}; then {}: {problem}", state.path);
            }
        }
        debug_assert!(outcome != SUCCESS, "only another outcome than success leaves before the end");
        debug_assert!(outcome != PREEMPTED || !reason.is_empty(), "a preemption says who asked for it");
        Progress::Ended { outcome: outcome.to_owned(), reason }
    }
}
