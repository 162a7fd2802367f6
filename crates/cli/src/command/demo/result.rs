//! The results of a demonstration: the paper's Table I or II with this machine's figures, and where the time went.

use crate::arguments::DemoArguments;
use crate::command::tables::improvement;
use crate::failure::Failure;
use ratn_cell::config::Setting;
use ratn_executive::protocol::Mode;
use ratn_model::program::SUCCESS;
use ratn_proto::v1::UnintendedContact;
use ratn_report::statistics::{self, Statistics, mode_name};
use ratn_report::timeline::Timeline;
use serde_json::{Value, json};
use std::fmt;
use std::path::PathBuf;

/// Tables I and II of the paper: HSM, CDTN 1 MP, CDTN 2 MP, in seconds.
const PAPER: [(Goods, f64, Option<f64>, f64); 5] = [
    (Goods::Boxes(1), 81.3, Some(73.5), 72.3),
    (Goods::Boxes(2), 123.7, Some(107.3), 97.3),
    (Goods::Boxes(3), 164.2, Some(141.5), 116.5),
    (Goods::Dishes { bowls: 2, forks: 2, cups: 0, plates: 0 }, 169.2, None, 122.9),
    (Goods::Dishes { bowls: 3, forks: 3, cups: 0, plates: 0 }, 255.4, None, 207.2),
];

/// Share of its processor time that a system waits for on a busy machine.
const BUSY: f64 = 0.3;

/// The row of the task with overlapping motions and looks.
const OVERLAPPED: Work = Work::Overlapped { plan_s: 0.0 };

/// The objects that a task moves.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Goods {
    /// Boxes, onto the base.
    Boxes(u32),
    /// Boxes, from one side of a table to the other.
    OnTable(u32),
    /// Tableware, onto a table with plates.
    Dishes { bowls: u32, forks: u32, cups: u32, plates: u32 },
}

/// Which task is run, and how long its planners may take. Each is a row of the table.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Work {
    /// The paper's task; planners use the time budget that it gives them.
    Budget,
    /// The paper's task; planners take only as long as a path needs.
    NoBudget,
    /// The task with overlapping motions and looks.
    Overlapped {
        /// Time for which a plan may be improved, in the robot's seconds; 0 leaves it to the planner.
        plan_s: f64,
    },
}

/// A planned run.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Plan {
    pub(super) mode: Mode,
    pub(super) planners: u32,
    pub(super) work: Work,
}

/// A finished run.
#[derive(Debug)]
pub(super) struct Outcome {
    pub(super) plan: Plan,
    pub(super) timeline: Timeline,
    /// Number of objects at their places, according to the cell's ground truth.
    pub(super) delivered: usize,
    /// Maximum tilt of a bowl or a cup while it was held, in radians.
    pub(super) greatest_tilt_rad: f64,
    /// Unintended contacts, according to the cell's physics.
    pub(super) unintended_contacts: Vec<UnintendedContact>,
    /// The share of its processor time that the system waited for, from 0 to 1.
    pub(super) waited_share: f64,
    /// How the task ended, as a sentence.
    pub(super) end: String,
    pub(super) log: PathBuf,
    pub(super) chart: PathBuf,
}

/// All runs.
#[derive(Debug)]
pub(super) struct Demonstration {
    goods: Goods,
    planners: u32,
    speed: f64,
    seed: u64,
    pub(super) outcomes: Vec<Outcome>,
}

impl Work {
    /// Whether both belong to the same row.
    pub(super) fn is_like(self, other: Work) -> bool {
        std::mem::discriminant(&self) == std::mem::discriminant(&other)
    }

    /// Text for people after the name of a mode.
    fn suffix(self) -> String {
        match self {
            Work::Budget => String::new(),
            Work::NoBudget => ", no budget".to_owned(),
            Work::Overlapped { plan_s: 0.0 } => ", overlapped".to_owned(),
            Work::Overlapped { plan_s } => format!(", overlapped, {plan_s} s"),
        }
    }

