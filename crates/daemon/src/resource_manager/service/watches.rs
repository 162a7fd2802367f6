//! Watches of resources: a snapshot in messages that are not too large, then the changes, until the watcher is too slow.

use super::Streamed;
use super::requests::Requests;
use crate::details::{ending, retry_later, status};
use crate::paging::{self, Filled, Page};
use crate::resource_manager::actor::Message;
use crate::resource_manager::watch_filter::WatchFilter;
use futures::StreamExt;
use ratn_model::id::Revision;
use ratn_proto::convert::names;
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
        .flat_map(move |update| futures::stream::iter(messages(update.into(), in_parts)))
        // After a snapshot that does not fit nothing follows.
        .scan(false, |over, message| {
            let before = std::mem::replace(over, message.is_err());
            futures::future::ready((!before).then_some(message))
        });
    let shut_down = shutdown.clone();
    let last = futures::stream::once(async move {
        if shut_down.is_cancelled() {
            return Err(ending());
        }
        let message = "the watch has ended, for it was too slow: watch again";
        Err(retry_later(Code::Unavailable, "WATCH_AGAIN", message, WATCH_AGAIN_AFTER))
    });
    Ok(Box::pin(updates.take_until(shutdown.cancelled_owned()).chain(last)))
}

/// A snapshot in messages that are not too large; anything else as it is.
fn messages(
    message: v1::ResourceServiceWatchResponse,
    in_parts: bool,
) -> Vec<Result<v1::ResourceServiceWatchResponse, Status>> {
    use v1::resource_service_watch_response::Kind;
    let Some(Kind::Snapshot(mut snapshot)) = message.kind else { return vec![Ok(message)] };
    let mut parts = paging::parts(std::mem::take(&mut snapshot.resources));
    if parts.len() > 1 && !in_parts {
        // What is no more than a message is sent as one.
        let mut filled = Filled::default();
        if let Err(too_large) = Page::of(0, "").fill(parts.into_iter().flatten(), &mut filled) {
            return vec![Err(too_large)];
        }
        parts = vec![filled.items];
    }
    let last = parts.len() - 1;
    let part = |(index, resources)| {
        let snapshot = v1::ResourceSnapshot { resources, more: index < last, ..snapshot.clone() };
        Ok(v1::ResourceServiceWatchResponse { kind: Some(Kind::Snapshot(snapshot)) })
    };
    parts.into_iter().enumerate().map(part).collect()
}
