//! `ratn resource …` on a real resource manager: what it says, what it holds, what it writes down.

mod support;

use anyhow::{Context, ensure};
use nix::sys::signal::Signal;
use serde_json::Value;
use std::path::PathBuf;
use support::{Place, Started, texts, wait_for};

/// A resource manager with an audit log.
struct Manager {
    place: Place,
    process: Started,
    audit: PathBuf,
}

impl Manager {
    fn start() -> anyhow::Result<Manager> {
        let place = Place::new()?;
        let (config, audit) = (place.path().join("ratn.toml"), place.path().join("audit.jsonl"));
        std::fs::write(&config, format!("[service]\naudit_file = \"{}\"\n", audit.display()))?;
        let arguments = ["resource-manager", "--config", config.to_str().context("a path")?];
        let process = place.start_as("manager", &arguments)?;
        let endpoint = place.path().join("run/resource-manager.endpoint");
        wait_for("the manager", || Ok(endpoint.exists().then_some(()))).with_context(|| process.said())?;
        Ok(Manager { place, process, audit })
    }

    /// Exit code, standard output, standard error.
    fn resource(&self, arguments: &[&str]) -> anyhow::Result<(Option<i32>, String, String)> {
        let output = self.place.ratn(&[&["resource"], arguments].concat()).output()?;
        let (out, err) = texts(&output);
        Ok((output.status.code(), out, err))
    }

    fn json(&self, arguments: &[&str]) -> anyhow::Result<Value> {
        let (code, out, err) = self.resource(&[arguments, &["--json"]].concat())?;
        ensure!(code == Some(0), "{code:?}\n{out}\n{err}");
        Ok(serde_json::from_str(&out)?)
    }

    fn free(&self, id: &str) -> anyhow::Result<u64> {
        self.json(&["get", id])?["free"].as_u64().context("no number of free units")
    }
}

#[test]
fn resources_are_created_shown_and_deleted() -> anyhow::Result<()> {
    let manager = Manager::start()?;
    let create = ["create", "Fixture", "--id", "f1", "--capacity", "3", "--attribute", "reach=1.5"];
    ensure!(manager.json(&create)?["attributes"]["reach"] == 1.5);
    let (_, table, _) = manager.resource(&["list"])?;
    ensure!(table.starts_with("ID") && table.contains("f1  Fixture  module        3/3"), "{table}");
    ensure!(manager.json(&["list", "Fixture"])?.as_array().map(Vec::len) == Some(1));
    ensure!(manager.resource(&["exists", "Fixture"])?.0 == Some(0));
    let (code, out, err) = manager.resource(&["exists", "Lathe"])?;
    ensure!(code == Some(1) && out == "no\n" && err.contains("Lathe"), "{code:?} {out} {err}");
    ensure!(manager.resource(&["delete", "f1"])?.1 == "f1\n");
    let (code, _, err) = manager.resource(&["delete", "f1"])?;
    ensure!(code == Some(1) && err.contains("there is no resource `f1`"), "{err}");
    let (code, _, err) = manager.resource(&["get", "f1"])?;
    ensure!(code == Some(1) && err.contains("f1"), "{err}");
    Ok(())
}

#[test]
fn parts_of_what_is_divisible_are_held_and_what_is_not_renewable_is_gone() -> anyhow::Result<()> {
    let manager = Manager::start()?;
    let create = ["create", "Charge", "--id", "c", "--capacity", "2.5", "--divisible", "--non-renewable"];
    let created = manager.json(&create)?;
    ensure!(created["capacity"] == 2.5 && created["divisible"] == true && created["renewable"] == false, "{created}");
    ensure!(manager.resource(&["block", "Charge", "--count", "0.75", "--", "true"])?.0 == Some(0));
    ensure!(manager.resource(&["consume", "Charge", "--count", "0.125", "--", "true"])?.0 == Some(0));
    let (_, full, _) = manager.resource(&["get", "c"])?;
    ensure!(full.contains("2.375 of 2.5, in parts, gone when it is consumed"), "{full}");
    ensure!(manager.resource(&["exists", "Charge", "--count", "2.375"])?.0 == Some(0));
    ensure!(manager.resource(&["exists", "Charge", "--count", "2.376"])?.0 == Some(1));
    for (count, why) in
        [("0", "more than nothing"), ("-1", "not negative"), ("0.0001", "three decimals"), ("NaN", "number")]
    {
        let (code, _, err) = manager.resource(&["exists", "Charge", &format!("--count={count}")])?;
        ensure!(code == Some(2) && err.contains(why), "{code:?} {err}");
    }
    let (code, _, err) = manager.resource(&["create", "Fixture", "--capacity", "1.5"])?;
    ensure!(code == Some(1) && err.contains("what is not divisible has whole units"), "{code:?} {err}");
    Ok(())
}

