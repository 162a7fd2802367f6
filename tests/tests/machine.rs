//! What a machine has, as resources that a task requires.

mod support;

use anyhow::{Context, ensure};
use serde_json::Value;
use support::{Place, repository, texts, wait_for};

const CONFIG: &str = r#"
[process-manager]
host = "here"
labels = { gpu = true }
machine = { interval_s = 0.2 }
"#;

#[test]
fn a_task_that_requires_a_charged_battery_and_a_free_core_runs_when_they_are_there_and_waits_when_not()
-> anyhow::Result<()> {
    let place = Place::new()?;
    let task = repository("examples/when_charged.yaml");
    let (full, low) = (place.path().join("full.toml"), place.path().join("low.toml"));
    std::fs::write(&full, CONFIG)?;
    std::fs::write(&low, format!("{CONFIG}[cell.battery]\nlevel = 0.15\n"))?;
    let full = full.to_str().context("a path")?;
    let output = place.ratn(&["run", task.to_str().context("a path")?, "--config", full]).output()?;
    ensure!(output.status.success(), "{:?}", texts(&output));

    let hurried = place.path().join("hurried.yaml");
    std::fs::write(&hurried, std::fs::read_to_string(&task)?.replace("deadline: 600", "deadline: 12"))?;
    let (hurried, low) = (hurried.to_str().context("a path")?, low.to_str().context("a path")?);
    let output = place.ratn(&["run", hurried, "--config", low]).output()?;
    let (_, said) = texts(&output);
    let waits = said.lines().any(|line| line.contains("waits  look  for") && line.contains("Battery"));
    ensure!(output.status.code() == Some(1) && waits, "{:?} {said}", output.status);
    Ok(())
}

#[test]
fn a_host_says_what_it_has_and_what_is_said_of_it() -> anyhow::Result<()> {
    let place = Place::new()?;
    let config = place.path().join("ratn.toml");
    std::fs::write(&config, CONFIG)?;
    let config = config.to_str().context("a path")?;
    let _manager = place.start_as("rm", &["resource-manager", "--config", config])?;
    let _processes = place.start_as("pm", &["process-manager", "--config", config])?;
    let there = wait_for("the host", || {
        let output = place.ratn(&["resource", "list", "Host", "Core", "--json"]).output()?;
        let listed = serde_json::from_slice::<Vec<Value>>(&output.stdout).unwrap_or_default();
        let told = listed.iter().any(|resource| resource["attributes"]["free_memory_mib"].is_number());
        Ok((listed.len() == 2 && told).then_some(listed))
    })?;
    let of = |id: &str| there.iter().find(|resource| resource["id"] == id).with_context(|| format!("{there:?}"));
    let (host, cores) = (of("host@here")?, of("cores@here")?);
    let attributes = &host["attributes"];
    ensure!(attributes["gpu"] == true && attributes["free_memory_mib"].as_i64() > Some(0), "{host}");
    ensure!(attributes["cores"].as_f64() == cores["capacity"].as_f64(), "{host} {cores}");
    let held = place.ratn(&["resource", "block", "Core", "--where", "gpu = true", "--", "true"]).output()?;
    ensure!(held.status.success(), "{:?}", texts(&held));
    Ok(())
}
