//! One action: its tries, its answer, and its effects.
//!
//! An action without an answer (timeout, too many crashes, a precondition that does not hold) ends `aborted` and changes nothing,
//! not even by the effects of `aborted`, because it is not known how far it came.

use super::evaluate::{Place, Read};
use super::walk::assign;
use super::{Fail, Outputs, Reference, effects, fails};
use crate::story::{Real, goal_text};
use ratn_executive::protocol::{Event, Goal};
use ratn_model::fact::FactKey;
use ratn_model::id::Revision;
use ratn_model::program::{ABORTED, Nature, PREEMPTED, STOPPED, SUCCESS, State, StateKind, VIOLATED};
use ratn_model::resource::ResourceOperation;
use ratn_model::value::{Type, Value};
use ratn_simulation::run::{Answer, Performance, Trigger};
use ratn_world::world::World;

/// Number of attempts of a computing or sensing action whose worker dies, unless it declares another.
const ATTEMPTS: u32 = 3;

/// The end of a goal.
struct Ended {
    outcome: String,
    outputs: Outputs,
    measured: Vec<(FactKey, Value)>,
    /// Whether the goal began; if not, nothing is changed, whatever the outcome declares.
    has_begun: bool,
}

impl Reference<'_> {
    /// Visits an action; returns its outcome.
    pub(super) fn action(
        &mut self,
        state: &State,
        path: &str,
        variables: &mut Vec<(String, Value)>,
        in_routine: bool,
    ) -> Result<String, Fail> {
        let mut inputs = Outputs::new();
        let ended = fails(self.tries(state, path, variables, in_routine, &mut inputs))?;
        let Ok(mut ended) = ended else {
            self.tell(path, in_routine, ABORTED, (inputs, Outputs::new()));
            return Ok(ABORTED.to_owned());
        };
        let assigned = self.answered(state, &mut ended, variables)?;
        let Ended { outcome, outputs, measured, has_begun } = ended;
        // Both modes log the outcome before they apply the effects; if an effect has no value, the action still ends `aborted`.
        self.tell(path, in_routine, &outcome, (inputs, outputs.clone()));
        let made = match has_begun {
            true => self.effects_of(state, &outcome, &outputs, &measured, variables),
            false => Ok(()),
        };
        let made = made.and_then(|()| match &*outcome {
            SUCCESS => self.operates(state, variables, &outputs),
            _ => Ok(()),
        });
        if fails(made)?.is_err() {
            return Ok(ABORTED.to_owned());
        }
        if is_good(&outcome) {
            self.outputs.insert(state.id, outputs);
            assign(variables, assigned);
        }
        Ok(outcome)
    }

    /// Notes a result as in the story of a run: nothing inside of routines, and no reasons of failures.
    pub(super) fn tell(&mut self, path: &str, in_routine: bool, outcome: &str, ports: (Outputs, Outputs)) {
        if !in_routine {
            let result = Real::new(outcome.to_owned(), is_good(outcome).then_some(ports));
            self.result.results.entry(path.to_owned()).or_default().push(result);
        }
    }

    /// Tries until an answer counts.
    fn tries(
        &mut self,
        state: &State,
        path: &str,
        variables: &[(String, Value)],
        in_routine: bool,
        inputs: &mut Outputs,
    ) -> Result<Ended, Fail> {
        let (mut tries, mut attempt, mut crashes) = (1, 1, 0);
        let annotations = &state.annotations;
        loop {
            self.meets(state, &variables.to_vec())?;
            // The action may be waiting for resources, even refused ones, or for its projection.
            self.may_be_cut()?;
            if !in_routine {
                self.asks(state, variables)?;
            }
            if self.is_violated(state, variables)? {
                return Ok(violated(false));
            }
            let (goal, performance) = self.perform(state, path, variables, tries, attempt)?;
            *inputs = goal.inputs;
            self.may_come();
            let seconds = performance.duration_s.min(annotations.timeout_s.unwrap_or(f64::INFINITY));
            if let Err(cut) = self.may_be_cut().and_then(|()| self.takes(seconds)) {
                if cut == Fail::Cut && (is_irreversible(state) || self.has_lost()) {
                    self.say_cut_short(state, variables);
                }
                return Err(cut);
            }
            if self.is_violated(state, variables)? {
                return Ok(violated(true));
            }
            attempt += 1;
            let answer = match annotations.timeout_s {
                Some(limit) if performance.duration_s > limit => None,
                _ => Some(performance.answer),
            };
            let mut why = "it took too long";
            let ended = match answer {
                Some(Answer::Crashed | Answer::LeaseLost) => {
                    crashes += 1;
                    if !is_irreversible(state) && crashes < annotations.attempts.unwrap_or(ATTEMPTS) {
                        continue;
                    }
                    why = "its worker died";
                    None
                }
                Some(Answer::Finished { outcome, outputs, measured }) => {
                    Some(Ended { outcome, outputs, measured, has_begun: true })
                }
                None => None,
            };
            let has_aborted = ended.as_ref().is_none_or(|ended| ended.outcome == ABORTED);
            if has_aborted && annotations.retry.is_some_and(|retry| tries <= retry.count) {
                tries += 1;
                continue;
            }
            return ended.ok_or_else(|| Fail::Wrong(why.to_owned()));
        }
    }

    /// Applies a state's effects for `preempted`, if they can be evaluated and are allowed.
    pub(super) fn say_cut_short(&mut self, state: &State, variables: &[(String, Value)]) {
        let Some(declared) = state.annotations.effects.get(PREEMPTED) else { return };
        let changes = effects::bound(declared, &self.place(variables, Some(&Outputs::new())));
        self.races.has_failed |= changes.and_then(|changes| self.change(changes)).is_err();
    }

    /// Whether a `while` condition does not hold.
    fn is_violated(&self, state: &State, variables: &[(String, Value)]) -> Result<bool, Fail> {
        for holds in &state.annotations.holds {
            if !holds.is_true(&self.place(variables, None))? {
                return Ok(true);
            }
        }
        Ok(false)
    }

    /// Performs one goal.
    fn perform(
        &mut self,
        state: &State,
        path: &str,
        variables: &[(String, Value)],
        tries: u32,
        attempt: u32,
    ) -> Result<(Goal, Performance), Fail> {
        let StateKind::Action { provider, action, inputs: ports, .. } = &state.kind else {
            return Err(Fail::NotMine("a goal of what is no action"));
        };
        let place = self.place(variables, None);
        let mut inputs = Outputs::new();
        for (port, value) in ports {
            match value.read(&place)? {
                // A missing optional input.
                Value::Null => {}
                value => drop(inputs.insert(port.clone(), value)),
            }
        }
        let facts = self.shown(state, &place);
        let expected_s = estimate_s(state, &place);
        let seed = seed(self.seed, path, if state.annotations.deterministic { 1 } else { tries });
        let goal = Goal {
            improves: None,
            reads_nothing: false,
            provider: provider.as_str().into(),
            action: action.as_str().into(),
            inputs,
            seed,
            lease: None,
            projection: None,
            expected_s,
            timeout_s: state.annotations.timeout_s,
        };
        if state.annotations.nature == Nature::Irreversible {
            self.result.acts.push((path.to_owned(), goal_text(&goal)));
        }
        // The oracle's interface needs a `World`.
        let world = World::from_facts(facts, Revision(0));
        let performance = self.oracle.perform(path, attempt, &goal, &world);
        self.come_from_outside(path);
        Ok((goal, performance))
    }

    /// Applies the changes from outside that are due when a goal of this path starts.
    fn come_from_outside(&mut self, path: &str) {
        let (now, later) = std::mem::take(&mut self.outside)
            .into_iter()
            .partition(|(trigger, _)| *trigger == Trigger::Starts(path.to_owned()));
        self.outside = later;
        for (_, event) in Vec::<(Trigger, Event)>::from_iter(now) {
            let Event::WorldChanged { facts, .. } = event else { continue };
            for (key, value) in facts {
                self.becomes(key, value);
            }
        }
    }

    /// Checks the answer against the action (a wrong one is a failure); returns what the state assigns.
    fn answered(
        &self,
        state: &State,
        ended: &mut Ended,
        variables: &Vec<(String, Value)>,
    ) -> Result<Vec<(String, Value)>, Fail> {
        let own = |name: &str| state.outcomes.iter().any(|known| known == name);
        let is_known = |name: &str| [SUCCESS, ABORTED, PREEMPTED].contains(&name) || own(name);
        let mut has_failed = false;
        if let StateKind::Action { outputs: declared, .. } = &state.kind {
            let is_written = |(port, ty): (&String, &Type)| ended.outputs.get(port).is_some_and(|v| ty.accepts(v));
            has_failed = ended.outcome == SUCCESS && !declared.iter().all(is_written);
        }
        if ended.outcome == STOPPED && !own(STOPPED) {
            ended.outcome = PREEMPTED.to_owned();
        }
        let mut assigned = Vec::new();
        if !has_failed && is_known(&ended.outcome) && is_good(&ended.outcome) {
            match fails(self.assigned(state, variables, &ended.outputs))? {
                Ok(values) => assigned = values,
                Err(_) => has_failed = true,
            }
        }
        if has_failed || !is_known(&ended.outcome) {
            ended.outcome = ABORTED.to_owned();
            ended.outputs.clear();
        }
        Ok(assigned)
    }

    fn effects_of(
        &mut self,
        state: &State,
        outcome: &str,
        outputs: &Outputs,
        measured: &[(FactKey, Value)],
        variables: &[(String, Value)],
    ) -> Result<(), Fail> {
        let declared = state.annotations.effects.get(outcome);
        let changes_nothing = match state.annotations.nature {
            _ if operates_resources(state) => false,
            Nature::Computes => true,
            Nature::Senses(_) => outcome != SUCCESS,
            Nature::Irreversible => false,
        };
        let predicted = match declared {
            Some(effects) => effects::bound(effects, &self.place(variables, Some(outputs)))?,
            None => Vec::new(),
        };
        let changes = effects::with_measured(predicted, measured, declared.is_some() || changes_nothing)?;
        self.change(changes)
    }
}

