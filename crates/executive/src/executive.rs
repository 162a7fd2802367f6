//! One run of one task, in either mode.

mod checkpoint;
mod order;

pub use checkpoint::RestoreError;
pub(crate) use order::removed;

use crate::context::Context;
use crate::hold;
use crate::interpreter::{Interpreter, Progress};
use crate::lookahead::Problem;
use crate::plan::Plan;
use crate::protocol::{Command, Event, Mode};
use crate::signals::Signals;
use crate::span::span;
use crate::turn::Turn;
use crate::way_out::{Leaving, WayOut};
use crate::window::{End, Window};
use order::in_order;
use ratn_model::expression::EffectExpr;
use ratn_model::fact::FactKey;
use ratn_model::id::InstanceId;
use ratn_model::program::{ABORTED, PREEMPTED, Program, SUCCESS};
use ratn_model::time::Timestamp;
use ratn_model::tolerance::Tolerance;
use ratn_model::value::Value;
use ratn_model::wait::Wait;
use ratn_world::world::World;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::sync::{Arc, OnceLock};

/// Executes one program once.
///
/// The first event is [`Event::Started`]; the first command then commits the program's declared initial world, as
/// instance 0. The last command is [`Command::End`]; events after it are ignored.
pub struct Executive {
    program: Arc<Program>,
    plan: Arc<Plan>,
    /// Fingerprint of the program and its plan, once a checkpoint has needed it.
    fingerprint: OnceLock<[u8; 32]>,
    tolerance: Tolerance,
    root: World,
    last_instance: u64,
    seed: u64,
    signals: Signals,
    /// Deadline of the run.
    deadline: Option<Timestamp>,
    state: State,
}

#[derive(Serialize, Deserialize)]
enum State {
    Fresh,
    Hsm(Box<Interpreter>),
    Cdtn(Box<Window>),
    Leaving(Box<Leaving>),
    Ended,
}

impl Executive {
    /// An executive for one run of a checked program.
    pub fn new(program: Arc<Program>, tolerance: Tolerance) -> Executive {
        let plan = Arc::new(Plan::of(&program));
        Executive {
            program,
            plan,
            fingerprint: OnceLock::new(),
            tolerance,
            root: World::default(),
            last_instance: 0,
            seed: 0,
            signals: Signals::default(),
            deadline: None,
            state: State::Fresh,
        }
    }

    /// Handles an event; returns the shell's next commands, in order.
    pub fn handle(&mut self, now: Timestamp, event: Event) -> Vec<Command> {
        let mut commands = Vec::with_capacity(8);
        match event {
            Event::Started { mode, parameters, seed, world, revision, capacity, learned, breakpoints, .. } => {
                if matches!(self.state, State::Fresh) {
                    self.root = World::from_facts(world, revision);
                    self.seed = seed;
                    let window =
                        || Window::new(&self.program, &self.plan, &parameters, capacity, learned, self.tolerance);
                    let window = (mode == Mode::Cdtn).then(|| Box::new(window()));
                    self.start(now, window, &parameters, breakpoints.into_vec(), &mut commands);
                }
            }
            event => self.step(now, event, &mut commands),
        }
        in_order(commands)
    }

    /// The mirror of the root world model.
    pub fn root(&self) -> &World {
        &self.root
    }

    /// Whether [`Command::End`] was given.
    pub fn has_ended(&self) -> bool {
        matches!(self.state, State::Ended)
    }

    /// Number of signals of a name that no state has taken yet; at most [`crate::MOST_SIGNALS_KEPT`] are kept.
    pub fn signals_kept(&self, name: &str) -> usize {
        self.signals.count(name)
    }

    /// The wait under way that the next signal of a name ends.
    pub fn first_waiting_for(&self, signal: &str) -> Option<InstanceId> {
        let waits = match &self.state {
            State::Cdtn(window) => window.waits_under_way(&self.program).map(|(turn, _)| turn).collect(),
            State::Hsm(interpreter) => interpreter.waits(&self.program, 0).collect(),
            State::Leaving(leaving) => leaving.waits(&self.program),
            State::Fresh | State::Ended => Vec::new(),
        };
        let is_it =
            |turn: &Turn| matches!(self.program.state(turn.state).wait(), Some(Wait::Signal(name)) if name == signal);
        waits.into_iter().filter(is_it).min().map(|turn| turn.instance)
    }

    /// The breakpoints, by the paths of states.
    pub fn breakpoints(&self) -> &[String] {
        match &self.state {
            State::Cdtn(window) => window.breakpoints(),
            State::Hsm(interpreter) => interpreter.breakpoints(),
            State::Leaving(leaving) => leaving.breakpoints(),
            State::Fresh | State::Ended => &[],
        }
    }

    /// Whether a breakpoint at a path (without visits) can ever stop a run of the program: a PIA is at, inside or around it.
    pub fn stops_for(program: &Program, path: &str) -> bool {
        hold::stops_for(program, path)
    }

