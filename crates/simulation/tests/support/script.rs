//! What the providers and the user do in a scenario, as `script.toml` says it. What a script does not name succeeds after its
//! declared duration (1 s where none is declared) with `x = 1` and `list = []`.
//!
//! ```toml
//! modes = ["cdtn"]                        # hsm and cdtn unless given
//! differs = "why the modes end differently"
//! inputs = true                           # the transcript says what goals are given
//! ends_only = true                        # the transcript says only how the runs end
//! [resources]
//! WorldModel = 2                          # so many instead of those of the catalogue
//! [durations]
//! look = 4.0                              # seconds
//! [outcomes]
//! pick = ["aborted", "success"]           # of one try after the other, the last for all further ones; or one for all
//! [outputs.look]
//! x = 2
//! [measured.grasp]
//! "held(box)" = { pose = [0.3, 0, 0] }    # or any other value
//! [[answers.check]]                       # the first that fits comes before all above
//! sees = { "held(box)" = 2 }              # what its world must show
//! given = { a = 2 }                       # which inputs it must have
//! attempt = 2
//! outcome = "empty"
//! outputs = { x = ["cup"] }
//! duration = 2.0
//! [[better.look]]                         # where it may give better results after its first: another, so many seconds later
//! after = 1.0
//! outputs = { x = 2 }
//! [crashes]
//! plan = 2                                # so many attempts
//! [[events]]
//! event = "pause"                         # pause, resume, step, abort, "abort at once", "not recorded"
//! at = 3.0                                # seconds; or starts = "path", ends = "path"
//! [[events]]
//! event = "world"                         # somebody else changes the world
//! facts = { "at(cup)" = "shelf" }
//! gone = ["at(box)"]
//! ends = "look"
//! [[events]]
//! event = "signal"                        # a client sends it
//! signal = "go"
//! value = 3
//! at = 1.0
//! [choices]
//! ask = { choice = "yes", after = 2.0 }    # what an operator answers, and so many seconds after the question
//! [kinds]
//! SmallPen = ["Pen"]                      # the superclasses of a kind of resource
//! [[events]]
//! event = "lease_lost"                    # what the instance of this path holds, before it has begun
//! path = "move"
//! at = 2.0
//! ```

use super::fact;
use ratn_executive::protocol::{Event, Goal, LogEntry, Unmade};
use ratn_model::fact::FactKey;
use ratn_model::id::{InstanceId, Revision};
use ratn_model::list::List;
use ratn_model::pose::Pose;
use ratn_model::program::Program;
use ratn_model::resource::Quantity;
use ratn_model::value::Value;
use ratn_simulation::run::{
    Answer, Better, Circumstances, Oracle, Performance, Run, RunError, Setup, Trigger, run_under,
};
use ratn_world::world::World;
use serde::Deserialize;
use std::collections::BTreeMap;
use std::num::NonZeroUsize;

/// A scenario's script, and what it has seen.
#[derive(Debug, Clone, Default, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub(crate) struct Script {
    pub(crate) modes: Vec<String>,
    pub(crate) differs: Option<String>,
    pub(crate) inputs: bool,
    pub(crate) ends_only: bool,
    resources: BTreeMap<String, u32>,
    pub(crate) kinds: BTreeMap<String, Vec<String>>,
    durations: BTreeMap<String, f64>,
    outcomes: BTreeMap<String, OneOrMore>,
    outputs: BTreeMap<String, BTreeMap<String, toml::Value>>,
    measured: BTreeMap<String, BTreeMap<String, toml::Value>>,
    answers: BTreeMap<String, Vec<Reply>>,
    better: BTreeMap<String, Vec<Later>>,
    crashes: BTreeMap<String, u32>,
    choices: BTreeMap<String, Choice>,
    events: Vec<Outside>,
    /// The executive is made anew from a checkpoint after every so many events.
    #[serde(skip)]
    pub(crate) checkpoint_every: Option<NonZeroUsize>,
    #[serde(skip)]
    tries: BTreeMap<String, usize>,
    /// The world of every goal that was given a projection, `None` for the others.
    #[serde(skip)]
    pub(crate) worlds: Vec<Option<Vec<String>>>,
}

#[derive(Debug, Clone, Deserialize)]
#[serde(untagged)]
enum OneOrMore {
    One(String),
    More(Vec<String>),
}

