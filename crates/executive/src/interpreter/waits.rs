//! States that wait: they begin as actions do, but no provider gets a goal. Whenever the world may have changed or a signal may have come,
//! every wait under way is checked, in its turn.

use super::node::GoalEnd;
use super::{Current, Interpreter, MAIN, Phase};
use crate::awaiting::{self, WaitEnd};
use crate::binding;
use crate::context::Context;
use crate::protocol::{Awaited, Command, Note};
use crate::turn::Turn;
use ratn_model::id::{InstanceId, StateId};
use ratn_model::program::{Program, VIOLATED};
use ratn_model::time::Timestamp;

impl Interpreter {
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

    /// The turns of the waits and watched motions under way. `place` is that of the region around the state.
    pub(crate) fn waits<'a>(&'a self, program: &'a Program, place: u64) -> impl Iterator<Item = Turn> + 'a {
        let waits = |current: &Current| {
            let state = program.state(current.state);
            current.phase == Phase::Running && (state.is_pause() || !state.annotations.holds.is_empty())
        };
        self.turns(place, move |current| waits(current).then_some(current.since))
    }

    /// The turns of what ends by its time.
    pub(crate) fn timed(&self, place: u64) -> impl Iterator<Item = Turn> {
        self.turns(place, |current| match current.phase {
            Phase::Backoff(until) => Some(until),
            Phase::Running => current.timeout,
            _ => None,
        })
    }

    fn turns<'a>(
        &'a self,
        place: u64,
        at: impl Fn(&Current) -> Option<Timestamp> + 'a,
    ) -> impl Iterator<Item = Turn> + 'a {
        self.threads.iter().filter_map(move |(thread, of)| {
            let current = of.current.as_ref()?;
            let place = if *thread == MAIN { place } else { *thread };
            Some(Turn { at: at(current)?, place, instance: current.instance, state: current.state })
        })
    }

    /// Ends the first wait that is over, if the world may have ended one since the last look; true if one was.
    pub(super) fn end_a_wait(&mut self, context: &mut Context<'_>) -> bool {
        if std::mem::take(&mut self.has_changed) {
            let mut waiting: Vec<Turn> = self.waits(context.program, MAIN).collect();
            waiting.sort_unstable();
            self.has_changed = waiting.into_iter().any(|turn| self.is_over(context, turn.instance));
        }
        self.has_changed
    }

    /// Ends a wait, or a watched motion, if it is over; true if it was.
    pub(crate) fn is_over(&mut self, context: &mut Context<'_>, instance: InstanceId) -> bool {
        match self.thread_of(instance).and_then(|thread| Some((thread, self.current(thread)?.state))) {
            Some((thread, state)) if context.program.state(state).is_pause() => {
                self.ends_waiting(context, thread, state)
            }
            Some((thread, _)) => self.ends_violated(context, thread),
            None => false,
        }
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
        let Some(thread) = self.thread_of(instance).filter(|id| self.phase(*id) == Some(Phase::Running)) else {
            return;
        };
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
