//! States that wait: they begin as PIAs do, at the head of their line, but no provider gets a goal. Whenever the root has changed or a
//! signal has come, every wait under way is checked, those inside of routines too.
//!
//! While a wait for a condition is under way, younger instances see the facts that its condition states literally; when it ends, the
//! root's facts take their place. A wait never begins beside an imprecise PIA, and is never passed over, so no signal is taken on a path
//! that is left.

use super::Window;
use super::graph::instance::{Changed, Ended, Status};
use super::waits::Timer;
use crate::awaiting::{self, WaitEnd};
use crate::binding::{self, Bindings, Outputs};
use crate::context::{Context, Made};
use crate::protocol::{Awaited, Command, Event, Note};
use ratn_model::expression::Scope;
use ratn_model::fact::Footprint;
use ratn_model::id::InstanceId;
use ratn_model::program::{Program, VIOLATED};

impl Window {
    /// Begins a wait at its place; ends it at once if it is over.
    pub(super) fn begin_waiting(&mut self, context: &mut Context<'_>, id: InstanceId) {
        let Some(instance) = self.graph.get(id) else { return };
        let Some(attempt) = instance.node().map(|node| node.attempt) else { return };
        let state = context.program.state(instance.state);
        let now = context.now;
        let (awaited, until) = match self.in_reality(context, id, |scope| awaiting::begins(state, now, scope)) {
            Some(Ok(begins)) => begins,
            Some(Err(error)) => return self.finish(context, id, Ended::aborted(error.reason())),
            None => return,
        };
        context.note(Note::Running { instance: id, attempt });
        // A wait that ends at once does not count as an action: a loop of such waits goes in circles.
        if self.ends_waiting(context, id) {
            return;
        }
        if awaited == Awaited::Time && until.is_some_and(|until| until <= now) {
            return self.has_waited(context, id, awaiting::is_up(state));
        }
        self.graph.run(id);
        if let Some(until) = until {
            self.waits.set_timer_at(until, Timer::Timeout(id, attempt));
            context.commands.push(Command::Wake { at: until });
        }
        if !state.is_unsaid() {
            context.note(Note::Awaiting { instance: id, awaited, until });
        }
    }

    /// Checks waits and watched motions under way, if the world may have ended one, until one is over; true if one was. Its consequences are
    /// handled before the others are checked.
    pub(super) fn look_at_waits(&mut self, context: &mut Context<'_>) -> bool {
        if !std::mem::take(&mut self.may_end_waits) {
            return false;
        }
        for id in self.longest_waiting_first(context.program) {
            if self.end.is_some() || self.is_over(context, id) {
                self.may_end_waits = true;
                return true;
            }
        }
        false
    }

    /// The same with the changes of the root that have not been followed yet.
    pub(super) fn ends_a_wait(&mut self, context: &mut Context<'_>) -> bool {
        self.follow_root(context);
        self.look_at_waits(context)
    }

    /// What is under way: what has waited longest first, then in the order of the lines.
    fn longest_waiting_first(&self, program: &Program) -> Vec<InstanceId> {
        let order = |id: &InstanceId| {
            let instance = self.graph.get(*id)?;
            let since = match &instance.node()?.status {
                Status::Running(held) => Some(held.since),
                Status::RunningRoutine(routine, since) => Some(routine.waits_since(program).unwrap_or(*since)),
                _ => None,
            };
            Some((since?, instance.line, *id))
        };
        let mut all: Vec<_> = self.dispatch.active().filter_map(|id| order(&id)).collect();
        all.sort_unstable();
        all.into_iter().map(|(_, _, id)| id).collect()
    }

    /// Checks a wait, a watched motion, or a routine with such inside; true if it has ended or gone on.
    fn is_over(&mut self, context: &mut Context<'_>, id: InstanceId) -> bool {
        let Some(instance) = self.graph.get(id) else { return false };
        match instance.node().map(|node| &node.status) {
            Some(Status::Running(_)) if context.program.state(instance.state).is_pause() => {
                self.ends_waiting(context, id)
            }
            Some(Status::Running(_)) => self.ends_violated(context, id),
            Some(Status::RunningRoutine(..)) if context.plan.state(instance.state).is_watched => {
                let before = context.commands.len();
                self.tell_routine(context, id, Event::Woken);
                context.commands.len() > before
            }
            _ => false,
        }
    }

