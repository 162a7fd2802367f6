//! For tests of a worker: performs one goal of an action over a real socket, without a system.

use crate::action::{Action, ActionServer, Goal, GoalOutcome};
use crate::client::{ActionClient, Channels, chain};
use crate::endpoint::Endpoint;
use crate::server::{Exposure, Services, Serving, bind_as};
use crate::tls::ClientTls;
use ratn_model::value::Value;
use std::collections::BTreeMap;
use tokio_util::sync::CancellationToken;

/// Performs one goal with these inputs, `perform(Nearest, [("from", Value::Pose(pose))])`, and returns its outcome with its outputs. The goal
/// has no lease and no world pool. It starts a tokio runtime of its own: in an `async` test call [`performed`] instead.
///
/// # Errors
/// A sentence: why the goal was refused, or how the action crashed.
pub fn perform<const N: usize>(action: impl Action, inputs: [(&str, Value); N]) -> Result<GoalOutcome, String> {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build();
    runtime.map_err(|error| error.to_string())?.block_on(performed(action, inputs))
}

/// As [`perform`], on the tokio runtime of the caller.
///
/// # Errors
/// As [`perform`].
pub async fn performed<const N: usize>(action: impl Action, inputs: [(&str, Value); N]) -> Result<GoalOutcome, String> {
    let name = action.name().to_owned();
    let server = ActionServer::builder("").action(action);
    server.check().map_err(|error| chain(&error))?;
    let bound = bind_as(&Endpoint::loopback(), &Exposure::default()).await.map_err(|error| chain(&error))?;
    let (endpoint, shutdown) = (bound.endpoint().clone(), CancellationToken::new());
    let services = Services::new().with(server.build().into_service());
    let serving = tokio::spawn(bound.serve_as(services, Serving::default(), shutdown.clone()));
    let goal = Goal {
        id: "test/1/1".to_owned(),
        action: name,
        inputs: inputs.into_iter().map(|(port, value)| (port.to_owned(), value)).collect::<BTreeMap<_, _>>(),
        seed: 1,
        lease: None,
        session: String::new(),
        projection: None,
        world_pool: String::new(),
        deadline_ms: 0,
        grace_ms: 0,
        improves: None,
    };
    let client = ActionClient::new(Channels::new(&ClientTls::none()));
    let outcome = client.execute(&endpoint, goal, |_, _| {}).await.map_err(|error| chain(&error));
    shutdown.cancel();
    let _ = serving.await;
    outcome
}
