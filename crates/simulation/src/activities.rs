//! Activities with resource demands and precedences, as a task: the scheduling problems of the literature.
//!
//! Every activity is a node that blocks its resources for its whole duration and takes an output of each of its predecessors. How well CDTN
//! mode interleaves them measures its dispatch and its look-ahead, on problems from outside this project.

use crate::dice::Dice;
use crate::run::{Answer, Oracle, Performance, Run, RunError, Setup, run_looking_ahead};
use ratn_executive::protocol::{Goal, Mode};
use ratn_model::catalogue::ResourceOffer;
use ratn_model::expression::Expr;
use ratn_model::id::StateId;
use ratn_model::program::{
    Annotations, Exceptions, Location, Nature, Program, ResourceExpr, SUCCESS, State, StateKind,
};
use ratn_model::resource::{Quantity, ResourceClass, ResourceOperation};
use ratn_model::tolerance::Tolerance;
use ratn_model::value::{Type, Value};
use ratn_world::world::World;
use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

/// Default number of schedules that look-ahead tries whenever much has changed.
pub const DEFAULT_ORDERS: usize = 30_000;

/// An activity.
#[derive(Debug, Clone, PartialEq)]
pub struct Activity {
    /// Its name in the task.
    pub name: String,
    /// Its estimated duration, in seconds.
    pub duration_s: f64,
    /// Its demands: the number of the kind, and the number of units.
    pub demands: Vec<(usize, u32)>,
    /// Its predecessors, by their numbers, which are smaller than its own.
    pub after: Vec<usize>,
}

/// A scheduling problem.
#[derive(Debug, Clone, PartialEq)]
pub struct Activities {
    /// The kinds of resources: name and number of units.
    pub kinds: Vec<(String, u32)>,
    /// The activities, each after its predecessors.
    pub activities: Vec<Activity>,
}

/// Options for executing a problem.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Execution {
    /// Number of schedules that look-ahead tries whenever much has changed; 0 is plain dispatch.
    pub orders: usize,
    /// The random seed.
    pub seed: u64,
    /// Actual durations differ from the estimates by up to this share, at random by the seed.
    pub vary: f64,
    /// Whether the executive knows the actual durations.
    pub is_clairvoyant: bool,
}

impl Default for Execution {
    fn default() -> Execution {
        Execution { orders: DEFAULT_ORDERS, seed: 1, vary: 0.0, is_clairvoyant: false }
    }
}

impl Activities {
    /// The problem as a task.
    pub fn program(&self) -> Program {
        let root = StateKind::Sequence {
            children: (1..=self.activities.len()).map(|id| StateId(id as u64)).collect(),
            outputs: Vec::new(),
        };
        let mut states = vec![state(0, "activities", None, root)];
        for (number, activity) in self.activities.iter().enumerate() {
            let done = |after: &usize| Expr::Port { state: StateId(*after as u64 + 1), port: "done".to_owned() };
            let inputs = activity.after.iter().map(|after| (format!("after_{after}"), done(after)));
            let kind = StateKind::Action {
                provider: "resource".to_owned(),
                action: "work".to_owned(),
                inputs: inputs.collect(),
                outputs: BTreeMap::from([("done".to_owned(), Type::Any)]),
            };
            let needs = |(kind, units): &(usize, u32)| ResourceExpr {
                count: Quantity::whole(*units),
                ..ResourceExpr::new(ResourceOperation::Block, self.kinds[*kind].0.clone())
            };
            let mut node = state(number as u64 + 1, &activity.name, Some(StateId(0)), kind);
            node.annotations = Annotations {
                nature: Nature::Computes,
                reads: Some(Vec::new()),
                effects: BTreeMap::from([(SUCCESS.to_owned(), Vec::new())]),
                resources: activity.demands.iter().map(needs).collect(),
                duration_s: Some(Expr::Literal(Value::Float(activity.duration_s))),
                ..Annotations::default()
            };
            states.push(node);
        }
        Program {
            name: "activities".to_owned(),
            // The window holds the whole problem.
            horizon: self.activities.len() + 1,
            speculation_width: Program::DEFAULT_SPECULATION_WIDTH,
            deadline_s: None,
            exceptions: Exceptions::Precise,
            parameters: Vec::new(),
            outputs: Vec::new(),
            initial: Vec::new(),
            tolerances: Default::default(),
            ontology: None,
            kinds: Default::default(),
            states,
            digest: String::new(),
        }
    }

    /// Executes the task in CDTN mode.
    ///
    /// # Errors
    /// As [`crate::run::run`].
    pub fn execute(&self, execution: Execution) -> Result<Run, RunError> {
        let actual = self.varied(execution);
        let estimated = if execution.is_clairvoyant { &actual } else { self };
        let durations_s = actual.activities.iter().map(|a| (a.name.clone(), a.duration_s)).collect();
        let setup = Setup {
            program: Arc::new(estimated.program()),
            mode: Mode::Cdtn,
            parameters: BTreeMap::new(),
            seed: execution.seed,
            resources: self
                .kinds
                .iter()
                .map(|(kind, units)| (kind.clone(), ResourceOffer::new(ResourceClass::Process, *units)))
                .collect(),
            world: Vec::new(),
            tolerance: Tolerance::EXACT,
            latency: Duration::ZERO,
        };
        run_looking_ahead(setup, &mut Performers { durations_s }, execution.orders)
    }

    /// Lower bound of the makespan: by the longest path, and by the work of each kind.
    pub fn lower_bound_s(&self) -> f64 {
        let mut ends = Vec::with_capacity(self.activities.len());
        let mut work = vec![0.0; self.kinds.len()];
        for activity in &self.activities {
            let begins = activity.after.iter().map(|after| ends[*after]).fold(0.0, f64::max);
            ends.push(begins + activity.duration_s);
            for (kind, units) in &activity.demands {
                work[*kind] += activity.duration_s * f64::from(*units);
            }
        }
        let loads = work.iter().zip(&self.kinds).map(|(work, (_, units))| work / f64::from(*units).max(1.0));
        loads.chain(ends.iter().copied()).fold(0.0, f64::max)
    }

    /// The problem with the actual durations.
    fn varied(&self, execution: Execution) -> Activities {
        let mut actual = self.clone();
        let mut dice = Dice(execution.seed);
        for activity in &mut actual.activities {
            activity.duration_s *= 1.0 + execution.vary * (2.0 * dice.share() - 1.0);
        }
        actual
    }
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

/// The providers, which take the actual durations.
struct Performers {
    durations_s: BTreeMap<String, f64>,
}

impl Oracle for Performers {
    fn perform(&mut self, path: &str, _attempt: u32, _goal: &Goal, _world: &World) -> Performance {
        let outputs = BTreeMap::from([("done".to_owned(), Value::Null)]);
        Performance {
            duration_s: self.durations_s.get(path).copied().unwrap_or(0.0),
            answer: Answer::Finished { outcome: SUCCESS.to_owned(), outputs, measured: Vec::new() },
        }
    }
}
