//! `ratn ps`, `logs`, `pool`, `restart` and `drain` on real process managers of two hosts.

mod support;

use anyhow::{Context, ensure};
use std::collections::BTreeMap;
use support::{Place, Started, texts, wait_for};

/// Of one host; the other's runtime directory is another.
fn config(host: &str, manager: &str) -> String {
    format!(
        r#"
        [process-manager]
        host = "{host}"
        {manager}
        [[process-manager.template]]
        name = "{host}-shell"
        kind = "Shell"
        program = "/bin/sh"
        args = ["-c", "echo I am {{id}}; exec cat"]
        readiness = {{ kind = "line", contains = "I am" }}
        max = 2
        "#
    )
}

/// The resource manager and the process manager of host `here`, and the one of host `there`.
fn start() -> anyhow::Result<(Place, Vec<Started>)> {
    let place = Place::new()?;
    let (here, there) = (place.path().join("here.toml"), place.path().join("there.toml"));
    std::fs::write(&here, config("here", ""))?;
    let manager = place.path().join("run/resource-manager.sock");
    // Without cgroups also where the machine has them.
    let settings = format!("resource_manager = \"unix:{}\"\ntracking = \"environment\"", manager.display());
    std::fs::write(&there, config("there", &settings))?;
    let (here, there) = (here.to_str().context("a path")?, there.to_str().context("a path")?);
    let elsewhere = place.path().join("run-there");
    let elsewhere = elsewhere.to_str().context("a path")?;
    let started = [
        place.start_as("rm", &["resource-manager", "--config", here])?,
        place.start_as("here", &["process-manager", "--config", here])?,
        place.start_as("there", &["process-manager", "--config", there, "--runtime-dir", elsewhere])?,
    ];
    Ok((place, started.into()))
}

fn asked(place: &Place, arguments: &[&str]) -> anyhow::Result<(Option<i32>, String, String)> {
    let output = place.ratn(arguments).output()?;
    let (out, err) = texts(&output);
    Ok((output.status.code(), out, err))
}

/// The ids of those that are ready, over all hosts.
fn ready(place: &Place) -> anyhow::Result<Vec<String>> {
    let (_, out, _) = asked(place, &["ps", "--json"])?;
    let Ok(shown) = serde_json::from_str::<serde_json::Value>(&out) else { return Ok(Vec::new()) };
    let list = |value: &serde_json::Value| value.as_array().cloned().unwrap_or_default();
    let pools = list(&shown["hosts"]).into_iter().flat_map(|host| list(&host["pools"]));
    let workers = pools.flat_map(|pool| list(&pool["workers"])).filter(|worker| worker["state"] == "ready");
    Ok(workers.filter_map(|worker| worker["id"].as_str().map(str::to_owned)).collect())
}

fn wait_for_ready(place: &Place, ids: &[&str]) -> anyhow::Result<()> {
    wait_for("the workers", || Ok((ready(place)? == ids).then_some(())))
}

#[test]
fn workers_of_all_hosts_are_shown_started_scaled_and_ended_and_their_logs_are_read() -> anyhow::Result<()> {
    let (place, _processes) = start()?;
    wait_for_ready(&place, &["here-shell-1@here", "there-shell-1@there"])?;
    let (code, table, err) = asked(&place, &["ps"])?;
    ensure!(code == Some(0) && table.starts_with("WORKER"), "{table} {err}");
    ensure!(table.contains("there-shell-1@there  Shell  ready"), "{table}");
    ensure!(table.contains("host here: processes are tracked by "), "{table}");
    ensure!(table.contains("host there: processes are tracked by subreaper (no cgroups): "), "{table}");
    ensure!(asked(&place, &["pool", "start", "there-shell"])?.1 == "there-shell-2@there\n");
    wait_for_ready(&place, &["here-shell-1@here", "there-shell-1@there", "there-shell-2@there"])?;
    let (code, _, err) = asked(&place, &["pool", "start", "there-shell"])?;
    ensure!(code == Some(1) && err.contains("at most 2"), "{code:?} {err}");
    let (code, _, err) = asked(&place, &["pool", "scale", "there-shell", "--max", "3"])?;
    ensure!(code == Some(1) && err.contains("more than its config's 2"), "{code:?} {err}");
    ensure!(asked(&place, &["pool", "scale", "there-shell", "--max", "1"])?.1 == "there-shell: 1 to 1, 0 spares\n");
    wait_for("one to end", || Ok((ready(&place)?.len() == 2).then_some(())))?;
    ensure!(asked(&place, &["logs", "there-shell-1@there"])?.1 == "I am there-shell-1@there\n");
    ensure!(asked(&place, &["logs", "there-shell-2@there"])?.1 == "I am there-shell-2@there\n", "one has ended");
    ensure!(asked(&place, &["logs", "here-shell"])?.1 == "here-shell-1@here: I am here-shell-1@here\n");
    let (code, _, err) = asked(&place, &["logs", "../shell"])?;
    ensure!(code == Some(2) && err.contains("there is no log"), "{code:?} {err}");
    Ok(())
}

