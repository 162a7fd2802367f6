//! `watch`: the resources, then every change. After a restart of the manager, the watch continues from the last change that
//! was shown.

use super::{Asking, show};
use crate::output;
use anyhow::Context;
use ratn_proto::types::{ResourceUpdate, WatchPosition};
use ratn_worker::client::{CallError, ResourceWatch};
use std::time::{Duration, Instant};

/// A manager that is unreachable for longer ends the watch.
const PATIENCE: Duration = Duration::from_secs(60);
/// Pause before a broken watch is opened again.
const AGAIN: Duration = Duration::from_millis(250);

/// Runs until the reader closes, or nobody answers any more.
pub(super) async fn watch(asking: &Asking, kinds: &[&str]) -> anyhow::Result<()> {
    let mut after: Option<WatchPosition> = None;
    let mut watch = asking.client.watch(kinds).await?;
    loop {
        let broke = loop {
            let update = match watch.next().await {
                Ok(Some(update)) => update,
                Ok(None) => break None,
                Err(error) => break Some(error),
            };
            after = Some(match &update {
                ResourceUpdate::Snapshot { revision, .. } => WatchPosition::from(*revision),
                ResourceUpdate::Event(event) => event.position(),
            });
            let shown = match (&update, asking.json) {
                (update, true) => output::line(show::update_json(update))?,
                (ResourceUpdate::Snapshot { resources, .. }, false) => output::line(show::table(resources))?,
                (ResourceUpdate::Event(event), false) => output::line(show::event(event))?,
            };
            if !shown {
                return Ok(());
            }
        };
        match broke {
            Some(error) if !error.is_crash() => return Err(error).context("the watch ended"),
            _ => output::progress("the resource manager ended the watch; it is asked again"),
        }
        watch = again(asking, kinds, after).await.context("the watch ended")?;
    }
}

/// Continues the watch where it broke off; with a snapshot where some changes since then are lost.
async fn again(asking: &Asking, kinds: &[&str], after: Option<WatchPosition>) -> Result<ResourceWatch, CallError> {
    let began = Instant::now();
    loop {
        tokio::time::sleep(AGAIN).await;
        let error = match asking.client.watch_from(kinds, after).await {
            Err(error) if error.code() == Some(tonic::Code::OutOfRange) => match asking.client.watch(kinds).await {
                Ok(watch) => return Ok(watch),
                Err(error) => error,
            },
            Ok(watch) => return Ok(watch),
            Err(error) => error,
        };
        if !error.is_crash() || began.elapsed() >= PATIENCE {
            return Err(error);
        }
    }
}
