//! Composite states: the order of inner states, and what happens at an exit.

use super::evaluate::Read;
use super::race::merge;
use super::{Fail, MAX_STEPS, Outputs, Reference, effects, fails};
use crate::around;
use ratn_model::id::StateId;
use ratn_model::program::{ABORTED, Again, Finally, PREEMPTED, Program, SUCCESS, State, StateKind, Target, VIOLATED};
use ratn_model::value::Value;
use std::collections::BTreeMap;

/// Variables in scope; the last one with a name counts.
type Variables = Vec<(String, Value)>;

impl Reference<'_> {
    /// Visits a state at a path; returns its outcome. If it is cut short, its effects for `preempted` are applied.
    pub(super) fn visit(
        &mut self,
        id: StateId,
        path: &str,
        variables: &mut Variables,
        in_routine: bool,
    ) -> Result<String, Fail> {
        let outside = variables.len();
        let ended = self.visited(id, path, variables, in_routine);
        let state = self.program.state(id);
        let is_composite = !matches!(state.kind, StateKind::Action { .. });
        if ended == Err(Fail::Cut) && is_composite && !std::mem::take(&mut self.is_outside) {
            let has_finally = |state: &State| state.annotations.finally.is_some();
            // A run that is told to end leaves the states inside of a state with `finally`.
            let is_left = self.has_lost() || around(self.program, state).skip(1).any(has_finally);
            if !has_finally(state) && is_left {
                self.say_cut_short(state, variables);
            }
            variables.truncate(outside);
        }
        ended
    }

    fn visited(
        &mut self,
        id: StateId,
        path: &str,
        variables: &mut Variables,
        in_routine: bool,
    ) -> Result<String, Fail> {
        let program = self.program;
        let state = program.state(id);
        self.steps += 1;
        if self.steps > MAX_STEPS {
            return Err(Fail::NotMine("a run without an end"));
        }
        self.may_come();
        if let Err(cut) = self.is_watched() {
            self.is_outside = !matches!(state.kind, StateKind::Action { .. });
            return Err(cut);
        }
        if let StateKind::Action { .. } = state.kind {
            if state.is_pause() {
                return self.wait(state, path, variables, in_routine);
            }
            return self.action(state, path, variables, in_routine);
        }
        if fails(self.meets(state, variables))?.is_err() {
            return Ok(ABORTED.to_owned());
        }
        let begins_routine = state.is_routine() && !in_routine;
        if begins_routine && let Err(cut) = self.may_be_cut() {
            self.is_outside = true;
            return Err(cut);
        }
        if begins_routine && fails(self.asks(state, variables))?.is_err() {
            return Ok(ABORTED.to_owned());
        }
        if !program.is_pass(id) {
            self.forget(id);
        }
        let outside = variables.len();
        for (name, value) in &state.variables {
            // No variable sees another one.
            let mut seen = variables.clone();
            seen.truncate(outside);
            match fails(value.read(&self.place(&seen, None)))? {
                Ok(value) => variables.push((name.clone(), value)),
                Err(_) => {
                    variables.truncate(outside);
                    return Ok(ABORTED.to_owned());
                }
            }
        }
        let inside = in_routine || begins_routine;
        let left = match &state.kind {
            StateKind::Action { .. } => None,
            StateKind::Sequence { .. } if state.annotations.finally.is_some() => {
                let finally = state.annotations.finally.as_ref();
                finally.map(|finally| self.lastly(finally, path, variables, inside)).transpose()?
            }
            StateKind::Sequence { .. } if state.annotations.again.is_some() => {
                let again = state.annotations.again.as_ref();
                again.map(|again| self.again(again, state, path, variables, inside)).transpose()?
            }
            StateKind::Sequence { children, .. } => Some(self.list(children, path, variables, inside)?),
            StateKind::Condition { predicate, then, otherwise, .. } => {
                match fails(predicate.is_true(&self.place(variables, None)))? {
                    Ok(true) => Some(self.list(then, path, variables, inside)?),
                    Ok(false) => Some(self.list(otherwise, path, variables, inside)?),
                    Err(_) => None,
                }
            }
            StateKind::ForEach { variable, index, collection, body, .. } => {
                match fails(collection.read(&self.place(variables, None)))? {
                    Ok(Value::List(elements)) => {
                        let mut left = SUCCESS.to_owned();
                        for (number, element) in elements.into_iter().enumerate() {
                            let before = variables.len();
                            variables.push((variable.clone(), element));
                            variables.extend(index.clone().map(|name| (name, Value::Int(number as i64))));
                            left = self.list(body, &format!("{path}[{number}]"), variables, inside)?;
                            variables.truncate(before);
                            if left != SUCCESS {
                                break;
                            }
                        }
                        Some(left)
                    }
                    _ => None,
                }
            }
            StateKind::While { predicate, body_first, index, body, .. } => {
                self.repeat(predicate, *body_first, index.as_deref(), body, path, variables, inside)?
            }
            StateKind::Concurrency { preemptive: true, .. } => match self.race(state, path, variables, inside)? {
                Some(outcome) => Some(outcome),
                None => {
                    variables.truncate(outside);
                    return Ok(VIOLATED.to_owned());
                }
            },
            StateKind::Concurrency { regions, decide, .. } => {
                Some(self.regions(regions, decide, path, variables, inside)?)
            }
        };
        // Its predicate or list has no value: the state itself fails, and its exit changes nothing.
        let Some(left) = left else {
            variables.truncate(outside);
            return Ok(ABORTED.to_owned());
        };
        let end = self.leave(state, &left, variables);
        // The task's outputs may use the task's own variables.
        if id != Program::ROOT {
            variables.truncate(outside);
        }
        match fails(end)? {
            Ok(assigned) => {
                assign(variables, assigned);
                Ok(left)
            }
            Err(_) => Ok(ABORTED.to_owned()),
        }
    }

    /// Checks every precondition.
    pub(super) fn meets(&self, state: &State, variables: &Variables) -> Result<(), Fail> {
        for required in &state.annotations.requires {
            if !required.is_true(&self.place(variables, None))? {
                return Err(Fail::Wrong(format!("{required} does not hold")));
            }
        }
        Ok(())
    }

    /// The values that a state assigns if it ends well.
    pub(super) fn assigned(
        &self,
        state: &State,
        variables: &Variables,
        own: &Outputs,
    ) -> Result<Vec<(String, Value)>, Fail> {
        let place = self.place(variables, Some(own));
        state.assign.iter().map(|(name, value)| Ok((name.clone(), value.read(&place)?))).collect()
    }

    /// Executes a list of states along their transitions; returns the outcome by which it is left.
    fn list(
        &mut self,
        list: &[StateId],
        path: &str,
        variables: &mut Variables,
        in_routine: bool,
    ) -> Result<String, Fail> {
        let mut visits: BTreeMap<StateId, u32> = BTreeMap::new();
        let Some(mut current) = list.first().copied() else { return Ok(SUCCESS.to_owned()) };
        // Outputs of the body's states belong to the iteration before until these states are passed.
        let around = self.program.state(current).parent;
        let is_body = around.is_some_and(|id| self.program.state(id).is_loop() || self.program.is_pass(id));
        let mut earlier: Vec<StateId> =
            list.iter().copied().filter(|id| is_body && self.outputs.contains_key(id)).collect();
        loop {
            let place = |id: StateId| list.iter().position(|other| *other == id);
            let (passed, later): (Vec<StateId>, Vec<StateId>) =
                earlier.into_iter().partition(|id| place(*id) < place(current));
            earlier = later;
            self.lose(passed);
            let state = self.program.state(current);
            let visit = visits.entry(current).or_default();
            *visit += 1;
            let name = if *visit == 1 { state.name.clone() } else { format!("{}#{visit}", state.name) };
            let outcome = self.visit(current, &below(path, &name), variables, in_routine)?;
            if !matches!(outcome.as_str(), ABORTED | PREEMPTED | VIOLATED) {
                earlier.retain(|id| *id != current);
            }
            let left = match state.transitions.get(&outcome) {
                Some(Target::State(next)) => {
                    current = *next;
                    continue;
                }
                Some(Target::Outcome(by)) => by.clone(),
                None if outcome != SUCCESS => outcome,
                None => match place(current).and_then(|place| list.get(place + 1)) {
                    Some(next) => {
                        current = *next;
                        continue;
                    }
                    None => SUCCESS.to_owned(),
                },
            };
            self.lose(earlier);
            return Ok(left);
        }
    }

    /// Removes the outputs of these states.
    fn lose(&mut self, states: Vec<StateId>) {
        for id in states {
            self.outputs.remove(&id);
        }
    }

    /// `retry`: tries a state until its outcome is not one of those to retry after, or all tries are used.
    fn again(
        &mut self,
        again: &Again,
        around: &State,
        path: &str,
        variables: &mut Variables,
        in_routine: bool,
    ) -> Result<String, Fail> {
        for number in 1.. {
            let visit = |name: &str| if number == 1 { name.to_owned() } else { format!("{name}#{number}") };
            let outcome = self.visit(again.body, &below(path, &visit("try")), variables, in_routine)?;
            if number > again.count || !again.on.contains(&outcome) {
                return Ok(outcome);
            }
            if around.children().any(|child| self.program.state(child).is_between_tries()) {
                // The pause is a place of its own, even if the next try never begins.
                self.may_be_cut()?;
                self.tell(&below(path, &visit("pause")), in_routine, SUCCESS, (Outputs::new(), Outputs::new()));
            }
            if let Some(before) = again.before {
                let made_possible = self.visit(before, &below(path, &visit("before")), variables, in_routine)?;
                if made_possible != SUCCESS {
                    return Ok(made_possible);
                }
            }
        }
        Err(Fail::NotMine("a retry without an end"))
    }

    /// `finally`: executed whatever the outcome of the body; if it fails, so does the whole state.
    fn lastly(
        &mut self,
        finally: &Finally,
        path: &str,
        variables: &mut Variables,
        in_routine: bool,
    ) -> Result<String, Fail> {
        let outcome = match self.visit(finally.body, &below(path, "body"), variables, in_routine) {
            Err(Fail::Cut) => return self.cut_lastly(finally, path, variables, "finally_preempted", in_routine),
            ended => ended?,
        };
        let Some(last) = finally.lastly.get(&outcome) else {
            return Err(Fail::Wrong(format!("nothing is done on the way out by {outcome}")));
        };
        let name = if outcome == SUCCESS { "finally".to_owned() } else { format!("finally_{outcome}") };
        if self.is_watched().is_err() {
            return self.cut_lastly(finally, path, variables, "finally_preempted", in_routine);
        }
        let last = match self.visit(*last, &below(path, &name), variables, in_routine) {
            Err(Fail::Cut) => {
                let again = if outcome == PREEMPTED { "finally_preempted#2" } else { "finally_preempted" };
                return self.cut_lastly(finally, path, variables, again, in_routine);
            }
            ended => ended?,
        };
        Ok(if last == SUCCESS { outcome } else { last })
    }

    /// Executes the `finally` of a state that is cut short, then leaves the states around. After the run was told to end, nothing
    /// counts as inside of a routine.
    fn cut_lastly(
        &mut self,
        finally: &Finally,
        path: &str,
        variables: &mut Variables,
        name: &str,
        in_routine: bool,
    ) -> Result<String, Fail> {
        let Some(last) = finally.lastly.get(PREEMPTED) else { return Err(Fail::Cut) };
        let in_routine = in_routine && self.has_lost();
        let cut = self.races.clone();
        let ended = fails(self.visit(*last, &below(path, name), variables, in_routine))?;
        self.races.resume(cut);
        self.races.has_failed |= !matches!(ended.as_deref(), Ok(SUCCESS | PREEMPTED));
        Err(Fail::Cut)
    }

    #[expect(clippy::too_many_arguments, reason = "all of it is one loop")]
    fn repeat(
        &mut self,
        predicate: &ratn_model::expression::Expr,
        body_first: bool,
        index: Option<&str>,
        body: &[StateId],
        path: &str,
        variables: &mut Variables,
        in_routine: bool,
    ) -> Result<Option<String>, Fail> {
        let before = variables.len();
        for number in 0.. {
            self.steps += 1;
            if self.steps > MAX_STEPS {
                return Err(Fail::NotMine("a loop without an end"));
            }
            variables.extend(index.map(|name| (name.to_owned(), Value::Int(number))));
            if number > 0 || !body_first {
                let again = fails(predicate.is_true(&self.place(variables, None)))?;
                if again != Ok(true) {
                    variables.truncate(before);
                    return Ok(again.ok().map(|_| SUCCESS.to_owned()));
                }
            }
            let left = self.list(body, &format!("{path}[{number}]"), variables, in_routine)?;
            variables.truncate(before);
            if left != SUCCESS {
                return Ok(Some(left));
            }
        }
        Ok(None)
    }

    /// Executes all regions, one after another; returns the outcome.
    fn regions(
        &mut self,
        regions: &[StateId],
        decide: &[(String, ratn_model::expression::Expr)],
        path: &str,
        variables: &mut Variables,
        in_routine: bool,
    ) -> Result<String, Fail> {
        let before = variables.clone();
        let mut outcomes = Vec::new();
        let mut beside = self.beside();
        for region in regions {
            let mut own = before.clone();
            let name = &self.program.state(*region).name;
            beside.begin(self);
            match self.visit(*region, &below(path, name), &mut own, in_routine) {
                Err(Fail::Cut) => beside.is_cut(self, regions.len())?,
                ended => outcomes.push((*region, ended?)),
            }
            merge(variables, &before, own);
        }
        beside.end(self, regions)?;
        // Outcomes of regions become visible when all have ended.
        self.regions.extend(outcomes.iter().cloned());
        let outcomes: Vec<String> = outcomes.into_iter().map(|(_, outcome)| outcome).collect();
        self.decided(decide, variables, &outcomes, None)
    }

    /// The outcome of a concurrency whose regions have ended.
    pub(super) fn decided(
        &mut self,
        decide: &[(String, ratn_model::expression::Expr)],
        variables: &mut Variables,
        outcomes: &[String],
        otherwise: Option<String>,
    ) -> Result<String, Fail> {
        for (outcome, holds) in decide {
            match fails(holds.is_true(&self.place(variables, None)))? {
                Ok(true) => return Ok(outcome.clone()),
                Ok(false) => {}
                Err(_) => return Ok(ABORTED.to_owned()),
            }
        }
        let by = |wanted: &str| outcomes.iter().any(|outcome| outcome == wanted);
        let all_well = outcomes.iter().all(|outcome| outcome == SUCCESS);
        Ok(otherwise.unwrap_or_else(|| {
            let outcome = match all_well {
                true => SUCCESS,
                false if by(ABORTED) || by(VIOLATED) => ABORTED,
                false => PREEMPTED,
            };
            outcome.to_owned()
        }))
    }

    /// The exit of a state: outputs, effects and resources; returns what it assigns.
    fn leave(&mut self, state: &State, outcome: &str, variables: &Variables) -> Result<Vec<(String, Value)>, Fail> {
        let is_good = !matches!(outcome, ABORTED | PREEMPTED | VIOLATED);
        let mut written = Outputs::new();
        if is_good {
            for output in state.outputs() {
                match output.value.read(&self.place(variables, Some(&written))) {
                    Ok(value) => drop(written.insert(output.name.clone(), value)),
                    // The state was left early, before this was written.
                    Err(Fail::Unwritten(_)) if outcome != SUCCESS => {}
                    Err(problem) => return Err(problem),
                }
            }
        }
        let assigned = if is_good { self.assigned(state, variables, &written)? } else { Vec::new() };
        if let Some(declared) = state.annotations.effects.get(outcome) {
            let changes = effects::bound(declared, &self.place(variables, Some(&written)))?;
            self.change(changes)?;
        }
        if outcome == SUCCESS {
            self.operates(state, variables, &written)?;
        }
        if is_good {
            self.outputs.insert(state.id, written);
        }
        Ok(assigned)
    }

    /// Removes the outputs that inner states wrote when the state was entered before.
    fn forget(&mut self, id: StateId) {
        for child in self.program.state(id).children() {
            self.outputs.remove(&child);
            self.regions.remove(&child);
            self.forget(child);
        }
    }
}

/// Assigns new values, each to the innermost variable of its name.
pub(super) fn assign(variables: &mut Variables, assigned: Vec<(String, Value)>) {
    for (name, value) in assigned {
        if let Some(variable) = variables.iter_mut().rev().find(|(known, _)| *known == name) {
            variable.1 = value;
        }
    }
}

fn below(path: &str, name: &str) -> String {
    if path.is_empty() { name.to_owned() } else { format!("{path}/{name}") }
}
