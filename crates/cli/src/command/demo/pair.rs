//! `ratn demo --robots 2`: two arms at one table, a task each. First one task after the other, then both at once, each time in a cell that is
//! laid out from the same seed.

use super::{BuiltIn, out_directory, said};
use crate::arguments::{DemoArguments, GoodsArguments, SystemArguments};
use crate::command::run::starting;
use crate::command::tables::improvement;
use crate::command::{blocking_here, check};
use crate::failure::Failure;
use crate::interrupt::Interrupt;
use crate::output;
use crate::system::config::SystemConfig;
use crate::system::{Judgement, System};
use anyhow::{Context, anyhow};
use ratn_cell::config::Setting;
use ratn_event_log as log;
use ratn_executive::protocol::Mode;
use ratn_model::program::{Program, SUCCESS};
use ratn_motion::robot::Robot;
use ratn_proto::v1::UnintendedContact;
use ratn_report::gantt;
use ratn_report::statistics::Statistics;
use ratn_report::timeline::Timeline;
use ratn_task_control::shell::{self, Ended, Place, Run};
use ratn_worker::tls::ClientTls;
use serde_json::{Value, json};
use std::fmt;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Instant;

/// The robot with two arms.
const TWIN: &str = "twin";
/// Its arms, by the names that the task's parameter uses.
const ARMS: [&str; 2] = ["left", "right"];
/// The task of each arm.
const FETCH: (&str, &str) = ("fetch_boxes_pair.yaml", include_str!("../../../../../examples/fetch_boxes_pair.yaml"));

/// The order of the two tasks.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Way {
    InTurn,
    Together,
}

/// The run of one arm's task.
#[derive(Debug)]
struct OneRun {
    arm: &'static str,
    ended: Ended,
    timeline: Timeline,
    log: PathBuf,
    chart: PathBuf,
}

/// Both tasks in one order.
#[derive(Debug)]
struct Outcome {
    way: Way,
    runs: Vec<OneRun>,
    /// From the beginning of the first run to the end of the last, in the robot's seconds.
    makespan_s: f64,
    delivered: usize,
    unintended_contacts: Vec<UnintendedContact>,
    /// The share of its processor time that the system waited for, from 0 to 1.
    waited_share: f64,
}

/// Everything that is shown.
#[derive(Debug)]
struct Demonstration {
    boxes: u32,
    planners: u32,
    speed: f64,
    seed: u64,
    outcomes: Vec<Outcome>,
}

/// What both orders share.
struct Setup<'a> {
    arguments: &'a DemoArguments,
    config: SystemConfig,
    program: Arc<Program>,
    directory: &'a Path,
    tls: &'a ClientTls,
}

