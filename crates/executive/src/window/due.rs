//! What falls due: the window's timers, and what is due inside of routines, in one order.

use super::graph::instance::{Ended, Status};
use super::waits::Timer;
use super::{End, Window};
use crate::context::Context;
use crate::protocol::{Command, Event};
use crate::turn::Turn;
use ratn_model::id::InstanceId;
use ratn_model::time::Timestamp;

impl Window {
    /// When what is due first is due, if it is by now.
    pub(crate) fn next_due(&mut self, now: Timestamp) -> Option<Timestamp> {
        self.first_due(now).map(|(turn, _)| turn.at)
    }

    /// Ends what is due first, and goes on; returns the end of the run if that ended it.
    pub(crate) fn fall_due(&mut self, context: &mut Context<'_>) -> Option<End> {
        let (turn, timer) = self.first_due(context.now)?;
        match timer {
            Timer::Inside(routine) => {
                self.with_routine(context, routine, |inside, context| inside.time_is_up(context, turn.instance));
            }
            timer => {
                self.waits.remove_timer(turn.at, timer);
                self.fire(context, timer);
            }
        }
        self.go_on(context)
    }

    fn first_due(&mut self, now: Timestamp) -> Option<(Turn, Timer)> {
        loop {
            let due: Vec<(Timestamp, Timer)> = self.waits.first_due(now).collect();
            let first = due.iter().flat_map(|(at, timer)| self.turns_of(*at, *timer)).min();
            if first.is_some() || due.is_empty() {
                return first;
            }
            // What they were set for is over.
            due.into_iter().for_each(|(at, timer)| self.waits.remove_timer(at, timer));
        }
    }

    /// The turns of what a timer was set for, as far as it is still to come.
    fn turns_of(&self, at: Timestamp, timer: Timer) -> Vec<(Turn, Timer)> {
        let Some(instance) = self.graph.get(timer.instance()) else { return Vec::new() };
        let place = instance.line.place();
        let turn = Turn { at, place, instance: instance.id, state: instance.state };
        match timer {
            Timer::Inside(id) => {
                let inside = self.status_of_routine(id).into_iter().flat_map(|routine| routine.timed(place));
                inside.filter(|turn| turn.at <= at).map(|turn| (turn, timer)).collect()
            }
            Timer::Timeout(id, attempt) if !self.is_at(id, attempt) => Vec::new(),
            _ => vec![(turn, timer)],
        }
    }

    /// A goal waits before it is given to its provider, or has been given: its timeout counts from then.
    pub(super) fn given(&mut self, context: &mut Context<'_>, event: Event) {
        let (Event::Delayed { instance: id, attempt } | Event::Given { instance: id, attempt }) = event else { return };
        if !self.is_at(id, attempt) {
            return self.in_routine(context, event);
        }
        let Some(state) = self.graph.get(id).map(|instance| instance.state) else { return };
        let timer = Timer::Timeout(id, attempt);
        match context.program.state(state).annotations.timeout_s {
            Some(_) if matches!(event, Event::Delayed { .. }) => self.waits.forget_timer(timer),
            Some(limit_s) if !self.waits.has_timer(timer) => self.set_timer(context, limit_s, timer),
            _ => {}
        }
    }

    fn fire(&mut self, context: &mut Context<'_>, timer: Timer) {
        match timer {
            Timer::Retry(id) => self.waits.enqueue(&mut self.graph, id),
            Timer::Hold(id) => {
                if self.dispatch.let_go(id, context.now) {
                    self.waits.enqueue(&mut self.graph, id);
                }
            }
            Timer::Room(id) => self.make_way_for(context, id),
            Timer::Timeout(id, attempt) => {
                let Some(instance) = self.graph.get(id) else { return };
                let state = context.program.state(instance.state);
                if state.is_pause() {
                    return self.waited_long_enough(context, id);
                }
                let limit = state.annotations.timeout_s.unwrap_or_default();
                context.commands.push(Command::Cancel { instance: id, attempt });
                self.goal_ended(context, id, Ended::aborted(format!("it took longer than {limit} s")));
            }
            Timer::Inside(_) => {}
        }
    }

    /// Whether this attempt of an instance is running.
    fn is_at(&self, id: InstanceId, attempt: u32) -> bool {
        let is_running = |status: &Status| matches!(status, Status::Running(_));
        let running = self.graph.get(id).filter(|instance| instance.end_to_take().is_none());
        let node = running.and_then(|instance| instance.node());
        node.is_some_and(|node| node.attempt == attempt && is_running(&node.status))
    }
}