#[test]
fn resources_are_selected_by_what_their_attributes_are_like() -> anyhow::Result<()> {
    let manager = Manager::start()?;
    for (id, payload, tool) in [("light", "1.5", "gripper"), ("heavy", "8", "welder")] {
        let (payload, tool) = (format!("payload={payload}"), format!("tool={tool}"));
        manager.json(&[
            "create",
            "Robot",
            "--id",
            id,
            "--host",
            "cell",
            "--attribute",
            &payload,
            "--attribute",
            &tool,
        ])?;
    }
    manager.json(&["create", "Robot", "--id", "bare"])?;
    let listed = |conditions: &[&str]| -> anyhow::Result<Vec<String>> {
        let conditions = conditions.iter().flat_map(|condition| ["--where", *condition]);
        let listed = manager.json(&["list", "Robot"].into_iter().chain(conditions).collect::<Vec<_>>())?;
        let ids = listed.as_array().context("a list")?.iter().map(|one| one["id"].as_str().map(str::to_owned));
        ids.collect::<Option<_>>().context("ids")
    };
    for (conditions, expected) in [
        (&["payload = 8"][..], &["heavy"][..]),
        (&["payload != 8"], &["light"]),
        (&["payload < 8"], &["light"]),
        (&["payload <= 8"], &["heavy", "light"]),
        (&["payload > 1.5"], &["heavy"]),
        (&["payload >= 1.5", "tool = gripper"], &["light"]),
        (&["tool in [welder, drill]"], &["heavy"]),
        (&["has tool", "host = cell"], &["heavy", "light"]),
    ] {
        let found = listed(conditions)?;
        ensure!(found == expected, "{conditions:?}: {found:?}");
    }
    let (code, out, _) = manager.resource(&["block", "Robot", "--where", "payload > 2", "--", "true"])?;
    ensure!(code == Some(0) && out.contains("heavy"), "{out}");
    ensure!(manager.resource(&["exists", "Robot", "--where", "payload > 9"])?.0 == Some(1));
    let (code, _, err) = manager.resource(&["list", "--where", "payload ~ 9"])?;
    ensure!(code == Some(2) && err.contains("`payload ~ 9` is no condition on an attribute"), "{code:?} {err}");
    Ok(())
}

