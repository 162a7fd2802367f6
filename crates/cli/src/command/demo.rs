//! `ratn demo`: the main demonstration. The same task on real processes in several ways, each time in the same cell.
//!
//! Every run gets a fresh system, started from the same seed, so that no run affects another.

mod pair;
mod result;
mod table_task;

use super::run::{Beside, on_system, starting};
use super::{blocking_here, check};
use crate::arguments::{Budget, DemoArguments, GoodsArguments, SystemArguments};
use crate::failure::Failure;
use crate::interrupt::Interrupt;
use crate::output;
use crate::system::config::SystemConfig;
use crate::system::{Judgement, System};
use anyhow::{Context, anyhow, bail};
use ratn_cell::config::{AIMM, Setting};
use ratn_event_log as log;
use ratn_executive::protocol::Mode;
use ratn_model::load::Files;
use ratn_model::program::{Program, SUCCESS};
use ratn_motion::robot::Robot;
use ratn_proto::v1::UnintendedContact;
use ratn_report::gantt;
use ratn_report::timeline::Timeline;
use ratn_task_control::shell::Run;
use ratn_worker::tls::ClientTls;
use result::{Demonstration, Outcome, Plan, Work};
use std::borrow::Cow;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// The tasks are built in, so that the demo works from any folder: file names and texts.
const FETCH: (&str, &str) = ("fetch_boxes.yaml", include_str!("../../../../examples/fetch_boxes.yaml"));
/// The same task for a robot without base and head, behind a table.
const FETCH_ON_TABLE: (&str, &str) =
    ("fetch_boxes_table.yaml", include_str!("../../../../examples/fetch_boxes_table.yaml"));
/// The recovering task for a cell with faults, and the library that it uses: the first task with an additional look beside each approach.
const FETCH_WATCHED: (&str, &str) =
    ("fetch_boxes_watched.yaml", include_str!("../../../../examples/fetch_boxes_watched.yaml"));
const RECOVERING: (&str, &str) =
    ("fetch_boxes_recovering.yaml", include_str!("../../../../examples/fetch_boxes_recovering.yaml"));
/// The second experiment: a library with a look beside each approach, and the task that looks first and uses it.
const SET_WATCHED: (&str, &str) =
    ("set_table_watched.yaml", include_str!("../../../../examples/set_table_watched.yaml"));
const LOOK_AND_SET: (&str, &str) =
    ("set_table_recovering.yaml", include_str!("../../../../examples/set_table_recovering.yaml"));

/// Both tasks, annotated with what may overlap.
const FETCH_OVERLAPPED: (&str, &str) =
    ("fetch_boxes_overlapped.yaml", include_str!("../../../../examples/fetch_boxes_overlapped.yaml"));
const SET_OVERLAPPED: (&str, &str) =
    ("set_table_overlapped.yaml", include_str!("../../../../examples/set_table_overlapped.yaml"));

/// Times in seconds for which plans of the sequential runs may be improved; the network is compared with the best of these runs. 0 leaves the time
/// to the planner.
const SWEEP_S: [f64; 3] = [0.0, 0.2, 0.5];

/// Maximum tilt of a carried bowl or cup, in radians: the task's tolerance plus what the grasp adds.
const MAX_TILT_RAD: f64 = 0.11;

/// The posture from which the task looks first, and the name of its parameter.
const OBSERVATION: &str = "observation";

struct BuiltIn;

impl Files for BuiltIn {
    fn read(&self, _using: &str, path: &str) -> Result<(String, String), String> {
        let (name, text) =
            [FETCH_WATCHED, SET_WATCHED].into_iter().find(|(name, _)| path == *name).ok_or("it is not built in")?;
        Ok((name.to_owned(), text.to_owned()))
    }
}

