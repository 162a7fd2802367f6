//! An actor for the tests of this folder.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

use crate::durable_actor::Journal;
use crate::metrics::Metrics;
use crate::resource_manager::actor::{self, Handle};
use crate::resource_manager::{ROLE, ResourceManagerConfig, journal};
use ratn_storage::Log;
use std::sync::Arc;
use tempfile::TempDir;
use tokio::sync::watch;

/// Starts an actor whose log is in the directory; `change` may modify the log before it is opened.
pub(super) fn started(change: impl FnOnce(Log) -> Log) -> (Handle, TempDir) {
    let (config, directory) = (ResourceManagerConfig::default(), tempfile::tempdir().unwrap());
    let log = change(Journal::log(&config.storage, directory.path()));
    let kept = journal::open(&config.storage, Arc::new(log), config.limits.clone()).unwrap();
    let signals = watch::Sender::new(config).subscribe();
    let metrics = Arc::new(Metrics::new(ROLE));
    let (actor, _) =
        actor::start(signals, kept, Default::default(), Default::default(), metrics, Default::default()).unwrap();
    (actor, directory)
}