    /// The name of the planners' budget in `--json`.
    fn budget(self) -> &'static str {
        match self {
            Work::Budget => "task",
            Work::NoBudget => "none",
            Work::Overlapped { .. } => "overlapped",
        }
    }
}

impl Plan {
    /// Name for people.
    pub(super) fn name(&self) -> String {
        let planners = match self.mode {
            Mode::Hsm => String::new(),
            Mode::Cdtn => format!(" {} MP", self.planners),
        };
        format!("{}{planners}{}", mode_name(self.mode), self.work.suffix())
    }

    /// Name for files.
    pub(super) fn file_stem(&self) -> String {
        let mode = match self.mode {
            Mode::Hsm => "hsm".to_owned(),
            Mode::Cdtn => format!("cdtn-{}mp", self.planners),
        };
        format!("{mode}{}", self.work.suffix().replace(", ", "-").replace(' ', "-"))
    }

    /// Text that is printed before the run begins.
    pub(super) fn announcement(&self, goods: &Goods) -> String {
        let how = match self.mode {
            Mode::Hsm => "as its state machine is written".to_owned(),
            Mode::Cdtn if self.planners == 1 => "as a dataflow network, one motion planner".to_owned(),
            Mode::Cdtn => format!("as a dataflow network, {} motion planners", self.planners),
        };
        let work = match self.work {
            Work::Budget => "",
            Work::NoBudget => "; planning takes what it takes",
            Work::Overlapped { .. } => "; the task whose motions and looks overlap",
        };
        format!("== {}: {} {how}{work} ==", self.name(), goods)
    }
}

impl Outcome {
    fn makespan_s(&self) -> Option<f64> {
        (self.timeline.outcome.as_deref() == Some(SUCCESS)).then_some(self.timeline.end_s)
    }
}

impl Demonstration {
    pub(super) fn new(arguments: &DemoArguments, goods: Goods) -> Demonstration {
        let DemoArguments { planners, speed, seed, .. } = *arguments;
        Demonstration { goods, planners, speed, seed, outcomes: Vec::new() }
    }

    /// The runs of a row.
    fn of(&self, work: Work) -> impl Iterator<Item = &Outcome> {
        self.outcomes.iter().filter(move |outcome| outcome.plan.work.is_like(work))
    }

    /// The makespan of the fastest run that ended with success; other runs do not count.
    fn makespan_s(&self, mode: Mode, planners: u32, work: Work) -> Option<f64> {
        let fitting =
            self.of(work).filter(|o| o.plan.mode == mode && (mode == Mode::Hsm || o.plan.planners == planners));
        fitting.filter_map(Outcome::makespan_s).min_by(f64::total_cmp)
    }

    fn row(&self, work: Work) -> Row {
        Row {
            hsm_s: self.makespan_s(Mode::Hsm, 0, work),
            cdtn_1mp_s: self.makespan_s(Mode::Cdtn, 1, work),
            cdtn_nmp_s: self.makespan_s(Mode::Cdtn, self.planners, work),
        }
    }

    /// The work of the first run.
    fn main_work(&self) -> Work {
        self.outcomes.first().map_or(Work::Budget, |first| first.plan.work)
    }

    /// For each planning time of the sequential runs, the makespan where the run ended with success.
    fn sweep(&self) -> Vec<(f64, Option<f64>)> {
        let hsm = self.outcomes.iter().filter(|o| o.plan.mode == Mode::Hsm);
        let overlapped = hsm.filter_map(|o| match o.plan.work {
            Work::Overlapped { plan_s } => Some((plan_s, o.makespan_s())),
            Work::Budget | Work::NoBudget => None,
        });
        overlapped.collect()
    }