/// Runs both tasks in both orders and compares.
pub(super) fn run(arguments: &DemoArguments, tls: &ClientTls) -> Result<(), Failure> {
    let config = config(arguments)?;
    let tls = &config.client_tls(tls)?;
    let program = check::load_from(&BuiltIn, FETCH.1, FETCH.0, &config.catalogue).map(Arc::new)?;
    let directory = out_directory(arguments)?;
    let setup = Setup { arguments, config, program, directory: &directory, tls };
    let DemoArguments { boxes, planners, speed, seed, .. } = *arguments;
    let mut demonstration = Demonstration { boxes, planners, speed, seed, outcomes: Vec::new() };
    // The first failure; the other order is run all the same.
    let mut failed: Option<String> = None;
    let outcome: Result<(), Failure> = blocking_here(async {
        let interrupt = Interrupt::listen()?;
        for way in [Way::InTurn, Way::Together] {
            output::progress(format_args!("\n{}", way.name()));
            // Boxed, because a config is large.
            let outcome = Box::pin(setup.perform(way, &interrupt)).await.with_context(|| way.name())?;
            if let Some(touched) = said(&outcome.unintended_contacts) {
                output::progress(format_args!("{}: {touched}", way.name()));
            }
            let wrong = outcome.what_is_wrong(boxes);
            demonstration.outcomes.push(outcome);
            if interrupt.asked() {
                return Err(anyhow!("interrupted").into());
            }
            if let Some(wrong) = wrong {
                output::progress(format_args!("{}: {wrong}", way.name()));
                failed.get_or_insert_with(|| format!("{}: {wrong}", way.name()));
            }
        }
        Ok(())
    });
    demonstration.draw()?;
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

/// The config of both systems; arguments that do not fit two robots are refused.
fn config(arguments: &DemoArguments) -> Result<SystemConfig, Failure> {
    let refused = |why: String| Failure::Refused(format!("ratn: --robots 2: {why}"));
    if arguments.robot.as_deref().is_some_and(|robot| robot != TWIN) {
        return Err(refused(format!("the task is made for the built-in robot `{TWIN}`: leave out --robot")));
    }
    if arguments.scenario != Setting::Boxes {
        return Err(refused("two arms fetch boxes: use `--scenario boxes`".to_owned()));
    }
    if !arguments.faults.fault.is_empty() {
        return Err(refused("the task does not recover from faults: leave out --fault".to_owned()));
    }
    let robot = Robot::built_in(TWIN).context("the built-in robot")?;
    let places = robot.workplace().map_or(0, |workplace| workplace.places.at.len());
    if arguments.boxes as usize > places {
        return Err(refused(format!("each arm has places for {places} boxes, not for {}", arguments.boxes)));
    }
    let mut config = SystemConfig::load_for(arguments.config.as_deref(), Some(TWIN))?;
    config.apply(&SystemArguments {
        goods: GoodsArguments { boxes: Some(arguments.boxes), ..GoodsArguments::default() },
        planners: Some(arguments.planners),
        speed: Some(arguments.speed),
        seed: Some(arguments.seed),
        ..SystemArguments::default()
    });
    Ok(config)
}

impl Setup<'_> {
    /// Performs both tasks in one order, on a separate system.
    async fn perform(&self, way: Way, interrupt: &Interrupt) -> anyhow::Result<Outcome> {
        let mut system = starting(Box::pin(System::start_private(self.config.clone(), self.tls)), interrupt).await?;
        let place = system.place();
        let [left, right] = ARMS.map(|arm| self.one(way, arm, &place, interrupt));
        let began = Instant::now();
        let runs = async {
            anyhow::Ok(match way {
                Way::InTurn => {
                    let left = Box::pin(left).await?;
                    (left, Box::pin(right).await?)
                }
                // If one fails, the other still runs to its end.
                Way::Together => {
                    let (left, right) = tokio::join!(Box::pin(left), Box::pin(right));
                    (left?, right?)
                }
            })
        };
        let ended = tokio::select! {
            ended = runs => ended,
            error = system.one_ended() => Err(error.context("a part of the system ended during the runs")),
        };
        let passed_s = began.elapsed().as_secs_f64() * self.arguments.speed;
        let judged = match ended {
            Ok(ended) => system.judgement().await.map(|judgement| (ended, judgement)),
            Err(error) => Err(error),
        };
        system.stop().await;
        let ((left, right), judgement) = judged?;
        let makespan_s = match way {
            // The time that a client needs to begin the second run is not counted.
            Way::InTurn => left.ended.makespan_s + right.ended.makespan_s,
            Way::Together => passed_s,
        };
        let Judgement { delivered, unintended_contacts, waited_share, .. } = judgement;
        Ok(Outcome { way, runs: vec![left, right], makespan_s, delivered, unintended_contacts, waited_share })
    }

    /// The run of one arm's task.
    async fn one(&self, way: Way, arm: &'static str, place: &Place, interrupt: &Interrupt) -> anyhow::Result<OneRun> {
        let set = [("arm".to_owned(), arm.to_owned()), ("boxes".to_owned(), self.arguments.boxes.to_string())];
        let file = |ending: &str| self.directory.join(format!("{}-{arm}.{ending}", way.file_stem()));
        let log = file("jsonl");
        let run = Run {
            program: self.program.clone(),
            // The task file is built in.
            from: None,
            file: String::new(),
            parameters: self.program.bind_parameters(&set)?,
            mode: Mode::Cdtn,
            seed: self.arguments.seed,
            learned: Default::default(),
            log: log.clone(),
            breakpoints: Vec::new(),
            quiet: false,
            // The system ends with the demo, so nobody resumes the run.
            checkpoint_every: 0,
        };
        let ended = shell::run(run, place, interrupt).await.with_context(|| format!("the arm `{arm}`"))?;
        let timeline = Timeline::of(&log::read(&log)?.lines);
        Ok(OneRun { arm, ended, timeline, log, chart: file("html") })
    }
}

impl Way {
    fn name(self) -> &'static str {
        match self {
            Way::InTurn => "one after the other",
            Way::Together => "both together",
        }
    }

    fn file_stem(self) -> &'static str {
        match self {
            Way::InTurn => "in-turn",
            Way::Together => "together",
        }
    }
}

impl Outcome {
    /// What is wrong with the result, if anything, according to the cell's ground truth.
    fn what_is_wrong(&self, boxes: u32) -> Option<String> {
        let failed = self.runs.iter().find(|run| run.ended.outcome != SUCCESS);
        if let Some(OneRun { arm, ended, .. }) = failed {
            return Some(format!("the task of the arm `{arm}` ended with {}: {}", ended.outcome, ended.reason));
        }
        let wanted = ARMS.len() * boxes as usize;
        (self.delivered != wanted).then(|| format!("{} of {wanted} boxes brought to their places", self.delivered))
    }

