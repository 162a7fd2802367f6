//! Logs in etcd for tests.

use ratn_storage::etcd::{Bounds, Connect, Holder};
use ratn_storage::{Etcd, EtcdOptions};
use std::sync::Arc;
use std::time::Duration;
use tonic::transport::Endpoint;

/// Plain channels.
pub(crate) fn connect() -> Connect {
    Arc::new(|address: &str| {
        let endpoint = Endpoint::from_shared(address.to_owned()).map_err(|error| error.to_string())?;
        Ok(endpoint.connect_timeout(Duration::from_millis(300)).connect_lazy())
    })
}

pub(crate) fn options(endpoints: Vec<String>, prefix: &str, about: &str) -> EtcdOptions {
    EtcdOptions {
        endpoints,
        connect: connect(),
        prefix: prefix.to_owned(),
        holder: Holder { address: format!("http://{about}"), about: about.to_owned() },
        bounds: Bounds::default(),
        mark: None,
        accept_restored: None,
    }
}

pub(crate) fn store(endpoints: Vec<String>, prefix: &str, about: &str) -> Etcd {
    Etcd::new(options(endpoints, prefix, about)).unwrap()
}