#[derive(Debug, Clone, Default, Deserialize)]
#[serde(default, deny_unknown_fields)]
struct Reply {
    sees: BTreeMap<String, toml::Value>,
    given: BTreeMap<String, toml::Value>,
    attempt: Option<u32>,
    outcome: Option<String>,
    outputs: BTreeMap<String, toml::Value>,
    duration: Option<f64>,
}

#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
struct Later {
    after: f64,
    outputs: BTreeMap<String, toml::Value>,
}

#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
struct Choice {
    choice: String,
    after: f64,
}

#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
struct Outside {
    event: String,
    at: Option<f64>,
    starts: Option<String>,
    ends: Option<String>,
    path: Option<String>,
    signal: Option<String>,
    value: Option<toml::Value>,
    #[serde(default)]
    states: Vec<String>,
    #[serde(default)]
    facts: BTreeMap<String, toml::Value>,
    #[serde(default)]
    gone: Vec<String>,
}

impl Script {
    /// From a file's text.
    pub(crate) fn from_toml(text: &str) -> Script {
        toml::from_str(text).unwrap_or_else(|error| panic!("{error}\n{text}"))
    }

    /// One run by this script.
    pub(crate) fn run(&mut self, program: &Program, mode: ratn_executive::protocol::Mode) -> Result<Run, RunError> {
        // A lease is lost by its instance, whose number only a run can tell: one in which nothing is lost is the same until then.
        let undisturbed = if self.events.iter().any(|outside| outside.event == "lease_lost") {
            let mut without = self.clone();
            without.events.retain(|outside| outside.event != "lease_lost");
            Some(without.run(program, mode)?)
        } else {
            None
        };
        let events =
            self.events.iter().map(|outside| (outside.trigger(), outside.event(undisturbed.as_ref()))).collect();
        let checkpoint_every = self.checkpoint_every;
        let circumstances = Circumstances { events, checkpoint_every, ..Circumstances::default() };
        run_under(self.setup(program, mode), self, circumstances)
    }

    fn setup(&self, program: &Program, mode: ratn_executive::protocol::Mode) -> Setup {
        let mut setup = super::setup(program.clone(), mode);
        for (kind, offer) in &mut setup.resources {
            if let Some(units) = self.resources.get(kind) {
                offer.count = Quantity::whole(*units);
            }
        }
        setup
    }

    fn reply(&self, path: &str, attempt: u32, goal: &Goal, world: &World) -> Option<&Reply> {
        self.answers.get(path)?.iter().find(|reply| {
            let sees = reply.sees.iter().all(|(key, v)| world.get(&fact(key)) == Some(&value(v)));
            let given = reply.given.iter().all(|(port, v)| goal.inputs.get(port) == Some(&value(v)));
            sees && given && reply.attempt.is_none_or(|number| number == attempt)
        })
    }
}

impl Outside {
    fn trigger(&self) -> Trigger {
        match (self.at, &self.starts, &self.ends) {
            (Some(at), None, None) => Trigger::At(at),
            (None, Some(path), None) => Trigger::Starts(path.clone()),
            (None, None, Some(path)) => Trigger::Ends(path.clone()),
            _ => panic!("an event has one of at, starts, ends: {self:?}"),
        }
    }

    fn event(&self, undisturbed: Option<&Run>) -> Event {
        match self.event.as_str() {
            "pause" => Event::PauseRequested,
            "resume" => Event::ResumeRequested,
            "step" => Event::StepRequested,
            "break" => Event::BreakpointsSet { states: self.states.clone() },
            "abort" => Event::AbortRequested { reason: "the user wants it so".to_owned(), at_once: false },
            "abort at once" => Event::AbortRequested { reason: "its session is lost".to_owned(), at_once: true },
            "not recorded" => Event::RetirementFailed {
                instance: InstanceId(1),
                reason: "the world pool is gone".to_owned(),
                unmade: Unmade::Untried,
            },
            "world" => {
                let set = self.facts.iter().map(|(key, v)| (fact(key), Some(value(v))));
                let facts = set.chain(self.gone.iter().map(|key| (fact(key), None))).collect();
                Event::WorldChanged { revision: Revision(99), facts }
            }
            "signal" => {
                let signal = self.signal.clone().unwrap_or_else(|| panic!("a signal has a name"));
                Event::Signalled { signal, value: self.value.as_ref().map_or(Value::Null, value) }
            }
            "lease_lost" => {
                let path = self.path.as_deref().unwrap_or_else(|| panic!("a lease is lost by a path"));
                let run = undisturbed.unwrap();
                let granted = |entry: &LogEntry| match entry {
                    LogEntry::Event(Event::Granted { instance, .. }) => Some(*instance),
                    _ => None,
                };
                let paths = super::paths(run);
                let mut holders = run.log.iter().filter_map(|line| granted(&line.entry));
                let instance = holders.find(|instance| paths[instance] == path).unwrap();
                Event::Crashed {
                    instance,
                    attempt: 1,
                    reason: "its lease was lost".to_owned(),
                    unknown: false,
                    refused: false,
                }
            }
            other => panic!("event: one of those above, not {other}"),
        }
    }
}

