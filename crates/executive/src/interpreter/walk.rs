//! The walk over the tree of states: chooses the next state.

use super::{Frame, Interpreter, MAIN, Progress, Todo};
use crate::binding::{self, Outputs, child_path};
use crate::context::{Context, MAX_IDLE_VISITS, in_circles};
use crate::protocol::Note;
use ratn_model::id::{InstanceId, StateId};
use ratn_model::list::List;
use ratn_model::program::{ABORTED, Program, SUCCESS, StateKind, Target, is_failure};
use ratn_model::value::Value;
use std::sync::Arc;

impl Interpreter {
    /// Lets every thread go on until all wait for events or the state has ended. Ends are followed first, up to the next state that would begin;
    /// then a wait that is over ends, because an end may have changed what it waits for; only then does a state begin.
    pub(crate) fn advance(&mut self, context: &mut Context<'_>) -> Progress {
        loop {
            let progress = self.progress(context);
            let goes_on = progress == Progress::Busy
                && (self.follow_end(context)
                    || self.end_a_wait(context)
                    || self.begin_next(context)
                    || self.take_turns(context));
            if !goes_on {
                return progress;
            }
        }
    }

    /// Whether the state has ended.
    pub(crate) fn progress(&mut self, context: &mut Context<'_>) -> Progress {
        if let Some(reason) = self.in_circles.clone() {
            self.abort(context);
            return Progress::Ended { outcome: ABORTED.to_owned(), reason };
        }
        match self.threads.get(&MAIN).map(|main| &main.todo) {
            Some(Todo::Done { outcome, reason }) => {
                Progress::Ended { outcome: outcome.clone(), reason: reason.clone() }
            }
            _ => Progress::Busy,
        }
    }

    /// Follows the first end, one step; false if there is none.
    pub(crate) fn follow_end(&mut self, context: &mut Context<'_>) -> bool {
        let follows = |thread: u64, todo: &Todo| match todo {
            Todo::Ended { .. } | Todo::Iterate => true,
            Todo::Enter(..) | Todo::Busy | Todo::Done { .. } => false,
            Todo::Join { state, regions, decided, .. } => {
                self.may_join(context.program, thread, *state, regions, decided.is_some())
            }
        };
        let first = self.first(follows);
        self.goes_on(context, first)
    }

    /// The first thread that can begins its next state; false if there is none.
    pub(crate) fn begin_next(&mut self, context: &mut Context<'_>) -> bool {
        let first = self.first(|_, todo| matches!(todo, Todo::Enter(..)));
        self.goes_on(context, first)
    }

    fn goes_on(&mut self, context: &mut Context<'_>, thread: Option<u64>) -> bool {
        let Some(id) = thread.filter(|_| self.in_circles.is_none()) else { return false };
        let Some(thread) = self.threads.get_mut(&id) else { return false };
        match std::mem::replace(&mut thread.todo, Todo::Busy) {
            Todo::Enter(state, path) => self.enter(context, id, state, path),
            Todo::Ended { state, outcome, reason } => self.follow(context, id, state, outcome, reason),
            Todo::Iterate => self.iterate(context, id),
            Todo::Join { state, path, regions, decided } => self.join(context, id, state, path, regions, decided),
            Todo::Busy | Todo::Done { .. } => {}
        }
        true
    }

    /// The first thread whose next step satisfies `is_such`.
    fn first(&self, is_such: impl Fn(u64, &Todo) -> bool) -> Option<u64> {
        self.threads.iter().find(|(id, thread)| is_such(**id, &thread.todo)).map(|(id, _)| *id)
    }

    /// Counts a visit of a state or an iteration; false if the thread has had too many without an action.
    fn count_visit(&mut self, thread: u64) -> bool {
        let Some(thread) = self.threads.get_mut(&thread) else { return false };
        thread.idle_visits += 1;
        if thread.idle_visits > MAX_IDLE_VISITS {
            let innermost = thread.frames.last();
            self.in_circles = Some(in_circles(innermost.map_or("", |frame| &frame.path)));
        }
        thread.idle_visits <= MAX_IDLE_VISITS
    }

    /// A thread has started an action's goal or a routine: resets the count.
    pub(super) fn has_begun_something(&mut self, thread: u64) {
        if let Some(thread) = self.threads.get_mut(&thread) {
            thread.idle_visits = 0;
        }
    }

    /// Notes the end of a state; the thread follows its outcome next.
    pub(super) fn ended(&mut self, thread: u64, state: StateId, outcome: impl Into<String>, reason: String) {
        if let Some(thread) = self.threads.get_mut(&thread) {
            thread.todo = Todo::Ended { state, outcome: outcome.into(), reason };
        }
    }

