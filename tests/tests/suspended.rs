//! A holder that is suspended for longer than its session lives, and then goes on as if nothing had happened.

mod support;

use anyhow::{Context, ensure};
use nix::sys::signal::Signal;
use ratn_model::resource::{Lease, Requirement, ResourceOperation};
use ratn_proto::types::Goal;
use ratn_worker::client::{AcquireOptions, ActionClient, CallError, Channels, ResourceClient};
use ratn_worker::endpoint::Endpoint;
use ratn_worker::runtime_directory::RuntimeDirectory;
use ratn_worker::session::Session;
use ratn_worker::tls::ClientTls;
use std::io::{BufRead, BufReader, Write};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::Duration;
use support::{Place, wait_for};

/// Tells the holder where the system is.
const DIRECTORY: &str = "RATN_TEST_HOLDER";
const TTL: Duration = Duration::from_secs(1);
const PATIENCE: Duration = Duration::from_secs(60);
/// What both want: one of the cell, one of a worker.
const KINDS: [&str; 2] = ["Gripper", "PathPlanner"];
/// The gripper's action needs no input; the planner's refuses a goal without any, and has seen its token by then.
const ACTIONS: [&str; 2] = ["release", "plan"];

/// A session with both resources under one lease.
struct Holder {
    _session: Session,
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
        let block = |kind: &str| Requirement::new(ResourceOperation::Block, kind);
        let lease = resources.acquire(KINDS.map(block).to_vec(), AcquireOptions::default()).await?;
        Ok(Holder { _session: session, actions: ActionClient::new(channels), lease })
    }

    /// What becomes of a goal for each of the two.
    async fn give_goals(&self, name: &str) -> anyhow::Result<[String; 2]> {
        let mut said = Vec::new();
        for (kind, action) in KINDS.into_iter().zip(ACTIONS) {
            let resource = self.lease.resource(kind).context("it is leased")?;
            let endpoint: Endpoint = resource.endpoint.parse()?;
            let goal = Goal {
                id: format!("{name}/{action}"),
                action: action.to_owned(),
                lease: Some(self.lease.clone()),
                ..Goal::default()
            };
            said.push(match self.actions.execute(&endpoint, goal, |_, _| {}).await {
                Ok(outcome) => format!("{} {}", outcome.outcome, outcome.reason),
                Err(CallError::Refused { code, message, .. }) => format!("{code:?} {message}"),
                Err(error) => return Err(error.into()),
            });
        }
        <[String; 2]>::try_from(said).map_err(|_| anyhow::anyhow!("two goals"))
    }
}

/// The role of the holder: says its token, waits for a word, and uses what it believes to have. As a test it does nothing.
#[test]
fn holder() -> anyhow::Result<()> {
    let Some(directory) = std::env::var_os(DIRECTORY) else { return Ok(()) };
    let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().build()?;
    runtime.block_on(async {
        let holder = Holder::acquire(Path::new(&directory), "suspended").await?;
        println!("\ntoken {}", holder.lease.token.0);
        let mut word = String::new();
        std::io::stdin().lock().read_line(&mut word)?;
        for said in holder.give_goals("suspended").await? {
            println!("\nsaid {said}");
        }
        Ok(())
    })
}

/// A child that is resumed and killed with the test.
struct Suspended {
    child: Child,
    lines: std::io::Lines<BufReader<std::process::ChildStdout>>,
}

impl Suspended {
    fn start(directory: &Path) -> anyhow::Result<Suspended> {
        let mut child = Command::new(std::env::current_exe()?)
            .args(["--exact", "holder", "--nocapture"])
            .env(DIRECTORY, directory)
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()?;
        let lines = BufReader::new(child.stdout.take().context("a pipe")?).lines();
        Ok(Suspended { child, lines })
    }

    /// The rest of the next line that begins so.
    fn hear(&mut self, beginning: &str) -> anyhow::Result<String> {
        for line in &mut self.lines {
            if let Some(rest) = line?.strip_prefix(beginning) {
                return Ok(rest.trim().to_owned());
            }
        }
        anyhow::bail!("the holder ended without saying `{beginning}`")
    }

    fn signal(&self, signal: Signal) -> anyhow::Result<()> {
        Ok(nix::sys::signal::kill(nix::unistd::Pid::from_raw(i32::try_from(self.child.id())?), signal)?)
    }
}

impl Drop for Suspended {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

#[test]
fn a_holder_that_slept_past_its_time_to_live_is_refused_by_the_worker_and_by_the_cell() -> anyhow::Result<()> {
    let place = Place::new()?;
    let directory = place.path().join("run");
    let arguments = ["up", "--runtime-dir", directory.to_str().context("a path")?, "--planners", "1", "--boxes", "1"];
    let up = place.start(&arguments)?;
    wait_for("the system", || Ok(up.said().contains("is ready").then_some(()))).with_context(|| up.said())?;

    let mut suspended = Suspended::start(&directory)?;
    let token: u64 = suspended.hear("token")?.parse()?;
    suspended.signal(Signal::SIGSTOP)?;

    // Its lease ends with its session, and the next one in the queue has a larger token.
    let runtime = tokio::runtime::Runtime::new()?;
    let (next, said) = runtime.block_on(async {
        let next = tokio::time::timeout(PATIENCE, Holder::acquire(&directory, "next")).await??;
        let said = next.give_goals("next").await?;
        anyhow::Ok((next, said))
    })?;
    ensure!(next.lease.token.0 > token, "{:?} after {token}", next.lease);
    ensure!(said[0].starts_with("success"), "{said:?}");
    ensure!(said[1].starts_with("aborted") && !said[1].contains("lease"), "{said:?}");

    // It goes on where it was: whatever it believes, nothing is done for it.
    suspended.child.stdin.take().context("a pipe")?.write_all(b"go on\n")?;
    suspended.signal(Signal::SIGCONT)?;
    let (cell, worker) = (suspended.hear("said")?, suspended.hear("said")?);
    for refused in [&cell, &worker] {
        ensure!(refused.starts_with("FailedPrecondition") && refused.contains("is over"), "{cell}; {worker}");
        ensure!(refused.contains(&format!("{token})")), "it names the token {token}: {refused}");
    }
    Ok(())
}
