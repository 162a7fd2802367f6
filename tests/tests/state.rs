//! `ratn state …`: the state of a resource manager or a world pool that runs is copied, put back, and looked at.

mod support;

use anyhow::{Context, ensure};
use nix::sys::signal::Signal;
use ratn_model::fact::{Change, FactKey};
use ratn_model::id::Revision;
use ratn_model::value::Value;
use ratn_worker::client::{Channels, WorldClient};
use ratn_worker::endpoint::Endpoint;
use ratn_worker::tls::ClientTls;
use std::path::{Path, PathBuf};
use support::{Place, Started, texts, wait_for};

struct Cell {
    place: Place,
}

impl Cell {
    fn path(&self, name: &str) -> String {
        self.place.path().join(name).display().to_string()
    }

    /// A resource manager that keeps its state in this folder.
    fn manager(&self, state: &str) -> anyhow::Result<Started> {
        self.daemon("resource-manager", state)
    }

    fn daemon(&self, role: &str, state: &str) -> anyhow::Result<Started> {
        let process = self.place.start_as(state, &[role, "--state-dir", &self.path(state)])?;
        let endpoint = self.place.path().join(format!("run/{role}.endpoint"));
        wait_for("the daemon", || Ok(endpoint.exists().then_some(()))).with_context(|| process.said())?;
        Ok(process)
    }

    fn end(&self, mut manager: Started) -> anyhow::Result<()> {
        manager.signal(Signal::SIGTERM)?;
        manager.child.wait()?;
        Ok(())
    }

    fn ratn(&self, arguments: &[&str]) -> anyhow::Result<(Option<i32>, String, String)> {
        let output = self.place.ratn(arguments).output()?;
        let (out, err) = texts(&output);
        Ok((output.status.code(), out, err))
    }

    fn json(&self, arguments: &[&str]) -> anyhow::Result<serde_json::Value> {
        let (code, out, err) = self.ratn(&[arguments, &["--json"]].concat())?;
        ensure!(code == Some(0), "{code:?}\n{out}\n{err}");
        Ok(serde_json::from_str(&out)?)
    }

    fn exists(&self, kind: &str) -> anyhow::Result<bool> {
        Ok(self.ratn(&["resource", "exists", kind])?.0 == Some(0))
    }
}

#[test]
fn a_backup_of_a_running_manager_is_put_back_and_what_came_later_is_gone() -> anyhow::Result<()> {
    let cell = Cell { place: Place::new()? };
    let manager = cell.manager("first")?;
    ensure!(cell.ratn(&["resource", "create", "Arm"])?.0 == Some(0));
    let (state, backup) = (cell.path("first/resource-manager"), cell.path("backup"));
    let copied = cell.json(&["state", "backup", &state, &backup])?;
    ensure!(copied["through"].as_u64() > Some(0), "{copied}");
    ensure!(cell.ratn(&["resource", "create", "Base"])?.0 == Some(0));
    ensure!(cell.exists("Base")?);
    cell.end(manager)?;

    let (code, _, err) = cell.ratn(&["state", "restore", &backup, &state])?;
    ensure!(code == Some(2) && err.contains("not empty"), "nothing is overwritten: {code:?} {err}");
    let (code, out, err) = cell.ratn(&["state", "restore", &backup, &cell.path("second/resource-manager")])?;
    ensure!(code == Some(0), "{out}{err}");
    let manager = cell.manager("second")?;
    ensure!(cell.exists("Arm")?, "it was there when the backup was made");
    ensure!(!cell.exists("Base")?, "it came later");
    cell.end(manager)
}

#[test]
fn a_backup_of_a_running_world_pool_has_its_facts() -> anyhow::Result<()> {
    let cell = Cell { place: Place::new()? };
    let asking = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
    let endpoint: Endpoint = format!("unix:{}", cell.path("run/world-pool.sock")).parse()?;
    let world = || WorldClient::new(&Channels::new(&ClientTls::none()), &endpoint);
    let set = |value| {
        let fact = FactKey { predicate: "at".to_owned(), arguments: Vec::new() };
        vec![Change::Set { fact, value: Value::Int(value) }]
    };
    let pool = cell.daemon("world-pool", "first")?;
    asking.block_on(async { world()?.commit("one", set(1), None).await })?;
    let (state, backup) = (cell.path("first/world-pool"), cell.path("backup"));
    ensure!(cell.json(&["state", "backup", &state, &backup])?["through"] == 1);
    asking.block_on(async { world()?.commit("two", set(2), None).await })?;
    ensure!(cell.json(&["state", "show", &state])?["records"]["count"] == 2);
    cell.end(pool)?;

    ensure!(cell.ratn(&["state", "restore", &backup, &cell.path("second/world-pool")])?.0 == Some(0));
    let pool = cell.daemon("world-pool", "second")?;
    let (revision, facts) = asking.block_on(async { world()?.root().await })?;
    ensure!(revision == Revision(1) && facts.len() == 1 && facts[0].value == Value::Int(1), "{revision} {facts:?}");
    cell.end(pool)
}

#[test]
fn a_state_is_shown_with_what_a_crash_left_unfinished_and_what_is_none_is_refused() -> anyhow::Result<()> {
    let cell = Cell { place: Place::new()? };
    let mut manager = cell.manager("state")?;
    ensure!(cell.ratn(&["resource", "create", "Arm"])?.0 == Some(0));
    manager.signal(Signal::SIGKILL)?;
    manager.child.wait()?;
    let state = cell.path("state/resource-manager");
    let shown = cell.json(&["state", "show", &state])?;
    ensure!(shown["records"]["count"].as_u64() > Some(0) && shown["torn"].is_null(), "{shown}");
    append(&segment(Path::new(&state))?, b"torn")?;
    let (code, out, _) = cell.ratn(&["state", "show", &state])?;
    ensure!(code == Some(0) && out.contains("unfinished"), "{code:?} {out}");
    let (code, _, err) = cell.ratn(&["state", "backup", &cell.path("run"), &cell.path("nothing")])?;
    ensure!(code == Some(2) && err.contains("no log"), "{code:?} {err}");
    ensure!(!Path::new(&cell.path("nothing")).exists());
    Ok(())
}

fn segment(state: &Path) -> anyhow::Result<PathBuf> {
    let entries: Vec<PathBuf> = std::fs::read_dir(state)?.flatten().map(|entry| entry.path()).collect();
    let segments = entries.into_iter().filter(|path| path.extension().is_some_and(|extension| extension == "log"));
    segments.max().context("a segment")
}

fn append(file: &Path, bytes: &[u8]) -> anyhow::Result<()> {
    use std::io::Write;
    Ok(std::fs::OpenOptions::new().append(true).open(file)?.write_all(bytes)?)
}