    /// Every path at which a breakpoint stops a run of the program, in program order.
    pub fn stopping(program: &Program) -> Vec<&str> {
        hold::stopping(program)
    }

    /// What every instance that has not begun waits for, as sentences; in HSM mode only those that the operator holds back.
    pub fn explain(&self) -> Vec<String> {
        match &self.state {
            State::Cdtn(window) => window.waits(&self.program),
            State::Hsm(interpreter) => interpreter.held_back(),
            State::Fresh | State::Leaving(_) | State::Ended => Vec::new(),
        }
    }

    /// Checks the executive's invariants between two events. For tests; costs the whole window.
    ///
    /// # Errors
    /// The invariant that does not hold.
    pub fn check_invariants(&self) -> Result<(), String> {
        match &self.state {
            State::Cdtn(window) => window.check_invariants(),
            State::Fresh | State::Hsm(_) | State::Leaving(_) | State::Ended => Ok(()),
        }
    }

    /// Checks that no instance was forgotten that could go on: all waiting instances are examined again in a copy. For tests; costs the
    /// whole window.
    ///
    /// # Errors
    /// The instance that could have gone on.
    pub fn check_quiescence(&self, now: Timestamp) -> Result<(), String> {
        self.copy().map_err(|error| format!("its checkpoint: {error}"))?.look_at_all(now)
    }

    fn look_at_all(&mut self, now: Timestamp) -> Result<(), String> {
        let program = self.program.clone();
        let plan = self.plan.clone();
        let mut commands = Vec::new();
        let mut context = Context {
            program: &program,
            plan: &plan,
            root: &mut self.root,
            now,
            last_instance: &mut self.last_instance,
            seed: self.seed,
            signals: &mut self.signals,
            commands: &mut commands,
        };
        match &mut self.state {
            State::Cdtn(window) => window.check_quiescence(&mut context),
            State::Fresh | State::Hsm(_) | State::Leaving(_) | State::Ended => Ok(()),
        }
    }

    /// The remaining certain work as a scheduling problem for look-ahead ([`crate::lookahead`]); empty in HSM mode.
    pub fn outlook(&mut self, now: Timestamp) -> Problem {
        let program = self.program.clone();
        let mut commands = Vec::new();
        let context = Context {
            program: &program,
            plan: &self.plan,
            root: &mut self.root,
            now,
            last_instance: &mut self.last_instance,
            seed: self.seed,
            signals: &mut self.signals,
            commands: &mut commands,
        };
        match &self.state {
            State::Cdtn(window) => window.outlook(&context),
            _ => Problem::default(),
        }
    }

    fn start(
        &mut self,
        now: Timestamp,
        window: Option<Box<Window>>,
        parameters: &BTreeMap<String, Value>,
        breakpoints: Vec<String>,
        commands: &mut Vec<Command>,
    ) {
        let program = self.program.clone();
        let mut context = Context {
            program: &program,
            plan: &self.plan,
            root: &mut self.root,
            now,
            last_instance: &mut self.last_instance,
            seed: self.seed,
            signals: &mut self.signals,
            commands,
        };
        if let Err(reason) = commit_initial(&mut context, parameters) {
            self.state = State::Ended;
            let reason = format!("the task's initial world: {reason}");
            commands.push(Command::End { outcome: ABORTED.to_owned(), outputs: BTreeMap::new(), reason });
            return;
        }
        self.deadline = program.deadline_s.map(|seconds| now + span(seconds));
        context.commands.extend(self.deadline.map(|at| Command::Wake { at }));
        let end = match window {
            None => {
                let mut interpreter = Box::new(Interpreter::of_program(parameters));
                interpreter.break_at(&program, breakpoints);
                let progress = interpreter.start(&mut context, Program::ROOT, "");
                let end = end_of(&mut context, &interpreter, progress);
                self.state = State::Hsm(interpreter);
                end
            }
            Some(mut window) => {
                window.break_at(&program, breakpoints);
                let end = window.start(&mut context);
                self.state = State::Cdtn(window);
                end
            }
        };
        self.end(end, commands);
    }