#[test]
fn a_block_holds_for_as_long_as_its_command_runs() -> anyhow::Result<()> {
    let manager = Manager::start()?;
    manager.json(&["create", "Fixture", "--id", "f1"])?;
    // In a program of its own, which is told what it has, and whose end ends it.
    let program = ["block", "Fixture", "--", "sh", "-c", "test $RATN_TOKEN -gt 0 && test $RATN_LEASE -gt 0"];
    let (code, out, err) = manager.resource(&program)?;
    ensure!(code == Some(0) && out.starts_with("lease "), "{code:?} {out} {err}");
    ensure!(manager.resource(&["block", "Fixture", "--", "sh", "-c", "exit 7"])?.0 == Some(7));
    ensure!(manager.resource(&["block", "Fixture", "--", "sh", "-c", "kill -9 $$"])?.0 == Some(128 + 9));
    ensure!(manager.resource(&["block", "Fixture", "--ttl", "0.01"])?.0 == Some(0));
    ensure!(manager.free("f1")? == 1);

    let mut holder = manager.place.start_as("holder", &["resource", "block", "Fixture"])?;
    wait_for("the block", || Ok((manager.free("f1")? == 0).then_some(()))).with_context(|| holder.said())?;
    let (code, _, err) = manager.resource(&["block", "Fixture", "--wait", "0.05"])?;
    ensure!(code == Some(1) && err.contains("not blocked: not granted"), "{err}");
    // Who waits behind it is explained.
    let waiter = manager.place.start_as("waiter", &["resource", "block", "Fixture"])?;
    let waiting = wait_for("the waiter", || {
        let waiting = manager.json(&["explain"])?;
        Ok(waiting.as_array().is_some_and(|all| all.len() == 1).then_some(waiting))
    })
    .with_context(|| waiter.said())?;
    ensure!(waiting[0]["obstacles"][0].as_str().is_some_and(|obstacle| obstacle.contains("Fixture")), "{waiting}");
    let (_, table, _) = manager.resource(&["explain"])?;
    ensure!(table.starts_with("AHEAD") && table.contains("Fixture"), "{table}");
    ensure!(manager.json(&["sessions"])?.as_array().map(Vec::len) == Some(2));
    let (code, _, err) = manager.resource(&["explain", "nobody"])?;
    ensure!(code == Some(1) && err.contains("nobody"), "{err}");
    waiter.process()?.kill()?;
    wait_for("the waiter to be gone", || {
        Ok(manager.json(&["explain"])?.as_array().is_some_and(Vec::is_empty).then_some(()))
    })?;
    holder.signal(Signal::SIGINT)?;
    let (code, _, said) = holder.finish()?;
    ensure!(code == Some(0), "{code:?} {said}");
    ensure!(manager.free("f1")? == 1);

    // However it ends: a killed one is free once its session has expired.
    let holder = manager.place.start_as("killed", &["resource", "block", "Fixture"])?;
    wait_for("the block", || Ok((manager.free("f1")? == 0).then_some(()))).with_context(|| holder.said())?;
    holder.process()?.kill()?;
    wait_for("the lease to expire", || Ok((manager.free("f1")? == 1).then_some(())))
}

#[test]
fn what_cannot_be_deleted_or_is_there_otherwise_is_said_of_each() -> anyhow::Result<()> {
    let manager = Manager::start()?;
    for id in ["f1", "f2"] {
        manager.json(&["create", "Fixture", "--id", id])?;
    }
    // Every one is tried, and what happened is said of each.
    let (code, out, err) = manager.resource(&["delete", "f1", "nope", "f2"])?;
    ensure!(code == Some(1) && out == "f1\nf2\n" && err.contains("`nope` is not deleted"), "{code:?} {out} {err}");
    // One of a kind.
    manager.json(&["create", "Fixture", "--id", "f3"])?;
    let (code, out, err) = manager.resource(&["delete", "--kind", "Fixture"])?;
    ensure!(code == Some(0) && out == "f3\n", "{code:?} {out} {err}");
    ensure!(manager.resource(&["delete", "--kind", "Fixture"])?.0 == Some(1));

    let create = ["create", "Fixture", "--id", "f4", "--attribute"];
    manager.json(&[create.as_slice(), &["a=1"]].concat())?;
    manager.json(&[create.as_slice(), &["a=1"]].concat())?;
    let (code, _, err) = manager.resource(&[create.as_slice(), &["a=2"]].concat())?;
    ensure!(code == Some(1) && err.contains("a=1") && err.contains("--update"), "{code:?} {err}");
    ensure!(manager.json(&["get", "f4"])?["attributes"]["a"] == 1);
    ensure!(manager.json(&[create.as_slice(), &["a=2", "--update"]].concat())?["attributes"]["a"] == 2);
    let (code, _, err) = manager.resource(&["create", "Fixture", "--attribute", "a=1", "--attribute", "a=2"])?;
    ensure!(code == Some(2) && err.contains("given twice"), "{code:?} {err}");
    ensure!(manager.resource(&["create", "bad kind"])?.0 == Some(2));
    Ok(())
}

