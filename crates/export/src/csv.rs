//! A table of the instances as CSV (RFC 4180): one row per instance, in the order in which they left the window.

use super::Writer;
use ratn_event_log::without_visits;
use ratn_executive::protocol::LogLine;
use ratn_report::timeline::{Changed, Instance, Timeline};
use std::io::{self, Write};

const HEAD: &str = "instance,path,state,stage,outcome,speculative,expanded_s,asked_s,granted_s,started_s,ended_s,left_s,\
                    waited_for_resources_s,worked_s,attempts,provider,action,resources,ahead_of_time,last_waited_for";

pub(crate) struct Csv<W> {
    out: W,
    has_head: bool,
}

impl<W: Write> Csv<W> {
    pub(crate) fn new(out: W) -> Csv<W> {
        Csv { out, has_head: false }
    }

    fn rows(&mut self, changed: &Changed) -> io::Result<()> {
        if !self.has_head {
            self.has_head = true;
            write!(self.out, "{HEAD}\r\n")?;
        }
        changed.left.iter().try_for_each(|instance| write!(self.out, "{}\r\n", row(instance)))
    }
}

impl<W: Write> Writer for Csv<W> {
    fn line(&mut self, _: &LogLine, _: &Timeline, changed: &Changed) -> io::Result<()> {
        self.rows(changed)
    }

    fn end(&mut self, _: &Timeline, changed: &Changed) -> io::Result<()> {
        self.rows(changed)
    }
}

fn row(one: &Instance) -> String {
    let moment = |at_s: Option<f64>| at_s.map_or_else(String::new, |at_s| format!("{at_s:.6}"));
    let (first, last) = (one.jobs.first(), one.jobs.last());
    let awaited = one.awaited().next_back();
    let cells = [
        one.id.0.to_string(),
        one.path.to_string(),
        without_visits(&one.path),
        one.stage.name().to_owned(),
        one.outcome.as_deref().unwrap_or_default().to_owned(),
        one.speculative.to_string(),
        moment(Some(one.expanded_s)),
        moment(one.waits.first().map(|wait| wait.from_s)),
        moment(one.waits.first().map(|wait| wait.to_s)),
        moment(first.map(|job| job.from_s)),
        moment(last.map(|job| job.to_s)),
        moment(one.has_left().then_some(one.since_s)),
        moment(Some(one.waits.iter().map(|wait| wait.to_s - wait.from_s).fold(0.0, |all, one| all + one))),
        moment(Some(one.jobs.iter().map(|job| job.length_s()).fold(0.0, |all, one| all + one))),
        one.jobs.len().to_string(),
        last.map(|job| job.provider.clone()).unwrap_or_default(),
        last.map(|job| job.action.clone()).unwrap_or_default(),
        last.map(|job| job.resources.join(" ")).unwrap_or_default(),
        one.jobs.iter().any(|job| job.ahead_of_time).to_string(),
        awaited.map(|phase| phase.ended_by.awaited()).unwrap_or_default(),
    ];
    cells.map(|cell| quoted(&cell)).join(",")
}

fn quoted(cell: &str) -> String {
    if cell.contains([',', '"', '\n', '\r']) { format!("\"{}\"", cell.replace('"', "\"\"")) } else { cell.to_owned() }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_cell_that_would_break_the_table_is_quoted() {
        assert_eq!(quoted("a,b\"c"), "\"a,b\"\"c\"");
        assert_eq!(quoted("place[2]/plan"), "place[2]/plan");
    }
}