/// Runs the task in every way and compares.
pub(crate) fn run(arguments: &DemoArguments, tls: &ClientTls) -> Result<(), Failure> {
    if arguments.robots == 2 {
        return pair::run(arguments, tls);
    }
    let config = SystemConfig::load_for(arguments.config.as_deref(), arguments.robot.as_deref())?;
    let tls = &config.client_tls(tls)?;
    let (file, text) = match arguments.scenario {
        scenario if config.robot != AIMM => (FETCH_ON_TABLE.0, on_table(&config.robot, scenario, arguments)?.into()),
        Setting::Boxes if arguments.faults.fault.is_empty() => built_in(FETCH),
        Setting::Boxes => built_in(RECOVERING),
        Setting::Table => built_in(LOOK_AND_SET),
    };
    let goods = result::Goods::of(arguments, config.robot == AIMM)?;
    let load = |text: &str, file: &str| check::load_from(&BuiltIn, text, file, &config.catalogue).map(Arc::new);
    let program = load(&text, file)?;
    let overlapped = overlapped(arguments, &config).map(|(file, text)| load(text, file)).transpose()?;
    if arguments.budget == Budget::Overlapped && overlapped.is_none() {
        let why = format!("made for {AIMM}, a cell in which nothing goes wrong, and no plates");
        return Err(Failure::Refused(format!("ratn: --budget overlapped: the task that overlaps is {why}")));
    }
    let plans = plans(arguments, overlapped.is_some());
    let directory = out_directory(arguments)?;
    let programs = (program, overlapped);
    let setup = Setup { goods: &goods, arguments, config: &config, programs, directory: &directory, tls };
    let mut demonstration = Demonstration::new(arguments, goods);
    // The first failure; the other ways are run all the same.
    let mut failed: Option<String> = None;
    let outcome: Result<(), Failure> = blocking_here(async {
        let interrupt = Interrupt::listen()?;
        for plan in plans {
            output::progress(format_args!("\n{}", plan.announcement(&goods)));
            let run = setup.run(&plan, &interrupt);
            // Boxed, because a config is large.
            let outcome = Box::pin(run).await;
            let outcome = outcome.with_context(|| plan.name())?;
            let wrong = what_is_wrong(&outcome, &goods);
            if let Some(touched) = said(&outcome.unintended_contacts) {
                output::progress(format_args!("{}: {touched}", plan.name()));
            }
            demonstration.outcomes.push(outcome);
            if interrupt.asked() {
                return Err(anyhow!("interrupted").into());
            }
            if let Some(wrong) = wrong {
                output::progress(format_args!("{}: {wrong}", plan.name()));
                failed.get_or_insert_with(|| format!("{}: {wrong}", plan.name()));
            }
        }
        Ok(())
    });
    // Whatever was run is shown, even if not everything was.
    draw(&mut demonstration)?;
    if arguments.json {
        output::progress(format_args!("\n{demonstration}"));
        output::result(serde_json::to_string_pretty(&demonstration.to_json())?)?;
    } else {
        output::progress("");
        output::result(&demonstration)?;
    }
    outcome?;
    failed.map_or(Ok(()), |failed| Err(anyhow!(failed).into()))
}

/// The task of the last row. It is written for the paper's robot and a cell without faults, and does not look for plates.
fn overlapped(arguments: &DemoArguments, config: &SystemConfig) -> Option<(&'static str, &'static str)> {
    let fits = config.robot == AIMM && arguments.faults.fault.is_empty() && arguments.budget != Budget::Task;
    match arguments.scenario {
        _ if !fits => None,
        Setting::Boxes => Some(FETCH_OVERLAPPED),
        Setting::Table => (arguments.plates == 0).then_some(SET_OVERLAPPED),
    }
}

fn built_in((file, text): (&'static str, &'static str)) -> (&'static str, Cow<'static, str>) {
    (file, text.into())
}

