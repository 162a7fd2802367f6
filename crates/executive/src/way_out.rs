//! The way out of a run that is aborted or over its deadline: its remaining `finally` blocks.
//!
//! The entered states that have a `finally` are left one after the other, the innermost first. First the states inside declare how being cut
//! short changed the world (`effects: {preempted: […]}`), then the `finally` block is executed, by the sequential interpreter on the actual
//! world, in both modes. A `finally` that was already under way is begun again. Then the run ends.
//!
//! ```text
//! told to end ─► what is under way is cancelled ─► each `finally`, the innermost first ─► the end
//!                                                     └─ told again, or after 60 s: cancelled ─┘
//! ```
//!
//! Outcome and reason are those of the first request. A `finally` that fails is added to the reason; the others are still executed.

use crate::binding::{Outputs, child_path};
use crate::context::Context;
use crate::hold::Hold;
use crate::interpreter::{Interpreter, Progress};
use crate::protocol::{Command, Event};
use crate::turn::Turn;
use crate::window::End;
use ratn_model::id::StateId;
use ratn_model::program::{ABORTED, PREEMPTED, Program, SUCCESS};
use ratn_model::time::Timestamp;
use ratn_model::value::Value;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::time::Duration;

/// Limit of the way out, in seconds of the robot's time: then the run ends, whatever is under way.
const LIMIT_S: u64 = 60;

/// The states to be left.
#[derive(Debug, Default, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct WayOut {
    scopes: Vec<Scope>,
    steps: Vec<Step>,
    /// The operator's pause and breakpoints.
    pub(crate) hold: Hold,
}

/// A state that is entered and not left: its path, and how often its `finally` was begun.
pub(crate) type Place = (StateId, String, u32);

/// The states that a routine's thread is in, the innermost first, with the variables and outputs in scope.
#[derive(Default)]
pub(crate) struct Within {
    pub(crate) places: Vec<Place>,
    pub(crate) variables: Vec<(String, Value)>,
    pub(crate) outputs: BTreeMap<StateId, Outputs>,
}

/// The scope at the place of a thread of control.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct Scope {
    variables: Vec<(String, Value)>,
    outputs: BTreeMap<StateId, Outputs>,
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct Step {
    scope: usize,
    /// The state to leave, or the `finally` state to execute.
    state: StateId,
    path: String,
    is_finally: bool,
    /// Depth in the tree of states.
    depth: usize,
}

impl WayOut {
    /// Adds the states that a thread of control is in, the innermost first.
    pub(crate) fn add(
        &mut self,
        program: &Program,
        entered: impl Iterator<Item = Place>,
        variables: impl FnOnce() -> Vec<(String, Value)>,
        outputs: impl FnOnce() -> BTreeMap<StateId, Outputs>,
    ) {
        let around = |id: StateId| std::iter::successors(program.state(id).parent, |id| program.state(*id).parent);
        let finally = |id: StateId| program.state(id).annotations.finally.as_ref()?.lastly.get(PREEMPTED).copied();
        let scope = self.scopes.len();
        let before = self.steps.len();
        for (owner, path, visits) in entered {
            let depth = around(owner).count();
            match finally(owner) {
                Some(state) => {
                    let name = &program.state(state).name;
                    let name = if visits == 0 { name.clone() } else { format!("{name}#{}", visits + 1) };
                    let path = child_path(&path, &name);
                    self.steps.push(Step { scope, state, path, is_finally: true, depth });
                }
                None if around(owner).any(|id| finally(id).is_some()) => {
                    self.steps.push(Step { scope, state: owner, path, is_finally: false, depth });
                }
                None => {}
            }
        }
        if self.steps.len() > before {
            self.scopes.push(Scope { variables: variables(), outputs: outputs() });
        }
    }

    /// Whether there is nothing to do.
    pub(crate) fn is_empty(&self) -> bool {
        self.steps.is_empty()
    }
}

/// A run on its way out.
#[derive(Serialize, Deserialize)]
pub(crate) struct Leaving {
    end: End,
    /// Remaining steps, the next one last.
    steps: Vec<Step>,
    scopes: Vec<Scope>,
    hold: Hold,
    /// The present `finally`, with the index of its scope.
    current: Option<(usize, Box<Interpreter>)>,
    until: Timestamp,
    /// Time of the last event.
    last: Timestamp,
    /// The user has asked to end the run; a second request ends it at once.
    is_asked: bool,
}

