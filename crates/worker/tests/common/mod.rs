//! A provider under test: a real server on a real socket, with actions that do what a test needs.
#![allow(dead_code, unreachable_pub, clippy::unwrap_used, reason = "a test may panic, and uses what it needs")]

use ratn_model::id::{FencingToken, LeaseId};
use ratn_model::resource::{Lease, LeasedResource};
use ratn_model::value::Value;
use ratn_proto::types::Goal;
use ratn_worker::action::{
    Action, ActionResult, ActionServer, ActionServerBuilder, CallFailure, GoalContext, GoalOutcome,
};
use ratn_worker::client::{ActionClient, Channels};
use ratn_worker::endpoint::Endpoint;
use ratn_worker::server::{DRAIN_DEADLINE, Services, Serving, bind};
use ratn_worker::tls::ClientTls;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Duration;
use tokio::sync::Notify;
use tokio::task::JoinHandle;
use tokio_util::sync::CancellationToken;

pub const RESOURCE: &str = "tester-1@here";

/// `double`: x → y = 2 x, with one progress message per run.
pub struct Double {
    pub runs: Arc<AtomicUsize>,
}

/// `wait`: says "waiting" and waits to be told to stop.
pub struct Wait {
    pub name: &'static str,
    pub abandon: bool,
    /// Told when a goal has ended.
    pub ended: Arc<Notify>,
}

/// `panic`: does.
pub struct Panic;

/// `trace`: says of which trace it is.
pub struct Trace;

/// `fill`: has as many bytes of text as x says; the length of its own text is in the reason.
pub struct Fill;

/// `relay`: has the lease's Doubler double x.
pub struct Relay;

/// `end`: comes to the outcome that it is told.
pub struct End;

/// `ask`: has the lease's Ender `end`, and wraps what comes of it.
pub struct Ask;

