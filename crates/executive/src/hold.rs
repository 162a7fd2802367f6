//! Pause, single step and breakpoints: whether PIAs may begin.

use ratn_model::id::{InstanceId, StateId};
use ratn_model::program::{Nature, Program, State, StateKind};
use serde::{Deserialize, Serialize};
use std::collections::BTreeSet;

/// The operator's control over PIAs.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
pub(crate) struct Hold {
    /// Number of PIAs that may still begin; `None`: no limit.
    steps: Option<u32>,
    /// The paths of the breakpoints, as the operator gave them.
    breakpoints: Vec<String>,
    /// The states at the breakpoints and inside of them.
    states: BTreeSet<StateId>,
    /// The PIA whose breakpoint caused the pause.
    stopped_at: Option<InstanceId>,
    /// The PIA that may pass its breakpoint.
    passes: Option<InstanceId>,
}

impl Hold {
    /// Whether a PIA of this state may begin now.
    pub(crate) fn lets_begin(&self, instance: InstanceId, state: StateId) -> bool {
        self.steps != Some(0) && !self.is_at_breakpoint(instance, state)
    }

    /// Called when a PIA would be next but may not begin: if it stands at a breakpoint, the run pauses from now on.
    pub(crate) fn stops_at(&mut self, instance: InstanceId, state: StateId) -> bool {
        let stops = self.steps != Some(0) && self.is_at_breakpoint(instance, state);
        if stops {
            (self.steps, self.stopped_at) = (Some(0), Some(instance));
        }
        stops
    }

    /// Notes that a PIA has begun.
    pub(crate) fn has_begun(&mut self, instance: InstanceId) {
        self.steps = self.steps.map(|steps| steps.saturating_sub(1));
        self.passes = self.passes.filter(|passes| *passes != instance);
    }

    /// Pauses: no more PIAs begin.
    pub(crate) fn pause(&mut self) {
        self.steps = Some(0);
    }

    /// Resumes: all PIAs may begin.
    pub(crate) fn resume(&mut self) {
        self.steps = None;
        self.pass();
    }

    /// Single step: one more PIA may begin, then the run pauses.
    pub(crate) fn step(&mut self) {
        self.steps = Some(self.steps.unwrap_or(0).saturating_add(1));
        self.pass();
    }

    /// Replaces all breakpoints, given by paths of states without visits.
    pub(crate) fn break_at(&mut self, program: &Program, breakpoints: Vec<String>) {
        self.states = breakpoints.iter().flat_map(|path| states_at(program, path)).collect();
        self.breakpoints = breakpoints;
    }

    /// The breakpoints, as the operator gave them.
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

/// The states at a path and inside of it. Inside of a routine: that routine, because it is one PIA.
fn states_at(program: &Program, path: &str) -> impl Iterator<Item = StateId> {
    let is_in = |inner: &str, outer: &str| inner.strip_prefix(outer).is_some_and(|rest| rest.starts_with('/'));
    let meant = program.states.iter().filter(move |state| {
        state.path == path || is_in(&state.path, path) || state.is_routine() && is_in(path, &state.path)
    });
    meant.map(|state| state.id)
}

/// Whether a breakpoint at a path can stop a run: a PIA is at this path or inside of it, or a routine is around it.
pub(crate) fn stops_for(program: &Program, path: &str) -> bool {
    states_at(program, path).any(|id| acts(program.state(id)))
}

/// Whether a state needs the operator's permission to begin.
fn acts(state: &State) -> bool {
    let is_pia = matches!(state.kind, StateKind::Action { .. }) && state.annotations.nature == Nature::Irreversible;
    is_pia || state.is_pause() || state.is_routine()
}

/// Every path at which a breakpoint stops a run (see [`stops_for`]), in program order.
pub(crate) fn stopping(program: &Program) -> Vec<&str> {
    let (mut around, mut routines) = (BTreeSet::new(), BTreeSet::new());
    for state in program.states.iter().filter(|state| acts(state)) {
        around.extend(outer(&state.path));
        around.insert(state.path.as_str());
        if state.is_routine() {
            routines.insert(state.path.as_str());
        }
    }
    let stops = |path: &str| around.contains(path) || outer(path).any(|outer| routines.contains(outer));
    let mut told = BTreeSet::new();
    let paths = program.states.iter().map(|state| state.path.as_str());
    paths.filter(|path| !path.is_empty() && stops(path) && told.insert(*path)).collect()
}

/// The paths of the states around a path.
fn outer(path: &str) -> impl Iterator<Item = &str> {
    path.match_indices('/').map(|(end, _)| &path[..end])
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
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

    #[test]
    fn every_path_at_which_a_run_stops_is_told_and_no_other() {
        let examples = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../../examples");
        let (mut stopping_there, mut quiet_there) = (0, 0);
        for file in std::fs::read_dir(examples).unwrap() {
            let path = file.unwrap().path();
            if path.extension().is_none_or(|ending| ending != "yaml") {
                continue;
            }
            let source = std::fs::read_to_string(&path).unwrap();
            let loaded = ratn_model::load::load(&source, "task.yaml", &ratn_model::catalogue::Catalogue::standard());
            let Ok(loaded) = loaded else { continue };
            let program = loaded.program;
            let told: BTreeSet<&str> = stopping(&program).into_iter().collect();
            for state in program.states.iter().filter(|state| !state.path.is_empty()) {
                let stops = stops_for(&program, &state.path);
                assert_eq!(told.contains(state.path.as_str()), stops, "{} of {}", state.path, path.display());
                *(if stops { &mut stopping_there } else { &mut quiet_there }) += 1;
            }
        }
        assert!(stopping_there > 20 && quiet_there > 20, "{stopping_there} and {quiet_there}: are the examples read?");
    }
}