#[test]
fn whoever_holds_what_an_operator_takes_away_hears_it_and_its_program_ends() -> anyhow::Result<()> {
    let manager = Manager::start()?;
    manager.json(&["create", "Tool", "--id", "t1"])?;
    let works =
        |name: &str, what: &str| manager.place.start_as(name, &["resource", "block", "Tool", "--", "sh", "-c", what]);
    let lease = || wait_for("the block", || Ok(manager.json(&["get", "t1"])?["holdings"][0]["lease"].as_u64()));

    // Asked to end, and what it started with it; one that does not is killed.
    let ended = manager.place.path().join("ended");
    let polite = format!("trap 'echo $? > {}; exit 3' TERM; sleep 600 & wait", ended.display());
    let mut holder = works("released", &polite)?;
    manager.json(&["release", &lease()?.to_string()])?;
    let (code, _, err) = holder.finish()?;
    ensure!(code == Some(75) && err.contains("was released by another"), "{code:?} {err}");
    ensure!(ended.exists(), "{err}");
    let mut holder = works("deleted", "trap '' TERM; while true; do sleep 1; done")?;
    lease()?;
    manager.json(&["delete", "t1"])?;
    let (code, _, err) = holder.finish()?;
    ensure!(code == Some(75) && err.contains("`t1` was deleted") && err.contains("is killed"), "{code:?} {err}");

    // And without a program.
    manager.json(&["create", "Tool", "--id", "t1"])?;
    let mut holder = manager.place.start_as("bare", &["resource", "block", "Tool"])?;
    manager.json(&["release", &lease()?.to_string()])?;
    let (code, _, err) = holder.finish()?;
    ensure!(code == Some(75) && err.contains("was released by another"), "{code:?} {err}");
    Ok(())
}

/// Processes of a command line that are there, without those that nobody has waited for yet.
fn alive(marker: &str) -> usize {
    let has = |pid: &str| {
        let line = std::fs::read(format!("/proc/{pid}/cmdline")).unwrap_or_default();
        String::from_utf8_lossy(&line).contains(marker)
    };
    let processes =
        std::fs::read_dir("/proc").into_iter().flatten().filter_map(|entry| entry.ok()?.file_name().into_string().ok());
    processes.filter(|pid| pid.bytes().all(|digit| digit.is_ascii_digit()) && has(pid)).count()
}

#[test]
fn a_program_is_ended_before_what_it_holds_can_be_anothers_also_when_the_manager_hangs_and_it_ignores_sigterm()
-> anyhow::Result<()> {
    let manager = Manager::start()?;
    manager.json(&["create", "Tool", "--id", "t1"])?;
    let marker = format!("{}-stubborn", manager.place.path().display());
    // Neither the program nor what it starts in the background ends by itself.
    let stubborn = format!(
        "trap '' TERM; : {marker}; sh -c 'trap \"\" TERM; : {marker}; sleep 600' & while true; do sleep 1; done"
    );
    let arguments = ["resource", "block", "Tool", "--", "sh", "-c", &stubborn];
    let mut holder = manager.place.start_as("holder", &arguments)?;
    wait_for("the program", || Ok((alive(&marker) >= 3).then_some(())))?;
    manager.process.signal(Signal::SIGSTOP)?;
    let (code, _, err) = holder.finish()?;
    ensure!(code == Some(75) && err.contains("was not heard for 7 s") && err.contains("is killed"), "{code:?} {err}");
    // The manager has not gone on: nobody else can have it yet.
    ensure!(alive(&marker) == 0, "something of the program is left");
    manager.process.signal(Signal::SIGCONT)?;
    let next = manager.place.ratn(&["resource", "block", "Tool", "--", "true"]).output()?;
    ensure!(next.status.success(), "{:?}", texts(&next));
    Ok(())
}

