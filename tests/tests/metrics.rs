//! What a resource manager shows to Prometheus after a little has happened.

mod support;

use anyhow::{Context, ensure};
use std::collections::BTreeMap;
use std::io::{Read, Write};
use std::net::TcpStream;
use support::{Place, wait_for};

/// The samples of a page by name and labels.
fn scrape(address: &str) -> anyhow::Result<BTreeMap<String, f64>> {
    let mut connection = TcpStream::connect(address)?;
    connection.write_all(b"GET /metrics HTTP/1.1\r\nHost: localhost\r\n\r\n")?;
    let mut page = String::new();
    connection.read_to_string(&mut page)?;
    let (head, body) = page.split_once("\r\n\r\n").context("no body")?;
    ensure!(head.starts_with("HTTP/1.1 200 OK") && body.ends_with("# EOF\n"), "{page}");
    let samples = body.lines().filter(|line| !line.starts_with('#'));
    samples
        .map(|line| {
            let (name, value) = line.rsplit_once(' ').with_context(|| format!("no sample: {line}"))?;
            Ok((name.to_owned(), value.parse()?))
        })
        .collect()
}

#[test]
fn what_happened_is_counted_and_what_is_there_is_shown() -> anyhow::Result<()> {
    let place = Place::new()?;
    let manager = place.start_as("manager", &["resource-manager", "--metrics", "127.0.0.1:0"])?;
    let address = wait_for("the metrics", || {
        let said = manager.said();
        let address = said.split("metrics are at http://").nth(1).and_then(|rest| rest.split('/').next());
        Ok(address.map(str::to_owned))
    })?;
    let endpoint = place.path().join("run/resource-manager.endpoint");
    wait_for("the manager", || Ok(endpoint.exists().then_some(()))).with_context(|| manager.said())?;
    let resource = |arguments: &[&str]| place.ratn(&[&["resource"], arguments].concat()).output();

    resource(&["create", "Fixture", "--id", "f1"])?;
    ensure!(resource(&["release", "77"])?.status.code() == Some(1));
    let holder = place.start_as("holder", &["resource", "block", "Fixture"])?;
    let shown = wait_for("the lease", || Ok(Some(scrape(&address)?).filter(|shown| shown["ratn_leases"] == 1.0)))
        .with_context(|| holder.said())?;
    let call = |method: &str, code: &str| {
        let labels = format!("service=\"ratn.v1.ResourceService\",method=\"{method}\",code=\"{code}\"");
        shown.get(&format!("ratn_rpc_duration_seconds_count{{{labels}}}")).copied()
    };
    ensure!(shown["ratn_resources"] == 1.0 && shown["ratn_sessions"] == 1.0 && shown["ratn_waiters"] == 0.0);
    ensure!(call("Create", "OK") == Some(1.0), "{shown:?}");
    ensure!(shown["ratn_refusals_total{operation=\"release\",reason=\"LEASE_UNKNOWN\"}"] == 1.0, "{shown:?}");
    ensure!(shown["ratn_journal_entries_total"] >= 3.0 && shown["ratn_journal_commits_total"] >= 1.0, "{shown:?}");
    ensure!(shown["ratn_journal_appended_bytes_total"] > 0.0 && shown["ratn_journal_failed"] == 0.0);
    // The grant is counted when it has left, and its call on the session's stream like any other.
    wait_for("the grant", || {
        let shown = scrape(&address)?;
        Ok((shown["ratn_grants_total"] == 1.0 && shown["ratn_queue_wait_seconds_count"] == 1.0).then_some(()))
    })?;

    // One that waits is shown, and a killed holder's lease goes with its session.
    let waiter = place.start_as("waiter", &["resource", "block", "Fixture"])?;
    wait_for("the waiter", || Ok((scrape(&address)?["ratn_waiters"] == 1.0).then_some(())))
        .with_context(|| waiter.said())?;
    holder.process()?.kill()?;
    wait_for("the next grant", || Ok((scrape(&address)?["ratn_grants_total"] == 2.0).then_some(())))?;
    Ok(())
}

#[test]
fn metrics_are_not_shown_to_other_machines_unless_it_is_said() -> anyhow::Result<()> {
    let place = Place::new()?;
    let mut manager = place.start_as("manager", &["resource-manager", "--metrics", "0.0.0.0:0"])?;
    let (code, _, said) = manager.finish()?;
    ensure!(code == Some(2) && said.contains("--insecure"), "{code:?} {said}");
    Ok(())
}