    /// The document of `--json`. The keys of the main runs, with the task's budget, are at the top; those of the runs without a budget
    /// are the same, below `budget_none`, and those of the overlapped task below `overlapped`.
    pub(super) fn to_json(&self) -> Value {
        let main = self.main_work();
        let mut document = json!({
            "planners": self.planners,
            "speed": self.speed,
            "seed": self.seed,
            "budget": main.budget(),
            "runs": self.outcomes.iter().map(|o| json!({
                "name": o.plan.name(),
                "planners": o.plan.planners,
                "budget": o.plan.work.budget(),
                "delivered": o.delivered,
                "greatest_tilt_rad": (o.greatest_tilt_rad * 1000.0).round() / 1000.0,
                "contacts": o.unintended_contacts.iter().map(contact_json).collect::<Vec<_>>(),
                "log": o.log,
                "chart": o.chart,
                "statistics": Statistics::of(&o.timeline),
            })).collect::<Vec<_>>(),
        });
        merge(&mut document, self.goods.to_json());
        merge(&mut document, self.row_json(main));
        for (name, work) in [("budget_none", Work::NoBudget), ("overlapped", OVERLAPPED)] {
            if !work.is_like(main) && self.of(work).next().is_some() {
                document[name] = self.row_json(work);
            }
        }
        let sweep = self.sweep().into_iter().map(|(plan_s, hsm_s)| json!({ "plan_s": plan_s, "hsm_s": hsm_s }));
        let sweep: Value = sweep.collect();
        if OVERLAPPED.is_like(main) {
            document["sweep"] = sweep;
        } else if document.get("overlapped").is_some() {
            document["overlapped"]["sweep"] = sweep;
        }
        document
    }

    fn row_json(&self, work: Work) -> Value {
        let row = self.row(work);
        let outcomes: Vec<&Outcome> = self.of(work).collect();
        let delivered: Vec<usize> = outcomes.iter().map(|o| o.delivered).collect();
        let rounded = |number: Option<f64>| number.map(|n| (n * 1000.0).round() / 1000.0);
        json!({
            "hsm_s": rounded(row.hsm_s),
            "cdtn_1mp_s": rounded(row.cdtn_1mp_s),
            "cdtn_2mp_s": rounded(row.cdtn_nmp_s),
            "improvement_2mp_percent": rounded(row.improvement()),
            // The least that any of the runs delivered.
            "delivered": delivered.iter().min().copied().unwrap_or(0),
            "delivered_per_run": delivered,
            "unintended_contacts": outcomes.iter().map(|o| o.unintended_contacts.len()).sum::<usize>(),
            "logs": outcomes.iter().map(|o| &o.log).collect::<Vec<_>>(),
            "charts": outcomes.iter().map(|o| &o.chart).collect::<Vec<_>>(),
        })
    }
}

pub(super) fn contact_json(contact: &UnintendedContact) -> Value {
    json!({
        "began_s": contact.began_s,
        "ended_s": contact.ended_s,
        "bodies": contact.bodies,
        "depth_m": contact.depth_m,
        "pushed_m": contact.pushed_m,
        "at_m": contact.at_m,
        "speed_m_s": contact.speed_m_s,
        "meant": contact.meant,
    })
}

impl Goods {
    /// The objects that the command line asks for.
    pub(super) fn of(arguments: &DemoArguments, onto_base: bool) -> Result<Goods, Failure> {
        match *arguments {
            DemoArguments { scenario: Setting::Boxes, boxes, .. } if !onto_base => Ok(Goods::OnTable(boxes)),
            DemoArguments { scenario: Setting::Boxes, boxes, .. } => Ok(Goods::Boxes(boxes)),
            DemoArguments { bowls: 0, forks: 0, cups: 0, .. } => {
                Err(Failure::Refused("ratn: no bowls, no forks and no cups: there is nothing to set".to_owned()))
            }
            DemoArguments { bowls, forks, cups, plates, .. } => Ok(Goods::Dishes { bowls, forks, cups, plates }),
        }
    }

