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

use crate::analysis::Analysis;
use crate::binding::{self, Bindings, Names, Outputs, child_path};
use crate::effects;
use crate::protocol::{Command, Event, Goal, Note};
use ratn_model::fact::{Change, Footprint};
use ratn_model::id::{InstanceId, ProjectionId, Revision, StateId};
use ratn_model::program::{ABORTED, PREEMPTED, Program, SUCCESS, State, StateKind, WORLD_MODEL};
use ratn_model::resource::{Lease, Requirement};
use ratn_model::value::Value;
use ratn_world::world::World;
use std::borrow::Cow;
use std::collections::BTreeMap;

/// How often a computing or sensing node is tried when its worker dies, unless the state says otherwise.
pub(crate) const DEFAULT_ATTEMPTS: u32 = 3;

/// What every part of the executive works with.
pub(crate) struct Context<'a> {
    pub(crate) program: &'a Program,
    pub(crate) analysis: &'a Analysis,
    /// The mirror of the root world model.
    pub(crate) root: &'a mut World,
    /// The last instance id given.
    pub(crate) last_instance: &'a mut u64,
    /// The run's seed.
    pub(crate) seed: u64,
    /// What the shell shall do.
    pub(crate) commands: &'a mut Vec<Command>,
}

impl Context<'_> {
    pub(crate) fn new_instance(&mut self) -> InstanceId {
        *self.last_instance += 1;
        InstanceId(*self.last_instance)
    }

    pub(crate) fn note(&mut self, note: Note) {
        self.commands.push(Command::Note(note));
    }

    /// Makes changes real: in the mirror now, in the world pool by command.
    pub(crate) fn commit(&mut self, instance: InstanceId, changes: Vec<Change>) -> Result<(), String> {
        if changes.is_empty() {
            return Ok(());
        }
        let revision = self.root.apply(&changes).map_err(|e| e.to_string())?;
        self.commands.push(Command::Commit { instance, changes, revision });
        Ok(())
    }
}

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

    /// Leaves sequences that are done, until an action has begun or all is done.
    fn advance(&mut self, context: &mut Context<'_>) -> Progress {
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

    fn iterate(&mut self, context: &Context<'_>, state: StateId, index: usize, element: Value, path: String) {
        if let StateKind::ForEach { variable, index: counter, body, .. } = &context.program.state(state).kind {
            self.unbind(variable, counter.as_deref());
            self.variables.push((variable.clone(), element));
            if let Some(counter) = counter {
                self.variables.push((counter.clone(), Value::Int(index as i64)));
            }
            self.frames.push(Frame::List { state, children: body.clone(), next: 0, path });
        }
    }

    fn unbind(&mut self, variable: &str, counter: Option<&str>) {
        while self.variables.last().is_some_and(|(n, _)| n == variable || Some(n.as_str()) == counter) {
            self.variables.pop();
        }
    }

    fn enter(&mut self, context: &mut Context<'_>, id: StateId, path: &str) -> Result<(), String> {
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
            StateKind::Condition { predicate, then, otherwise } => {
                let taken = self.with_scope(context, None, |s| predicate.holds(s)).map_err(|e| e.to_string())?;
                let children = if taken { then.clone() } else { otherwise.clone() };
                self.frames.push(Frame::List { state: id, children, next: 0, path: path.to_owned() });
            }
        }
        Ok(())
    }

    /// The innermost frame is done: its state's outputs, effects and resource operations happen.
    fn exit(&mut self, context: &mut Context<'_>) -> Result<(), String> {
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
        self.operate(context, program.state(id), InstanceId(0), None)
    }

    /// A hierarchy's own effects for an outcome.
    fn hierarchy_effects(&mut self, context: &mut Context<'_>, state: &State, outcome: &str) -> Result<(), String> {
        let Some(declared) = state.annotations.effects.get(outcome) else { return Ok(()) };
        let outputs = self.outputs.get(&state.id).cloned();
        let changes = self
            .with_scope(context, outputs.as_ref(), |s| effects::actual(Some(declared), outcome, &[], s))
            .map_err(|e| e.to_string())?;
        self.apply(context, InstanceId(0), changes)
    }

    fn begin(&mut self, context: &mut Context<'_>, id: StateId, path: &str) -> Result<(), String> {
        let (program, analysis) = (context.program, context.analysis);
        let instance = context.new_instance();
        context.note(Note::Expanded { instance, state: id, path: path.to_owned(), speculative: false });
        self.current = Some(Current {
            instance,
            state: id,
            path: path.to_owned(),
            attempt: 1,
            phase: Phase::Acquiring,
            lease: None,
            projection: None,
        });
        let wanted = &analysis.state(id).requirements;
        if self.routine.is_some() || wanted.is_empty() {
            return match self.project_or_run(context) {
                Progress::Busy => Ok(()),
                Progress::Ended { reason, .. } => Err(reason),
            };
        }
        let requirements = self
            .with_scope(context, None, |scope| binding::requirements(program.state(id), wanted, scope))
            .map_err(|e| e.reason())?;
        context.commands.push(Command::Acquire { instance, requirements, priority: i64::MAX });
        Ok(())
    }

    fn project_or_run(&mut self, context: &mut Context<'_>) -> Progress {
        let Some(current) = self.current.as_mut() else { return Progress::Busy };
        let analysis = context.analysis.state(current.state);
        if !analysis.requirements.iter().any(|r| r.kind == WORLD_MODEL) {
            return self.run(context);
        }
        current.phase = Phase::Projecting;
        let (instance, attempt) = (current.instance, current.attempt);
        let reads = match &analysis.reads {
            None => Footprint::Everything,
            Some(reads) => self.with_scope(context, None, |s| ratn_model::expression::FactExpr::footprint(reads, s)),
        };
        let (base, changes) = match &self.target {
            Target::Actual => (context.root.revision(), Vec::new()),
            Target::Projection { base, changes, .. } => (*base, changes.clone()),
        };
        context.commands.push(Command::Project { instance, attempt, base, changes, reads });
        Progress::Busy
    }

    fn run(&mut self, context: &mut Context<'_>) -> Progress {
        let program = context.program;
        let Some(current) = self.current.as_ref() else { return Progress::Busy };
        let state = program.state(current.state);
        let StateKind::Action { provider, action, inputs, .. } = &state.kind else { return Progress::Busy };
        let inputs = match self.with_scope(context, None, |scope| binding::inputs(state, inputs, scope)) {
            Ok(inputs) => inputs,
            Err(error) => return self.leave(context, ABORTED, error.reason()),
        };
        let expected_s = self.with_scope(context, None, |scope| binding::expected_s(state, scope));
        let Some(current) = self.current.as_mut() else { return Progress::Busy };
        current.phase = Phase::Running;
        let (instance, attempt) = (current.instance, current.attempt);
        let goal = Goal {
            provider: provider.clone(),
            action: action.clone(),
            inputs,
            seed: binding::seed(context.seed, &current.path),
            lease: self.routine.as_ref().map_or(&current.lease, |routine| &routine.lease).clone(),
            projection: current.projection,
            expected_s,
        };
        context.note(Note::Running { instance, attempt });
        context.commands.push(Command::Start { instance, attempt, goal });
        Progress::Busy
    }

    fn crashed(&mut self, context: &mut Context<'_>, reason: &str) -> Progress {
        let Some(mut current) = self.current.take() else { return Progress::Busy };
        let state = context.program.state(current.state);
        self.give_back(context, &current);
        let again = context.analysis.state(current.state).nature != crate::analysis::NodeNature::Irreversible
            && current.attempt < state.annotations.attempts.unwrap_or(DEFAULT_ATTEMPTS);
        if !again {
            let (path, attempt) = (current.path.clone(), current.attempt);
            current.lease = None;
            current.projection = None;
            self.current = Some(current);
            return self.leave(context, ABORTED, format!("{path} crashed in attempt {attempt}: {reason}"));
        }
        let (instance, id) = (current.instance, current.state);
        let requirements = match &mut self.routine {
            // Nothing of it moves between two nodes: it gives everything back and asks for all of it again.
            Some(routine) => {
                let lease = routine.lease.take().map(|l| l.id);
                if lease.is_some() {
                    context.commands.push(Command::Release { instance, lease, projection: None });
                }
                Ok(routine.requirements.clone())
            }
            None => self.with_scope(context, None, |scope| {
                binding::requirements(state, &context.analysis.state(id).requirements, scope)
            }),
        };
        let requirements = match requirements {
            Ok(requirements) => requirements,
            Err(error) => return self.leave(context, ABORTED, error.reason()),
        };
        let phase = Phase::Acquiring;
        let attempt = current.attempt + 1;
        self.current = Some(Current { attempt, phase, lease: None, projection: None, ..current });
        if requirements.is_empty() {
            return self.project_or_run(context);
        }
        context.commands.push(Command::Acquire { instance, requirements, priority: i64::MAX });
        Progress::Busy
    }

    fn finished(
        &mut self,
        context: &mut Context<'_>,
        mut outcome: String,
        outputs: Outputs,
        measured: &[(ratn_model::fact::FactKey, Value)],
        mut reason: String,
    ) -> Progress {
        let Some(current) = self.current.take() else { return Progress::Busy };
        let program = context.program;
        let state = program.state(current.state);
        let (id, instance) = (current.state, current.instance);
        if let StateKind::Action { outputs: declared, .. } = &state.kind
            && outcome == SUCCESS
            && let Some(problem) = binding::missing_output(declared, &outputs)
        {
            (outcome, reason) = (ABORTED.to_owned(), problem);
        }
        let nature = context.analysis.state(id).nature;
        let declared = effects::declared(state, nature, &outcome);
        let changes = self.with_scope(context, Some(&outputs), |s| effects::actual(declared, &outcome, measured, s));
        if outcome == SUCCESS {
            self.outputs.insert(id, outputs);
        }
        let made = changes.map_err(|e| e.to_string()).and_then(|changes| self.apply(context, instance, changes));
        if let Err(problem) = made {
            (outcome, reason) = (ABORTED.to_owned(), format!("{}: {problem}", current.path));
        }
        context.note(Note::Finished { instance, outcome: outcome.clone() });
        if outcome == SUCCESS
            && let Err(problem) = self.operate(context, state, instance, self.outputs.get(&id).cloned())
        {
            (outcome, reason) = (ABORTED.to_owned(), problem);
        }
        self.give_back(context, &current);
        if matches!(self.target, Target::Actual) {
            context.note(Note::Retired { instance });
        }
        if outcome == SUCCESS {
            return self.advance(context);
        }
        let reason = if reason.starts_with(&current.path) { reason } else { format!("{}: {reason}", current.path) };
        self.leave(context, &outcome, reason)
    }

    /// An outcome that is not success leaves every state around by the same name.
    fn leave(&mut self, context: &mut Context<'_>, outcome: &str, mut reason: String) -> Progress {
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

    fn apply(&mut self, context: &mut Context<'_>, instance: InstanceId, changes: Vec<Change>) -> Result<(), String> {
        match &mut self.target {
            Target::Actual => context.commit(instance, changes),
            Target::Projection { changes: all, world, .. } => {
                world.apply(&changes).map_err(|e| e.to_string())?;
                all.extend(changes);
                Ok(())
            }
        }
    }

    fn operate(
        &self,
        context: &mut Context<'_>,
        state: &State,
        instance: InstanceId,
        outputs: Option<Outputs>,
    ) -> Result<(), String> {
        let wanted = &context.analysis.state(state.id).operations;
        if wanted.is_empty() {
            return Ok(());
        }
        let operations = self
            .with_scope(context, outputs.as_ref(), |s| binding::requirements(state, wanted, s))
            .map_err(|e| e.reason())?;
        context.commands.push(Command::Operate { instance, operations });
        Ok(())
    }

    fn give_back(&self, context: &mut Context<'_>, current: &Current) {
        let lease = current.lease.as_ref().map(|l| l.id);
        if lease.is_some() || current.projection.is_some() {
            context.commands.push(Command::Release {
                instance: current.instance,
                lease,
                projection: current.projection,
            });
        }
    }

    fn with_scope<T>(
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