    /// Ends a wait if its condition holds or its signal is kept; true if it ended.
    fn ends_waiting(&mut self, context: &mut Context<'_>, id: InstanceId) -> bool {
        let Some(state) = self.graph.get(id).map(|instance| context.program.state(instance.state)) else {
            return false;
        };
        if let Some(end) = awaiting::takes(state, context.signals) {
            self.has_waited(context, id, end);
            return true;
        }
        match self.in_reality(context, id, |scope| awaiting::has_come(state, scope)) {
            Some(Ok(Some(end))) => self.has_waited(context, id, end),
            Some(Err(error)) => self.finish(context, id, Ended::aborted(error.reason())),
            Some(Ok(None)) | None => return false,
        }
        true
    }

    /// Ends an action whose `while` condition does not hold, before it begins or while it runs; true if it ended.
    pub(super) fn ends_violated(&mut self, context: &mut Context<'_>, id: InstanceId) -> bool {
        let Some(instance) = self.graph.get(id) else { return false };
        let state = context.program.state(instance.state);
        if state.annotations.holds.is_empty() {
            return false;
        }
        let ended = match self.in_reality(context, id, |scope| binding::violated(state, scope)) {
            Some(Ok(Some(reason))) => Ended { reason, ..Ended::with(VIOLATED.to_owned(), Outputs::new()) },
            Some(Err(error)) => Ended::aborted(error.reason()),
            Some(Ok(None)) | None => return false,
        };
        let ended = match instance.node().filter(|node| node.status.is_running()) {
            Some(node) => {
                context.commands.push(Command::Cancel { instance: id, attempt: node.attempt });
                ended
            }
            None => Ended { changes: Changed::Exactly(Made::default()), ..ended },
        };
        self.finish(context, id, ended);
        true
    }

    /// Calls `use_scope` with the scope of a wait at its place: its variables, the ports of older instances, which are real there, and
    /// the facts of the actual world. Future effects of imprecise PIAs in other regions are not visible.
    fn in_reality<T>(&self, context: &Context<'_>, id: InstanceId, use_scope: impl Fn(&dyn Scope) -> T) -> Option<T> {
        self.look(context, id, None, |_, view| {
            let unknown = &Footprint::NOTHING;
            use_scope(&Bindings { names: view, outputs: None, world: context.root, unknown })
        })
    }

    /// The time of a wait is up.
    pub(super) fn waited_long_enough(&mut self, context: &mut Context<'_>, id: InstanceId) {
        // Its condition may hold, or its signal may have come, at this very moment.
        if !self.ends_waiting(context, id)
            && let Some(state) = self.graph.get(id).map(|instance| context.program.state(instance.state))
        {
            self.has_waited(context, id, awaiting::is_up(state));
        }
    }

    /// An operator has answered a question.
    pub(super) fn answer(&mut self, context: &mut Context<'_>, id: InstanceId, choice: &str) {
        let waiting = self
            .graph
            .get(id)
            .filter(|instance| instance.node().is_some_and(|node| matches!(node.status, Status::Running(_))));
        match waiting.map(|instance| context.program.state(instance.state)) {
            Some(state) => {
                if let Some(end) = awaiting::answered(state, choice) {
                    self.has_waited(context, id, end);
                }
            }
            None => self.in_routine(context, Event::Answered { instance: id, choice: choice.to_owned() }),
        }
    }

    fn has_waited(&mut self, context: &mut Context<'_>, id: InstanceId, end: WaitEnd) {
        let WaitEnd { outcome, outputs, reason } = end;
        let Some(state) = self.graph.get(id).map(|instance| instance.state) else { return };
        let foreseen = context.program.state(state).annotations.effects.get(&outcome);
        let as_it_is = self.in_reality(context, id, |scope| awaiting::as_it_is(foreseen, scope, context.root));
        let changes = Changed::Foreseen(as_it_is.unwrap_or_default());
        let ended = Ended { changes, reason, ..Ended::with(outcome, outputs) };
        self.finish(context, id, ended);
    }
}
