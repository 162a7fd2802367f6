//! Cancelling what is under way: everything when the run ends, or a region when another region has won.
//!
//! A region that is cut short leaves its states, the innermost first. A state with a `finally` is left when its `finally` has been executed. The
//! region ends when it has left the last of them; the concurrency around it ends only then.

use super::{CutShort, Frame, Interpreter, MAIN, Phase, Target, Thread, Todo};
use crate::binding::Outputs;
use crate::context::Context;
use crate::hold::Hold;
use crate::protocol::{Command, Note};
use crate::way_out::{Place, WayOut, Within};
use ratn_model::id::{InstanceId, StateId};
use ratn_model::program::{ABORTED, Finally, PREEMPTED, Program, StateKind};
use ratn_model::value::Value;
use std::collections::BTreeMap;

impl Interpreter {
    /// Cancels everything under way. Effects that a motion declares for `preempted` are applied; the exits of composite states are not executed.
    pub(crate) fn abort(&mut self, context: &mut Context<'_>) {
        let all: Vec<u64> = self.threads.keys().copied().collect();
        for thread in all {
            // Errors do not matter: the run ends anyway.
            let _ = self.cancel(context, thread);
            self.set(thread, Todo::Done { outcome: PREEMPTED.to_owned(), reason: String::new() });
        }
        self.give_up_routines(context);
    }

    fn is_cut_short(&self, thread: u64) -> bool {
        self.threads.get(&thread).is_some_and(|thread| thread.cut_short.is_some())
    }

    /// Whether a thread is cut short and executes no `finally` at present.
    pub(super) fn is_leaving(&self, thread: u64) -> bool {
        let is_leaving = |thread: &Thread| {
            thread.cut_short.as_ref().is_some_and(|cut| cut.frames == 0 || thread.frames.len() < cut.frames)
        };
        self.threads.get(&thread).is_some_and(is_leaving)
    }

    /// Cuts a region short because another one has won: cancels its action, which ends `preempted`, then leaves the composite states that it is
    /// in, the innermost first. Does nothing if the region has ended or is already on its way out.
    pub(super) fn cut_short(&mut self, context: &mut Context<'_>, id: u64) {
        if self.is_cut_short(id) || self.region_end(id).is_some() {
            return;
        }
        let cancelled = self.cancel(context, id);
        let Some(thread) = self.threads.get_mut(&id) else { return };
        thread.cut_short = Some(CutShort::default());
        let todo = std::mem::replace(&mut thread.todo, Todo::Busy);
        // The `finally` of this state has been executed already.
        if let Todo::Ended { state, .. } = &todo
            && let Some(frame) = thread.frames.last()
            && finally(context.program, frame).is_some_and(|finally| finally.lastly.values().any(|last| last == state))
            && let Some(frame) = thread.frames.pop()
        {
            thread.variables.truncate(frame.variables);
        }
        self.has_problem(id, cancelled);
        match todo {
            Todo::Join { state, path, regions, .. } => {
                for region in &regions {
                    self.cut_short(context, *region);
                }
                if self.have_ended(&regions) {
                    self.leave_regions(context, id, state, &path, &regions);
                } else {
                    self.set(id, Todo::Join { state, path, regions, decided: None });
                }
            }
            _ => self.leave_all(context, id),
        }
    }

    /// Leaves a concurrency whose regions have been cut short.
    pub(super) fn leave_regions(
        &mut self,
        context: &mut Context<'_>,
        id: u64,
        state: StateId,
        path: &str,
        regions: &[u64],
    ) {
        self.merge_variables(id, regions);
        for region in regions {
            let thread = self.threads.remove(region);
            if let Some(cut) = thread.and_then(|thread| thread.cut_short).filter(|cut| !cut.problem.is_empty()) {
                self.has_problem(id, Err(cut.problem));
            }
        }
        let left = self.leave_preempted(context, id, (InstanceId(0), state), path);
        self.has_problem(id, left);
        self.leave_all(context, id);
    }

    /// A region that is cut short leaves its states, up to the next one with a `finally`.
    fn leave_all(&mut self, context: &mut Context<'_>, id: u64) {
        // The outermost frame is that of the concurrency itself.
        while let Some(thread) = self.threads.get_mut(&id).filter(|thread| thread.frames.len() > 1)
            && let Some(frame) = thread.frames.last()
        {
            if let Some(last) = finally(context.program, frame).and_then(|finally| finally.lastly.get(PREEMPTED)) {
                let frames = thread.frames.len();
                thread.cut_short.get_or_insert_default().frames = frames;
                return self.set(id, Todo::Enter(*last, None));
            }
            let Some(frame) = thread.frames.pop() else { break };
            let left = self.leave_preempted(context, id, (InstanceId(0), frame.owner), &frame.path);
            self.has_problem(id, left);
            if let Some(thread) = self.threads.get_mut(&id) {
                thread.variables.truncate(frame.variables);
            }
        }
        let problem = self.threads.get(&id).and_then(|thread| thread.cut_short.as_ref());
        let reason = problem.map(|cut| cut.problem.clone()).unwrap_or_default();
        let outcome = if reason.is_empty() { PREEMPTED } else { ABORTED };
        self.set(id, Todo::Done { outcome: outcome.to_owned(), reason });
    }

