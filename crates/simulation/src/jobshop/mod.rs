//! Job shops: scheduling instances of the standard text format, as tasks.
//!
//! Every operation is a node that blocks its machine and takes the outputs of the job's operation before it. The task lists
//! one job after the other, as its sequential program would do them; how well CDTN mode interleaves them is a measure
//! of its dispatch, on instances that nobody here has made.

mod best_known;
mod format;

pub use best_known::best_known;
pub use format::{InvalidJobShop, MAX_OPERATIONS};

use crate::run::{Answer, Oracle, Performance, Run, RunError, Setup, run_looking_ahead};
use ratn_executive::protocol::{Goal, Mode};
use ratn_model::catalogue::ResourceOffer;
use ratn_model::expression::Expr;
use ratn_model::id::StateId;
use ratn_model::program::{
    Annotations, Exceptions, Location, Nature, Program, ResourceExpr, SUCCESS, State, StateKind,
};
use ratn_model::resource::{ResourceClass, ResourceOperation};
use ratn_model::tolerance::Tolerance;
use ratn_model::value::{Type, Value};
use ratn_world::world::World;
use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

/// Orders that are looked at whenever much has changed, unless told otherwise.
pub const DEFAULT_ORDERS: usize = 10_000;

/// An instance.
#[derive(Debug, Clone, PartialEq)]
pub struct JobShop {
    /// How many machines there are.
    pub machines: usize,
    /// Per job its operations in order: machine and duration.
    pub jobs: Vec<Vec<(usize, f64)>>,
}

impl JobShop {
    /// The instance as a task.
    pub fn program(&self) -> Program {
        let operations: usize = self.jobs.iter().map(Vec::len).sum();
        let mut states =
            vec![state(0, "jobs", None, StateKind::Sequence { children: Vec::new(), outputs: Vec::new() })];
        for (job, operations) in self.jobs.iter().enumerate() {
            for (number, (machine, duration)) in operations.iter().enumerate() {
                let id = states.len() as u64;
                let before = (number > 0).then(|| Expr::Port { state: StateId(id - 1), port: "part".to_owned() });
                let kind = StateKind::Action {
                    provider: "machine".to_owned(),
                    action: "work".to_owned(),
                    inputs: before.into_iter().map(|part| ("part".to_owned(), part)).collect(),
                    outputs: BTreeMap::from([("part".to_owned(), Type::Any)]),
                };
                let mut operation = state(id, &format!("job{job}_{number}"), Some(StateId(0)), kind);
                operation.annotations = Annotations {
                    nature: Nature::Computes,
                    reads: Some(Vec::new()),
                    effects: BTreeMap::from([(SUCCESS.to_owned(), Vec::new())]),
                    resources: vec![ResourceExpr::new(ResourceOperation::Block, machine_kind(*machine))],
                    duration_s: Some(Expr::Literal(Value::Float(*duration))),
                    ..Annotations::default()
                };
                states.push(operation);
            }
        }
        let children = (1..states.len()).map(|id| StateId(id as u64)).collect();
        states[0].kind = StateKind::Sequence { children, outputs: Vec::new() };
        Program {
            name: "jobs".to_owned(),
            // All of it is in the window.
            horizon: operations + 1,
            speculation_width: Program::DEFAULT_SPECULATION_WIDTH,
            deadline_s: None,
            exceptions: Exceptions::Precise,
            parameters: Vec::new(),
            outputs: Vec::new(),
            initial: Vec::new(),
            tolerances: Default::default(),
            ontology: None,
            states,
            digest: String::new(),
        }
    }

    /// Executes the task in CDTN mode, with a look ahead at so many orders whenever much has changed; none is plain dispatch.
    ///
    /// # Errors
    /// As [`crate::run::run`].
    pub fn execute(&self, orders: usize, seed: u64) -> Result<Run, RunError> {
        let setup = Setup {
            program: Arc::new(self.program()),
            mode: Mode::Cdtn,
            parameters: BTreeMap::new(),
            seed,
            resources: (0..self.machines)
                .map(|m| (machine_kind(m), ResourceOffer::new(ResourceClass::Process, 1)))
                .collect(),
            world: Vec::new(),
            tolerance: Tolerance::EXACT,
            latency: Duration::ZERO,
        };
        run_looking_ahead(setup, &mut Machines, orders)
    }
}

fn machine_kind(machine: usize) -> String {
    format!("Machine{machine}")
}

fn state(id: u64, name: &str, parent: Option<StateId>, kind: StateKind) -> State {
    State {
        id: StateId(id),
        name: name.to_owned(),
        path: if parent.is_some() { name.to_owned() } else { String::new() },
        parent,
        kind,
        outcomes: Vec::new(),
        transitions: BTreeMap::new(),
        variables: Vec::new(),
        assign: Vec::new(),
        defaults: BTreeMap::new(),
        annotations: Annotations::default(),
        location: Location::default(),
    }
}

/// Takes as long as it is said to.
struct Machines;

impl Oracle for Machines {
    fn perform(&mut self, _path: &str, _attempt: u32, goal: &Goal, _world: &World) -> Performance {
        let outputs = BTreeMap::from([("part".to_owned(), Value::Null)]);
        Performance {
            duration_s: goal.expected_s.unwrap_or(0.0),
            answer: Answer::Finished { outcome: SUCCESS.to_owned(), outputs, measured: Vec::new() },
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]

    use super::*;
    use ratn_executive::protocol::{Event, LogEntry, LogLine};

    #[test]
    fn operations_of_a_job_follow_each_other_and_a_machine_has_one_at_a_time() {
        let shop = JobShop::parse("2 2\n0 3 1 2\n0 2 1 4\n").unwrap();
        let run = shop.execute(0, 1).unwrap();
        assert_eq!((run.outcome.as_str(), run.end_s), ("success", 8.0), "job 1 first: its rest is longer");
    }

    #[test]
    fn what_a_look_ahead_promises_is_what_the_run_takes() {
        let shop = JobShop::parse(include_str!("../../../../tests/jobshop/ft06.txt")).unwrap();
        let plain = shop.execute(0, 1).unwrap();
        let ahead = shop.execute(1000, 1).unwrap();
        assert!(ahead.end_s < plain.end_s && ahead.end_s >= 55.0, "{} after {}", ahead.end_s, plain.end_s);
        let advice = |line: &LogLine| matches!(line.entry, LogEntry::Event(Event::Advised { .. }));
        assert!(ahead.log.iter().any(advice) && !plain.log.iter().any(advice));
    }
}
