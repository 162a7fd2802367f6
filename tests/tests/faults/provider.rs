//! A provider of one tool as a process of its own, which writes down every moment in which it moves, and for whom.
//!
//! It moves in small steps. Each step is a line in a file that all of its lives append to: the goal, the lease, the token, and the time
//! of the machine's monotonic clock. So mutual exclusion is measured where the work is done, not where it is granted.

use crate::support::Place;
use anyhow::Context;
use nix::sys::signal::Signal;
use ratn_model::resource::ResourceClass;
use ratn_proto::types::{GoalOutcome, Resource};
use ratn_worker::action::{Action, ActionFailure, ActionResult, ActionServer, GoalContext};
use ratn_worker::client::Channels;
use ratn_worker::endpoint::Endpoint;
use ratn_worker::lease_watch::LeaseWatch;
use ratn_worker::provider::Provider;
use ratn_worker::server::{Services, bind};
use ratn_worker::session::Session;
use ratn_worker::tls::ClientTls;
use std::fs::{File, OpenOptions};
use std::io::Write;
use std::path::PathBuf;
use std::process::{Child, Command, Stdio};
use std::time::Duration;
use tokio_util::sync::CancellationToken;

/// The resource, and its kind.
pub(crate) const TOOL: &str = "tool";
pub(crate) const KIND: &str = "Tool";
/// The time to live of the provider's session, and how long it trusts leases while it does not hear the manager.
pub(crate) const TTL: Duration = Duration::from_millis(400);

/// The bound within which the tool stands still; longer than a round, so that only the provider's word counts.
const BOUND: Duration = Duration::from_secs(60);

/// Tells a provider process where it serves, where the manager is and where it writes its steps.
const SOCKET: &str = "RATN_TEST_PROVIDER";
const MANAGER: &str = "RATN_TEST_MANAGER";
const STEPS: &str = "RATN_TEST_STEPS";
/// Between two steps.
const STEP: Duration = Duration::from_millis(3);
const AGAIN: Duration = Duration::from_millis(20);

/// A step of the tool.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Step {
    pub(crate) goal: String,
    pub(crate) lease: u64,
    pub(crate) token: u64,
    pub(crate) at: u64,
}

/// A provider process that is killed, suspended and started again.
pub(crate) struct Tool {
    socket: PathBuf,
    steps: PathBuf,
    said: PathBuf,
    manager: Endpoint,
    process: Option<Child>,
}

impl Tool {
    pub(crate) fn start(place: &Place, manager: Endpoint) -> anyhow::Result<Tool> {
        let path = |name: &str| place.path().join(name);
        let mut tool =
            Tool { socket: path("tool.sock"), steps: path("steps"), said: path("toolerr"), manager, process: None };
        tool.start_again()?;
        Ok(tool)
    }

    pub(crate) fn socket(&self) -> PathBuf {
        self.socket.clone()
    }

    pub(crate) fn start_again(&mut self) -> anyhow::Result<()> {
        if self.process.is_some() {
            return Ok(());
        }
        let said = OpenOptions::new().create(true).append(true).open(&self.said)?;
        let child = Command::new(std::env::current_exe()?)
            .args(["--exact", "a_provider", "--nocapture"])
            .env(SOCKET, &self.socket)
            .env(MANAGER, self.manager.to_string())
            .env(STEPS, &self.steps)
            .stdin(Stdio::null())
            .stdout(said.try_clone()?)
            .stderr(said)
            .spawn()?;
        self.process = Some(child);
        Ok(())
    }

    pub(crate) fn kill(&mut self) -> anyhow::Result<()> {
        if let Some(mut process) = self.process.take() {
            process.kill()?;
            process.wait()?;
        }
        Ok(())
    }

    pub(crate) fn signal(&self, signal: Signal) -> anyhow::Result<()> {
        let Some(process) = &self.process else { return Ok(()) };
        Ok(nix::sys::signal::kill(nix::unistd::Pid::from_raw(i32::try_from(process.id())?), signal)?)
    }

    /// What all its lives have written to standard error.
    pub(crate) fn said(&self) -> String {
        std::fs::read_to_string(&self.said).unwrap_or_default()
    }

    /// Every step so far, in the order of time.
    pub(crate) fn steps(&self) -> anyhow::Result<Vec<Step>> {
        let text = std::fs::read_to_string(&self.steps).unwrap_or_default();
        // A process that was killed may have left a part of a line.
        let whole = text.rfind('\n').map_or("", |end| &text[..end]);
        whole.lines().map(|line| step(line).with_context(|| format!("no step: {line}"))).collect()
    }
}

impl Drop for Tool {
    fn drop(&mut self) {
        let _ = self.kill();
    }
}

fn step(line: &str) -> Option<Step> {
    let mut words = line.split(' ');
    let goal = words.next()?.to_owned();
    let [lease, token, at] = [words.next()?, words.next()?, words.next()?].map(|word| word.parse().ok());
    Some(Step { goal, lease: lease?, token: token?, at: at? })
}

/// The role of the provider's process; without being told to it does nothing.
pub(crate) fn serve() -> anyhow::Result<()> {
    let Some(socket) = std::env::var_os(SOCKET) else { return Ok(()) };
    let (manager, steps) = (std::env::var(MANAGER)?.parse()?, std::env::var(STEPS)?);
    let file = OpenOptions::new().create(true).append(true).open(steps)?;
    let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build()?;
    runtime.block_on(provide(PathBuf::from(socket), manager, file))
}

async fn provide(socket: PathBuf, manager: Endpoint, file: File) -> anyhow::Result<()> {
    let leases = LeaseWatch::of([TOOL]);
    // It moves by its steps alone, and they end with their process.
    leases.brought_to_rest();
    let server = ActionServer::builder(TOOL).action(Move { file }).one_at_a_time().leases(&leases).build();
    let bound = bind(&Endpoint::Unix(socket)).await?;
    let endpoint = bound.endpoint().clone();
    tokio::spawn(bound.serve(Services::new().with(server.into_service()), CancellationToken::new()));

    let channels = Channels::new(&ClientTls::none());
    let session = Session::open_as(&channels, &manager, KIND.to_owned(), KIND, TTL);
    let provider = Provider::start_at_rest(&channels, &manager, &session, &leases)?;
    let watching = leases.follow_session(&channels, &manager, &session, TTL)?;
    let resource = Resource::new(TOOL, ResourceClass::Module, KIND).with_endpoint(&endpoint);
    let resource = resource.with_standstill(BOUND);
    let offering = async {
        while let Err(error) = provider.offer(resource.clone()).await {
            eprintln!("not offered: {error}");
            tokio::time::sleep(AGAIN).await;
        }
    };
    tokio::join!(watching, offering);
    Ok(())
}

/// Moves for some milliseconds.
struct Move {
    file: File,
}

#[tonic::async_trait]
impl Action for Move {
    fn name(&self) -> &'static str {
        "move"
    }

    fn can_be_suspended(&self) -> bool {
        true
    }

    async fn execute(&self, goal: GoalContext) -> ActionResult {
        let steps = goal.optional_int("steps")?.unwrap_or(1);
        let lease = goal.lease.clone().ok_or_else(|| ActionFailure::aborted("no lease"))?;
        for _ in 0..steps {
            goal.while_held().await?;
            goal.checkpoint()?;
            let line = format!("{} {} {} {}\n", goal.id, lease.id.0, lease.token.0, super::history::now());
            (&self.file).write_all(line.as_bytes())?;
            tokio::time::sleep(STEP).await;
        }
        Ok(GoalOutcome::success())
    }
}