#[test]
fn a_log_is_followed_until_its_worker_ends_while_another_takes_its_place() -> anyhow::Result<()> {
    let (place, _processes) = start()?;
    wait_for_ready(&place, &["here-shell-1@here", "there-shell-1@there"])?;
    let mut followed = place.start_as("log", &["logs", "-f", "there-shell-1@there"])?;
    let (code, out, err) = asked(&place, &["restart", "there-shell"])?;
    ensure!((code, out.as_str()) == (Some(0), "there-shell-1@there\n"), "{out} {err}");
    let (code, out, err) = followed.finish()?;
    ensure!((code, out.as_str()) == (Some(0), "I am there-shell-1@there\n"), "{out} {err}");
    wait_for_ready(&place, &["here-shell-1@here", "there-shell-2@there"])?;
    ensure!(asked(&place, &["restart", "here-shell-1@here"])?.0 == Some(0));
    wait_for_ready(&place, &["here-shell-2@here", "there-shell-2@there"])
}

#[test]
fn a_drained_host_has_no_workers_also_after_a_restart_until_that_is_undone() -> anyhow::Result<()> {
    let (place, mut processes) = start()?;
    wait_for_ready(&place, &["here-shell-1@here", "there-shell-1@there"])?;
    let (code, out, _) = asked(&place, &["drain", "here"])?;
    ensure!(code == Some(0) && out.contains("end once nobody holds them: here-shell-1@here"), "{out}");
    wait_for_ready(&place, &["there-shell-1@there"])?;
    let (code, _, err) = asked(&place, &["pool", "start", "here-shell"])?;
    ensure!(code == Some(1) && err.contains("the host `here` is drained"), "{code:?} {err}");
    let config = place.path().join("here.toml");
    processes[1].signal(nix::sys::signal::Signal::SIGTERM)?;
    processes[1].finish()?;
    processes[1] = place.start_as("again", &["process-manager", "--config", config.to_str().context("a path")?])?;
    wait_for("the host", || Ok(asked(&place, &["ps"])?.1.contains("host here: drained; ").then_some(())))?;
    ensure!(asked(&place, &["drain", "here", "--undo"])?.1 == "here takes work again\n");
    wait_for_ready(&place, &["here-shell-1@here", "there-shell-1@there"])?;
    let (code, _, err) = asked(&place, &["drain", "nowhere"])?;
    ensure!(code == Some(2) && err.contains("asked: here, there"), "{code:?} {err}");
    Ok(())
}

/// One worker is kept, and another one is started when there is work for it.
const GROWING: &str = r#"
[process-manager]
host = "here"
[[process-manager.template]]
name = "shell"
kind = "Shell"
program = "/bin/sh"
args = ["-c", "echo I am {id}; exec cat"]
readiness = { kind = "line", contains = "I am" }
min = 1
max = 2
idle_s = 1
"#;

#[test]
fn four_who_wait_for_one_worker_start_another_one_which_ends_when_it_is_idle() -> anyhow::Result<()> {
    let place = Place::new()?;
    let config = place.path().join("here.toml");
    std::fs::write(&config, GROWING)?;
    let config = config.to_str().context("a path")?;
    let _manager = place.start_as("rm", &["resource-manager", "--config", config])?;
    let _host = place.start_as("here", &["process-manager", "--config", config])?;
    wait_for_ready(&place, &["shell-1@here"])?;
    let begin = std::time::Instant::now();
    let goals =
        ["a", "b", "c", "d"].map(|name| place.start_as(name, &["resource", "block", "Shell", "--", "sleep", "2"]));
    let mut used = BTreeMap::<String, usize>::new();
    for goal in goals {
        let (code, out, err) = goal?.finish()?;
        let worker = ["shell-1@here", "shell-2@here"].into_iter().find(|id| out.contains(id));
        ensure!(code == Some(0), "{out} {err}");
        *used.entry(worker.with_context(|| format!("no worker: {out}"))?.to_owned()).or_default() += 1;
    }
    eprintln!("four goals of 2 s: {:.1} s, by {used:?}", begin.elapsed().as_secs_f64());
    ensure!(used.len() == 2, "{used:?}");
    wait_for("one to end", || Ok((ready(&place)?.len() == 1).then_some(())))
}
