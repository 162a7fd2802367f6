//! One planning problem solved as a user of the crate would, timed by the caller's clock and checked by the exact shapes.

use crate::connect::{Budget, ConnectError, Route, connect};
use crate::diagnosis::diagnosis;
use crate::endless::{Unwound, unwound, wound_too_far};
use crate::exact::{Exact, Touch};
use crate::mechanism::Mechanism;
use crate::pace::Control;
use crate::problems::Problem;
use crate::simplify::{path_length, simplify};
use crate::space::{Isa, Space, State, state};

/// Postures per radian that the exact check looks at: four times those of the search.
const EXACT_PER_RADIAN: f64 = 4.0 * Space::RESOLUTION as f64;

/// How a problem is tried.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Settings {
    /// What the search may cost.
    pub budget: Budget,
    /// How often it is solved, for the least times; at least once. Every time gives the same path.
    pub repetitions: usize,
}

/// What came of a problem.
#[derive(Debug, Clone, PartialEq)]
pub struct Trial {
    /// From the search to its path, in the clock's units.
    pub plan: f64,
    /// From that to a short path that is free also between its postures.
    pub simplify: f64,
    /// Why there is none.
    pub outcome: Result<Found, ConnectError>,
    /// What is wrong with the start or the goal, where that is why.
    pub diagnosis: Vec<String>,
}

/// A path.
#[derive(Debug, Clone, PartialEq)]
pub struct Found {
    /// Postures, straight motions between them.
    pub path: Vec<Vec<f64>>,
    /// Its length, in radians.
    pub length_rad: f32,
    /// Before simplification.
    pub first_length_rad: f32,
    /// Samples drawn.
    pub iterations: usize,
    /// Positions of the start and the goal that were beyond a limit by rounding and are at the limit on the path.
    pub clamped: Vec<String>,
    /// What the exact check rejects.
    pub touch: Option<Touch>,
}

/// Solves a problem; `clock` gives the time in any units.
pub fn run(mechanism: &Mechanism, problem: &Problem, settings: Settings, clock: &mut dyn FnMut() -> f64) -> Trial {
    run_with_isa(mechanism, problem, settings, Isa::detect(), clock)
}

/// As [`run`], with instructions that are not the widest.
pub fn run_with_isa(
    mechanism: &Mechanism,
    problem: &Problem,
    settings: Settings,
    isa: Isa,
    clock: &mut dyn FnMut() -> f64,
) -> Trial {
    let filtered = (!problem.self_filters.is_empty()).then(|| {
        let mut problem = problem.clone();
        problem.filter(mechanism);
        problem
    });
    let problem = filtered.as_ref().unwrap_or(problem);
    let ends = [
        ("start state", &problem.start, ConnectError::Start),
        ("goal state", &problem.goal, ConnectError::Goal { goals: 1 }),
    ];
    for (which, positions, error) in ends {
        let diagnosis = wound_too_far(mechanism, positions, which);
        if !diagnosis.is_empty() {
            return Trial { plan: 0.0, simplify: 0.0, outcome: Err(error), diagnosis };
        }
    }
    let unwound = unwound(mechanism, &problem.start, &problem.goal);
    let mechanism = &unwound.mechanism;
    let mut space = Space::with_isa(mechanism, problem.surroundings(), isa);
    let ends = [("start", &unwound.start), ("goal", &unwound.goals[0])].map(|(which, positions)| {
        let (positions, beyond) = mechanism.clamped(positions);
        (positions, beyond.iter().map(|b| format!("{which} state: {b}")).collect::<Vec<_>>())
    });
    let start = state(&ends[0].0);
    let goals: Vec<State> = unwound.goals.iter().map(|goal| state(&mechanism.clamped(goal).0)).collect();
    let mut go_on = |_: usize| Control::Continue;
    let (mut plan_time, mut simplify_time) = (f64::INFINITY, f64::INFINITY);
    let mut outcome = Err(ConnectError::Cancelled);
    for _ in 0..settings.repetitions.max(1) {
        let begin = clock();
        let route = connect(&mut space, &start, &goals, settings.budget, &mut go_on);
        let between = clock();
        let paths = route.and_then(|route| {
            let path = simplify(&mut space, &route.path, settings.budget, &mut go_on)?;
            Ok((route, path))
        });
        let end = clock();
        plan_time = plan_time.min(between - begin);
        simplify_time = simplify_time.min(end - between);
        outcome = paths.map_err(|error| match error {
            // The same one, turned to by other ways.
            ConnectError::Goal { .. } => ConnectError::Goal { goals: 1 },
            error => error,
        });
    }
    let clamped = ends.iter().flat_map(|(_, clamped)| clamped.clone()).collect();
    let outcome = outcome.map(|(route, path)| Found { clamped, ..found(&unwound, problem, &route, &path) });
    let diagnosis = match &outcome {
        Err(ConnectError::Start) => diagnosis(mechanism, problem, &ends[0].0, "start state"),
        Err(ConnectError::Goal { .. }) => diagnosis(mechanism, problem, &ends[1].0, "goal state"),
        _ => Vec::new(),
    };
    Trial { plan: plan_time, simplify: simplify_time, outcome, diagnosis }
}

fn found(unwound: &Unwound, problem: &Problem, route: &Route, path: &[State]) -> Found {
    let mechanism = &unwound.mechanism;
    let joints = mechanism.joints.len();
    let postures: Vec<Vec<f64>> = path.iter().map(|s| s[..joints].iter().map(|q| f64::from(*q)).collect()).collect();
    let touch = Exact::new(mechanism, problem.surroundings()).touch_along(&postures, EXACT_PER_RADIAN);
    Found {
        path: postures.iter().map(|posture| unwound.wound(posture)).collect(),
        length_rad: path_length(path),
        first_length_rad: path_length(&route.path),
        iterations: route.iterations,
        clamped: Vec::new(),
        touch,
    }
}