    /// Their number.
    pub(super) fn count(&self) -> usize {
        match *self {
            Goods::Boxes(boxes) | Goods::OnTable(boxes) => boxes as usize,
            Goods::Dishes { bowls, forks, cups, plates } => (bowls + forks + cups + plates) as usize,
        }
    }

    /// Parameters of the task.
    pub(super) fn parameters(&self) -> Vec<(String, String)> {
        let set = |name: &str, value: u32| (name.to_owned(), value.to_string());
        match *self {
            Goods::Boxes(boxes) | Goods::OnTable(boxes) => vec![set("boxes", boxes)],
            Goods::Dishes { bowls, forks, cups, plates } => {
                vec![set("bowls", bowls), set("forks", forks), set("cups", cups), set("plates", plates)]
            }
        }
    }

    /// What was to be done with them, for people.
    pub(super) fn destination(&self) -> &'static str {
        match self {
            Goods::Boxes(_) => "delivered to the base",
            Goods::OnTable(_) => "brought to their places",
            Goods::Dishes { .. } => "at their places on the table",
        }
    }

    fn doing(&self) -> &'static str {
        match self {
            Goods::Boxes(_) | Goods::OnTable(_) => "Fetching",
            Goods::Dishes { .. } => "Setting",
        }
    }

    fn to_json(self) -> Value {
        match self {
            Goods::Boxes(boxes) | Goods::OnTable(boxes) => json!({ "scenario": "boxes", "boxes": boxes }),
            Goods::Dishes { bowls, forks, cups, plates } => {
                json!({ "scenario": "table", "bowls": bowls, "forks": forks, "cups": cups, "plates": plates })
            }
        }
    }
}

impl fmt::Display for Goods {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let many = |number: u32, one: &str, more: &str| match number {
            1 => format!("1 {one}"),
            _ => format!("{number} {more}"),
        };
        match *self {
            Goods::Boxes(boxes) | Goods::OnTable(boxes) => f.write_str(&many(boxes, "box", "boxes")),
            Goods::Dishes { bowls, forks, cups, plates } => {
                let all = [
                    (bowls, "bowl", "bowls"),
                    (forks, "fork", "forks"),
                    (cups, "cup", "cups"),
                    (plates, "plate", "plates"),
                ];
                let some: Vec<String> = all
                    .into_iter()
                    .filter(|kind| kind.0 > 0)
                    .map(|(number, one, more)| many(number, one, more))
                    .collect();
                match &some[..] {
                    [most @ .., last] if !most.is_empty() => write!(f, "{} and {last}", most.join(", ")),
                    _ => f.write_str(&some.concat()),
                }
            }
        }
    }
}

fn merge(into: &mut Value, from: Value) {
    if let (Value::Object(into), Value::Object(from)) = (into, from) {
        into.extend(from);
    }
}

/// A row of the table.
#[derive(Debug, Clone, Copy)]
struct Row {
    hsm_s: Option<f64>,
    cdtn_1mp_s: Option<f64>,
    cdtn_nmp_s: Option<f64>,
}

impl Row {
    fn improvement(&self) -> Option<f64> {
        Some(improvement(self.hsm_s?, self.cdtn_nmp_s?))
    }

    fn write(&self, f: &mut fmt::Formatter<'_>, name: &str) -> fmt::Result {
        let seconds = |s: Option<f64>| s.map_or_else(|| "-".to_owned(), |s| format!("{s:.1}"));
        let improvement = self.improvement().map_or_else(|| "-".to_owned(), |p| format!("{p:.1} %"));
        writeln!(
            f,
            "  {name:<26} {:>8} {:>11} {:>11} {improvement:>13}",
            seconds(self.hsm_s),
            seconds(self.cdtn_1mp_s),
            seconds(self.cdtn_nmp_s),
        )
    }
}