impl Leaving {
    /// Begins the way out; returns the run's end if there is nothing to wait for.
    pub(crate) fn begin(context: &mut Context<'_>, mut end: End) -> Result<Leaving, Box<End>> {
        let WayOut { scopes, mut steps, hold } = std::mem::take(&mut end.way_out);
        steps.sort_by_key(|step| (step.depth, std::cmp::Reverse(step.state)));
        let until = context.now + Duration::from_secs(LIMIT_S);
        let is_asked = end.outcome == PREEMPTED;
        let mut leaving = Leaving { end, steps, scopes, hold, current: None, until, last: context.now, is_asked };
        match leaving.go_on(context) {
            Some(end) => Err(Box::new(end)),
            None => {
                context.commands.push(Command::Wake { at: until });
                Ok(leaving)
            }
        }
    }

    /// Handles an event; returns the end of the run if this event ended it.
    pub(crate) fn handle(&mut self, context: &mut Context<'_>, event: Event) -> Option<End> {
        let before = std::mem::replace(&mut self.last, context.now);
        match event {
            // Time while task control was down does not count against the limit.
            Event::Resumed { .. } => {
                self.until = self.until + context.now.since(before);
                context.commands.push(Command::Wake { at: self.until });
            }
            // First request by the user of a run that is over its deadline.
            Event::AbortRequested { at_once: false, .. } if !self.is_asked => self.is_asked = true,
            Event::AbortRequested { reason, .. } => return self.cut_short(context, &reason),
            Event::RetirementFailed { reason, .. } => {
                ABORTED.clone_into(&mut self.end.outcome);
                return self.cut_short(context, &format!("what had happened could not be recorded: {reason}"));
            }
            _ if self.until <= context.now => {
                return self.cut_short(context, &format!("its way out took longer than {LIMIT_S} s"));
            }
            event => {
                let (_, interpreter) = self.current.as_mut()?;
                let progress = interpreter.handle(context, event);
                self.ended(progress);
            }
        }
        self.go_on(context)
    }

    /// The turns of the waits under way.
    pub(crate) fn waits(&self, program: &Program) -> Vec<Turn> {
        self.current.iter().flat_map(|(_, interpreter)| interpreter.waits(program, 0)).collect()
    }

    /// The breakpoints; see [`crate::executive::Executive::breakpoints`].
    pub(crate) fn breakpoints(&self) -> &[String] {
        self.current.as_ref().map_or(self.hold.breakpoints(), |(_, interpreter)| interpreter.breakpoints())
    }

    /// Executes the next steps until there is something to wait for.
    fn go_on(&mut self, context: &mut Context<'_>) -> Option<End> {
        while self.current.is_none() {
            let Some(Step { scope, state, path, is_finally, .. }) = self.steps.pop() else {
                return Some(self.end.clone());
            };
            let Some(Scope { variables, outputs }) = self.scopes.get(scope).cloned() else { continue };
            let mut interpreter = Box::new(Interpreter::on_the_way_out(variables, outputs, self.hold.clone()));
            if is_finally {
                let progress = interpreter.start(context, state, &path);
                self.current = Some((scope, interpreter));
                self.ended(progress);
            } else if let Err(problem) = interpreter.leave(context, state, &path) {
                self.tell(&problem);
            }
        }
        None
    }

    /// Ends the current step if it has finished; later steps see the variables that it assigned.
    fn ended(&mut self, progress: Progress) {
        let Progress::Ended { outcome, reason } = progress else { return };
        let Some((scope, interpreter)) = self.current.take() else { return };
        let (variables, outputs, hold) = interpreter.into_scope();
        if let Some(scope) = self.scopes.get_mut(scope) {
            *scope = Scope { variables, outputs };
        }
        self.hold = hold;
        if outcome != SUCCESS {
            self.tell(if reason.is_empty() { &outcome } else { &reason });
        }
    }

    /// Ends the run at once.
    fn cut_short(&mut self, context: &mut Context<'_>, why: &str) -> Option<End> {
        if let Some((_, mut interpreter)) = self.current.take() {
            interpreter.abort(context);
        }
        self.tell(why);
        Some(self.end.clone())
    }

    fn tell(&mut self, problem: &str) {
        self.end.reason = format!("{}; on the way out: {problem}", self.end.reason);
    }
}
