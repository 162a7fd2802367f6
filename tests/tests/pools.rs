//! `ratn ps`, `ratn logs` and `ratn pool` on a real process manager.

mod support;

use anyhow::{Context, ensure};
use support::{Place, Started, texts, wait_for};

const CONFIG: &str = r#"
[process-manager]
host = "here"
[[process-manager.template]]
name = "shell"
kind = "Shell"
program = "/bin/sh"
args = ["-c", "echo I am {id}; exec cat"]
readiness = { kind = "line", contains = "I am" }
max = 2
"#;

fn start() -> anyhow::Result<(Place, Vec<Started>)> {
    let place = Place::new()?;
    let config = place.path().join("ratn.toml");
    std::fs::write(&config, CONFIG)?;
    let config = config.to_str().context("a path")?;
    let started = ["resource-manager", "process-manager"]
        .iter()
        .map(|role| place.start_as(role, &[role, "--config", config]))
        .collect::<anyhow::Result<Vec<_>>>()?;
    Ok((place, started))
}

fn asked(place: &Place, arguments: &[&str]) -> anyhow::Result<(Option<i32>, String, String)> {
    let output = place.ratn(arguments).output()?;
    let (out, err) = texts(&output);
    Ok((output.status.code(), out, err))
}

/// The ids of those that are ready.
fn ready(place: &Place) -> anyhow::Result<Vec<String>> {
    let (_, out, _) = asked(place, &["ps", "--json"])?;
    let Ok(shown) = serde_json::from_str::<serde_json::Value>(&out) else { return Ok(Vec::new()) };
    let workers = shown["pools"][0]["workers"].as_array().cloned().unwrap_or_default();
    let ready = workers.iter().filter(|worker| worker["state"] == "ready");
    Ok(ready.filter_map(|worker| worker["id"].as_str().map(str::to_owned)).collect())
}

fn wait_for_ready(place: &Place, ids: &[&str]) -> anyhow::Result<()> {
    wait_for("the workers", || Ok((ready(place)? == ids).then_some(())))
}

#[test]
fn workers_are_shown_started_and_ended_and_their_logs_are_read() -> anyhow::Result<()> {
    let (place, _processes) = start()?;
    wait_for_ready(&place, &["shell-1@here"])?;
    let (code, table, err) = asked(&place, &["ps"])?;
    ensure!(code == Some(0) && table.starts_with("WORKER"), "{table} {err}");
    ensure!(table.contains("shell-1@here  Shell  ready"), "{table}");
    ensure!(asked(&place, &["pool", "start", "shell"])?.1 == "shell-2@here\n");
    wait_for_ready(&place, &["shell-1@here", "shell-2@here"])?;
    let (code, _, err) = asked(&place, &["pool", "start", "shell"])?;
    ensure!(code == Some(1) && err.contains("at most 2"), "{code:?} {err}");
    ensure!(asked(&place, &["logs", "shell-2@here"])?.1 == "I am shell-2@here\n");
    let (code, _, err) = asked(&place, &["logs", "../shell"])?;
    ensure!(code == Some(2) && err.contains("there is no log"), "{code:?} {err}");
    ensure!(asked(&place, &["pool", "stop", "shell-1@here"])?.0 == Some(0));
    wait_for_ready(&place, &["shell-2@here"])?;
    ensure!(asked(&place, &["logs", "shell-1@here"])?.1 == "I am shell-1@here\n", "it has ended, its log is kept");
    Ok(())
}