    fn step(&mut self, now: Timestamp, event: Event, commands: &mut Vec<Command>) {
        if let Event::WorldChanged { facts, .. } = &event {
            if let State::Cdtn(window) = &mut self.state {
                window.compare_outside(&self.program, &self.root, facts);
            }
            let fact = |(fact, value): &(FactKey, Option<Value>)| (fact.clone(), value.clone());
            self.root.overwrite(facts.iter().map(fact));
        }
        if let Event::Signalled { signal, value } = &event {
            self.signals.came(signal.clone(), value.clone());
        }
        let program = self.program.clone();
        let mut context = Context {
            program: &program,
            plan: &self.plan,
            root: &mut self.root,
            now,
            last_instance: &mut self.last_instance,
            seed: self.seed,
            signals: &mut self.signals,
            commands,
        };
        // What is due is handled before an event that arrives after it.
        let mut after = None;
        let end = match (come_to_now(&mut context, &mut self.state, self.deadline, &event), &mut self.state) {
            (Some(end), _) => {
                after = Some(event);
                Some(end)
            }
            (None, State::Fresh | State::Ended) => None,
            (None, State::Cdtn(window)) => window.handle(&mut context, event),
            (None, State::Leaving(leaving)) => leaving.handle(&mut context, event),
            (None, State::Hsm(interpreter)) => match event {
                Event::AbortRequested { reason, at_once: false } => {
                    Some(cut_short(&mut context, interpreter, PREEMPTED, reason))
                }
                Event::AbortRequested { reason, at_once: true } => {
                    interpreter.abort(&mut context);
                    Some(End::new(PREEMPTED, reason))
                }
                Event::RetirementFailed { reason, .. } => {
                    interpreter.abort(&mut context);
                    Some(End::new(ABORTED, format!("what had happened could not be recorded: {reason}")))
                }
                event => {
                    let progress = interpreter.handle(&mut context, event);
                    end_of(&mut context, interpreter, progress)
                }
            },
        };
        let end = match end {
            Some(end) if !end.way_out.is_empty() => match Leaving::begin(&mut context, end) {
                Ok(mut leaving) => {
                    let end = after.and_then(|event| leaving.handle(&mut context, event));
                    self.state = State::Leaving(Box::new(leaving));
                    end
                }
                Err(end) => Some(*end),
            },
            end => end,
        };
        self.end(end, commands);
    }

    fn end(&mut self, end: Option<End>, commands: &mut Vec<Command>) {
        if let Some(End { outcome, outputs, reason, .. }) = end {
            self.state = State::Ended;
            commands.push(Command::End { outcome, outputs, reason });
        }
    }
}

/// Handles what has fallen due, one after the other, each with all that follows from it; returns the end of the run if that ended it. The deadline is
/// one of them, and of those of one moment the first.
fn come_to_now(
    context: &mut Context<'_>,
    state: &mut State,
    deadline: Option<Timestamp>,
    event: &Event,
) -> Option<End> {
    let mut end = match state {
        State::Hsm(interpreter) => {
            let progress = interpreter.before(context, event);
            end_of(context, interpreter, progress)
        }
        State::Cdtn(window) => window.before(context, event),
        State::Fresh | State::Leaving(_) | State::Ended => None,
    };
    while end.is_none() {
        let due = match state {
            State::Hsm(interpreter) => interpreter.next_due(context.now),
            State::Cdtn(window) => window.next_due(context.now),
            State::Fresh | State::Leaving(_) | State::Ended => return None,
        };
        let is_over = deadline.is_some_and(|deadline| deadline <= due.unwrap_or(context.now));
        let limit = context.program.deadline_s.unwrap_or_default();
        let reason = || format!("the task took longer than its deadline of {limit} s");
        end = match state {
            State::Hsm(interpreter) if is_over => Some(cut_short(context, interpreter, ABORTED, reason())),
            State::Cdtn(window) if is_over => window.end_early(context, reason()),
            _ if due.is_none() => return None,
            State::Hsm(interpreter) => {
                let progress = interpreter.fall_due(context);
                end_of(context, interpreter, progress)
            }
            State::Cdtn(window) => window.fall_due(context),
            State::Fresh | State::Leaving(_) | State::Ended => None,
        };
    }
    end
}

/// Cancels everything under way; the end returned contains the way out.
fn cut_short(context: &mut Context<'_>, interpreter: &mut Interpreter, outcome: &str, reason: String) -> End {
    let mut way_out = WayOut::default();
    interpreter.way_out(context.program, &mut way_out);
    interpreter.abort(context);
    End { way_out, ..End::new(outcome, reason) }
}

fn commit_initial(context: &mut Context<'_>, parameters: &BTreeMap<String, Value>) -> Result<(), String> {
    let interpreter = Interpreter::of_program(parameters);
    let changes = interpreter
        .in_scope(context, |scope| EffectExpr::bind(&context.program.initial, scope))
        .map_err(|e| e.to_string())?;
    context.commit(InstanceId(0), context.program.name.clone(), changes.into())
}

fn end_of(context: &mut Context<'_>, interpreter: &Interpreter, progress: Progress) -> Option<End> {
    let Progress::Ended { outcome, reason } = progress else { return None };
    let mut outputs = BTreeMap::new();
    if outcome == SUCCESS {
        for output in &context.program.outputs {
            match interpreter.in_scope(context, |scope| output.value.evaluate(scope)) {
                Ok(value) => {
                    outputs.insert(output.name.clone(), value);
                }
                Err(error) => {
                    let reason = format!("output `{}`: {error}", output.name);
                    return Some(End::new(ABORTED, reason));
                }
            }
        }
    }
    Some(End { outputs, ..End::new(&outcome, reason) })
}
