//! A holder of the arm is killed in the middle of a motion: the next one has the arm when it stands still.

mod support;

use anyhow::{Context, ensure};
use nix::sys::signal::Signal;
use ratn_model::resource::{Lease, Requirement, ResourceOperation};
use ratn_model::value::Value;
use ratn_proto::types::Goal;
use ratn_worker::client::{AcquireOptions, ActionClient, Channels, ResourceClient};
use ratn_worker::endpoint::Endpoint;
use ratn_worker::runtime_directory::RuntimeDirectory;
use ratn_worker::session::Session;
use ratn_worker::tls::ClientTls;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};
use support::host::Host;
use support::wait_for;
use tokio::runtime::Runtime;

/// Tells the holder where the system is.
const DIRECTORY: &str = "RATN_TEST_HOLDER";
const TTL: Duration = Duration::from_secs(1);
const PATIENCE: Duration = Duration::from_secs(60);
/// The cell's `standstill_ms` unless given.
const BOUND: Duration = Duration::from_secs(6);
/// Where the arm goes, and how slowly: for longer than a test takes.
const FAR: [f64; 7] = [0.9, -1.2, 0.0, 0.9, 0.0, -0.6, 0.0];
const SLOWLY: f64 = 0.01;

/// A session with the arm.
struct Holder {
    session: Session,
    resources: ResourceClient,
    actions: ActionClient,
    lease: Lease,
}

impl Holder {
    async fn acquire(directory: &Path, name: &str) -> anyhow::Result<Holder> {
        let (channels, manager) =
            (Channels::new(&ClientTls::none()), RuntimeDirectory::at(directory).find("resource-manager")?);
        let session = Session::open(&channels, &manager, name, TTL);
        session.alive(PATIENCE).await?;
        let resources = ResourceClient::new(&channels, &manager, session.id())?;
        let options = AcquireOptions { deadline: PATIENCE, ..AcquireOptions::default() };
        let lease = resources.block(Requirement::new(ResourceOperation::Block, "Arm"), options).await?;
        Ok(Holder { session, resources, actions: ActionClient::new(channels), lease })
    }

    /// Moves the arm at a fraction of its speed; how that ends.
    async fn moves(&self, name: &str, speed: f64) -> anyhow::Result<String> {
        let endpoint: Endpoint = self.lease.resource("Arm").context("it is leased")?.endpoint.parse()?;
        let inputs = [("joints", Value::Joints(FAR.to_vec())), ("speed", Value::Float(speed))];
        let goal = Goal {
            id: format!("{name}/move"),
            action: "move_to".to_owned(),
            inputs: inputs.map(|(port, value)| (port.to_owned(), value)).into(),
            lease: Some(self.lease.clone()),
            ..Goal::default()
        };
        Ok(self.actions.execute(&endpoint, goal, |_, _| {}).await?.outcome)
    }
}

/// The role of the holder: moves the arm until it is killed. As a test it does nothing.
#[test]
fn holder() -> anyhow::Result<()> {
    let Some(directory) = std::env::var_os(DIRECTORY) else { return Ok(()) };
    Runtime::new()?.block_on(async {
        let holder = Holder::acquire(Path::new(&directory), "holder").await?;
        holder.moves("holder", SLOWLY).await.map(drop)
    })
}

struct Killed(Child);

impl Drop for Killed {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// A system in whose cell another process moves the arm.
struct Moving {
    host: Host,
    directory: PathBuf,
    holder: Killed,
}

impl Moving {
    fn begin() -> anyhow::Result<Moving> {
        let host = Host::start()?;
        let directory = host.place.path().join("run");
        let holder = Command::new(std::env::current_exe()?)
            .args(["--exact", "holder", "--nocapture"])
            .env(DIRECTORY, &directory)
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .spawn()?;
        let moving = Moving { host, directory, holder: Killed(holder) };
        wait_for("the arm to move", || Ok((!moving.host.begun()?.is_empty()).then_some(())))?;
        ensure!(!moving.has_stopped()?, "it was to move for long");
        Ok(moving)
    }

    fn has_stopped(&self) -> anyhow::Result<bool> {
        let record = std::fs::read_to_string(self.host.place.path().join("cellerr"))?;
        Ok(record.lines().any(|line| line.contains("ended goal=holder/move")))
    }

    /// What is listed of the arm.
    fn arm(&self) -> Option<serde_json::Value> {
        let listed = self.host.json(&["resource", "list", "Arm", "--json"])?;
        Some(listed.get(0).cloned().unwrap_or_default())
    }

    /// The next holder uses it, and gives it back.
    async fn goes_on(&self, next: Holder) -> anyhow::Result<()> {
        ensure!(next.moves("next", 1.0).await? == "success");
        let begun = self.host.begun()?;
        ensure!(begun == ["holder/move", "next/move"], "{begun:?}");
        next.resources.release(next.lease.id).await?;
        next.session.close().await;
        Ok(())
    }
}

#[test]
fn the_next_holder_has_the_arm_when_it_stands_still_and_well_before_the_bound() -> anyhow::Result<()> {
    let mut moving = Moving::begin()?;
    moving.holder.0.kill()?;
    ensure!(!moving.has_stopped()?, "it was to be killed in mid motion");
    let killed = Instant::now();
    Runtime::new()?.block_on(async {
        let next = Holder::acquire(&moving.directory, "next").await?;
        ensure!(moving.has_stopped()?, "it was granted while the arm moved");
        ensure!(killed.elapsed() < BOUND, "{:?}: that was the bound", killed.elapsed());
        moving.goes_on(next).await
    })
}

#[test]
fn while_the_cell_is_suspended_nobody_has_the_arm() -> anyhow::Result<()> {
    // For less and for longer than the cell's own session lives.
    for until_gone in [false, true] {
        let mut moving = Moving::begin()?;
        let runtime = Runtime::new()?;
        moving.host.signal("cell", Signal::SIGSTOP)?;
        moving.holder.0.kill()?;
        let directory = moving.directory.clone();
        let next = runtime.spawn(async move { Holder::acquire(&directory, "next").await });
        wait_for("the end of the holder's lease", || {
            let Some(arm) = moving.arm() else { return Ok(None) };
            let is_there = arm["id"].is_string();
            let is_over = arm["holdings"].as_array().is_none_or(Vec::is_empty);
            Ok((is_over && !(until_gone && is_there)).then_some(()))
        })?;
        std::thread::sleep(Duration::from_millis(300));
        ensure!(!moving.has_stopped()?, "it was to be suspended in mid motion");
        if next.is_finished() {
            let granted = runtime.block_on(next)??.lease;
            anyhow::bail!("{granted:?} was granted while the cell was suspended: {:?}", moving.arm());
        }
        moving.host.signal("cell", Signal::SIGCONT)?;
        runtime.block_on(async {
            let next = tokio::time::timeout(PATIENCE, next).await???;
            ensure!(moving.has_stopped()?, "it was granted while the arm moved");
            moving.goes_on(next).await
        })?;
    }
    Ok(())
}
