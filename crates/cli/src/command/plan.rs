//! `ratn plan`: solves a file of planning problems for any robot and reports times, path lengths and
//! success.

use crate::arguments::PlanArguments;
use crate::failure::Failure;
use crate::output;
use ratn_motion::connect::{Budget, ConnectError};
use ratn_motion::mechanism::Mechanism;
use ratn_motion::mesh_files::MeshFiles;
use ratn_motion::pairs::{self, Kind, Pair};
use ratn_motion::problems::{Problem, Problems};
use ratn_motion::robot_model::RobotModel;
use ratn_motion::robot_state::RobotState;
use ratn_motion::trial::{self, Settings, Trial};
use serde::Serialize;
use std::collections::BTreeMap;
use std::path::Path;
use std::time::{Duration, Instant};

/// Maximum number of pairs named per kind.
const MOST_NAMED: usize = 8;

/// Interval of progress messages.
const TOLD_EVERY: Duration = Duration::from_secs(5);

/// Maximum size of a file of problems, and of a robot.
const MAX_FILE: usize = 256 << 20;

/// Results of a class of problems.
#[derive(Debug, Serialize)]
struct Class {
    class: String,
    problems: usize,
    solved: usize,
    /// Number of problems whose start or goal touches something.
    invalid: usize,
    /// Number of paths that the exact shapes reject.
    rejected: usize,
    plan_us: Spread,
    simplify_us: Spread,
    length_rad: Spread,
    results: Vec<Line>,
}

/// Over the solved problems; null where there are none.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
struct Spread {
    median: Option<f64>,
    p95: Option<f64>,
}

/// Result of one problem.
#[derive(Debug, Serialize)]
struct Line {
    index: u64,
    plan_us: f64,
    simplify_us: f64,
    iterations: Option<usize>,
    postures: Option<usize>,
    length_rad: Option<f64>,
    /// Why there is no path, or what the exact check found on it.
    trouble: Option<String>,
    /// Positions that exceeded a limit by rounding and were clamped.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    clamped: Vec<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    path: Option<Vec<Vec<f64>>>,
}

/// Solves all problems and prints a line per class.
pub(crate) fn run(arguments: &PlanArguments) -> Result<(), Failure> {
    if arguments.robot.extension().is_some_and(|extension| extension == "toml") {
        let file = arguments.robot.display();
        return Err(Failure::Refused(format!(
            "ratn: {file}: `ratn plan` takes the URDF that a robot.toml names (`urdf`), and its `srdf` with --srdf"
        )));
    }
    let urdf = read(&arguments.robot)?;
    let srdf = arguments.srdf.as_deref().map(read).transpose()?;
    let beside = arguments.problems.parent().unwrap_or(Path::new("")).to_owned();
    let files = MeshFiles { beside, packages: arguments.packages.clone() };
    let mut load = |name: &str| files.read(name).map_err(|error| error.to_string());
    let problems = Problems::parse_with_files(&read(&arguments.problems)?, &mut load)
        .map_err(|error| refused(&arguments.problems, error))?;
    let beside = arguments.robot.parent().unwrap_or(Path::new("")).to_owned();
    let meshes = MeshFiles { beside, packages: arguments.packages.clone() };
    let mut load = |name: &str| meshes.read(name);
    let model = RobotModel::read_with_meshes(&urdf, srdf.as_deref(), &mut load)
        .map_err(|error| refused(&arguments.robot, error))?;
    if let Some(said) = pairs_said(&model, srdf.is_some()) {
        output::progress(said);
    }
    let mut robot: Option<(BTreeMap<String, f64>, Mechanism)> = None;
    let settings = Settings {
        budget: Budget { iterations: arguments.iterations, seed: arguments.seed },
        repetitions: arguments.repeat,
        limit: arguments.limit_s * 1e6,
    };
    let begin = Instant::now();
    let mut told = begin;
    let mut clock = || begin.elapsed().as_secs_f64() * 1e6;
    let mut classes = Vec::new();
    for (class, list) in &problems.classes {
        let mut trials = Vec::new();
        for problem in list {
            // Most files have only one state.
            let mechanism = match robot.take() {
                Some((state, mechanism)) if state == problem.state => mechanism,
                _ => {
                    let mut mechanism = in_state(&model, &problems.joints, problem, arguments)?;
                    mechanism.pad_all(arguments.padding_mm * 1e-3);
                    mechanism
                }
            };
            trials.push((problem.index, trial::run(&mechanism, problem, settings, &mut clock)));
            if told.elapsed() >= TOLD_EVERY {
                told = Instant::now();
                let (done, all, so_far) = (trials.len(), list.len(), begin.elapsed().as_secs());
                output::progress(format!("{class}: {done} of {all} problems after {so_far} s"));
            }
            robot = Some((problem.state.clone(), mechanism));
        }
        classes.push(summary(class, trials, arguments.paths));
    }
    if arguments.json {
        output::result(serde_json::to_string(&classes)?)?;
    } else {
        output::result(table(&classes))?;
    }
    verdict(&classes)
}

