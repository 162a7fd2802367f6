//! Event logs in the forms that the tools of the field open.
//!
//! Pure writers over the one projection of a log (`ratn_report::timeline`): lines come in, bytes go out, and what is kept does not grow
//! with the log. Each form is a file of its own that says who reads it. They need no task file and no system that runs.
//!
//! What is exported is what the log says. Time is the robot's, laid on the moment at which the run began.

mod csv;
mod graph;
pub mod live;
mod mcap;
mod otlp;
mod perfetto;
mod wire;

use ratn_executive::protocol::LogLine;
use ratn_report::timeline::{Changed, Timeline};
use std::io::{self, Write};

/// Of the instances that have left the window so many are known, for what still refers to them.
const KEPT: usize = 256;

/// A form.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Format {
    /// A trace for ui.perfetto.dev.
    Perfetto,
    /// Spans as OTLP/JSON, a request a line.
    Otlp,
    /// A recording for Foxglove and Rerun.
    Mcap,
    /// A table of the instances.
    Csv,
    /// A graph for Graphviz.
    Dot(Drawing),
    /// A graph for Mermaid.
    Mermaid(Drawing),
}

/// What a graph shows.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Drawing {
    /// The instances, and what each waited for.
    Network,
    /// The states in their hierarchy, all visits of a state as one.
    Task,
}

/// Why nothing, or not everything, was exported.
#[derive(Debug, thiserror::Error)]
pub enum ExportError<E> {
    /// The log does not read on.
    #[error(transparent)]
    Log(E),
    /// The target does not take it.
    #[error("cannot write the export")]
    Write(#[source] io::Error),
}

/// One form under way.
trait Writer {
    /// After each line: the run since then, and what the line changed.
    fn line(&mut self, line: &LogLine, run: &Timeline, changed: &Changed) -> io::Result<()>;
    /// After the last one. What was still held or kept is in `changed`.
    fn end(&mut self, run: &Timeline, changed: &Changed) -> io::Result<()>;
}

/// Writes a log in a form.
///
/// # Errors
/// Where a line cannot be read, or what is made of it not be written. What was written until then is incomplete.
pub fn export<E>(
    format: Format,
    lines: impl IntoIterator<Item = Result<LogLine, E>>,
    mut out: impl Write,
) -> Result<(), ExportError<E>> {
    let mut writer: Box<dyn Writer + '_> = match format {
        Format::Perfetto => Box::new(perfetto::Perfetto::new(&mut out)),
        Format::Otlp => Box::new(otlp::Otlp::new(&mut out)),
        Format::Mcap => Box::new(mcap::Mcap::new(&mut out)),
        Format::Csv => Box::new(csv::Csv::new(&mut out)),
        Format::Dot(drawing) => graph::writer(&mut out, graph::Language::Dot, drawing),
        Format::Mermaid(drawing) => graph::writer(&mut out, graph::Language::Mermaid, drawing),
    };
    let mut run = Timeline::following(KEPT);
    for line in lines {
        let line = line.map_err(ExportError::Log)?;
        let changed = run.apply(&line);
        writer.line(&line, &run, &changed).map_err(ExportError::Write)?;
    }
    let changed = run.close();
    writer.end(&run, &changed).map_err(ExportError::Write)?;
    drop(writer);
    out.flush().map_err(ExportError::Write)
}

/// Nanoseconds since 1970.
fn unix_ns(run: &Timeline, at_s: f64) -> u64 {
    // A moment of a run is never negative.
    run.began_unix_ms.saturating_mul(1_000_000).saturating_add((at_s.max(0.0) * 1e9).round() as u64)
}
