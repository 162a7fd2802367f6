//! Solves one planning problem as a user of the crate would, with times from the caller's clock and a check by the exact shapes.

use crate::confirmed::{Confirmed, Couples};
use crate::connect::{Budget, ConnectError, Route, connect};
use crate::diagnosis;
use crate::endless::{Unwound, unwound, wound_too_far};
use crate::exact::{Exact, Touch};
use crate::mechanism::Mechanism;
use crate::pace::Control;
use crate::problems::Problem;
use crate::simplify::{path_length, simplify};
use crate::space::{Isa, Space, State, state};
use std::cell::RefCell;

/// Postures per radian of the exact check: four times those of the search.
const EXACT_PER_RADIAN: f64 = Space::EXACT_RESOLUTION as f64;

/// Settings of a trial.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Settings {
    /// The budget of the search.
    pub budget: Budget,
    /// Number of repetitions for the minimum times; at least one. Every repetition gives the same path. A failure is not repeated.
    pub repetitions: usize,
    /// Maximum time for everything, in the clock's units; infinity for as long as the budget lasts.
    pub limit: f64,
}

/// The result of a trial.
#[derive(Debug, Clone, PartialEq)]
pub struct Trial {
    /// Time of the search, in the clock's units.
    pub plan: f64,
    /// Time of making the path short and free between its postures.
    pub simplify: f64,
    /// The path, or why there is none.
    pub outcome: Result<Found, ConnectError>,
    /// What is wrong with the start or the goal, if that is the reason.
    pub diagnosis: Vec<String>,
}

/// A path that was found.
#[derive(Debug, Clone, PartialEq)]
pub struct Found {
    /// The postures, with straight motions between them.
    pub path: Vec<Vec<f64>>,
    /// Its length, in radians.
    pub length_rad: f32,
    /// Its length before simplification, in radians.
    pub first_length_rad: f32,
    /// Number of samples drawn.
    pub iterations: usize,
    /// Positions of the start and the goal that exceeded a limit by rounding and are at the limit on the path.
    pub clamped: Vec<String>,
    /// A contact that the exact check finds on the path.
    pub touch: Option<Touch>,
}

/// Solves a problem; `clock` returns the time in any units.
pub fn run(mechanism: &Mechanism, problem: &Problem, settings: Settings, clock: &mut dyn FnMut() -> f64) -> Trial {
    run_with_isa(mechanism, problem, settings, Isa::detect(), clock)
}

/// As [`run`], with a given instruction set.
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
        let wound = wound_too_far(mechanism, positions, which);
        if !wound.is_empty() {
            return Trial { plan: 0.0, simplify: 0.0, outcome: Err(error), diagnosis: wound };
        }
    }
    let unwound = unwound(mechanism, &problem.start, &problem.goal);
    let mechanism = &unwound.mechanism;
    let ends = [("start", &unwound.start), ("goal", &unwound.goals[0])].map(|(which, positions)| {
        let (positions, beyond) = mechanism.clamped(positions);
        (positions, beyond.iter().map(|b| format!("{which} state: {b}")).collect::<Vec<_>>())
    });
    let goals: Vec<Vec<f64>> = unwound.goals.iter().map(|goal| mechanism.clamped(goal).0).collect();
    let exact = Exact::new(mechanism, problem.surroundings());
    // The search skips some pairs, so the exact shapes decide about its ends.
    let goals: Vec<Vec<f64>> = goals.into_iter().filter(|goal| exact.touch(goal).is_none()).collect();
    let refusal = match () {
        () if exact.touch(&ends[0].0).is_some() => Some(ConnectError::Start),
        () if goals.is_empty() => Some(ConnectError::Goal { goals: 1 }),
        () => None,
    };
    let mut space = Space::with_isa(mechanism, problem.surroundings(), isa);
    let mut doubts = Couples::default();
    let mut postures = goals.iter().chain([&ends[0].0]).map(Vec::as_slice);
    if refusal.is_none() && postures.clone().any(|posture| !space.is_free(&state(posture))) {
        doubts = diagnosis::doubts(mechanism, problem, &mut postures);
    }
    let mut task = Task { unwound: &unwound, problem, settings, isa, start: &ends[0].0, goals: &goals };
    let clock = RefCell::new(clock);
    let now = || (clock.borrow_mut())();
    let begin = now();
    let mut tried = match refusal {
        Some(error) => Tried { plan: 0.0, simplify: 0.0, outcome: Err(error) },
        None if doubts.is_empty() => task.attempt(&mut space, begin, &now),
        None => task.attempt(&mut task.confirming(&doubts), begin, &now),
    };
    let mut lines = Vec::new();
    // Spheres may block a way that the shapes leave free, and the shapes may reject a path because of pairs that the search skips.
    let again = match &tried.outcome {
        Ok(Found { touch: Some(_), .. }) => {
            doubts.extend(Couples { pairs: mechanism.by_shapes.clone(), ..Couples::default() })
        }
        Err(ConnectError::Exhausted { .. } | ConnectError::TimeUp { .. }) => {
            let blocked = diagnosis::blocked(mechanism, problem, [&ends[0].0, &goals[0]]);
            lines = blocked.lines;
            doubts.extend(blocked.doubts)
        }
        _ => false,
    };
    if again && now() - begin < settings.limit {
        task.settings.repetitions = 1;
        let mended = task.attempt(&mut task.confirming(&doubts), begin, &now);
        // A path that the shapes reject is still returned if there is no other.
        if mended.outcome.is_ok() || tried.outcome.is_err() {
            tried = Tried { plan: tried.plan + tried.simplify + mended.plan, ..mended };
        }
    }
    let Tried { plan, simplify, outcome } = tried;
    let clamped = ends.iter().flat_map(|(_, clamped)| clamped.clone()).collect();
    let outcome = outcome.map(|found| Found { clamped, ..found });
    let diagnosis = match &outcome {
        Err(ConnectError::Start) => diagnosis::diagnosis(mechanism, problem, &ends[0].0, "start state"),
        Err(ConnectError::Goal { .. }) => diagnosis::diagnosis(mechanism, problem, &ends[1].0, "goal state"),
        Err(_) => lines,
        Ok(_) => Vec::new(),
    };
    Trial { plan, simplify, outcome, diagnosis }
}