#[test]
fn a_program_whose_lease_is_taken_away_is_ended_before_the_next_begins_where_the_resource_asks_for_it()
-> anyhow::Result<()> {
    let manager = Manager::start()?;
    manager.json(&["create", "Tool", "--id", "t1", "--attribute", "standstill_ms=20000"])?;
    let pid = manager.place.path().join("pid");
    let stubborn = format!("trap '' TERM; echo $$ > {}; while true; do sleep 1; done", pid.display());
    let mut holder = manager.place.start_as("holder", &["resource", "block", "Tool", "--", "sh", "-c", &stubborn])?;
    wait_for("the program", || Ok(std::fs::read_to_string(&pid).is_ok_and(|pid| pid.ends_with('\n')).then_some(())))?;
    let lease = manager.json(&["get", "t1"])?["holdings"][0]["lease"].as_u64().context("a lease")?;
    // Fails where the program of the one before is still there.
    let look = format!("kill -0 $(cat {}) && exit 9; exit 0", pid.display());
    let mut next = manager.place.start_as("next", &["resource", "block", "Tool", "--", "sh", "-c", &look])?;
    wait_for("the waiter", || Ok((manager.json(&["explain"])?[0]["request"].is_string()).then_some(())))?;
    manager.json(&["release", &lease.to_string()])?;
    wait_for("the end", || Ok(manager.json(&["get", "t1"])?["ending"][0]["lease"].as_u64()))?;
    let why = manager.json(&["explain"])?.to_string();
    ensure!(why.contains("is ending"), "{why}");
    let (code, _, err) = holder.finish()?;
    ensure!(code == Some(75) && err.contains("is killed"), "{code:?} {err}");
    // Well before the bound has passed: the holder has confirmed.
    let (code, out, err) = next.finish()?;
    ensure!(code == Some(0), "{code:?} {out} {err}");
    Ok(())
}

#[test]
fn who_waits_and_who_watches_goes_on_with_the_manager_that_comes_back() -> anyhow::Result<()> {
    let place = Place::new()?;
    let start = |name: &str| {
        let endpoint = place.path().join("run/resource-manager.endpoint");
        let _ = std::fs::remove_file(&endpoint);
        let process = place.start_as(name, &["resource-manager"])?;
        wait_for("the manager", || Ok(endpoint.exists().then_some(()))).with_context(|| process.said())?;
        anyhow::Ok(process)
    };
    let resource = |arguments: &[&str]| -> anyhow::Result<String> {
        let output = place.ratn(&[&["resource"], arguments].concat()).output()?;
        ensure!(output.status.success(), "{arguments:?}: {:?}", texts(&output));
        Ok(texts(&output).0)
    };
    let waiting = || {
        wait_for("the waiter", || {
            let waiting: Value = serde_json::from_str(&resource(&["explain", "--json"])?)?;
            Ok(waiting[0]["request"].as_str().map(str::to_owned))
        })
    };
    let mut manager = start("first")?;
    resource(&["create", "Tool", "--id", "t1"])?;
    let mut watch = place.start_as("watch", &["resource", "watch", "--json"])?;
    let mut holder = place.start_as("holder", &["resource", "block", "Tool"])?;
    wait_for("the block", || Ok(resource(&["list"])?.contains("lease").then_some(())))?;
    let mut waiter = place.start_as("waiter", &["resource", "block", "Tool", "--", "echo", "worked"])?;
    let request = waiting()?;
    for (name, signal) in [("second", Signal::SIGTERM), ("third", Signal::SIGKILL)] {
        manager.signal(signal)?;
        manager.finish()?;
        manager = start(name)?;
        // The same request, though the queue was forgotten.
        ensure!(waiting().with_context(|| waiter.said())? == request);
    }
    holder.signal(Signal::SIGINT)?;
    holder.finish()?;
    let (code, out, err) = waiter.finish()?;
    ensure!(code == Some(0) && out.contains("worked"), "{code:?} {out} {err}");
    let seen = || std::fs::read_to_string(place.path().join("watchout")).unwrap_or_default();
    let released = |line: &Value| line["event"] == "released" && line["resource"]["id"] == "t1";
    let read =
        |all: &str| all.lines().filter_map(|line| serde_json::from_str::<Value>(line).ok()).filter(released).count();
    wait_for("both releases", || Ok((read(&seen()) == 2).then_some(()))).with_context(seen)?;
    watch.child.kill()?;
    Ok(())
}