fn violated(has_begun: bool) -> Ended {
    Ended { outcome: VIOLATED.to_owned(), outputs: Outputs::new(), measured: Vec::new(), has_begun }
}

fn is_good(outcome: &str) -> bool {
    !matches!(outcome, ABORTED | PREEMPTED | VIOLATED)
}

/// The declared estimate, if it is valid.
fn estimate_s(state: &State, place: &Place<'_>) -> Option<f64> {
    let seconds = match state.annotations.duration_s.as_ref()?.read(place).ok()? {
        Value::Int(i) => i as f64,
        Value::Float(x) => x,
        _ => return None,
    };
    (seconds.is_finite() && seconds >= 0.0).then_some(seconds)
}

/// A state that operates on resources is potentially irreversible, whatever it declares.
fn is_irreversible(state: &State) -> bool {
    state.annotations.nature == Nature::Irreversible || operates_resources(state)
}

fn operates_resources(state: &State) -> bool {
    let changes = |operation| !matches!(operation, ResourceOperation::Block | ResourceOperation::Exists);
    state.annotations.resources.iter().any(|line| changes(line.operation))
}

/// The seed of a try: FNV-1a over the run's seed, the path and, from the second try on, the number of the try.
fn seed(run: u64, path: &str, tries: u32) -> u64 {
    let mut bytes = run.to_le_bytes().to_vec();
    bytes.extend(path.bytes());
    if tries > 1 {
        bytes.extend(tries.to_le_bytes());
    }
    bytes.iter().fold(0xcbf2_9ce4_8422_2325, |hash, byte| (hash ^ u64::from(*byte)).wrapping_mul(0x0000_0100_0000_01b3))
}