/// Pairs of links that are not checked, or not during the search, although no SRDF says so.
fn pairs_said(model: &RobotModel, has_srdf: bool) -> Option<String> {
    let checks = model.checks();
    let named = |pairs: &mut dyn Iterator<Item = &Pair>| pairs::named(model, pairs, MOST_NAMED);
    let mut lines = Vec::new();
    if !model.has_exceptions() {
        lines.push(match has_srdf {
            true => "The SRDF excepts no pair of links (it has no <disable_collisions> of two of them), so they are told apart by how they meet:",
            false => "Without an SRDF (--srdf), pairs of links are told apart by how they meet:",
        });
    } else if !checks.unsaid.is_empty() || !checks.by_shapes.is_empty() {
        lines.push("Of the pairs of links that the SRDF does not except:");
    } else {
        return None;
    }
    let mut lines: Vec<String> = lines.into_iter().map(str::to_owned).collect();
    if model.has_exceptions() {
        if !checks.unsaid.is_empty() {
            let names = named(&mut checks.unsaid.iter());
            lines.push(format!("  {} meet in every posture, not checked: {names}", checks.unsaid.len()));
            lines.extend(
                checks
                    .unsaid
                    .iter()
                    .take(MOST_NAMED)
                    .map(|pair| format!("    to say so in the SRDF: {}", pairs::exception(model, *pair, "Default"))),
            );
        }
    } else {
        for (kind, pairs) in pairs::kinds(model) {
            let names = match kind {
                Kind::Sometimes | Kind::Never => String::new(),
                _ => format!(": {}", named(&mut pairs.iter())),
            };
            let is_excepted = matches!(kind, Kind::Neighbours | Kind::Always);
            let checked = if is_excepted { "not checked" } else { "checked" };
            lines.push(format!("  {} {kind}, {checked}{names}", pairs.len()));
        }
    }
    let by_shapes = &checks.by_shapes;
    if !by_shapes.is_empty() {
        let names = named(&mut by_shapes.iter());
        lines.push(format!(
            "  {} of them in the start, the goal and on the finished path alone, their spheres are too coarse for the search: {names}",
            by_shapes.len()
        ));
    }
    Some(lines.join("\n"))
}

/// The robot with its unplanned joints at the positions of a problem.
fn in_state(
    model: &RobotModel,
    joints: &[String],
    problem: &Problem,
    arguments: &PlanArguments,
) -> Result<Mechanism, Failure> {
    let state = RobotState::neutral(model).with(model, &problem.state).map_err(|error| {
        refused(&arguments.problems, anyhow::anyhow!("the `state` of problem {}: {error}", problem.index))
    })?;
    model.planned(joints, &state).map_err(|error| refused(&arguments.robot, error))
}

/// A failure where a path is rejected, or where no problem was solved.
fn verdict(classes: &[Class]) -> Result<(), Failure> {
    let rejected: usize = classes.iter().map(|c| c.rejected).sum();
    if rejected > 0 {
        return Err(anyhow::anyhow!("{rejected} paths are not free by the exact shapes").into());
    }
    if classes.iter().all(|c| c.solved == 0) {
        return Err(anyhow::anyhow!("none of the problems was solved; above is why").into());
    }
    Ok(())
}

fn read(path: &Path) -> Result<String, Failure> {
    ratn_regular_file::read_text(path, MAX_FILE)
        .map_err(|error| refused(path, anyhow::anyhow!("cannot be read: {error}")))
}

fn refused(path: &Path, error: impl Into<anyhow::Error>) -> Failure {
    Failure::Refused(format!("{}: {:#}", path.display(), error.into()))
}

fn summary(class: &str, trials: Vec<(u64, Trial)>, with_paths: bool) -> Class {
    let found = || trials.iter().filter_map(|(_, t)| t.outcome.as_ref().ok().map(|found| (t, found)));
    let is_invalid = |t: &Trial| matches!(t.outcome, Err(ConnectError::Start | ConnectError::Goal { .. }));
    Class {
        class: class.to_owned(),
        problems: trials.len(),
        solved: found().count(),
        invalid: trials.iter().filter(|(_, t)| is_invalid(t)).count(),
        rejected: found().filter(|(_, found)| found.touch.is_some()).count(),
        plan_us: spread(found().map(|(t, _)| t.plan).collect()),
        simplify_us: spread(found().map(|(t, _)| t.simplify).collect()),
        length_rad: spread(found().map(|(_, found)| f64::from(found.length_rad)).collect()),
        results: trials.iter().map(|(index, trial)| line(*index, trial, with_paths)).collect(),
    }
}

