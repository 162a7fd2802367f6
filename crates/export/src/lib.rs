//! Exports event logs to the formats of common tools.
//!
//! Pure writers over one fold of a log (`ratn_report::timeline`): lines in, bytes out, with memory that does not grow with the log. Each
//! format is a source file of its own, which names the tools that read it. No task file and no running system is needed.
//!
//! The export contains what the log says. Times are robot time, added to the wall time at which the run began.

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

/// Number of instances kept after they have left the window, because later lines may refer to them.
const KEPT: usize = 256;

/// An export format.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Format {
    /// A trace for ui.perfetto.dev.
    Perfetto,
    /// Spans as OTLP/JSON, one request per line.
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
    /// The hierarchy of states, all visits of a state as one node.
    Task,
}

/// Why nothing, or not everything, was exported.
#[derive(Debug, thiserror::Error)]
pub enum ExportError<E> {
    /// A line of the log cannot be read.
    #[error(transparent)]
    Log(E),
    /// The output cannot be written.
    #[error("cannot write the export")]
    Write(#[source] io::Error),
}

/// A writer of one format.
trait Writer {
    /// Called after each line, with the run so far, and what the line changed.
    fn line(&mut self, line: &LogLine, run: &Timeline, changed: &Changed) -> io::Result<()>;
    /// Called after the last line. `changed` contains what was still held or kept.
    fn end(&mut self, run: &Timeline, changed: &Changed) -> io::Result<()>;
}

/// Writes a log in a format.
///
/// # Errors
/// A line cannot be read, or the output not be written. What was written until then is incomplete.
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

/// A moment of the run in nanoseconds since 1970.
fn unix_ns(run: &Timeline, at_s: f64) -> u64 {
    // Times of a run are never negative.
    run.began_unix_ms.saturating_mul(1_000_000).saturating_add((at_s.max(0.0) * 1e9).round() as u64)
}
