//! Pause, single step and breakpoints: whether PIAs may begin.

use ratn_model::id::{InstanceId, StateId};
use ratn_model::program::{Nature, Program, StateKind};
use serde::{Deserialize, Serialize};
use std::collections::BTreeSet;

/// What the operator lets begin.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
pub(crate) struct Hold {
    /// So many PIAs, then it is a pause; `None`: all.
    steps: Option<u32>,
    /// The paths of states before which it becomes a pause, as they were said.
    breakpoints: Vec<String>,
    /// The states that these are, or are inside of.
    states: BTreeSet<StateId>,
    /// The PIA at whose breakpoint it became a pause.
    stopped_at: Option<InstanceId>,
    /// The one that was let go from there.
    passes: Option<InstanceId>,
}

impl Hold {
    /// Whether a PIA of this state may begin.
    pub(crate) fn lets_begin(&self, instance: InstanceId, state: StateId) -> bool {
        self.steps != Some(0) && !self.is_at_breakpoint(instance, state)
    }

    /// A PIA that may not begin has its turn. Where that is for a breakpoint, it is a pause from now on.
    pub(crate) fn stops_at(&mut self, instance: InstanceId, state: StateId) -> bool {
        let stops = self.steps != Some(0) && self.is_at_breakpoint(instance, state);
        if stops {
            (self.steps, self.stopped_at) = (Some(0), Some(instance));
        }
        stops
    }

    /// A PIA has begun.
    pub(crate) fn has_begun(&mut self, instance: InstanceId) {
        self.steps = self.steps.map(|steps| steps.saturating_sub(1));
        self.passes = self.passes.filter(|passes| *passes != instance);
    }

    /// No more may begin.
    pub(crate) fn pause(&mut self) {
        self.steps = Some(0);
    }

    /// All may begin.
    pub(crate) fn resume(&mut self) {
        self.steps = None;
        self.pass();
    }

    /// One more may begin, and then no more.
    pub(crate) fn step(&mut self) {
        self.steps = Some(self.steps.unwrap_or(0).saturating_add(1));
        self.pass();
    }

    /// These are the breakpoints from now on, by the paths of states without visits.
    pub(crate) fn break_at(&mut self, program: &Program, breakpoints: Vec<String>) {
        self.states = breakpoints.iter().flat_map(|path| states_at(program, path)).collect();
        self.breakpoints = breakpoints;
    }

    /// The breakpoints, as they were said.
    pub(crate) fn breakpoints(&self) -> &[String] {
        &self.breakpoints
    }

    fn pass(&mut self) {
        self.passes = self.stopped_at.take().or(self.passes);
    }

    fn is_at_breakpoint(&self, instance: InstanceId, state: StateId) -> bool {
        self.states.contains(&state) && self.passes != Some(instance)
    }
}

/// The states at a path and inside of it; for one inside of a routine that routine, which is one PIA.
fn states_at(program: &Program, path: &str) -> impl Iterator<Item = StateId> {
    let is_in = |inner: &str, outer: &str| inner.strip_prefix(outer).is_some_and(|rest| rest.starts_with('/'));
    let meant = program.states.iter().filter(move |state| {
        state.path == path || is_in(&state.path, path) || state.is_routine() && is_in(path, &state.path)
    });
    meant.map(|state| state.id)
}

/// Whether a run stops anywhere for a breakpoint at a path: a PIA is there, is inside of it, or is a routine around it.
pub(crate) fn stops_for(program: &Program, path: &str) -> bool {
    states_at(program, path).any(|id| {
        let state = program.state(id);
        let acts = matches!(state.kind, StateKind::Action { .. }) && state.annotations.nature == Nature::Irreversible;
        acts || state.is_pause() || state.is_routine()
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    const STATE: StateId = StateId(3);

    fn with_breakpoint() -> Hold {
        Hold { states: BTreeSet::from([STATE]), ..Hold::default() }
    }

    #[test]
    fn a_breakpoint_is_a_pause_once_for_each_instance() {
        let mut hold = with_breakpoint();
        let [first, second, other] = [1, 2, 9].map(InstanceId);
        assert!(hold.lets_begin(other, StateId(0)) && !hold.lets_begin(first, STATE));
        assert!(hold.stops_at(first, STATE) && !hold.stops_at(first, STATE), "it stops once");
        assert!(!hold.lets_begin(other, StateId(0)), "nothing begins now");
        hold.resume();
        assert!(hold.lets_begin(first, STATE) && !hold.lets_begin(second, STATE));
        hold.has_begun(first);
        assert!(!hold.lets_begin(first, STATE), "another try of it stops again");
        assert!(hold.lets_begin(other, StateId(0)) && hold.stops_at(second, STATE));
    }

    #[test]
    fn a_step_lets_go_what_stands_at_a_breakpoint_and_pauses_again() {
        let mut hold = with_breakpoint();
        let [first, other] = [1, 9].map(InstanceId);
        assert!(hold.stops_at(first, STATE));
        hold.step();
        assert!(hold.lets_begin(first, STATE));
        hold.has_begun(first);
        assert!(
            !hold.lets_begin(other, StateId(0)) && !hold.stops_at(other, StateId(0)),
            "it is the pause of the step"
        );
    }
}
