//! What a run has moved: by its event log, and by the cell's own record.

use anyhow::{Context, ensure};
use serde_json::Value;
use std::collections::BTreeMap;
use std::path::Path;

/// An event log.
pub(crate) fn lines(log: &Path) -> anyhow::Result<Vec<Value>> {
    let text = std::fs::read_to_string(log)?;
    text.lines().map(|line| serde_json::from_str(line).with_context(|| line.to_owned())).collect()
}

/// Whether a line of a log commands a provider to start something.
pub(crate) fn starts(line: &Value, provider: &str) -> bool {
    line["command"] == "start" && line["goal"]["provider"] == provider
}

/// Ids of the goals that the cell has begun, by its own record (what it says at `ratn_worker=debug`).
pub(crate) fn begun_in(record: &Path) -> anyhow::Result<Vec<String>> {
    let record = std::fs::read_to_string(record)?;
    let begun = record.lines().filter(|line| line.contains("begun"));
    let id = |line: &str| Some(line.split_once("goal=")?.1.split_whitespace().next()?.to_owned());
    begun.map(|line| id(line).with_context(|| line.to_owned())).collect()
}

/// Every motion that the log has, by its goal id: no path twice.
pub(crate) fn motions(lines: &[Value]) -> anyhow::Result<BTreeMap<String, String>> {
    let run = lines[0]["origin"]["run"].as_str().context("no run")?;
    let mut paths = BTreeMap::new();
    let mut motions = BTreeMap::new();
    for line in lines {
        if line["note"] == "expanded" {
            paths.insert(line["instance"].as_u64(), line["path"].as_str().unwrap_or_default().to_owned());
        }
        if ["arm", "gripper", "pan_tilt"].iter().any(|provider| starts(line, provider)) {
            let path = paths.get(&line["instance"].as_u64()).cloned().context("an instance without a path")?;
            ensure!(!motions.values().any(|other| *other == path), "{path} was begun twice");
            motions.insert(format!("{run}/i{}/{}", line["instance"], line["attempt"]), path);
        }
    }
    Ok(motions)
}