    fn enter(&mut self, context: &mut Context<'_>, thread: u64, id: StateId, path: Option<String>) {
        let program = context.program;
        let state = program.state(id);
        let path = path.unwrap_or_else(|| self.visit(thread, id, &state.name));
        if self.is_inside(thread) && !self.count_visit(thread) {
            return;
        }
        self.forget_passed_over(program, thread, Some(id));
        // A node checks its preconditions itself.
        let begins_routine = state.is_routine() && self.routine_of(thread).is_none();
        if begins_routine || matches!(state.kind, StateKind::Action { .. }) {
            return self.begin(context, thread, id, &path);
        }
        match self.with_scope(context, thread, None, |scope| binding::unmet(state, scope)) {
            Ok(None) => {}
            Ok(Some(reason)) => return self.ended(thread, id, ABORTED, format!("{path}: {reason}")),
            Err(error) => return self.ended(thread, id, ABORTED, format!("{path}: {}", error.reason())),
        }
        self.enter_composite(context, thread, id, path);
    }

    /// False only at the entry of a routine of the window, whose visit the window has counted already.
    fn is_inside(&self, thread: u64) -> bool {
        self.threads.get(&thread).is_some_and(|thread| !thread.frames.is_empty() || thread.routine.is_none())
    }

    /// Enters a composite state whose preconditions hold.
    pub(super) fn enter_composite(&mut self, context: &mut Context<'_>, thread: u64, id: StateId, path: String) {
        let program = context.program;
        let state = program.state(id);
        if !program.is_pass(id) {
            self.forget_inside(program, id);
        }
        let base = self.threads.get(&thread).map_or(0, |thread| thread.variables.len());
        let mut bound = Vec::new();
        for (name, value) in &state.variables {
            match self.with_scope(context, thread, None, |scope| value.evaluate(scope)) {
                Ok(value) => bound.push((name.clone(), Arc::new(value))),
                Err(error) => {
                    let reason = format!("{path}: variable `{name}`: {error}");
                    return self.ended(thread, id, ABORTED, reason);
                }
            }
        }
        if let Some(thread) = self.threads.get_mut(&thread) {
            thread.variables.extend(bound);
        }
        let inside = base + state.variables.len();
        let wrong = |what: &str, error: &dyn std::fmt::Display| format!("{path}: {what}: {error}");
        match &state.kind {
            StateKind::Action { .. } => {}
            StateKind::Sequence { children, .. } => self.begin_list(context, thread, id, 0, path, base, children),
            StateKind::ForEach { collection, .. } => {
                let list = self.with_scope(context, thread, None, |scope| collection.evaluate(scope));
                match list {
                    Ok(Value::List(elements)) => {
                        self.decided(context, &path, elements.len().to_string());
                        self.push_frame(thread, id, 0, path, inside, Some((usize::MAX, Some(elements))));
                        self.set(thread, Todo::Iterate);
                    }
                    Ok(other) => {
                        let reason = format!("{path}: it loops over a {}, not a list", other.type_name());
                        self.fail_at_its_list(thread, id, base, reason);
                    }
                    Err(error) => self.fail_at_its_list(thread, id, base, wrong("its list", &error)),
                }
            }
            StateKind::While { body_first, .. } => {
                let before = if *body_first { 0 } else { usize::MAX };
                self.push_frame(thread, id, 0, path, inside, Some((before, None)));
                if *body_first {
                    self.begin_iteration(program, thread);
                } else {
                    self.set(thread, Todo::Iterate);
                }
            }
            StateKind::Condition { predicate, then, otherwise, .. } => {
                match self.with_scope(context, thread, None, |scope| predicate.holds(scope)) {
                    Ok(taken) => {
                        self.decided(context, &path, if taken { "then" } else { "else" }.to_owned());
                        let (list, children) = if taken { (0, then) } else { (1, otherwise) };
                        self.begin_list(context, thread, id, list, path, base, children);
                    }
                    Err(error) => self.ended(thread, id, ABORTED, wrong("its predicate", &error)),
                }
            }
            StateKind::Concurrency { regions, .. } => self.fork(context.plan, thread, id, path, regions),
        }
    }

    /// Logs a decision, which has no instance of its own here, so that later runs learn from it.
    pub(super) fn decided(&self, context: &mut Context<'_>, path: &str, decision: String) {
        context.note(Note::Decided { instance: InstanceId(0), path: path.to_owned(), decision });
    }

