//! Writes down what happens to the cell, [`Line`] by line.
//!
//! A line that cannot be written ends the recording, not the cell.

use crate::config::CellConfig;
use crate::core::recording::Line;
use anyhow::Context;
use std::fs::File;
use std::io::{self, BufWriter, Write};
use std::path::Path;

#[derive(Debug)]
pub(crate) struct Recorder(Option<BufWriter<File>>);

impl Recorder {
    /// One that writes nothing.
    pub(crate) fn none() -> Recorder {
        Recorder(None)
    }

    /// Begins a recording in a new file.
    pub(crate) fn begin(file: &Path, config: &CellConfig) -> anyhow::Result<Recorder> {
        let made = File::create_new(file).with_context(|| format!("cannot record to {}", file.display()))?;
        let mut recorder = Recorder(Some(BufWriter::new(made)));
        recorder.write(&[Line::header(config)]);
        Ok(recorder)
    }

    /// Whether lines are wanted.
    pub(crate) fn is_on(&self) -> bool {
        self.0.is_some()
    }

    pub(crate) fn write(&mut self, lines: &[Line]) {
        if let Some(file) = &mut self.0
            && let Err(error) = write(file, lines)
        {
            tracing::error!(%error, "the recording ends here");
            self.0 = None;
        }
    }
}

fn write(file: &mut BufWriter<File>, lines: &[Line]) -> io::Result<()> {
    for line in lines {
        serde_json::to_writer(&mut *file, line)?;
        file.write_all(b"\n")?;
    }
    file.flush()
}
