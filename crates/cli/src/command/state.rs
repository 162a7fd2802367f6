//! `ratn state backup|restore|copy|show`: copies a daemon's state while it runs, restores it, moves it to other storage, or shows
//! it.

use crate::arguments::{StateArguments, StateCommand};
use crate::failure::Failure;
use crate::output;
use crate::system::config::SystemConfig;
use anyhow::Context;
use ratn_daemon::config::Engine;
use ratn_storage::{
    Copied, CopyError, Log, OpenError, Options, Position, Store, backup, restore, transfer, transfer_running,
};
use serde_json::json;
use std::path::Path;

/// Performs the command.
pub(super) fn run(arguments: &StateArguments) -> Result<(), Failure> {
    match &arguments.command {
        StateCommand::Backup { state, target } => copied(backup(state, target), arguments.json, target),
        StateCommand::Restore { backup, target } => copied(restore(backup, target), arguments.json, target),
        StateCommand::Copy { role, from, to, running } => moved(role, from, to, *running, arguments.json),
        StateCommand::Show { state } => show(state, arguments.json),
    }
}

fn copied(copied: Result<Copied, CopyError>, as_json: bool, target: &Path) -> Result<(), Failure> {
    let Copied { through, snapshot } = copied.map_err(|error| match error {
        // The request makes no sense; existing files are unchanged.
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

fn moved(role: &str, from: &Path, to: &Path, running: bool, as_json: bool) -> Result<(), Failure> {
    let store = |file: &Path| {
        let config = SystemConfig::load(Some(file))?;
        let storage = if role == "world-pool" { config.world_pool.storage } else { config.resource_manager.storage };
        if storage.engine == Engine::Log && storage.directory.is_none() {
            let what = format!("ratn: {}: [{role}.storage] names no `directory`", file.display());
            return Err(Failure::Refused(what));
        }
        Ok(storage.store(role).with_context(|| format!("the storage of {}", file.display()))?)
    };
    let (from, to) = (store(from)?, store(to)?);
    let copied = if running { transfer_running(&*from, &*to) } else { transfer(&*from, &*to) };
    let through = copied.map_err(|error| match error {
        CopyError::Nothing { .. } | CopyError::NotEmpty { .. } | CopyError::Open(OpenError::Held { .. }) => {
            Failure::Refused(format!("ratn: {error}"))
        }
        other => Failure::Failed(other.into()),
    })?;
    match as_json {
        true => output::result(json!({ "from": from.place(), "to": to.place(), "through": through.0 }))?,
        false => output::result(format!("{} has the state of {}", to.place(), from.place()))?,
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
