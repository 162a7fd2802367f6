//! The sequential interpreter: executes a state and what it contains as written, one node after the other.
//!
//! It is HSM mode (from the root, on the actual world), and it runs inside a routine of the window (under the routine's
//! lease, on the actual world or, for a routine that only computes, on a projection). It shares no code with the window's
//! scheduling.
//!
//! ```text
//! one action:  acquiring ─► projecting ─► running ─► its effects are made, the next begins
//!              (none within a routine)  (only with a world model)
//! ```

mod node;
mod walk;

use crate::binding::{Bindings, Names, Outputs};
use crate::context::Context;
use crate::protocol::{Command, Event, Note};
use ratn_model::fact::{Change, Footprint};
use ratn_model::id::{InstanceId, ProjectionId, Revision, StateId};
use ratn_model::program::ABORTED;
use ratn_model::resource::{Lease, Requirement};
use ratn_model::value::Value;
use ratn_world::world::World;
use std::borrow::Cow;
use std::collections::BTreeMap;

/// How often a computing or sensing node is tried when its worker dies, unless the state says otherwise.
pub(crate) const DEFAULT_ATTEMPTS: u32 = 3;

/// Where effects go.
pub(crate) enum Target {
    /// Into the root world.
    Actual,
    /// Into a projection: nothing becomes real.
    Projection {
        /// The root's revision below it.
        base: Revision,
        /// What was changed since, in order: first what older instances will have changed, then what this one has.
        changes: Vec<Change>,
        /// How many of them are the older instances'.
        before: usize,
        /// The result.
        world: World,
    },
}

/// Whether the interpreter is still at it.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Progress {
    /// It waits for events.
    Busy,
    /// It has ended.
    Ended {
        /// The outcome of the state it executes.
        outcome: String,
        /// Why, when that is not success.
        reason: String,
    },
}

enum Frame {
    /// The children of a sequence, or one branch of a condition.
    List { state: StateId, children: Vec<StateId>, next: usize, path: String },
    /// The iterations of a loop.
    Loop { state: StateId, elements: Vec<Value>, next: usize, path: String },
}

enum Phase {
    Acquiring,
    Projecting,
    Running,
}

struct Current {
    instance: InstanceId,
    state: StateId,
    path: String,
    attempt: u32,
    phase: Phase,
    lease: Option<Lease>,
    projection: Option<ProjectionId>,
}

/// The interpreter of one state.
pub(crate) struct Interpreter {
    frames: Vec<Frame>,
    variables: Vec<(String, Value)>,
    outputs: BTreeMap<StateId, Outputs>,
    current: Option<Current>,
    routine: Option<Routine>,
    target: Target,
}

/// What a routine holds for everything it contains.
pub(crate) struct Routine {
    /// What it asks for.
    pub(crate) requirements: Vec<Requirement>,
    /// What it was granted; `None` while it asks again because a worker of it died.
    pub(crate) lease: Option<Lease>,
}

struct Scoped<'a> {
    variables: &'a [(String, Value)],
    outputs: &'a BTreeMap<StateId, Outputs>,
}

impl Names for Scoped<'_> {
    fn variable(&self, name: &str) -> Option<Cow<'_, Value>> {
        self.variables.iter().rev().find(|(n, _)| n == name).map(|(_, v)| Cow::Borrowed(v))
    }

    fn port(&self, state: StateId, port: &str) -> Option<Cow<'_, Value>> {
        self.outputs.get(&state)?.get(port).map(Cow::Borrowed)
    }
}

impl Interpreter {
    /// HSM mode: the whole program on the actual world.
    pub(crate) fn of_program(parameters: &BTreeMap<String, Value>) -> Interpreter {
        Interpreter {
            frames: Vec::new(),
            variables: parameters.iter().map(|(n, v)| (n.clone(), v.clone())).collect(),
            outputs: BTreeMap::new(),
            current: None,
            routine: None,
            target: Target::Actual,
        }
    }