    fn is_good(&self) -> bool {
        self.runs.iter().all(|run| run.ended.outcome == SUCCESS)
    }
}

impl Demonstration {
    fn of(&self, way: Way) -> Option<&Outcome> {
        self.outcomes.iter().find(|outcome| outcome.way == way)
    }

    /// The makespan, if both tasks ended with success.
    fn makespan_s(&self, way: Way) -> Option<f64> {
        self.of(way).filter(|outcome| outcome.is_good()).map(|outcome| outcome.makespan_s)
    }

    /// How much shorter the makespan of both together is, in percent.
    fn saving(&self) -> Option<f64> {
        Some(improvement(self.makespan_s(Way::InTurn)?, self.makespan_s(Way::Together)?))
    }

    /// Draws a chart per run, all with the time axis of the longest.
    fn draw(&self) -> anyhow::Result<()> {
        let runs = || self.outcomes.iter().flat_map(|outcome| &outcome.runs);
        let scale_s = runs().map(|run| run.timeline.end_s).fold(0.0, f64::max);
        for run in runs() {
            gantt::write(&run.chart, &run.timeline, Some(scale_s))
                .with_context(|| format!("cannot write {}", run.chart.display()))?;
        }
        Ok(())
    }

    fn to_json(&self) -> Value {
        let rounded = |number: Option<f64>| number.map(|n| (n * 1000.0).round() / 1000.0);
        let of_way = |outcome: &Outcome| {
            json!({
                "way": outcome.way.file_stem(),
                "makespan_s": rounded(Some(outcome.makespan_s)),
                "delivered": outcome.delivered,
                "unintended_contacts": outcome.unintended_contacts.len(),
                "contacts": outcome.unintended_contacts.iter().map(super::result::contact_json).collect::<Vec<_>>(),
                "runs": outcome.runs.iter().map(|run| json!({
                    "arm": run.arm,
                    "outcome": run.ended.outcome,
                    "reason": run.ended.reason,
                    "makespan_s": rounded(Some(run.ended.makespan_s)),
                    "log": run.log,
                    "chart": run.chart,
                    "statistics": Statistics::of(&run.timeline),
                })).collect::<Vec<_>>(),
            })
        };
        json!({
            "robots": ARMS.len(),
            "boxes": self.boxes,
            "planners": self.planners,
            "speed": self.speed,
            "seed": self.seed,
            "in_turn_s": rounded(self.makespan_s(Way::InTurn)),
            "together_s": rounded(self.makespan_s(Way::Together)),
            "saving_percent": rounded(self.saving()),
            "unintended_contacts": self.outcomes.iter().map(|o| o.unintended_contacts.len()).sum::<usize>(),
            "ways": self.outcomes.iter().map(of_way).collect::<Vec<_>>(),
        })
    }
}

