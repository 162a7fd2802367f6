//! `ratn report LOG`

use crate::arguments::ReportArguments;
use crate::failure::Failure;
use crate::output;
use crate::report::gantt;
use crate::report::statistics::Statistics;
use crate::report::timeline::Timeline;
use crate::task_control::log;
use anyhow::Context;

/// Prints statistics of an event log, and draws it.
pub(crate) fn run(arguments: &ReportArguments) -> Result<(), Failure> {
    let timeline = Timeline::of(&log::read(&arguments.log)?);
    let statistics = Statistics::of(&timeline);
    if let Some(path) = &arguments.gantt {
        gantt::write(path, &timeline, None).with_context(|| format!("cannot write {}", path.display()))?;
        output::progress(format_args!("chart: {}", path.display()));
    }
    if arguments.json {
        output::result(serde_json::to_string_pretty(&statistics)?)?;
    } else {
        output::result(&statistics)?;
    }
    Ok(())
}
