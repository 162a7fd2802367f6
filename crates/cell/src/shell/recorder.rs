//! Records the events of the cell, [`Line`] by line.
//!
//! A line that cannot be written ends the recording, not the cell. A restarted cell does not overwrite earlier recordings.

use crate::core::cell::Cell;
use crate::core::recording::Line;
use anyhow::Context;
use std::fs::File;
use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};

/// Maximum number of recordings with one name.
const MAX_RECORDINGS: u32 = 1_000;

#[derive(Debug)]
pub(crate) struct Recorder(Option<BufWriter<File>>);

impl Recorder {
    /// A recorder that writes nothing.
    pub(crate) fn none() -> Recorder {
        Recorder(None)
    }

    /// Begins a recording in a new file: `file`, or `file.2`, `file.3` and so on if that exists.
    pub(crate) fn begin(file: &Path, cell: &Cell) -> anyhow::Result<Recorder> {
        let (made, file) = new_file(file).with_context(|| format!("cannot record to {}", file.display()))?;
        tracing::info!(file = %file.display(), "what happens is recorded");
        let mut recorder = Recorder(Some(BufWriter::new(made)));
        recorder.write(&[Line::header(cell)]);
        Ok(recorder)
    }

    /// Whether lines are recorded.
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

fn new_file(wanted: &Path) -> io::Result<(File, PathBuf)> {
    let later = (2..=MAX_RECORDINGS).map(|number| {
        let mut name = wanted.as_os_str().to_owned();
        name.push(format!(".{number}"));
        PathBuf::from(name)
    });
    for file in std::iter::once(wanted.to_owned()).chain(later) {
        match File::create_new(&file) {
            Err(error) if error.kind() == io::ErrorKind::AlreadyExists => {}
            made => return Ok((made?, file)),
        }
    }
    Err(io::Error::other(format!("{MAX_RECORDINGS} recordings of that name are there: remove some")))
}

fn write(file: &mut BufWriter<File>, lines: &[Line]) -> io::Result<()> {
    for line in lines {
        serde_json::to_writer(&mut *file, line)?;
        file.write_all(b"\n")?;
    }
    file.flush()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::CellConfig;

    #[test]
    fn a_cell_that_is_started_again_leaves_the_recordings_of_before() -> anyhow::Result<()> {
        let cell = Cell::new(CellConfig::default())?;
        let place = tempfile::tempdir()?;
        let file = place.path().join("cell.jsonl");
        for _ in 0..3 {
            assert!(Recorder::begin(&file, &cell)?.is_on());
        }
        for name in ["cell.jsonl", "cell.jsonl.2", "cell.jsonl.3"] {
            assert!(std::fs::read_to_string(place.path().join(name))?.starts_with("{\"form\":2"), "{name}");
        }
        let nowhere = Recorder::begin(&place.path().join("no/cell.jsonl"), &cell);
        assert!(nowhere.is_err_and(|error| error.to_string().starts_with("cannot record to")));
        Ok(())
    }
}