    /// A state has ended in a thread that is cut short. If that completes a `finally`, the thread leaves the states around it and the result is
    /// true.
    pub(super) fn goes_on_out(
        &mut self,
        context: &mut Context<'_>,
        id: u64,
        state: StateId,
        outcome: &str,
        reason: &str,
    ) -> bool {
        let is_left = |thread: &Thread| thread.cut_short.as_ref().is_some_and(|cut| thread.frames.len() < cut.frames);
        if !self.threads.get(&id).is_some_and(is_left) {
            return false;
        }
        if outcome != PREEMPTED {
            let path = &context.program.state(state).path;
            let reason = if reason.is_empty() { format!("{path}: it ended `{outcome}`") } else { reason.to_owned() };
            self.has_problem(id, Err(reason));
        }
        self.leave_all(context, id);
        true
    }

    /// Keeps the first error on the way out.
    fn has_problem(&mut self, id: u64, result: Result<(), String>) {
        if let Err(problem) = result
            && let Some(cut) = self.threads.get_mut(&id).and_then(|thread| thread.cut_short.as_mut())
            && cut.problem.is_empty()
        {
            cut.problem = problem;
        }
    }

    fn leave_preempted(
        &mut self,
        context: &mut Context<'_>,
        thread: u64,
        (instance, state): (InstanceId, StateId),
        path: &str,
    ) -> Result<(), String> {
        let state = context.program.state(state);
        let changed = self.change(context, thread, (instance, state), path, PREEMPTED, &Outputs::new());
        changed.map_err(|problem| format!("{path}: {problem}"))
    }

    /// Applies the `preempted` effects of a composite state, for a run that was told to end inside of it.
    pub(crate) fn leave(&mut self, context: &mut Context<'_>, state: StateId, path: &str) -> Result<(), String> {
        self.leave_preempted(context, MAIN, (InstanceId(0), state), path)
    }

    /// Adds the `finally` blocks that remain when everything under way is cut short.
    pub(crate) fn way_out(&self, program: &Program, way: &mut WayOut) {
        if let Some(Within { places, variables, outputs }) = self.way_out_within(program, way) {
            way.add(program, places.into_iter(), || variables, || outputs);
        }
        way.hold = self.hold.clone();
    }

    /// The same for the regions' threads; returns the place of the main thread, because the states around a routine of the window belong to the
    /// same thread of control.
    pub(crate) fn way_out_within(&self, program: &Program, way: &mut WayOut) -> Option<Within> {
        let within = |thread: &Thread| Within {
            places: places(program, thread),
            variables: thread.variables.iter().map(|(name, value)| (name.clone(), (**value).clone())).collect(),
            outputs: self.outputs.clone(),
        };
        for (_, region) in self.threads.iter().filter(|(id, _)| **id != MAIN) {
            let Within { places, variables, outputs } = within(region);
            way.add(program, places.into_iter(), || variables, || outputs);
        }
        self.threads.get(&MAIN).map(within)
    }

    /// An interpreter for one `finally` block of a run that was told to end, in the scope of its place.
    pub(crate) fn on_the_way_out(
        variables: Vec<(String, Value)>,
        outputs: BTreeMap<StateId, Outputs>,
        hold: Hold,
    ) -> Interpreter {
        Interpreter { hold, ..Interpreter::new(variables, outputs, None, Target::Actual) }
    }

    /// The variables and outputs in the scope of the outermost state, and the operator's holds.
    pub(crate) fn into_scope(mut self) -> (Vec<(String, Value)>, BTreeMap<StateId, Outputs>, Hold) {
        let main = self.threads.remove(&MAIN).map(|main| main.variables).unwrap_or_default();
        let variables = main.into_iter().map(|(name, value)| (name, (*value).clone())).collect();
        (variables, self.outputs, self.hold)
    }

    /// Cancels the action of a thread. If it was running, its `preempted` effects are applied.
    fn cancel(&mut self, context: &mut Context<'_>, id: u64) -> Result<(), String> {
        let Some(current) = self.threads.get_mut(&id).and_then(|thread| thread.current.take()) else { return Ok(()) };
        let has_begun = current.phase == Phase::Running && !context.program.state(current.state).is_pause();
        let mut result = Ok(());
        match current.phase {
            Phase::Held | Phase::Stalled | Phase::Backoff(_) | Phase::Queued(_) => {}
            Phase::Running if !has_begun => {}
            Phase::Acquiring => context.commands.push(Command::Withdraw { instance: current.instance }),
            Phase::Projecting | Phase::Running => {
                context.commands.push(Command::Cancel { instance: current.instance, attempt: current.attempt });
                if has_begun {
                    result = self.leave_preempted(context, id, (current.instance, current.state), &current.path);
                }
            }
        }
        self.give_back(context, &current);
        context.note(Note::Squashed { instance: current.instance });
        result
    }
}

/// The states that a thread has entered and not left, the innermost first.
fn places(program: &Program, thread: &Thread) -> Vec<Place> {
    let is_region = |frame: &Frame| matches!(program.state(frame.owner).kind, StateKind::Concurrency { .. });
    // The outermost frame of a region belongs to the concurrency, which the thread around it is in.
    let own = usize::from(thread.frames.first().is_some_and(is_region));
    let joins = match &thread.todo {
        Todo::Join { state, path, .. } => Some((*state, path.clone(), 0)),
        _ => None,
    };
    let entered = |frame: &Frame| {
        let last = finally(program, frame).and_then(|finally| finally.lastly.get(PREEMPTED));
        let visits = last.and_then(|last| frame.visits.get(last)).copied().unwrap_or(0);
        (frame.owner, frame.path.clone(), visits)
    };
    joins.into_iter().chain(thread.frames[own..].iter().rev().map(entered)).collect()
}

/// The `finally` of the state that a list belongs to.
pub(super) fn finally<'p>(program: &'p Program, frame: &Frame) -> Option<&'p Finally> {
    program.state(frame.owner).annotations.finally.as_ref()
}
