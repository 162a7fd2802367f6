//! `ratn report LOG [LOG…]`.

use crate::arguments::{ReportArguments, RowArgument};
use crate::failure::Failure;
use crate::output;
use anyhow::Context;
use ratn_event_log as log;
use ratn_executive::protocol::Mode;
use ratn_report::gantt::{self, By};
use ratn_report::report::{Report, repeated, table};
use ratn_report::timeline::Timeline;
use std::path::Path;

/// Reports where the time of a run went, or compares several runs, and draws them.
pub(crate) fn run(arguments: &ReportArguments) -> Result<(), Failure> {
    if let Some(path) = &arguments.gantt {
        output::check_writable(path)?;
    }
    let mut runs = arguments.logs.iter().map(|path| read(path)).collect::<Result<Vec<Timeline>, Failure>>()?;
    if let Some(path) = &arguments.gantt {
        let by = match arguments.by {
            RowArgument::Resource => By::Resource,
            RowArgument::Node => By::Node,
        };
        let mut charts: Vec<&Timeline> = runs.iter().collect();
        charts.sort_by_key(|run| run.mode == Mode::Cdtn);
        gantt::write_all(path, &charts, by, None).with_context(|| format!("cannot write {}", path.display()))?;
        output::progress(format_args!("chart: {}", path.display()));
    }
    if runs.len() == 1
        && let Some(run) = runs.pop()
    {
        let report = Report::of(&run);
        let text = if arguments.json { serde_json::to_string_pretty(&report)? } else { report.to_string() };
        output::result(text.trim_end())?;
        return Ok(());
    }
    let together = repeated(&runs);
    if arguments.json {
        let document = serde_json::json!({
            "together": together,
            "runs": runs.iter().map(Report::of).collect::<Vec<_>>(),
            "logs": arguments.logs,
        });
        output::result(serde_json::to_string_pretty(&document)?)?;
    } else {
        output::result(table(&together).trim_end())?;
    }
    Ok(())
}

fn read(path: &Path) -> Result<Timeline, Failure> {
    let log = log::read(path)?;
    if let Some(line) = log.torn {
        let place = path.display();
        output::progress(format_args!(
            "{place}:{line}: warning: the last line is torn (its writer was interrupted); this is what is before it"
        ));
    }
    Ok(Timeline::of(&log.lines))
}
