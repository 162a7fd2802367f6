//! `ratn doctor`, and configs whose workers cannot be started here.

mod support;

use anyhow::{Context, ensure};
use serde_json::Value;
use std::os::unix::fs::PermissionsExt;
use support::{Place, texts, wait_for};

const GOOD: &str = r#"
[process-manager]
host = "here"
[[process-manager.template]]
name = "shell"
kind = "Shell"
program = "sh"
args = ["-c", "echo ready; exec cat"]
readiness = { kind = "line", contains = "ready" }
"#;

fn write(place: &Place, name: &str, text: &str) -> anyhow::Result<String> {
    let file = place.path().join(name);
    std::fs::write(&file, text)?;
    Ok(file.to_str().context("a path")?.to_owned())
}

/// The exit code, and the findings that are not `ok`: level, about, found.
fn examined(place: &Place, config: &str) -> anyhow::Result<(Option<i32>, Vec<String>)> {
    let output = place.ratn(&["doctor", "--quiet", "--json", "--config", config]).output()?;
    let (out, err) = texts(&output);
    Ok((output.status.code(), findings(&out).with_context(|| err)?))
}

fn findings(out: &str) -> anyhow::Result<Vec<String>> {
    let document: Value = serde_json::from_str(out).with_context(|| out.to_owned())?;
    let findings = document["findings"].as_array().context("findings")?;
    let text = |finding: &Value, key: &str| finding[key].as_str().unwrap_or_default().to_owned();
    let line = |f: &Value| format!("{} {}: {}", text(f, "level"), text(f, "about"), text(f, "found"));
    ensure!(findings.iter().all(|finding| !text(finding, "help").is_empty()), "what to do is not said: {out}");
    Ok(findings.iter().map(line).collect())
}

fn says(findings: &[String], what: &str) -> anyhow::Result<()> {
    ensure!(findings.iter().any(|finding| finding.contains(what)), "not `{what}`: {findings:#?}");
    Ok(())
}

#[test]
fn a_system_that_is_well_has_no_problems_and_one_whose_daemon_was_killed_has() -> anyhow::Result<()> {
    let place = Place::new()?;
    let config = write(&place, "ratn.toml", GOOD)?;
    let (code, findings) = examined(&place, &config)?;
    ensure!(code == Some(0), "nothing runs yet, and that is well: {findings:#?}");
    let manager = place.start_as("rm", &["resource-manager", "--config", &config])?;
    let mut processes = place.start_as("pm", &["process-manager", "--config", &config])?;
    let worker = || Ok(place.ratn(&["ps"]).output()?.stdout.windows(7).any(|w| w == b"  ready").then_some(()));
    wait_for("the worker", worker)?;
    let (code, findings) = examined(&place, &config)?;
    ensure!(code == Some(0), "{findings:#?}");
    let output = place.ratn(&["doctor", "--config", &config]).output()?;
    let (out, _) = texts(&output);
    ensure!(out.contains("host here, clock: ") && out.contains("template shell: 1 workers"), "{out}");
    manager.process()?.kill()?;
    processes.signal(nix::sys::signal::Signal::SIGTERM)?;
    processes.finish()?;
    let (code, findings) = examined(&place, &config)?;
    ensure!(code == Some(1), "{findings:#?}");
    says(&findings, "problem resource-manager: is published at")
}

#[test]
fn what_is_wrong_with_a_config_on_this_machine_is_said() -> anyhow::Result<()> {
    let place = Place::new()?;
    let tls = place.path().join("tls");
    let tls = tls.to_str().context("a path")?;
    for host in ["localhost", "other"] {
        ensure!(place.ratn(&["certs", tls, host, "--days", "10"]).output()?.status.success());
    }
    std::fs::set_permissions(format!("{tls}/localhost.key"), std::fs::Permissions::from_mode(0o644))?;
    let text = format!(
        r#"
        [service.tls]
        cert = "{tls}/localhost.pem"
        key = "{tls}/localhost.key"
        client_ca = "{tls}/ca.pem"
        [resource-manager]
        listen = "127.0.0.1:0"
        [process-manager]
        cgroup = "/no/group"
        [[process-manager.template]]
        name = "gone"
        kind = "Gone"
        program = "/no/such/program"
        [[process-manager.template]]
        name = "text"
        kind = "Text"
        program = "{tls}/ca.pem"
        "#
    );
    let config = write(&place, "ratn.toml", &text)?;
    let (code, findings) = examined(&place, &config)?;
    ensure!(code == Some(1), "{findings:#?}");
    for what in [
        "problem template gone: there is no program /no/such/program",
        "ca.pem may not be executed",
        "problem cgroup: /no/group is no group of cgroup v2",
        "localhost.key: others may read it (mode 644)",
        "localhost.pem: is over in ",
        "is not for `127.0.0.1`, which is listened on",
    ] {
        says(&findings, what)?;
    }
    let mixed = write(&place, "mixed.toml", &text.replace("localhost.key", "other.key"))?;
    says(&examined(&place, &mixed)?.1, "is not the key of")?;
    let exposed = write(&place, "exposed.toml", "[cell]\nlisten = \"0.0.0.0:0\"\n")?;
    says(&examined(&place, &exposed)?.1, "problem [cell] listen: http://0.0.0.0:0 can be reached")?;
    let bad = write(&place, "bad.toml", "sped = 1\n")?;
    says(&examined(&place, &bad)?.1, "unknown field `sped`")
}

#[test]
fn too_few_open_files_for_the_pools_are_a_problem_only_where_the_hard_limit_has_fewer() -> anyhow::Result<()> {
    let place = Place::new()?;
    let config = write(&place, "ratn.toml", &format!("{GOOD}max = 50\n"))?;
    let found = |limits: &str| -> anyhow::Result<Vec<String>> {
        let ratn = place.ratn(&["doctor", "--quiet", "--json", "--config", &config]);
        let mut limited = place.within("/bin/sh", &["-c", &format!("{limits} && exec \"$0\" \"$@\"")]);
        let output = limited.arg(ratn.get_program()).args(ratn.get_args()).output()?;
        findings(&texts(&output).0)
    };
    says(
        &found("ulimit -Sn 500 && ulimit -Hn 500")?,
        "problem open files: 500 may be open at once; a process manager of 50",
    )?;
    let raised = found("ulimit -Sn 500 && ulimit -Hn 1000")?;
    ensure!(!raised.iter().any(|finding| finding.contains("open files")), "it raises its limit itself: {raised:#?}");
    Ok(())
}

#[test]
fn a_template_that_cannot_be_started_is_refused_before_anything_is() -> anyhow::Result<()> {
    let place = Place::new()?;
    let config = write(&place, "ratn.toml", &GOOD.replace("\"sh\"", "\"/no/such/program\""))?;
    for arguments in
        [["process-manager", "--check-config", "--config", &config].as_slice(), &["up", "--config", &config]]
    {
        let output = place.ratn(arguments).output()?;
        let (_, err) = texts(&output);
        let said = err.contains("template `shell`: there is no program /no/such/program");
        ensure!(output.status.code() == Some(2) && said, "{arguments:?}: {:?} {err}", output.status);
    }
    let output = place.ratn(&["cell", "--check-config", "--config", &config]).output()?;
    ensure!(output.status.success(), "its workers are another host's");
    Ok(())
}
