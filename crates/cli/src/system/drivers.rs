//! The drivers of a system: processes that move something, and serve emergency stop and hold for it.
//!
//! A driver offers a resource of class module, or a process with a standstill bound.

use futures::future::join_all;
use ratn_daemon::resource_manager;
use ratn_model::resource::ResourceClass;
use ratn_proto::types::{Resource, ResourceFilter};
use ratn_worker::client::{CallError, Channels, ResourceClient};
use ratn_worker::endpoint::Endpoint;
use ratn_worker::runtime_directory::RuntimeDirectory;
use ratn_worker::safety::{SafetyClient, SafetyState};
use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;
use tokio::time::timeout;

/// The safety state of each driver, or why it is unknown.
pub(crate) type Answers = BTreeMap<Endpoint, Result<SafetyState, String>>;

/// The drivers of these resources.
pub(crate) fn among<'a>(resources: impl IntoIterator<Item = &'a Resource>) -> BTreeSet<Endpoint> {
    let moves = |resource: &&Resource| match resource.class {
        ResourceClass::Module => true,
        ResourceClass::Process => resource.standstill().is_some(),
        _ => false,
    };
    resources.into_iter().filter(moves).filter_map(|resource| resource.endpoint().parse().ok()).collect()
}

/// The drivers that the resource manager lists.
///
/// # Errors
/// Why there is no list; also where there is no answer within `patience`.
pub(crate) async fn offered(
    channels: &Channels,
    directory: &RuntimeDirectory,
    patience: Duration,
) -> Result<BTreeSet<Endpoint>, String> {
    let manager = directory.find(resource_manager::ROLE).map_err(|error| error.to_string())?;
    let client = ResourceClient::new(channels, &manager, "").map_err(|error| error.to_string())?;
    let of = |class| client.list_where(ResourceFilter { class: Some(class), ..ResourceFilter::default() });
    let both = async { tokio::try_join!(of(ResourceClass::Module), of(ResourceClass::Process)) };
    let listed = timeout(patience, both).await.map_err(|_| "the resource manager does not answer".to_owned())?;
    let (modules, processes) = listed.map_err(|error: CallError| error.to_string())?;
    Ok(among(modules.iter().chain(&processes)))
}

/// Asks all of them at once, and waits for each no longer than `patience`.
pub(crate) async fn ask(
    channels: &Channels,
    drivers: &BTreeSet<Endpoint>,
    patience: Duration,
    question: impl AsyncFn(SafetyClient) -> Result<SafetyState, CallError>,
) -> Answers {
    let one = async |endpoint: &Endpoint| {
        let asked = async { question(SafetyClient::new(channels, endpoint)?).await };
        let answer = match timeout(patience, asked).await {
            Ok(answer) => answer.map_err(|error| error.to_string()),
            Err(_) => Err(format!("no answer within {} s", patience.as_secs())),
        };
        (endpoint.clone(), answer)
    };
    join_all(drivers.iter().map(one)).await.into_iter().collect()
}