    /// A routine: its own lease serves everything it contains.
    pub(crate) fn of_routine(
        variables: Vec<(String, Value)>,
        outputs: BTreeMap<StateId, Outputs>,
        routine: Routine,
        target: Target,
    ) -> Interpreter {
        Interpreter { frames: Vec::new(), variables, outputs, current: None, routine: Some(routine), target }
    }

    /// What a routine holds now.
    pub(crate) fn lease(&self) -> Option<&Lease> {
        self.routine.as_ref()?.lease.as_ref()
    }

    /// Begins with `state`.
    pub(crate) fn start(&mut self, context: &mut Context<'_>, state: StateId, path: &str) -> Progress {
        match self.enter(context, state, path) {
            Ok(()) => self.advance(context),
            Err(reason) => self.leave(context, ABORTED, reason),
        }
    }

    /// The instances it has under way.
    pub(crate) fn instance(&self) -> Option<InstanceId> {
        self.current.as_ref().map(|c| c.instance)
    }

    /// What the states it executed have written so far.
    pub(crate) fn outputs(&self) -> &BTreeMap<StateId, Outputs> {
        &self.outputs
    }

    /// The changes it has made to its projection; none in the actual world, where they are real already.
    pub(crate) fn into_changes(self) -> Vec<Change> {
        match self.target {
            Target::Actual => Vec::new(),
            Target::Projection { changes, before, .. } => changes[before..].to_vec(),
        }
    }

    /// Uses the scope of the outermost state: its parameters, and the outputs of what it has executed.
    pub(crate) fn in_scope<T>(
        &self,
        context: &Context<'_>,
        use_scope: impl FnOnce(&dyn ratn_model::expression::Scope) -> T,
    ) -> T {
        self.with_scope(context, None, use_scope)
    }

    /// An event for the instance under way; others are not for us.
    pub(crate) fn handle(&mut self, context: &mut Context<'_>, event: Event) -> Progress {
        let Some(current) = self.current.as_mut() else { return Progress::Busy };
        match event {
            Event::Granted { instance, lease } if instance == current.instance => {
                match &mut self.routine {
                    Some(routine) => routine.lease = Some(lease),
                    None => current.lease = Some(lease),
                }
                self.project_or_run(context)
            }
            Event::Refused { instance, reason } if instance == current.instance => {
                self.leave(context, ABORTED, format!("its resources were refused: {reason}"))
            }
            Event::Projected { instance, attempt, projection }
                if instance == current.instance && attempt == current.attempt =>
            {
                current.projection = Some(projection);
                self.run(context)
            }
            Event::Crashed { instance, attempt, reason }
                if instance == current.instance && attempt == current.attempt =>
            {
                self.crashed(context, &reason)
            }
            Event::Finished { instance, attempt, outcome, outputs, measured, reason }
                if instance == current.instance && attempt == current.attempt =>
            {
                self.finished(context, outcome, outputs, &measured, reason)
            }
            _ => Progress::Busy,
        }
    }

    /// Ends everything under way.
    pub(crate) fn abort(&mut self, context: &mut Context<'_>) {
        if let Some(current) = self.current.take() {
            match current.phase {
                Phase::Acquiring => context.commands.push(Command::Withdraw { instance: current.instance }),
                Phase::Projecting | Phase::Running => {
                    context.commands.push(Command::Cancel { instance: current.instance, attempt: current.attempt });
                }
            }
            self.give_back(context, &current);
            context.note(Note::Squashed { instance: current.instance });
        }
        self.frames.clear();
    }

    pub(super) fn with_scope<T>(
        &self,
        context: &Context<'_>,
        outputs: Option<&Outputs>,
        use_scope: impl FnOnce(&dyn ratn_model::expression::Scope) -> T,
    ) -> T {
        let world = match &self.target {
            Target::Actual => &*context.root,
            Target::Projection { world, .. } => world,
        };
        let names = Scoped { variables: &self.variables, outputs: &self.outputs };
        use_scope(&Bindings { names: &names, outputs, world, unknown: &Footprint::NOTHING })
    }
}