/// What `ask` makes of an end without success.
#[derive(Debug, thiserror::Error)]
#[error("asked in vain")]
pub struct InVain(#[from] CallFailure);

#[tonic::async_trait]
impl Action for Double {
    fn name(&self) -> &str {
        "double"
    }

    fn description(&self) -> &str {
        "twice as much"
    }

    async fn execute(&self, goal: GoalContext) -> ActionResult {
        let run = self.runs.fetch_add(1, Ordering::SeqCst) + 1;
        goal.progress(format!("run {run}"));
        let x = goal.input_float("x")?;
        Ok(GoalOutcome::success().with_output("y", Value::Float(2.0 * x)))
    }
}

#[tonic::async_trait]
impl Action for Wait {
    fn name(&self) -> &str {
        self.name
    }

    fn cancel_when_abandoned(&self) -> bool {
        self.abandon
    }

    async fn execute(&self, goal: GoalContext) -> ActionResult {
        goal.progress("waiting");
        goal.cancelled.cancelled().await;
        self.ended.notify_one();
        Err(goal.stopped())
    }
}

#[tonic::async_trait]
impl Action for Panic {
    fn name(&self) -> &str {
        "panic"
    }

    async fn execute(&self, _: GoalContext) -> ActionResult {
        panic!("on purpose")
    }
}

#[tonic::async_trait]
impl Action for Trace {
    fn name(&self) -> &str {
        "trace"
    }

    async fn execute(&self, _: GoalContext) -> ActionResult {
        let context = ratn_worker::trace::current().map_or_else(String::new, |context| context.to_string());
        Ok(GoalOutcome::success().with_output("trace", Value::String(context)))
    }
}

#[tonic::async_trait]
impl Action for Fill {
    fn name(&self) -> &str {
        "fill"
    }

    async fn execute(&self, goal: GoalContext) -> ActionResult {
        let (bytes, heard) = (goal.input_float("x")?, goal.input_string("text").map_or(0, str::len));
        let outcome = GoalOutcome::success().with_output("text", Value::String("x".repeat(bytes as usize)));
        Ok(GoalOutcome { reason: heard.to_string(), ..outcome })
    }
}

#[tonic::async_trait]
impl Action for Relay {
    fn name(&self) -> &str {
        "relay"
    }

    async fn execute(&self, goal: GoalContext) -> ActionResult {
        let outputs = goal.call("Doubler", "double", goal.inputs.clone()).await?;
        Ok(GoalOutcome { outputs, ..GoalOutcome::success() })
    }
}

#[tonic::async_trait]
impl Action for End {
    fn name(&self) -> &str {
        "end"
    }

    async fn execute(&self, goal: GoalContext) -> ActionResult {
        Ok(GoalOutcome { reason: "so".to_owned(), ..GoalOutcome::named(goal.input_string("outcome")?) })
    }
}

#[tonic::async_trait]
impl Action for Ask {
    fn name(&self) -> &str {
        "ask"
    }

    async fn execute(&self, goal: GoalContext) -> ActionResult {
        let outputs = goal.call("Ender", "end", goal.inputs.clone()).await.map_err(InVain)?;
        Ok(GoalOutcome { outputs, ..GoalOutcome::success() })
    }
}

/// A served provider.
pub struct Provider {
    pub endpoint: Endpoint,
    pub client: ActionClient,
    pub server: ActionServer,
    pub runs: Arc<AtomicUsize>,
    pub ended: Arc<Notify>,
    pub shutdown: CancellationToken,
    pub serving: JoinHandle<()>,
    _directory: tempfile::TempDir,
}

/// Serves the actions at `listen`, or at a fresh Unix socket.
pub async fn provider(listen: Option<Endpoint>) -> Provider {
    provider_with(listen, DRAIN_DEADLINE).await
}

/// As [`provider`], with a drain of its own.
pub async fn provider_with(listen: Option<Endpoint>, drain: Duration) -> Provider {
    let believing = |builder: ActionServerBuilder| builder.dangerously_believe_every_lease().results_kept(2);
    provider_built(listen, drain, believing).await
}

/// As [`provider`], built as it is said.
pub async fn provider_built(
    listen: Option<Endpoint>,
    drain: Duration,
    build: impl FnOnce(ActionServerBuilder) -> ActionServerBuilder,
) -> Provider {
    let directory = tempfile::tempdir().unwrap();
    let listen = listen.unwrap_or_else(|| Endpoint::Unix(directory.path().join("workers/one.sock")));
    let (runs, ended) = (Arc::new(AtomicUsize::new(0)), Arc::new(Notify::new()));
    let server = build(ActionServer::builder(RESOURCE))
        .one_at_a_time()
        .action(Double { runs: Arc::clone(&runs) })
        .action(Wait { name: "wait", abandon: true, ended: Arc::clone(&ended) })
        .action(Wait { name: "stay", abandon: false, ended: Arc::clone(&ended) })
        .action(Panic)
        .action(Trace)
        .action(Relay)
        .action(End)
        .action(Fill)
        .action(Ask)
        .build();
    let bound = bind(&listen).await.unwrap();
    let endpoint = bound.endpoint().clone();
    let shutdown = CancellationToken::new();
    let services = Services::new().with(server.clone().into_service());
    let serve = bound.serve_as(services, Serving { drain, ..Serving::default() }, shutdown.clone());
    let serving = tokio::spawn(async move { serve.await.unwrap() });
    let client = ActionClient::new(Channels::new(&ClientTls::none()));
    Provider { endpoint, client, server, runs, ended, shutdown, serving, _directory: directory }
}

/// A goal under a lease of the provider with this token.
pub fn goal(id: &str, action: &str, token: u64) -> Goal {
    Goal {
        id: id.to_owned(),
        action: action.to_owned(),
        inputs: [("x".to_owned(), Value::Float(21.0))].into(),
        lease: Some(lease(token, &[(RESOURCE, "Tester", "")])),
        ..Goal::default()
    }
}

pub fn lease(token: u64, resources: &[(&str, &str, &str)]) -> Lease {
    let resource = |(id, kind, endpoint): &(&str, &str, &str)| LeasedResource {
        id: (*id).to_owned(),
        kind: (*kind).to_owned(),
        endpoint: (*endpoint).to_owned(),
        superclasses: Vec::new(),
    };
    Lease {
        id: LeaseId(token),
        token: FencingToken(token),
        resources: resources.iter().map(resource).collect(),
        consumed: Vec::new(),
    }
}

/// Gives a goal and returns once it has said something; its result comes from the task.
pub async fn begin(provider: &Provider, goal: Goal) -> JoinHandle<Result<GoalOutcome, ratn_worker::client::CallError>> {
    let (client, endpoint, said) = (provider.client.clone(), provider.endpoint.clone(), Arc::new(Notify::new()));
    let tell = Arc::clone(&said);
    let task = tokio::spawn(async move { client.execute(&endpoint, goal, |_, _| tell.notify_one()).await });
    said.notified().await;
    task
}
