//! Concurrency: one thread per region, and the decider when they have ended.

use super::{Decided, Interpreter, Thread, Todo};
use crate::context::Context;
use crate::plan::Plan;
use ratn_model::id::StateId;
use ratn_model::program::{ABORTED, PREEMPTED, Program, SUCCESS, StateKind, VIOLATED};
use ratn_model::wait::Wait;
use std::sync::Arc;

impl Interpreter {
    /// Begins every region, each with its own copy of the variables.
    pub(super) fn fork(&mut self, plan: &Plan, thread: u64, state: StateId, path: String, regions: &[StateId]) {
        let Some(around) = self.threads.get(&thread) else { return };
        let (variables, routine) = (around.variables.clone(), around.routine);
        let mut threads = Vec::new();
        for region in regions {
            let number = plan.state(*region).place;
            threads.push(number);
            let todo = Todo::Enter(*region, None);
            let frame = super::Frame {
                owner: state,
                list: threads.len() - 1,
                path: path.clone(),
                visits: Default::default(),
                iteration: None,
                variables: variables.len(),
                because: String::new(),
            };
            let (frames, variables) = (vec![frame], variables.clone());
            let region = Thread { frames, variables, todo, current: None, routine, idle_visits: 0, cut_short: None };
            self.threads.insert(number, region);
        }
        self.set(thread, Todo::Join { state, path, regions: threads, decided: None });
    }

    /// Whether enough regions have ended for the join.
    pub(super) fn may_join(
        &self,
        program: &Program,
        thread: u64,
        state: StateId,
        regions: &[u64],
        is_decided: bool,
    ) -> bool {
        if is_decided || self.is_leaving(thread) {
            return self.have_ended(regions);
        }
        let mut ended = regions.iter().map(|region| self.region_end(*region).is_some());
        match program.state(state).kind {
            StateKind::Concurrency { successes: Some(wanted), .. } => {
                let going_on = ended.filter(|ended| !ended).count();
                let succeeded = self.succeeded(regions);
                succeeded >= wanted as usize || succeeded + going_on < wanted as usize
            }
            StateKind::Concurrency { preemptive: true, .. } => regions.is_empty() || ended.any(|ended| ended),
            _ => ended.all(|ended| ended),
        }
    }

    pub(super) fn have_ended(&self, regions: &[u64]) -> bool {
        regions.iter().all(|region| self.region_end(*region).is_some())
    }

    fn succeeded(&self, regions: &[u64]) -> usize {
        regions.iter().filter(|region| self.region_end(**region).is_some_and(|(outcome, _)| outcome == SUCCESS)).count()
    }

    /// Outcome and reason of a region that has ended.
    pub(super) fn region_end(&self, region: u64) -> Option<(&str, &str)> {
        match &self.threads.get(&region)?.todo {
            Todo::Done { outcome, reason } => Some((outcome, reason)),
            _ => None,
        }
    }

    /// Enough regions have ended: cuts the others short; when these have ended, too, the outcomes decide.
    pub(super) fn join(
        &mut self,
        context: &mut Context<'_>,
        thread: u64,
        id: StateId,
        path: String,
        regions: Vec<u64>,
        decided: Option<Decided>,
    ) {
        if self.is_leaving(thread) {
            return self.leave_regions(context, thread, id, &path, &regions);
        }
        let Decided { first, enough, is_entered } =
            decided.unwrap_or_else(|| self.decision(context.program, id, &regions));
        for region in &regions {
            self.cut_short(context, *region);
        }
        if !self.have_ended(&regions) {
            let decided = Some(Decided { first, enough, is_entered });
            return self.set(thread, Todo::Join { state: id, path, regions, decided });
        }
        let regions = regions.as_slice();
        let program = context.program;
        let StateKind::Concurrency { regions: states, decide, preemptive, .. } = &program.state(id).kind else {
            return;
        };
        let watches = states.first().is_some_and(|first| matches!(program.state(*first).wait(), Some(Wait::Watch(_))));
        let mut outcomes = Vec::new();
        let mut reasons = Vec::new();
        for (region, state) in regions.iter().zip(states) {
            let end = self.region_end(*region).map(|(outcome, reason)| (outcome.to_owned(), reason.to_owned()));
            let (outcome, reason) = end.unwrap_or_else(|| (PREEMPTED.to_owned(), String::new()));
            self.regions.insert(*state, outcome.clone());
            if !reason.is_empty() {
                reasons.push(reason);
            }
            outcomes.push(outcome);
        }
        self.merge_variables(thread, regions);
        for region in regions {
            self.threads.remove(region);
        }
        let base = self.threads.get(&thread).map_or(0, |thread| thread.variables.len());
        let mut reason = reasons.join("; ");
        let mut decision = None;
        for (outcome, holds) in decide {
            match self.with_scope(context, thread, None, |scope| holds.holds(scope)) {
                Ok(false) => {}
                Ok(true) => decision = Some(outcome.clone()),
                Err(error) => {
                    reason = format!("{path}: `decide.{outcome}`: {error}");
                    decision = Some(ABORTED.to_owned());
                }
            }
            if decision.is_some() {
                break;
            }
        }
        let outcome = decision.unwrap_or_else(|| match first {
            _ if enough == Some(true) => SUCCESS.to_owned(),
            _ if enough == Some(false) => ABORTED.to_owned(),
            Some(first) if *preemptive && decide.is_empty() => outcomes[first].clone(),
            _ if outcomes.iter().all(|outcome| outcome == SUCCESS) => SUCCESS.to_owned(),
            _ if outcomes.iter().any(|outcome| outcome == ABORTED || outcome == VIOLATED) => ABORTED.to_owned(),
            _ => PREEMPTED.to_owned(),
        });
        if enough == Some(true) && outcome == SUCCESS {
            reason.clear();
        }
        self.decided(context, &path, outcome.clone());
        if outcome == VIOLATED && watches && !is_entered {
            // The watched state has not begun, so it has changed nothing.
            if let Some(thread) = self.threads.get_mut(&thread) {
                thread.variables.truncate(base);
            }
            return self.ended(thread, id, outcome, reason);
        }
        self.exit(context, thread, id, &path, base, outcome, reason);
    }

    /// The present decision of a concurrency.
    fn decision(&self, program: &Program, id: StateId, regions: &[u64]) -> Decided {
        let StateKind::Concurrency { successes, .. } = &program.state(id).kind else {
            return Decided { first: None, enough: None, is_entered: true };
        };
        let last = regions.last().and_then(|last| self.threads.get(last));
        Decided {
            first: regions.iter().position(|region| self.region_end(*region).is_some()),
            enough: successes.map(|wanted| self.succeeded(regions) >= wanted as usize),
            is_entered: last.is_none_or(|last| !matches!(last.todo, Todo::Enter(..)) || last.frames.len() > 1),
        }
    }

    /// Takes over what regions assigned to variables outside; if several assigned the same variable, the last region
    /// wins.
    pub(super) fn merge_variables(&mut self, thread: u64, regions: &[u64]) {
        let Some(before) = self.threads.get(&thread).map(|thread| thread.variables.clone()) else { return };
        for region in regions {
            let Some(theirs) = self.threads.get(region).map(|region| region.variables.clone()) else { continue };
            let Some(thread) = self.threads.get_mut(&thread) else { return };
            for ((own, old), new) in thread.variables.iter_mut().zip(&before).zip(theirs) {
                if !Arc::ptr_eq(&new.1, &old.1) && new.1 != old.1 {
                    own.1 = new.1;
                }
            }
        }
    }
}