/// The text of the task for another robot than the paper's, with the table and the places of its workplace.
fn on_table(robot: &str, scenario: Setting, arguments: &DemoArguments) -> Result<String, Failure> {
    let refused = |why: String| Failure::Refused(format!("ratn: --robot {robot}: {why}"));
    if scenario != Setting::Boxes {
        return Err(refused(format!("the scenario `table` is made for {AIMM}: use `--scenario boxes`")));
    }
    if !arguments.faults.fault.is_empty() {
        return Err(refused(format!("the task that recovers from faults is made for {AIMM}: leave out --fault")));
    }
    let described = Robot::named_or_file(robot).map_err(|error| refused(error.to_string()))?;
    let workplace = table_task::workplace(&described, OBSERVATION, arguments.boxes).map_err(refused)?;
    Ok(table_task::at(FETCH_ON_TABLE.1, workplace)?)
}

/// A robot's posture outside of the camera's view, as a parameter of its task.
fn observation(robot: &str) -> anyhow::Result<String> {
    let posture = Robot::named_or_file(robot)?.posture(OBSERVATION);
    let posture = posture.with_context(|| format!("the robot {robot} has no posture `{OBSERVATION}`"))?;
    let positions: Vec<String> = posture.iter().map(f64::to_string).collect();
    Ok(format!("joints({})", positions.join(", ")))
}

/// What is wrong with the result of a run, if anything, according to the cell's ground truth.
fn what_is_wrong(outcome: &Outcome, goods: &result::Goods) -> Option<String> {
    let Outcome { delivered, greatest_tilt_rad, end, .. } = outcome;
    if *delivered != goods.count() {
        return Some(format!("{delivered} of {goods} {}; {end}", goods.destination()));
    }
    let leans = *greatest_tilt_rad > MAX_TILT_RAD;
    leans.then(|| {
        format!("a bowl or a cup leaned by {greatest_tilt_rad:.2} rad on its way, at most {MAX_TILT_RAD} are tolerated")
    })
}

/// The runs, in the order of the table's rows and columns.
fn plans(arguments: &DemoArguments, overlapped: bool) -> Vec<Plan> {
    let plan = |mode, planners, work| Plan { mode, planners, work };
    let mut plans = Vec::new();
    if matches!(arguments.budget, Budget::Task | Budget::Both) {
        plans.push(plan(Mode::Hsm, arguments.planners, Work::Budget));
        plans.push(plan(Mode::Cdtn, 1, Work::Budget));
        plans.push(plan(Mode::Cdtn, arguments.planners, Work::Budget));
    }
    if matches!(arguments.budget, Budget::None | Budget::Both) {
        plans.push(plan(Mode::Hsm, arguments.planners, Work::NoBudget));
        if arguments.budget == Budget::None {
            plans.push(plan(Mode::Cdtn, 1, Work::NoBudget));
        }
        plans.push(plan(Mode::Cdtn, arguments.planners, Work::NoBudget));
    }
    if overlapped {
        let hsm = SWEEP_S.map(|plan_s| plan(Mode::Hsm, arguments.planners, Work::Overlapped { plan_s }));
        plans.extend(hsm);
        plans.push(plan(Mode::Cdtn, arguments.planners, Work::Overlapped { plan_s: 0.0 }));
    }
    // With one planner two columns are equal.
    plans.dedup_by_key(|plan| plan.file_stem());
    plans
}

/// What all runs of a demonstration share.
struct Setup<'a> {
    goods: &'a result::Goods,
    arguments: &'a DemoArguments,
    config: &'a SystemConfig,
    /// The paper's task, and the overlapped one.
    programs: (Arc<Program>, Option<Arc<Program>>),
    /// The folder of logs and charts.
    directory: &'a Path,
    tls: &'a ClientTls,
}

