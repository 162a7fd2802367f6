//! `ratn tables`: the paper's tables, in virtual time with the same executive as on the robot.

use crate::arguments::TablesArguments;
use crate::failure::Failure;
use crate::output;
use anyhow::Context;
use ratn_executive::protocol::Mode;
use ratn_report::gantt;
use ratn_report::timeline::Timeline;
use ratn_simulation::tables::{self, Row, Scenario};
use std::path::Path;

/// Prints both tables, and draws every run.
pub(crate) fn run(arguments: &TablesArguments) -> Result<(), Failure> {
    let rows = tables::tables()?;
    let scenarios = tables::scenarios();
    if let Some(directory) = &arguments.gantt {
        draw(directory, &scenarios)?;
    }
    if arguments.json {
        output::result(serde_json::to_string_pretty(&rows)?)
    } else {
        output::result(table(&rows, &scenarios))
    }
    .map_err(Failure::from)
}

fn table(rows: &[Row], scenarios: &[Scenario]) -> String {
    let mut lines = vec![
        "Seconds; each figure beside the paper's. MP: motion planner processes. Improvement: 2 MP over HSM.\n"
            .to_owned(),
        "table  objects          HSM  paper   CDTN 1 MP  paper   CDTN 2 MP  paper   improvement   paper".to_owned(),
    ];
    for (row, scenario) in rows.iter().zip(scenarios) {
        let paper = scenario.paper;
        let one = paper.cdtn_1mp_s.map_or_else(|| "-".to_owned(), |s| format!("{s:.1}"));
        lines.push(format!(
            "{:<5}  {:<11} {:>8.1} {:>6.1}  {:>10.1} {:>6}  {:>10.1} {:>6.1}  {:>11.1}% {:>6.1}%",
            row.table,
            row.objects,
            row.hsm_s,
            paper.hsm_s,
            row.cdtn_1mp_s,
            one,
            row.cdtn_2mp_s,
            paper.cdtn_2mp_s,
            improvement(row.hsm_s, row.cdtn_2mp_s),
            paper.improvement_percent,
        ));
    }
    lines.join("\n")
}

/// In percent.
pub(super) fn improvement(before_s: f64, after_s: f64) -> f64 {
    if before_s > 0.0 { 100.0 * (1.0 - after_s / before_s) } else { 0.0 }
}

fn draw(directory: &Path, scenarios: &[Scenario]) -> anyhow::Result<()> {
    std::fs::create_dir_all(directory).with_context(|| format!("cannot make {}", directory.display()))?;
    for scenario in scenarios {
        let mut scale_s = None;
        for (mode, planners, name) in [(Mode::Hsm, 1, "hsm"), (Mode::Cdtn, 1, "cdtn-1mp"), (Mode::Cdtn, 2, "cdtn-2mp")]
        {
            let run = scenario.replay(mode, planners)?;
            // All charts of a row have the time axis of the first, which is the longest.
            let scale_s = *scale_s.get_or_insert(run.end_s);
            let objects = scenario.objects.to_lowercase().replace('+', "-");
            let path = directory.join(format!("table-{}-{objects}-{name}.html", scenario.table.to_lowercase()));
            gantt::write(&path, &Timeline::of(&run.log), Some(scale_s))
                .with_context(|| format!("cannot write {}", path.display()))?;
            output::progress(format_args!("chart: {}", path.display()));
        }
    }
    Ok(())
}
