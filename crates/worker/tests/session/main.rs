//! Sessions and providers against a resource manager reduced to what they need of it (`manager`).
#![allow(clippy::unwrap_used, reason = "a test may panic")]

mod leases;
mod lifetime;
mod manager;
mod offers;
mod workers;

use ratn_model::resource::ResourceClass;
use ratn_proto::types::Resource;
use ratn_worker::client::Channels;
use ratn_worker::endpoint::Endpoint;
use ratn_worker::tls::ClientTls;
use std::time::Duration;

const LONG: Duration = Duration::from_secs(20);
const TTL: Duration = Duration::from_millis(200);

/// Where a manager can serve.
fn place() -> (tempfile::TempDir, Endpoint) {
    let directory = tempfile::tempdir().unwrap();
    let endpoint = Endpoint::Unix(directory.path().join("rm.sock"));
    (directory, endpoint)
}

fn channels() -> Channels {
    Channels::new(&ClientTls::none())
}

fn arm() -> Resource {
    Resource::new("arm@sim", ResourceClass::Module, "Arm").with_endpoint("unix:/cell.sock")
}