impl fmt::Display for Demonstration {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let planners = self.planners;
        writeln!(
            f,
            "{} {}: seconds of the robot's time (wall time × {}); MP: motion planner processes\n",
            self.goods.doing(),
            self.goods,
            self.speed
        )?;
        let columns = (format!("CDTN {planners} MP"), format!("{planners} MP over HSM"));
        writeln!(f, "  {:<26} {:>8} {:>11} {:>11} {:>13}", "", "HSM", "CDTN 1 MP", columns.0, columns.1)?;
        let rows =
            [(Work::Budget, "this run"), (Work::NoBudget, "planning without a budget"), (OVERLAPPED, "and overlapped")];
        for (work, name) in rows {
            if self.of(work).next().is_some() {
                self.row(work).write(f, name)?;
            }
        }
        if let Some((_, hsm, one, two)) = PAPER.into_iter().find(|row| row.0 == self.goods) {
            let paper = Row { hsm_s: Some(hsm), cdtn_1mp_s: one, cdtn_nmp_s: (planners == 2).then_some(two) };
            paper.write(f, "the paper")?;
        }
        self.write_sweep(f)?;
        self.write_where_the_time_went(f)?;
        self.write_plans(f)?;
        f.write_str(&busy(self.outcomes.iter().map(|outcome| outcome.waited_share)))?;
        writeln!(f, "\nfiles")?;
        for outcome in &self.outcomes {
            writeln!(f, "  {:<26} {}", outcome.plan.name(), outcome.log.display())?;
            writeln!(f, "  {:<26} {}", "", outcome.chart.display())?;
        }
        Ok(())
    }
}

impl Demonstration {
    fn write_sweep(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let sweep = self.sweep();
        if sweep.is_empty() {
            return Ok(());
        }
        let one = |(plan_s, hsm_s): &(f64, Option<f64>)| match hsm_s {
            Some(hsm_s) => format!("{hsm_s:.1} s with {plan_s} s"),
            None => format!("no success with {plan_s} s"),
        };
        let all: Vec<String> = sweep.iter().map(one).collect();
        writeln!(
            f,
            "\n  overlapped, HSM by the time that a plan may get better: {}; the best is in the table",
            all.join(", ")
        )
    }

    fn write_where_the_time_went(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(
            f,
            "\n  {:<26} {:>8} {:>11} {:>11} {:>8} {:>12} {:>10}",
            "where the time went, s", "motion", "detection", "planning", "idle", "in parallel", "delivered"
        )?;
        for outcome in &self.outcomes {
            let s = Statistics::of(&outcome.timeline);
            writeln!(
                f,
                "  {:<26} {:>8.1} {:>11.1} {:>11.1} {:>8.1} {:>12.1} {:>10}",
                outcome.plan.name(),
                s.time.motion_s,
                s.time.detection_s,
                s.time.planning_waited_for_s,
                s.time.idle_s,
                s.overlap_s,
                format!("{} of {}", outcome.delivered, self.goods.count())
            )?;
        }
        writeln!(f, "  (planning: while nothing moved and nothing was looked at)")
    }

    fn write_plans(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Some(outcome) = self.of(self.main_work()).filter(|o| o.plan.mode == Mode::Cdtn).last() else {
            return Ok(());
        };
        let plans = Statistics::of(&outcome.timeline).plans;
        writeln!(f, "\nwhat the planners did with their time in {}", outcome.plan.name())?;
        f.write_str(statistics::plan_table(&plans).trim_start_matches('\n'))?;
        if let Some(first) = median(plans.iter().map(|p| p.first_path_s)) {
            let shortened = median(plans.iter().map(|p| p.shortened_percent)).unwrap_or_default();
            writeln!(
                f,
                "  medians: the first path after {first:.2} s, the rest of the budget made it {shortened:.1} % shorter"
            )?;
        }
        Ok(())
    }
}

