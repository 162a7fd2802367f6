//! States that wait: they begin as actions do, but no provider gets a goal. Whenever the world may have changed or a signal may have come,
//! every wait under way is checked.

use super::node::GoalEnd;
use super::{Interpreter, Phase, Progress, Thread};
use crate::awaiting::{self, WaitEnd};
use crate::binding;
use crate::context::Context;
use crate::protocol::{Awaited, Command, Note};
use ratn_model::id::{InstanceId, StateId};
use ratn_model::program::{Program, VIOLATED};
use ratn_model::time::Timestamp;

impl Interpreter {
    /// Goes on until all threads wait and none of these waits is over.
    pub(super) fn go_on_with(&mut self, context: &mut Context<'_>) -> Progress {
        loop {
            let progress = self.advance(context);
            if progress != Progress::Busy || !self.look_at_waits(context) {
                return progress;
            }
        }
    }

    pub(super) fn begin_waiting(&mut self, context: &mut Context<'_>, thread: u64) {
        let program = context.program;
        let Some(current) = self.threads.get(&thread).and_then(|thread| thread.current.as_ref()) else { return };
        let (instance, attempt, id) = (current.instance, current.attempt, current.state);
        let state = program.state(id);
        let now = context.now;
        let begins = self.with_scope(context, thread, None, |scope| awaiting::begins(state, now, scope));
        let (awaited, until) = match begins {
            Ok(begins) => begins,
            Err(error) => return self.end_node(context, thread, error.reason()),
        };
        if self.routine_of(thread).is_none() && self.is_pia(context, thread) {
            self.hold.has_begun(instance);
        }
        if let Some(current) = self.current(thread) {
            current.phase = Phase::Running;
            current.since = now;
            current.timeout = until;
        }
        context.note(Note::Running { instance, attempt });
        // A wait that ends at once does not count as an action: a loop of such waits goes in circles.
        if self.ends_waiting(context, thread, id) {
            return;
        }
        if awaited == Awaited::Time && until.is_some_and(|until| until <= now) {
            return self.has_waited(context, thread, awaiting::is_up(state));
        }
        self.has_begun_something(thread);
        context.commands.extend(until.map(|at| Command::Wake { at }));
        if !state.is_unsaid() {
            context.note(Note::Awaiting { instance, awaited, until });
        }
    }

    /// Since when the wait that is under way for the longest time waits.
    pub(crate) fn waits_since(&self, program: &Program) -> Option<Timestamp> {
        let under_way = self.threads.values().filter_map(|thread| thread.current.as_ref());
        let waits =
            under_way.filter(|current| current.phase == Phase::Running && program.state(current.state).is_pause());
        waits.map(|current| current.since).min()
    }

    /// Checks waits and watched motions under way until one is over; true if one was. What has waited longest comes first, then the first
    /// thread. The consequences are handled before the others are checked.
    pub(super) fn look_at_waits(&mut self, context: &mut Context<'_>) -> bool {
        let waits = |(thread, current): (u64, &super::Current)| {
            let state = context.program.state(current.state);
            let may_end = state.is_pause() || !state.annotations.holds.is_empty();
            (current.phase == Phase::Running && may_end).then_some((current.since, thread, current.state))
        };
        let under_way = self.threads.iter().filter_map(|(id, thread)| Some((*id, thread.current.as_ref()?)));
        let mut waiting: Vec<(Timestamp, u64, StateId)> = under_way.filter_map(waits).collect();
        waiting.sort_unstable();
        waiting.into_iter().any(|(_, thread, state)| {
            if context.program.state(state).is_pause() {
                self.ends_waiting(context, thread, state)
            } else {
                self.ends_violated(context, thread)
            }
        })
    }

    /// Ends a wait if its condition holds or its signal is kept; true if it ended.
    fn ends_waiting(&mut self, context: &mut Context<'_>, thread: u64, id: StateId) -> bool {
        let state = context.program.state(id);
        if let Some(end) = awaiting::takes(state, context.signals) {
            self.has_waited(context, thread, end);
            return true;
        }
        match self.with_scope(context, thread, None, |scope| awaiting::has_come(state, scope)) {
            Ok(None) => return false,
            Ok(Some(end)) => self.has_waited(context, thread, end),
            Err(error) => self.end_node(context, thread, error.reason()),
        }
        true
    }

    /// Ends an action whose `while` condition does not hold: before it begins (it has changed nothing then) or while it runs. True if it
    /// ended.
    pub(super) fn ends_violated(&mut self, context: &mut Context<'_>, thread: u64) -> bool {
        let Some(current) = self.threads.get(&thread).and_then(|thread| thread.current.as_ref()) else { return false };
        let state = context.program.state(current.state);
        if state.annotations.holds.is_empty() {
            return false;
        }
        let violated = self.with_scope(context, thread, None, |scope| binding::violated(state, scope));
        let has_begun = current.phase == Phase::Running;
        if has_begun && !matches!(violated, Ok(None)) {
            context.commands.push(Command::Cancel { instance: current.instance, attempt: current.attempt });
        }
        match violated {
            Ok(None) => return false,
            Ok(Some(reason)) if has_begun => self.has_waited(context, thread, awaiting::cut_short(VIOLATED, reason)),
            Ok(Some(reason)) => self.end_unanswered(context, thread, VIOLATED, reason),
            Err(error) => self.end_node(context, thread, error.reason()),
        }
        true
    }

    /// The time of a wait is up.
    pub(super) fn waited_long_enough(&mut self, context: &mut Context<'_>, thread: u64) {
        let Some(id) = self.current(thread).map(|current| current.state) else { return };
        // Its condition may hold, or its signal may have come, at this very moment.
        if !self.ends_waiting(context, thread, id) {
            self.has_waited(context, thread, awaiting::is_up(context.program.state(id)));
        }
    }

    /// An operator has answered a question.
    pub(super) fn answered(&mut self, context: &mut Context<'_>, instance: InstanceId, choice: &str) {
        let asks = |thread: &Thread| {
            let current = thread.current.as_ref();
            current.is_some_and(|current| current.instance == instance && current.phase == Phase::Running)
        };
        let Some(thread) = self.threads.iter().find(|(_, thread)| asks(thread)).map(|(id, _)| *id) else { return };
        let Some(id) = self.current(thread).map(|current| current.state) else { return };
        if let Some(end) = awaiting::answered(context.program.state(id), choice) {
            self.has_waited(context, thread, end);
        }
    }

    fn has_waited(&mut self, context: &mut Context<'_>, thread: u64, end: WaitEnd) {
        let (measured, evidence) = Default::default();
        let WaitEnd { outcome, outputs, reason } = end;
        self.finish(context, thread, GoalEnd { outcome, outputs, measured, evidence, reason });
    }
}