impl Oracle for Script {
    fn perform(&mut self, path: &str, attempt: u32, goal: &Goal, world: &World) -> Performance {
        let facts = || world.iter().map(|(key, fact)| format!("{key} = {}", fact.value)).collect();
        self.worlds.push(goal.projection.map(|_| facts()));
        let reply = self.reply(path, attempt, goal, world).cloned().unwrap_or_default();
        let declared = self.durations.get(path).copied().or(goal.expected_s);
        let duration_s = reply.duration.or(declared).unwrap_or(1.0);
        if attempt <= self.crashes.get(path).copied().unwrap_or(0) {
            return Performance { duration_s, answer: Answer::Crashed };
        }
        let tries = self.tries.entry(path.to_owned()).or_default();
        *tries += 1;
        let outcome = match self.outcomes.get(path) {
            None => "success",
            Some(OneOrMore::One(outcome)) => outcome,
            Some(OneOrMore::More(all)) => all.get(*tries - 1).or(all.last()).map_or("success", String::as_str),
        };
        let outcome = reply.outcome.as_deref().unwrap_or(outcome).to_owned();
        let mut outputs =
            BTreeMap::from([("x".to_owned(), Value::Int(1)), ("list".to_owned(), Value::List(List::new()))]);
        let said = self.outputs.get(path).into_iter().flatten().chain(&reply.outputs);
        outputs.extend(said.map(|(port, v)| (port.clone(), value(v))));
        let measured = self.measured.get(path).into_iter().flatten();
        let measured: Vec<(FactKey, Value)> = measured.map(|(key, v)| (fact(key), value(v))).collect();
        Performance { duration_s, answer: Answer::Finished { outcome, outputs, measured } }
    }

    fn better(&mut self, path: &str, _: u32, _: &Goal, first: &BTreeMap<String, Value>) -> Option<Better> {
        let later = self.better.get(path)?;
        let better = |(number, Later { after, outputs }): (usize, &Later)| {
            let own = outputs.iter().map(|(port, v)| (port.clone(), value(v)));
            (*after, first.clone().into_iter().chain(own).collect(), (later.len() - number) as f64)
        };
        Some(Better { results: later.iter().enumerate().map(better).collect(), end: None })
    }

    fn awaited(&mut self, path: &str, instance: InstanceId) -> Option<(f64, Event)> {
        let Choice { choice, after } = self.choices.get(path)?.clone();
        Some((after, Event::Answered { instance, choice }))
    }
}

fn value(said: &toml::Value) -> Value {
    match said {
        toml::Value::Integer(i) => Value::Int(*i),
        toml::Value::Float(x) => Value::Float(*x),
        toml::Value::Boolean(b) => Value::Bool(*b),
        toml::Value::String(text) => Value::String(text.clone()),
        toml::Value::Array(items) => Value::List(items.iter().map(value).collect()),
        toml::Value::Table(fields) => match fields.get("pose").and_then(toml::Value::as_array) {
            Some(at) => {
                let number = |n: usize| at[n].as_float().or(at[n].as_integer().map(|i| i as f64)).unwrap();
                Value::Pose(Pose::at(number(0), number(1), number(2)))
            }
            None => Value::Map(fields.iter().map(|(name, v)| (name.clone(), value(v))).collect()),
        },
        toml::Value::Datetime(_) => panic!("no value: {said}"),
    }
}