fn line(index: u64, trial: &Trial, with_paths: bool) -> Line {
    let found = trial.outcome.as_ref().ok();
    let trouble = match &trial.outcome {
        Ok(found) => found.touch.as_ref().map(ToString::to_string),
        Err(error) if trial.diagnosis.is_empty() => Some(error.to_string()),
        Err(error) => Some(format!("{error}: {}", trial.diagnosis.join("; "))),
    };
    Line {
        index,
        plan_us: round(trial.plan),
        simplify_us: round(trial.simplify),
        iterations: found.map(|f| f.iterations),
        postures: found.map(|f| f.path.len()),
        length_rad: found.map(|f| f64::from(f.length_rad)),
        trouble,
        clamped: found.map(|f| f.clamped.clone()).unwrap_or_default(),
        path: found.filter(|_| with_paths).map(|f| f.path.clone()),
    }
}

/// Percentiles by nearest rank.
fn spread(mut values: Vec<f64>) -> Spread {
    values.sort_by(f64::total_cmp);
    let rank = |share: f64| {
        let rank = (values.len() as f64 * share).ceil() as usize;
        values.get(rank.saturating_sub(1)).map(|v| round(*v))
    };
    Spread { median: rank(0.5), p95: rank(0.95) }
}

fn round(value: f64) -> f64 {
    (value * 1e3).round() / 1e3
}

fn table(classes: &[Class]) -> String {
    let row = |cells: [String; 9]| {
        let [name, solved, rest @ ..] = cells;
        let rest: String = rest.iter().map(|cell| format!("{cell:>10}")).collect();
        format!("{name:<20}{solved:>9}{rest}")
    };
    let head = ["class", "solved", "invalid", "plan µs", "p95", "simplify", "p95", "length", "rejected"];
    let mut lines = vec![row(head.map(str::to_owned))];
    for class in classes {
        let number =
            |value: Option<f64>, digits: usize| value.map_or_else(|| "-".to_owned(), |v| format!("{v:.digits$}"));
        lines.push(row([
            class.class.clone(),
            format!("{}/{}", class.solved, class.problems),
            class.invalid.to_string(),
            number(class.plan_us.median, 0),
            number(class.plan_us.p95, 0),
            number(class.simplify_us.median, 0),
            number(class.simplify_us.p95, 0),
            number(class.length_rad.median, 2),
            class.rejected.to_string(),
        ]));
    }
    for class in classes {
        for line in &class.results {
            for note in line.clamped.iter().chain(&line.trouble) {
                lines.push(format!("{} {}: {note}", class.class, line.index));
            }
        }
    }
    lines.join("\n")
}

#[cfg(test)]
mod tests {
    use super::*;
    use ratn_motion::trial::Found;

    #[test]
    fn medians_and_percentiles_are_nearest_ranks() {
        assert_eq!(spread(vec![]), Spread { median: None, p95: None });
        assert_eq!(spread(vec![3.0, 1.0, 2.0]), Spread { median: Some(2.0), p95: Some(3.0) });
        assert_eq!(spread((1..=100).map(f64::from).collect()), Spread { median: Some(50.0), p95: Some(95.0) });
    }

    #[test]
    fn a_problem_without_a_path_counts_as_unsolved_and_says_why() {
        let diagnosis = vec!["hand is 3.0 mm inside shelf".to_owned()];
        let trial = Trial { plan: 1.0, simplify: 0.0, outcome: Err(ConnectError::Goal { goals: 1 }), diagnosis };
        let class = summary("tight", vec![(7, trial)], false);
        assert_eq!((class.problems, class.solved, class.invalid), (1, 0, 1));
        insta::assert_snapshot!(table(&[class]), @r"
        class                  solved   invalid   plan µs       p95  simplify       p95    length  rejected
        tight                     0/1         1         -         -         -         -         -         0
        tight 7: none of the 1 goals is free: hand is 3.0 mm inside shelf
        ");
    }

    #[test]
    fn a_file_of_which_nothing_was_solved_is_a_failure() {
        let unsolved = Err(ConnectError::Exhausted { iterations: 9 });
        let failed = Trial { plan: 1.0, simplify: 0.0, outcome: unsolved, diagnosis: Vec::new() };
        let found = Found {
            path: vec![vec![0.0], vec![1.0]],
            length_rad: 1.0,
            first_length_rad: 1.0,
            iterations: 0,
            clamped: vec!["goal state: elbow is at 3.1416".to_owned()],
            touch: None,
        };
        let solved = Trial { outcome: Ok(found), ..failed.clone() };
        assert!(verdict(&[summary("shelf", vec![(1, failed.clone())], false)]).is_err());
        let classes = [summary("shelf", vec![(1, failed), (2, solved)], false)];
        assert!(verdict(&classes).is_ok());
        assert!(table(&classes).ends_with("\nshelf 2: goal state: elbow is at 3.1416"));
    }
}
