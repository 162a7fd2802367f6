//! States that wait. There is no clock: an event that comes ends the wait; without one, the wait ends by its timeout.

use super::evaluate::Read;
use super::walk::assign;
use super::{Fail, Outputs, Reference, fails};
use ratn_executive::protocol::Event;
use ratn_model::id::InstanceId;
use ratn_model::program::{ABORTED, SUCCESS, State};
use ratn_model::value::Value;
use ratn_model::wait::Wait;

impl Reference<'_> {
    /// Visits a state that waits; returns its outcome.
    pub(super) fn wait(
        &mut self,
        state: &State,
        path: &str,
        variables: &mut Vec<(String, Value)>,
        in_routine: bool,
    ) -> Result<String, Fail> {
        if let Err(cut) = self.may_be_cut() {
            self.awaits(state, path, variables);
            return Err(cut);
        }
        let ended = fails(self.waited(state, path, variables))?;
        let assigned = match &ended {
            Ok((_, outputs)) => fails(self.assigned(state, variables, outputs))?,
            Err(_) => Ok(Vec::new()),
        };
        let (Ok((outcome, outputs)), Ok(assigned)) = (ended, assigned) else {
            self.tell(path, in_routine, ABORTED, (Outputs::new(), Outputs::new()));
            return Ok(ABORTED.to_owned());
        };
        self.tell(path, in_routine, &outcome, (Outputs::new(), Outputs::new()));
        self.outputs.insert(state.id, outputs);
        assign(variables, assigned);
        Ok(outcome)
    }

    /// Notes what the environment may still change if the run is told to end during this wait.
    fn awaits(&mut self, state: &State, path: &str, variables: &[(String, Value)]) {
        if let Some(Wait::Condition(condition)) = state.wait()
            && condition.is_true(&self.place(variables, None)) == Ok(false)
            && let Some((_, Event::WorldChanged { facts, .. })) = self.oracle.awaited(path, InstanceId(0))
        {
            self.coming.extend(facts);
            self.may_come();
        }
    }

    fn waited(&mut self, state: &State, path: &str, variables: &[(String, Value)]) -> Result<(String, Outputs), Fail> {
        let late = "timeout".to_owned();
        let one = |port: &str, value: Value| Outputs::from([(port.to_owned(), value)]);
        match state.wait() {
            None | Some(Wait::Watch(_) | Wait::Limit(_)) => Err(Fail::NotMine("a wait of another kind")),
            Some(Wait::Seconds(time) | Wait::Until(time)) => match time.read(&self.place(variables, None))? {
                Value::Int(_) => Ok((SUCCESS.to_owned(), Outputs::new())),
                Value::Float(seconds) if seconds.is_finite() => Ok((SUCCESS.to_owned(), Outputs::new())),
                other => Err(Fail::Wrong(format!("{other} is no time"))),
            },
            Some(Wait::Condition(condition)) => {
                if condition.is_true(&self.place(variables, None))? {
                    return Ok((SUCCESS.to_owned(), Outputs::new()));
                }
                let Some((_, Event::WorldChanged { facts, .. })) = self.oracle.awaited(path, InstanceId(0)) else {
                    return Ok((late, Outputs::new()));
                };
                for (key, value) in facts {
                    self.becomes(key, value);
                }
                self.is_watched()?;
                if condition.is_true(&self.place(variables, None))? {
                    return Ok((SUCCESS.to_owned(), Outputs::new()));
                }
                // The condition has two parts that exclude each other.
                match state.annotations.timeout_s {
                    Some(_) => Ok((late, Outputs::new())),
                    None => Err(Fail::NotMine("a wait without an end")),
                }
            }
            Some(Wait::Signal(name)) => {
                if let Some(kept) = self.signals.iter().position(|(signal, _)| signal == name) {
                    return Ok((SUCCESS.to_owned(), one("value", self.signals.remove(kept).1)));
                }
                match self.oracle.awaited(path, InstanceId(0)) {
                    Some((_, Event::Signalled { value, .. })) => Ok((SUCCESS.to_owned(), one("value", value))),
                    _ => Ok((late, one("value", Value::Null))),
                }
            }
            Some(Wait::Answer(question)) => {
                let answer = match self.oracle.awaited(path, InstanceId(0)) {
                    Some((_, Event::Answered { choice, .. })) => Some(choice),
                    _ => question.default.map(str::to_owned),
                };
                let Some(choice) = answer else { return Ok((late, one("answer", Value::Null))) };
                let outcome = if state.outcomes.contains(&choice) { choice.clone() } else { SUCCESS.to_owned() };
                Ok((outcome, one("answer", Value::String(choice))))
            }
        }
    }
}