impl fmt::Display for Demonstration {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Demonstration { boxes, planners, speed, .. } = self;
        let each = if *boxes == 1 { "1 box".to_owned() } else { format!("{boxes} boxes") };
        writeln!(
            f,
            "Two arms at one table fetch {each} each, with {planners} planners: seconds of the robot's time (wall time × {speed})\n"
        )?;
        writeln!(f, "  {:<22} {:>9} {:>9} {:>10} {:>9}", "", "makespan", "saving", "delivered", "contacts")?;
        let seconds = |s: Option<f64>| s.map_or_else(|| "-".to_owned(), |s| format!("{s:.1}"));
        for outcome in &self.outcomes {
            let saving = self.saving().filter(|_| outcome.way == Way::Together);
            writeln!(
                f,
                "  {:<22} {:>9} {:>9} {:>10} {:>9}",
                outcome.way.name(),
                seconds(self.makespan_s(outcome.way)),
                saving.map_or_else(String::new, |percent| format!("{percent:.1} %")),
                format!("{} of {}", outcome.delivered, ARMS.len() * *boxes as usize),
                outcome.unintended_contacts.len()
            )?;
        }
        writeln!(
            f,
            "\n  {:<30} {:>9} {:>8} {:>11} {:>10} {:>8}",
            "where the time went, s", "makespan", "motion", "detection", "planning", "idle"
        )?;
        for outcome in &self.outcomes {
            for run in &outcome.runs {
                let time = Statistics::of(&run.timeline).time;
                writeln!(
                    f,
                    "  {:<30} {:>9.1} {:>8.1} {:>11.1} {:>10.1} {:>8.1}",
                    format!("{}, {}", outcome.way.name(), run.arm),
                    run.ended.makespan_s,
                    time.motion_s,
                    time.detection_s,
                    time.planning_waited_for_s,
                    time.idle_s
                )?;
            }
        }
        writeln!(
            f,
            "  (planning: while the arm did not move and nothing was looked at; idle: waiting for the middle, among others)"
        )?;
        f.write_str(&super::result::busy(self.outcomes.iter().map(|outcome| outcome.waited_share)))?;
        writeln!(f, "\nfiles")?;
        for run in self.outcomes.iter().flat_map(|outcome| &outcome.runs) {
            writeln!(f, "  {}", run.log.display())?;
            writeln!(f, "  {}", run.chart.display())?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;
    use ratn_model::value::Value as Given;
    use std::collections::BTreeMap;

    fn outcome(way: Way, ends: [&str; 2], makespan_s: f64) -> Outcome {
        let run = |(arm, end): (&'static str, &str)| OneRun {
            arm,
            ended: Ended {
                outcome: end.to_owned(),
                outputs: BTreeMap::<String, Given>::new(),
                reason: String::new(),
                makespan_s: makespan_s / 2.0,
            },
            timeline: Timeline::of(&[]),
            log: PathBuf::new(),
            chart: PathBuf::new(),
        };
        let runs = ARMS.into_iter().zip(ends).map(run).collect();
        Outcome { way, runs, makespan_s, delivered: 6, unintended_contacts: Vec::new(), waited_share: 0.0 }
    }

    fn demonstration(outcomes: Vec<Outcome>) -> Demonstration {
        Demonstration { boxes: 3, planners: 2, speed: 1.0, seed: 1, outcomes }
    }

    #[test]
    fn the_saving_is_of_two_ways_that_both_ended_well() {
        let good = [SUCCESS; 2];
        let shown = demonstration(vec![outcome(Way::InTurn, good, 60.0), outcome(Way::Together, good, 33.0)]);
        assert_eq!(shown.to_json()["saving_percent"], json!(45.0));
        assert!(shown.to_string().contains("45.0 %"), "{shown}");
        assert_eq!(shown.outcomes[1].what_is_wrong(3), None);
        let failed = outcome(Way::Together, [SUCCESS, "aborted"], 33.0);
        assert!(failed.what_is_wrong(3).unwrap().contains("the arm `right` ended with aborted"));
        let shown = demonstration(vec![outcome(Way::InTurn, good, 60.0), failed]);
        assert_eq!((&shown.to_json()["saving_percent"], &shown.to_json()["in_turn_s"]), (&Value::Null, &json!(60.0)));
    }

    #[test]
    fn boxes_that_are_not_at_their_places_are_said() {
        let mut short = outcome(Way::Together, [SUCCESS; 2], 33.0);
        short.delivered = 5;
        assert_eq!(short.what_is_wrong(3).unwrap(), "5 of 6 boxes brought to their places");
    }

    #[test]
    fn the_task_has_the_numbers_of_the_robot_s_workplace() {
        let robot = Robot::built_in(TWIN).unwrap();
        let workplace = robot.workplace().unwrap();
        let text = FETCH.1;
        let ratn_motion::workplace::Slab { centre, size } = workplace.table;
        assert!(text.contains(&format!("at(table) = pose({}, {}, {})", centre[0], centre[1], centre[2])));
        assert!(text.contains(&format!("shape(table) = {{type: box, size: [{}, {}, {}]}}", size[0], size[1], size[2])));
        for (side, (boxes, places)) in [1.0, -1.0].into_iter().zip(workplace.shares()) {
            for (i, at) in places.at.iter().enumerate() {
                let said = [0.3 + 0.14 * i as f64, side * 0.58, 0.7];
                assert!((0..3).all(|k| (said[k] - at[k]).abs() < 1e-9), "{said:?} {at:?}");
            }
            // The whole box is in the region that the camera looks at.
            let far = boxes.greatest[0] / 2.0;
            for (x, y) in [(boxes.x[0] - far, boxes.y[0] - far), (boxes.x[1] + far, boxes.y[1] + far)] {
                assert!((x - 0.47).abs() <= 0.19 && (y - side * 0.26).abs() <= 0.22, "({x}, {y})");
            }
        }
        assert_eq!(workplace.middle.unwrap().y, [-0.09, 0.09]);
        assert!(text.contains("beyond($arm, 0.09)") && text.contains("beyond($arm, -0.03)"));
        assert_eq!(ARMS.to_vec(), robot.arm_names().collect::<Vec<_>>());
    }
}