#[test]
fn a_release_by_the_operator_and_every_other_mutation_is_in_the_audit_log() -> anyhow::Result<()> {
    let mut manager = Manager::start()?;
    manager.json(&["create", "Fixture", "--id", "the-fixture"])?;
    let mut holder = manager.place.start_as("holder", &["resource", "block", "Fixture"])?;
    let lease = wait_for("the block", || Ok(manager.json(&["get", "the-fixture"])?["holdings"][0]["lease"].as_u64()))?;
    ensure!(manager.resource(&["release", &lease.to_string()])?.0 == Some(0));
    let (code, _, err) = manager.resource(&["release", &lease.to_string()])?;
    ensure!(code == Some(1) && err.contains("had ended before"), "{err}");
    ensure!(manager.resource(&["delete", "nothing"])?.0 == Some(1));
    ensure!(holder.finish()?.0 == Some(75));
    manager.process.signal(Signal::SIGTERM)?;
    let (code, _, said) = manager.process.finish()?;
    ensure!(code == Some(0) && !said.contains("the-fixture"), "{code:?} {said}");

    let lines = std::fs::read_to_string(&manager.audit)?;
    let lines: Vec<Value> = lines.lines().map(serde_json::from_str).collect::<Result<_, _>>()?;
    let who = format!("uid {}", nix::unistd::geteuid());
    ensure!(lines.iter().all(|line| line["who"] == *who), "{lines:?}");
    let (sessions, lines): (Vec<Value>, Vec<Value>) =
        lines.into_iter().partition(|line| line["operation"].as_str().is_some_and(|name| name.ends_with("_session")));
    ensure!(sessions.iter().any(|line| line["operation"] == "open_session"), "{sessions:?}");
    let told: Vec<(&str, &str)> =
        lines.iter().filter_map(|line| Some((line["operation"].as_str()?, line["code"].as_str()?))).collect();
    let expected =
        [("create", "Ok"), ("acquire", "Ok"), ("release", "Ok"), ("release", "NotFound"), ("delete", "NotFound")];
    ensure!(told == expected, "{lines:?}");
    // Each command is a trace; that of the block came over its session's stream.
    let traces: std::collections::BTreeSet<&str> = lines.iter().filter_map(|line| line["trace"].as_str()).collect();
    ensure!(traces.len() == lines.len() && traces.iter().all(|trace| trace.len() == 32), "{lines:?}");
    ensure!(
        lines[1]["token"].as_u64() > Some(0)
            && lines[0]["what"].as_str().is_some_and(|what| what.contains("the-fixture"))
    );
    Ok(())
}

#[test]
fn a_watch_shows_what_is_there_and_what_happens() -> anyhow::Result<()> {
    let manager = Manager::start()?;
    let mut watch = manager.place.start_as("watch", &["resource", "watch", "--json"])?;
    let said = |name: &str| std::fs::read_to_string(manager.place.path().join(name)).unwrap_or_default();
    wait_for("the snapshot", || Ok(said("watchout").contains("snapshot").then_some(())))?;
    manager.json(&["create", "Fixture", "--id", "f1"])?;
    wait_for("the event", || {
        let out = said("watchout");
        let event = out.lines().nth(1).and_then(|line| serde_json::from_str::<Value>(line).ok());
        Ok(event.filter(|event| event["event"] == "created" && event["resource"]["id"] == "f1").map(|_| ()))
    })?;
    watch.child.kill()?;
    Ok(())
}

#[test]
fn without_a_manager_every_command_says_so() -> anyhow::Result<()> {
    let place = Place::new()?;
    for arguments in [["resource", "list"].as_slice(), &["resource", "block", "Arm"], &["resource", "watch"]] {
        let output = place.ratn(arguments).output()?;
        let err = texts(&output).1;
        ensure!(output.status.code() == Some(2) && err.contains("no resource-manager is running"), "{err}");
    }
    // Nor where an address is given and nobody listens.
    let nobody = format!("unix:{}", place.path().join("nobody.sock").display());
    for arguments in [["resource", "list"].as_slice(), &["resource", "exists", "Arm"]] {
        let output = place.ratn(&[arguments, &["--manager", &nobody]].concat()).output()?;
        let err = texts(&output).1;
        ensure!(output.status.code() == Some(2) && err.contains("does not answer"), "{:?} {err}", output.status);
    }
    Ok(())
}