impl Setup<'_> {
    /// Runs the task in one way, on a separate system.
    async fn run(&self, plan: &Plan, interrupt: &Interrupt) -> anyhow::Result<Outcome> {
        let Setup { goods, arguments, config, ref programs, directory, tls } = *self;
        let mut config = config.clone();
        config.apply(&SystemArguments {
            robot: None,
            scene: Some(arguments.scenario),
            goods: GoodsArguments {
                boxes: Some(arguments.boxes),
                bowls: Some(arguments.bowls),
                forks: Some(arguments.forks),
                cups: Some(arguments.cups),
                plates: Some(arguments.plates),
            },
            planners: Some(plan.planners),
            speed: Some(arguments.speed),
            seed: Some(arguments.seed),
            faults: arguments.faults.clone(),
        });
        let mut set = goods.parameters();
        let program = match plan.work {
            Work::Budget | Work::NoBudget => {
                set.push(("budget".to_owned(), (plan.work == Work::Budget).to_string()));
                &programs.0
            }
            Work::Overlapped { plan_s } => {
                set.retain(|(name, _)| name != "plates");
                set.push(("plan_s".to_owned(), plan_s.to_string()));
                programs.1.as_ref().context("there is no task that overlaps")?
            }
        };
        if config.robot != AIMM {
            set.push((OBSERVATION.to_owned(), observation(&config.robot)?));
        }
        let log_file = directory.join(format!("{}.jsonl", plan.file_stem()));
        let run = Run {
            program: program.clone(),
            // The task file is built in.
            from: None,
            file: String::new(),
            parameters: program.bind_parameters(&set)?,
            mode: plan.mode,
            seed: arguments.seed,
            learned: Default::default(),
            log: log_file.clone(),
            breakpoints: Vec::new(),
            quiet: false,
            // The system ends with the demo, so nobody resumes the run.
            checkpoint_every: 0,
        };
        let system = starting(Box::pin(System::start_private(config, tls)), interrupt).await?;
        let (ended, judgement) =
            on_system(run, system, Beside::default(), interrupt, async |system| system.judgement().await).await?;
        let Judgement { delivered, greatest_tilt_rad, unintended_contacts, waited_share } = judgement;
        let timeline = Timeline::of(&log::read(&log_file)?.lines);
        if timeline.outcome.as_deref() != Some(ended.outcome.as_str()) {
            bail!("the event log {} does not end as the run did", log_file.display());
        }
        let end = if ended.outcome == SUCCESS {
            "the task ended with success".to_owned()
        } else {
            format!("the task ended with {}: {}", ended.outcome, ended.reason)
        };
        let chart = directory.join(format!("{}.html", plan.file_stem()));
        let plan = *plan;
        Ok(Outcome {
            plan,
            timeline,
            delivered,
            greatest_tilt_rad,
            unintended_contacts,
            waited_share,
            end,
            log: log_file,
            chart,
        })
    }
}

/// A sentence about unintended contacts.
fn said(contacts: &[UnintendedContact]) -> Option<String> {
    let one = |contact: &UnintendedContact| {
        format!(
            "{} at {:.2} s, {:.1} mm deep, pushed by {:.1} mm",
            contact.bodies.join(" touches "),
            contact.began_s,
            contact.depth_m * 1e3,
            contact.pushed_m * 1e3
        )
    };
    let all: Vec<String> = contacts.iter().map(one).collect();
    (!all.is_empty()).then(|| format!("what touched that should not have: {}", all.join("; ")))
}

fn out_directory(arguments: &DemoArguments) -> anyhow::Result<PathBuf> {
    match &arguments.out {
        Some(directory) => {
            std::fs::create_dir_all(directory).with_context(|| format!("cannot make {}", directory.display()))?;
            Ok(directory.canonicalize()?)
        }
        None => Ok(tempfile::Builder::new().prefix("ratn-demo-").tempdir()?.keep()),
    }
}

/// Draws a chart per run; all charts of a row have the time axis of the longest run.
fn draw(demonstration: &mut Demonstration) -> anyhow::Result<()> {
    for outcome in &demonstration.outcomes {
        let same = demonstration.outcomes.iter().filter(|other| other.plan.work.is_like(outcome.plan.work));
        let scale_s = same.map(|other| other.timeline.end_s).fold(0.0, f64::max);
        gantt::write(&outcome.chart, &outcome.timeline, Some(scale_s))
            .with_context(|| format!("cannot write {}", outcome.chart.display()))?;
    }
    Ok(())
}