    pub(super) fn set(&mut self, thread: u64, todo: Todo) {
        if let Some(thread) = self.threads.get_mut(&thread) {
            thread.todo = todo;
        }
    }

    /// Counts a visit of a state; returns its path.
    fn visit(&mut self, thread: u64, id: StateId, name: &str) -> String {
        let Some(frame) = self.threads.get_mut(&thread).and_then(|thread| thread.frames.last_mut()) else {
            return name.to_owned();
        };
        let visits = frame.visits.entry(id).or_default();
        *visits += 1;
        let name = if *visits > 1 { format!("{name}#{visits}") } else { name.to_owned() };
        match &frame.iteration {
            Some((index, _)) => child_path(&format!("{}[{index}]", frame.path), &name),
            None => child_path(&frame.path, &name),
        }
    }

    /// A loop fails before its first iteration; its variables are removed.
    fn fail_at_its_list(&mut self, id: u64, state: StateId, base: usize, reason: String) {
        if let Some(thread) = self.threads.get_mut(&id) {
            thread.variables.truncate(base);
        }
        self.ended(id, state, ABORTED, reason);
    }

    /// Stores the outputs of a state that has ended well.
    pub(super) fn write(&mut self, id: StateId, outputs: Outputs) {
        self.earlier.remove(&id);
        self.outputs.insert(id, outputs);
    }

    /// Removes old outputs of body states that this iteration has passed over on its way to `to`, or to its end. Outputs of states that may still
    /// come stay those of the iteration before.
    fn forget_passed_over(&mut self, program: &Program, thread: u64, to: Option<StateId>) {
        if self.earlier.is_empty() {
            return;
        }
        let Some(frame) = self.threads.get(&thread).and_then(|thread| thread.frames.last()) else { return };
        let owner = program.state(frame.owner);
        if !program.is_iterated(owner.id) {
            return;
        }
        let passed = owner.children().take_while(|child| Some(*child) != to);
        for child in passed {
            if self.earlier.remove(&child) {
                self.outputs.remove(&child);
            }
        }
    }

    /// Removes the outputs that states inside wrote in an earlier activation.
    fn forget_inside(&mut self, program: &Program, id: StateId) {
        for child in program.state(id).children() {
            self.outputs.remove(&child);
            self.earlier.remove(&child);
            self.regions.remove(&child);
            self.forget_inside(program, child);
        }
    }

    fn push_frame(
        &mut self,
        thread: u64,
        owner: StateId,
        list: usize,
        path: String,
        variables: usize,
        iteration: Option<(usize, Option<List>)>,
    ) {
        let frame =
            Frame { owner, list, path, visits: Default::default(), iteration, variables, because: String::new() };
        if let Some(thread) = self.threads.get_mut(&thread) {
            thread.frames.push(frame);
        }
    }

    #[expect(clippy::too_many_arguments, reason = "all of it is one activation")]
    fn begin_list(
        &mut self,
        context: &mut Context<'_>,
        thread: u64,
        owner: StateId,
        list: usize,
        path: String,
        variables: usize,
        children: &[StateId],
    ) {
        self.push_frame(thread, owner, list, path, variables, None);
        match children.first() {
            Some(first) => self.set(thread, Todo::Enter(*first, None)),
            None => self.leave_list(context, thread, SUCCESS.to_owned(), String::new()),
        }
    }

    fn iterate(&mut self, context: &mut Context<'_>, id: u64) {
        let program = context.program;
        let Some(thread) = self.threads.get_mut(&id) else { return };
        let Some(frame) = thread.frames.last_mut() else { return };
        frame.visits.clear();
        frame.because.clear();
        thread.variables.truncate(frame.variables);
        let (owner, path) = (frame.owner, frame.path.clone());
        let Some((index, elements)) = &mut frame.iteration else { return };
        *index = index.wrapping_add(1);
        match elements {
            Some(elements) if *index < elements.len() => self.begin_iteration(program, id),
            Some(_) => self.leave_list(context, id, SUCCESS.to_owned(), String::new()),
            None => {
                let path = format!("{path}[{index}]");
                self.bind_iteration(program, id);
                let StateKind::While { predicate, .. } = &program.state(owner).kind else { return };
                match self.with_scope(context, id, None, |scope| predicate.holds(scope)) {
                    Ok(true) => {
                        self.decided(context, &path, "again".to_owned());
                        self.begin_iteration(program, id);
                    }
                    Ok(false) => {
                        self.decided(context, &path, "done".to_owned());
                        self.leave_list(context, id, SUCCESS.to_owned(), String::new());
                    }
                    Err(error) => {
                        // The loop itself fails, not a state of its body.
                        if let Some(thread) = self.threads.get_mut(&id)
                            && let Some(frame) = thread.frames.pop()
                        {
                            thread.variables.truncate(super::exit::outside(program.state(owner), frame.variables));
                        }
                        self.ended(id, owner, ABORTED, format!("{path}: its predicate: {error}"));
                    }
                }
            }
        }
    }

