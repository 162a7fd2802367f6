//! Watches of resources: a snapshot in messages that are not too large, then the changes, until the watcher is too slow.

use super::Streamed;
use super::requests::Requests;
use crate::details::{retry_later, status};
use crate::paging;
use crate::resource_manager::actor::Message;
use crate::resource_manager::watch_filter::WatchFilter;
use crate::watch_stream;
use futures::StreamExt;
use ratn_model::id::Revision;
use ratn_proto::convert::{few, names};
use ratn_proto::types::WatchPosition;
use ratn_proto::v1;
use std::sync::Arc;
use std::time::Duration;
use tokio_util::sync::CancellationToken;
use tonic::{Code, Status};

/// Resources that one watch may name.
const MAX_WATCHED: usize = 1_024;
/// When a watcher that was cut off may come back.
const WATCH_AGAIN_AFTER: Duration = Duration::from_millis(50);

pub(super) async fn watch(
    requests: &Requests,
    request: v1::ResourceServiceWatchRequest,
    shutdown: CancellationToken,
) -> Result<Streamed<v1::ResourceServiceWatchResponse>, Status> {
    few(request.kinds.len(), "kinds")?;
    names(&request.kinds, "kinds")?;
    names(&request.resource_ids, "resource_ids")?;
    if request.resource_ids.len() > MAX_WATCHED {
        let there = request.resource_ids.len();
        let message = format!("resource_ids: has {there} ids, at most {MAX_WATCHED}: watch without any, or twice");
        return Err(status(Code::InvalidArgument, "MALFORMED", message));
    }
    let (part, in_parts) = (request.after_part, request.in_parts);
    let after = request.after_revision.map(|revision| WatchPosition { revision: Revision(revision), part });
    let filter = Arc::new(WatchFilter {
        kinds: request.kinds.into_iter().collect(),
        resources: request.resource_ids.into_iter().collect(),
    });
    let watch = |answer| Message::Watch { after, filter: filter.clone(), answer };
    let updates = requests.counted("watch", requests.actor().request(watch).await)?;
    let updates = tokio_stream::wrappers::ReceiverStream::new(updates)
        .flat_map(move |told| futures::stream::iter(told.updates(&filter, after)))
        .flat_map(move |update| futures::stream::iter(messages(update.into(), in_parts)));
    let message = "the watch has ended, for it was too slow: watch again";
    let cut_off = retry_later(Code::Unavailable, "WATCH_AGAIN", message, WATCH_AGAIN_AFTER);
    Ok(watch_stream::ended(updates, shutdown, cut_off))
}

/// A snapshot in messages that are not too large; anything else as it is.
fn messages(
    message: v1::ResourceServiceWatchResponse,
    in_parts: bool,
) -> Vec<Result<v1::ResourceServiceWatchResponse, Status>> {
    use v1::resource_service_watch_response::Kind;
    let Some(Kind::Snapshot(mut snapshot)) = message.kind else { return vec![Ok(message)] };
    let parts = match paging::snapshot_parts(std::mem::take(&mut snapshot.resources), in_parts) {
        Ok(parts) => parts,
        Err(too_large) => return vec![Err(too_large)],
    };
    let last = parts.len() - 1;
    let part = |(index, resources)| {
        let snapshot = v1::ResourceSnapshot { resources, more: index < last, ..snapshot.clone() };
        Ok(v1::ResourceServiceWatchResponse { kind: Some(Kind::Snapshot(snapshot)) })
    };
    parts.into_iter().enumerate().map(part).collect()
}
