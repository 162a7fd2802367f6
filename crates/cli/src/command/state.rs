//! `ratn state backup|restore|show`: what a daemon keeps on the disk, copied while it runs, put back, looked at.

use crate::arguments::{StateArguments, StateCommand};
use crate::failure::Failure;
use crate::output;
use anyhow::Context;
use ratn_storage::{Copied, CopyError, Log, Options, Position, Store, backup, restore};
use serde_json::json;
use std::path::Path;

/// Copies, puts back, or shows.
pub(super) fn run(arguments: &StateArguments) -> Result<(), Failure> {
    match &arguments.command {
        StateCommand::Backup { state, target } => copied(backup(state, target), arguments.json, target),
        StateCommand::Restore { backup, target } => copied(restore(backup, target), arguments.json, target),
        StateCommand::Show { state } => show(state, arguments.json),
    }
}

fn copied(copied: Result<Copied, CopyError>, as_json: bool, target: &Path) -> Result<(), Failure> {
    let Copied { through, snapshot } = copied.map_err(|error| match error {
        // What was asked for makes no sense; what is there is as it was.
        CopyError::Nothing { .. } | CopyError::NotEmpty { .. } => Failure::Refused(format!("ratn: {error}")),
        other => Failure::Failed(other.into()),
    })?;
    match as_json {
        true => output::result(json!({ "target": target, "through": through.0, "snapshot": snapshot.0 }))?,
        false => output::result(format!(
            "{}: records through {through}, those through {snapshot} in a snapshot",
            target.display()
        ))?,
    }
    Ok(())
}

fn show(state: &Path, as_json: bool) -> Result<(), Failure> {
    if !state.is_dir() {
        return Err(Failure::Refused(format!("ratn: {} is no directory", state.display())));
    }
    let read = Log::new(state, Options::default()).read();
    let found = read.with_context(|| format!("{} cannot be read as a state", state.display()))?;
    let last = found.last();
    let snapshot = found.snapshot.as_ref().map_or((Position(0), 0), |taken| (taken.through, taken.payload.len()));
    let records: usize = found.records.iter().map(|record| record.payload.len()).sum();
    if as_json {
        let torn =
            found.torn.as_ref().map(|torn| json!({ "file": torn.place, "offset": torn.offset, "bytes": torn.bytes }));
        output::result(json!({
            "epoch": found.epoch.0,
            "through": last.0,
            "snapshot": { "through": snapshot.0.0, "bytes": snapshot.1 },
            "records": { "count": found.records.len(), "bytes": records },
            "torn": torn,
        }))?;
        return Ok(());
    }
    let mut lines = vec![
        format!("writers so far   {}", found.epoch.0),
        format!("records          {} after the snapshot, {records} bytes; the last is {last}", found.records.len()),
        match snapshot.0 {
            Position(0) => "snapshot         none yet".to_owned(),
            through => format!("snapshot         of records through {through}, {} bytes", snapshot.1),
        },
    ];
    if let Some(torn) = &found.torn {
        lines.push(format!(
            "unfinished       {} bytes at {} of {}: the next start cuts them off; nobody was told of them",
            torn.bytes, torn.offset, torn.place
        ));
    }
    output::result(lines.join("\n"))?;
    Ok(())
}
