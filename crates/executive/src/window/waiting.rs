//! States that wait: they begin as PIAs do, at the head of their line, but no provider gets a goal. Whenever the root has changed or a
//! signal has come, every wait under way is checked in its turn, those inside of routines too.
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
use crate::turn::Turn;
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
        self.graph.run(id, now);
        if let Some(until) = until {
            self.waits.set_timer_at(until, Timer::Timeout(id, attempt));
            context.commands.push(Command::Wake { at: until });
        }
        if !state.is_unsaid() {
            context.note(Note::Awaiting { instance: id, awaited, until });
        }
    }

    /// Ends the first wait, or watched motion, that is over, if the world may have ended one since the last look; true if one was.
    pub(super) fn look_at_waits(&mut self, context: &mut Context<'_>) -> bool {
        if !std::mem::take(&mut self.may_end_waits) {
            return false;
        }
        let mut waiting: Vec<(Turn, InstanceId)> = self.waits_under_way(context.program).collect();
        waiting.sort_unstable();
        for (turn, id) in waiting {
            if self.end.is_some() || self.is_over(context, turn.instance, id) {
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

    /// The turns of the waits and watched motions under way, also inside of routines, each with the node that it is in.
    pub(crate) fn waits_under_way<'a>(&'a self, program: &'a Program) -> impl Iterator<Item = (Turn, InstanceId)> + 'a {
        let turns = move |id: InstanceId| {
            let instance = self.graph.get(id)?;
            let (state, place) = (program.state(instance.state), instance.line.place());
            let own = match &instance.node()?.status {
                Status::Running(held) if state.is_pause() || !state.annotations.holds.is_empty() => {
                    Some(Turn { at: held.since, place, instance: id, state: state.id })
                }
                _ => None,
            };
            let routine = self.status_of_routine(id).filter(|routine| routine.is_actual());
            let inside = routine.into_iter().flat_map(move |routine| routine.waits(program, place));
            Some(own.into_iter().chain(inside).map(move |turn| (turn, id)))
        };
        self.dispatch.active().filter_map(turns).flatten()
    }

    /// Ends a wait, or a watched motion, if it is over; true if it was. What follows inside of a routine comes in its turn.
    fn is_over(&mut self, context: &mut Context<'_>, inside: InstanceId, id: InstanceId) -> bool {
        if inside != id {
            return self.with_routine(context, id, |routine, context| routine.is_over(context, inside)) == Some(true);
        }
        match self.graph.get(id).map(|instance| context.program.state(instance.state).is_pause()) {
            Some(true) => self.ends_waiting(context, id),
            Some(false) => self.ends_violated(context, id),
            None => false,
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
        if state.annotations.holds.is_empty() || instance.end_to_take().is_some() {
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