    fn begin_iteration(&mut self, program: &Program, thread: u64) {
        if !self.count_visit(thread) {
            return;
        }
        self.bind_iteration(program, thread);
        let Some(frame) = self.threads.get(&thread).and_then(|thread| thread.frames.last()) else { return };
        let of_the_body = program.body_of(frame.owner).iter().copied();
        self.earlier.extend(of_the_body.filter(|state| self.outputs.contains_key(state)));
        let body = match &program.state(frame.owner).kind {
            StateKind::ForEach { body, .. } | StateKind::While { body, .. } => body.first(),
            _ => None,
        };
        self.set(thread, body.map_or(Todo::Iterate, |first| Todo::Enter(*first, None)));
    }

    fn bind_iteration(&mut self, program: &Program, thread: u64) {
        let Some(thread) = self.threads.get_mut(&thread) else { return };
        let Some(frame) = thread.frames.last() else { return };
        let Some((number, elements)) = &frame.iteration else { return };
        thread.variables.truncate(frame.variables);
        let count = Arc::new(Value::Int(i64::try_from(*number).unwrap_or(i64::MAX)));
        match &program.state(frame.owner).kind {
            StateKind::ForEach { variable, index, .. } => {
                let element = elements.as_ref().and_then(|all| all.get(*number)).cloned();
                thread.variables.extend(element.map(|element| (variable.clone(), Arc::new(element))));
                thread.variables.extend(index.clone().map(|index| (index, count)));
            }
            StateKind::While { index, .. } => thread.variables.extend(index.clone().map(|index| (index, count))),
            _ => {}
        }
    }

    fn follow(&mut self, context: &mut Context<'_>, id: u64, state: StateId, outcome: String, reason: String) {
        self.end_routine(context, id, state, &outcome);
        if self.goes_on_out(context, id, state, &outcome, &reason) {
            return;
        }
        let Some(frame) = self.threads.get(&id).and_then(|thread| thread.frames.last()) else {
            return self.set(id, Todo::Done { outcome, reason });
        };
        let (owner, list) = (context.program.state(frame.owner), frame.list);
        if matches!(owner.kind, StateKind::Concurrency { .. }) {
            // A region has one state and ends as it does.
            return self.set(id, Todo::Done { outcome, reason });
        }
        if is_failure(&outcome)
            && !reason.is_empty()
            && let Some(frame) = self.threads.get_mut(&id).and_then(|thread| thread.frames.last_mut())
        {
            frame.because.clone_from(&reason);
        }
        match context.program.target(state, &outcome) {
            Target::State(next) => self.set(id, Todo::Enter(next, None)),
            Target::Outcome(by) => {
                self.forget_passed_over(context.program, id, None);
                let is_loop = matches!(owner.kind, StateKind::ForEach { .. } | StateKind::While { .. });
                debug_assert!(owner.lists().get(list).is_some_and(|list| list.contains(&state)));
                if is_loop && by == SUCCESS {
                    self.set(id, Todo::Iterate);
                } else {
                    let reason = self.because(id, &by, reason);
                    self.leave_list(context, id, by, reason);
                }
            }
        }
    }

    /// Reason with which a list ends: that of its last failure, if the ending state itself gives none. A success has no reason.
    fn because(&self, id: u64, outcome: &str, reason: String) -> String {
        if outcome == SUCCESS {
            return String::new();
        }
        let frame = self.threads.get(&id).and_then(|thread| thread.frames.last());
        match frame.filter(|_| is_failure(outcome) && reason.is_empty()) {
            Some(frame) => frame.because.clone(),
            None => reason,
        }
    }

    /// Leaves the innermost list, and with it the state around it.
    fn leave_list(&mut self, context: &mut Context<'_>, id: u64, outcome: String, reason: String) {
        let Some(frame) = self.threads.get_mut(&id).and_then(|thread| thread.frames.pop()) else { return };
        self.exit(context, id, frame.owner, &frame.path, frame.variables, outcome, reason);
    }
}