/// What is searched, and how.
struct Task<'t> {
    unwound: &'t Unwound,
    problem: &'t Problem,
    settings: Settings,
    isa: Isa,
    start: &'t [f64],
    goals: &'t [Vec<f64>],
}

/// The result of a search, with its time.
struct Tried {
    plan: f64,
    simplify: f64,
    outcome: Result<Found, ConnectError>,
}

impl Task<'_> {
    /// The space with these couples checked by exact shapes.
    fn confirming(&self, doubts: &Couples) -> Space {
        let (mechanism, surroundings) = (&self.unwound.mechanism, self.problem.surroundings());
        let mut space = Space::with_isa(&doubts.left_out_of(mechanism), surroundings, self.isa);
        space.confirm(Confirmed::new(mechanism, surroundings, doubts, 0.0));
        space
    }

    /// Searches as often as the settings ask for, while a path is found, until the time limit after `begin`.
    fn attempt(&self, space: &mut Space, begin: f64, now: &dyn Fn() -> f64) -> Tried {
        let Task { problem, settings, .. } = self;
        let start = state(self.start);
        let goals: Vec<State> = self.goals.iter().map(|goal| state(goal)).collect();
        let mut go_on = |_: usize| if now() - begin > settings.limit { Control::TimeUp } else { Control::Continue };
        let (mut plan, mut simplified) = (f64::INFINITY, f64::INFINITY);
        let mut routes = Err(ConnectError::Cancelled);
        for repetition in 0..settings.repetitions.max(1) {
            // Every repetition gives the same path, or the same failure.
            let is_enough = now() - begin > settings.limit || routes.is_err();
            if repetition > 0 && is_enough {
                break;
            }
            let begin = now();
            let route = connect(space, &start, &goals, settings.budget, &mut go_on);
            let between = now();
            let paths = route.and_then(|route| {
                let path = simplify(space, &route.path, settings.budget, &mut go_on)?;
                Ok((route, path))
            });
            let end = now();
            plan = plan.min(between - begin);
            simplified = simplified.min(end - between);
            // A repetition that was stopped by the time limit does not count.
            if repetition == 0 || paths.is_ok() {
                routes = paths;
            }
        }
        let outcome = routes.map_err(|error| match error {
            // These are the one original goal, reached by other turns.
            ConnectError::Goal { .. } => ConnectError::Goal { goals: 1 },
            error => error,
        });
        let outcome = outcome.map(|(route, path)| found(self.unwound, problem, &route, &path));
        Tried { plan, simplify: simplified, outcome }
    }
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
