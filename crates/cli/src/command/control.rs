//! `ratn control pause|resume|step|abort`

use super::blocking_on;
use crate::arguments::ControlArguments;
use crate::failure::Failure;
use crate::system::public_directory;
use crate::task_control::control;
use anyhow::Context;
use std::io::ErrorKind;

/// Tells the run of a system.
pub(crate) fn run(arguments: &ControlArguments) -> Result<(), Failure> {
    blocking_on(tokio::runtime::Builder::new_current_thread(), async {
        let directory = public_directory(arguments.runtime_dir.as_deref());
        let told = control::tell(&directory, arguments.word).await;
        let place = directory.display();
        match told {
            Err(error) if matches!(error.kind(), ErrorKind::NotFound | ErrorKind::ConnectionRefused) => {
                Err(anyhow::anyhow!("no run is under way in {place}: say the `--runtime-dir` of its system").into())
            }
            told => Ok(told.with_context(|| format!("the run in {place} does not take that"))?),
        }
    })
}
