//! `ratn export FORMAT LOG`.

use crate::arguments::{DrawingArgument, ExportArguments, FormatArgument};
use crate::failure::Failure;
use crate::output;
use anyhow::Context;
use ratn_event_log::Lines;
use ratn_export::{Drawing, ExportError, Format, export};
use std::fs::File;
use std::io::{BufWriter, ErrorKind, IsTerminal};
use std::path::Path;

/// Writes an event log in another format.
pub(crate) fn run(arguments: &ExportArguments) -> Result<(), Failure> {
    let format = format(arguments);
    let mut lines = Lines::of(&arguments.log)?;
    match &arguments.output {
        Some(path) => {
            output::check_writable(path)?;
            if is_same(path, &arguments.log) {
                let place = path.display();
                return Err(Failure::Refused(format!("ratn: {place} is the event log itself: name another file")));
            }
            let file = ratn_regular_file::open_to_write(path, File::options().write(true).create(true).truncate(true));
            let file = file.with_context(|| format!("cannot write {}", path.display()))?;
            let written = export(format, lines.by_ref(), BufWriter::new(file));
            written.with_context(|| format!("{} is incomplete", path.display()))?;
        }
        None if matches!(format, Format::Perfetto | Format::Mcap) && std::io::stdout().is_terminal() => {
            let help = "ratn: this form is not for a terminal: name a file with -o FILE";
            return Err(Failure::Refused(help.to_owned()));
        }
        None => match export(format, lines.by_ref(), BufWriter::new(std::io::stdout().lock())) {
            // The reader has closed the pipe.
            Err(ExportError::Write(error)) if error.kind() == ErrorKind::BrokenPipe => return Ok(()),
            other => other.map_err(anyhow::Error::from)?,
        },
    }
    if let Some(line) = lines.torn() {
        let place = arguments.log.display();
        output::progress(format_args!("{place}:{line}: warning: the last line is torn; exported is what is before it"));
    }
    Ok(())
}

fn format(arguments: &ExportArguments) -> Format {
    let drawing = match arguments.of {
        DrawingArgument::Network => Drawing::Network,
        DrawingArgument::Task => Drawing::Task,
    };
    match arguments.format {
        FormatArgument::Perfetto => Format::Perfetto,
        FormatArgument::Otlp => Format::Otlp,
        FormatArgument::Mcap => Format::Mcap,
        FormatArgument::Csv => Format::Csv,
        FormatArgument::Dot => Format::Dot(drawing),
        FormatArgument::Mermaid => Format::Mermaid(drawing),
    }
}

fn is_same(a: &Path, b: &Path) -> bool {
    matches!((a.canonicalize(), b.canonicalize()), (Ok(a), Ok(b)) if a == b)
}

#[cfg(test)]
mod tests {
    use super::*;

    const LOG: &str = r#"{"at":0,"event":"started","task":"t","digest":"d","mode":"cdtn","parameters":{},"seed":1,"world":[],"revision":0}
{"at":0,"command":"note","note":"expanded","instance":1,"state":1,"path":"look","speculative":false}
{"at":0,"command":"end","outcome":"success","outputs":{},"reason":""}
"#;

    #[test]
    fn an_export_is_written_and_never_over_its_own_log() -> anyhow::Result<()> {
        let place = tempfile::tempdir()?;
        let (log, table) = (place.path().join("run.jsonl"), place.path().join("run.csv"));
        std::fs::write(&log, LOG)?;
        let (format, of) = (FormatArgument::Csv, DrawingArgument::Network);
        let to = |output: &Path| ExportArguments { format, log: log.clone(), output: Some(output.to_owned()), of };
        assert!(run(&to(&table)).is_ok());
        assert!(std::fs::read_to_string(&table)?.contains("\r\n1,look,look,waiting,"));
        assert!(matches!(run(&to(&place.path().join("./run.jsonl"))), Err(Failure::Refused(_))));
        assert_eq!(std::fs::read_to_string(&log)?, LOG);
        // Opening a pipe does not wait for a reader.
        let pipe = place.path().join("pipe");
        nix::unistd::mkfifo(&pipe, nix::sys::stat::Mode::S_IRWXU)?;
        let refused = run(&to(&pipe)).err().map(|error| error.to_string()).unwrap_or_default();
        assert!(refused.contains("pipe") && refused.contains("nobody reads"), "{refused}");
        Ok(())
    }
}
