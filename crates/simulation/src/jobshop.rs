//! Job shops: scheduling instances of the standard text format, as tasks.
//!
//! Every operation is a node that blocks its machine and takes the outputs of the job's operation before it. The task lists
//! one job after the other, as its sequential program would do them; how well CDTN mode interleaves them is a measure
//! of its dispatch, on instances that nobody here has made.

use crate::run::{Answer, Oracle, Performance, Run, RunError, Setup, run_looking_ahead};
use ratn_executive::protocol::{Goal, Mode};
use ratn_model::expression::Expr;
use ratn_model::id::StateId;
use ratn_model::program::{
    Annotations, Exceptions, Location, Nature, Program, ResourceExpr, SUCCESS, State, StateKind,
};
use ratn_model::resource::{ResourceClass, ResourceOperation};
use ratn_model::value::{Type, Value};
use ratn_world::tolerance::Tolerance;
use ratn_world::world::World;
use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

/// No instance has more operations.
const MAX_OPERATIONS: usize = 10_000;

/// Published makespans: proven optima.
const BEST_KNOWN: [(&str, f64); 23] = [
    ("ft06", 55.0),
    ("ft10", 930.0),
    ("ft20", 1165.0),
    ("la01", 666.0),
    ("la02", 655.0),
    ("la03", 597.0),
    ("la04", 590.0),
    ("la05", 593.0),
    ("la06", 926.0),
    ("la07", 890.0),
    ("la08", 863.0),
    ("la09", 951.0),
    ("la10", 958.0),
    ("la11", 1222.0),
    ("la12", 1039.0),
    ("la13", 1150.0),
    ("la14", 1292.0),
    ("la15", 1207.0),
    ("la16", 945.0),
    ("la17", 784.0),
    ("la18", 848.0),
    ("la19", 842.0),
    ("la20", 902.0),
];

/// An instance.
#[derive(Debug, Clone, PartialEq)]
pub struct JobShop {
    /// How many machines there are.
    pub machines: usize,
    /// Per job its operations in order: machine and duration.
    pub jobs: Vec<Vec<(usize, f64)>>,
}

/// A text that is no instance.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error("line {line}: {problem}")]
pub struct InvalidJobShop {
    /// Which line, from 1.
    pub line: usize,
    /// What is wrong, and what to write instead.
    pub problem: String,
}

/// The best makespan published for an instance of that name.
pub fn best_known(instance: &str) -> Option<f64> {
    BEST_KNOWN.iter().find(|(name, _)| *name == instance).map(|(_, best)| *best)
}

impl JobShop {
    /// Reads the standard format: a line with the numbers of jobs and machines, then a line per job with pairs of
    /// machine (from 0) and duration. Lines that begin with `#` or with a letter, and empty ones, are comments.
    ///
    /// # Errors
    /// [`InvalidJobShop`] names the first line that does not fit.
    pub fn parse(text: &str) -> Result<JobShop, InvalidJobShop> {
        let is_comment = |line: &str| line.is_empty() || !line.starts_with(|c: char| c.is_ascii_digit() || c == '-');
        let mut lines = text.lines().enumerate().map(|(i, line)| (i + 1, line.trim())).filter(|(_, l)| !is_comment(l));
        let wrong = |line: usize, problem: String| InvalidJobShop { line, problem };
        let Some((line, first)) = lines.next() else {
            return Err(wrong(1, "there is no line with the numbers of jobs and machines".to_owned()));
        };
        let numbers: Vec<usize> = first.split_whitespace().map_while(|word| word.parse().ok()).collect();
        let [jobs, machines, ..] = numbers.as_slice() else {
            return Err(wrong(line, format!("expected the numbers of jobs and machines, found `{first}`")));
        };
        let (count, machines) = (*jobs, *machines);
        if count == 0 || machines == 0 || count.saturating_mul(machines) > MAX_OPERATIONS {
            let problem = format!(
                "{count} jobs on {machines} machines; both at least 1, and {MAX_OPERATIONS} operations at most"
            );
            return Err(wrong(line, problem));
        }
        let mut jobs = Vec::new();
        for (line, text) in lines {
            if jobs.len() == count {
                return Err(wrong(line, format!("this is the line of a job, and there are {count} already")));
            }
            let words: Vec<&str> = text.split_whitespace().collect();
            if words.is_empty() || words.len() % 2 == 1 {
                return Err(wrong(
                    line,
                    format!("expected pairs of machine and duration, found {} numbers", words.len()),
                ));
            }
            let mut operations = Vec::new();
            for pair in words.chunks(2) {
                let machine = pair[0].parse::<usize>().ok().filter(|machine| *machine < machines);
                let Some(machine) = machine else {
                    return Err(wrong(line, format!("`{}` is no machine: they are 0 to {}", pair[0], machines - 1)));
                };
                let duration = pair[1].parse::<f64>().ok().filter(|d| d.is_finite() && *d >= 0.0);
                let Some(duration) = duration else {
                    return Err(wrong(line, format!("`{}` is no duration", pair[1])));
                };
                operations.push((machine, duration));
            }
            jobs.push(operations);
        }
        if jobs.len() < count {
            let problem = format!("{count} jobs are announced and {} are there", jobs.len());
            return Err(wrong(text.lines().count(), problem));
        }
        Ok(JobShop { machines, jobs })
    }

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
                    resources: vec![ResourceExpr {
                        operation: ResourceOperation::Block,
                        kind: machine_kind(*machine),
                        class: None,
                        attributes: Vec::new(),
                        count: 1,
                        unordered: false,
                    }],
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
            resources: (0..self.machines).map(|m| (machine_kind(m), ResourceClass::Process, 1)).collect(),
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

    #[test]
    fn what_is_no_instance_is_refused_with_its_line() {
        let refusal = |text: &str| JobShop::parse(text).unwrap_err().to_string();
        assert_eq!(refusal(""), "line 1: there is no line with the numbers of jobs and machines");
        assert_eq!(refusal("# a comment\n2 2\n0 1 1 2\n0 1 2 2\n"), "line 4: `2` is no machine: they are 0 to 1");
        assert_eq!(refusal("1 1\n0 1\n0 1\n"), "line 3: this is the line of a job, and there are 1 already");
        assert_eq!(refusal("2 1\n0 1\n"), "line 2: 2 jobs are announced and 1 are there");
        assert_eq!(refusal("1 1\n0 x\n"), "line 2: `x` is no duration");
        assert_eq!(refusal("1 1\n0 1 0\n"), "line 2: expected pairs of machine and duration, found 3 numbers");
    }

    #[test]
    fn operations_of_a_job_follow_each_other_and_a_machine_has_one_at_a_time() {
        let shop = JobShop::parse("2 2\n0 3 1 2\n0 2 1 4\n").unwrap();
        let run = shop.execute(0, 1).unwrap();
        assert_eq!((run.outcome.as_str(), run.end_s), ("success", 8.0), "job 1 first: its rest is longer");
    }
}