/// A warning about figures that were measured on a busy machine; empty on one that was not. The shares are of the runs.
pub(super) fn busy(waited_shares: impl Iterator<Item = f64>) -> String {
    match waited_shares.fold(0.0, f64::max) {
        share if share > BUSY => format!(
            "\nWARNING: the processors were busy: up to {:.0} % of the time in which the system wanted to compute it had to wait for one. Plans took \
             longer for that, so these figures are not those of an idle machine.\n",
            share * 100.0
        ),
        _ => String::new(),
    }
}

fn median(values: impl Iterator<Item = f64>) -> Option<f64> {
    let mut values: Vec<f64> = values.collect();
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn outcome(mode: Mode, work: Work, end: Option<&str>, end_s: f64) -> Outcome {
        let mut timeline = Timeline::of(&[]);
        (timeline.outcome, timeline.end_s) = (end.map(str::to_owned), end_s);
        let plan = Plan { mode, planners: 2, work };
        Outcome {
            plan,
            timeline,
            delivered: 1,
            greatest_tilt_rad: 0.0,
            unintended_contacts: Vec::new(),
            waited_share: 0.0,
            end: String::new(),
            log: PathBuf::new(),
            chart: PathBuf::new(),
        }
    }

    #[test]
    fn figures_of_a_busy_machine_are_shown_with_a_warning() {
        assert_eq!(busy([0.0, 0.1].into_iter()), "");
        assert!(busy([0.1, 0.62].into_iter()).contains("up to 62 %"));
    }

    #[test]
    fn a_run_that_did_not_succeed_has_no_figure() {
        let mut shown = Demonstration { goods: Goods::Boxes(3), planners: 2, speed: 1.0, seed: 1, outcomes: vec![] };
        let of = |mode, end| outcome(mode, Work::Budget, Some(end), 50.0);
        shown.outcomes = vec![of(Mode::Hsm, SUCCESS), of(Mode::Cdtn, "preempted")];
        let json = shown.to_json();
        assert_eq!((&json["hsm_s"], &json["cdtn_2mp_s"]), (&json!(50.0), &Value::Null));
        assert_eq!(json["improvement_2mp_percent"], Value::Null);
        let text = shown.to_string();
        let row: Vec<&str> = text.lines().filter(|line| line.contains("this run")).collect();
        assert!(row[0].split_whitespace().eq(["this", "run", "50.0", "-", "-", "-"]), "{row:?}");
    }

    #[test]
    fn the_state_machine_of_the_task_that_overlaps_is_shown_with_the_time_for_plans_that_suits_it_best() {
        let mut shown = Demonstration { goods: Goods::Boxes(3), planners: 2, speed: 1.0, seed: 1, outcomes: vec![] };
        let of = |mode, plan_s, end_s| outcome(mode, Work::Overlapped { plan_s }, Some(SUCCESS), end_s);
        let failed = outcome(Mode::Hsm, Work::Overlapped { plan_s: 0.1 }, Some("aborted"), 20.0);
        shown.outcomes = vec![
            outcome(Mode::Hsm, Work::Budget, Some(SUCCESS), 90.0),
            of(Mode::Hsm, 0.0, 42.0),
            failed,
            of(Mode::Hsm, 0.2, 40.0),
            of(Mode::Cdtn, 0.0, 30.0),
        ];
        let json = shown.to_json();
        assert_eq!(json["hsm_s"], json!(90.0));
        let overlapped = &json["overlapped"];
        assert_eq!((&overlapped["hsm_s"], &overlapped["improvement_2mp_percent"]), (&json!(40.0), &json!(25.0)));
        let (sweep, failed) = (&overlapped["sweep"], json!({ "plan_s": 0.1, "hsm_s": null }));
        assert_eq!((&sweep[1], &sweep[2]), (&failed, &json!({ "plan_s": 0.2, "hsm_s": 40.0 })));
        let text = shown.to_string();
        assert!(text.contains("42.0 s with 0 s, no success with 0.1 s, 40.0 s with 0.2 s; the best"), "{text}");
        assert_eq!(shown.outcomes[3].plan.file_stem(), "hsm-overlapped-0.2-s");
    }
}
