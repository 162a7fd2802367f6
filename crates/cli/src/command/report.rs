//! `ratn report LOG`

use crate::arguments::ReportArguments;
use crate::failure::Failure;
use crate::output;
use anyhow::Context;
use ratn_event_log as log;
use ratn_report::gantt;
use ratn_report::statistics::Statistics;
use ratn_report::timeline::Timeline;

/// Prints statistics of an event log, and draws it.
pub(crate) fn run(arguments: &ReportArguments) -> Result<(), Failure> {
    if let Some(path) = &arguments.gantt {
        output::check_writable(path)?;
    }
    let log = log::read(&arguments.log)?;
    if let Some(line) = log.torn {
        let place = arguments.log.display();
        output::progress(format_args!(
            "{place}:{line}: warning: the last line is torn (its writer was interrupted); this is what is before it"
        ));
    }
    let timeline = Timeline::of(&log.lines);
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
