//! Watches of resources: a snapshot in messages of limited size, then the changes, until the watcher is too slow.

use super::Streamed;
use super::requests::Requests;
use crate::access::Caller;
use crate::details::{retry_later, status};
use crate::paging;
use crate::quota::Quotas;
use crate::resource_manager::actor::Message;
use crate::resource_manager::watch_filter::WatchFilter;
use crate::resource_manager::watch_message::WatchMessage;
use crate::resource_manager::wire;
use crate::watch_stream;
use futures::StreamExt;
use ratn_model::id::Revision;
use ratn_proto::convert::{few, kinds, names};
use ratn_proto::types::WatchPosition;
use ratn_proto::v1;
use ratn_resources::{Holding, ResourceView};
use ratn_worker::gate::Permit;
use std::sync::Arc;
use std::time::{Duration, Instant};
use tokio_util::sync::CancellationToken;
use tonic::{Code, Status};

/// Maximum number of resources that one watch may name.
const MAX_WATCHED: usize = 1_024;
/// After this time a disconnected watcher may return.
const WATCH_AGAIN_AFTER: Duration = Duration::from_millis(50);

pub(super) async fn watch(
    requests: &Requests,
    reader: Reader,
    request: v1::ResourceServiceWatchRequest,
    shutdown: CancellationToken,
) -> Result<Streamed<v1::ResourceServiceWatchResponse>, Status> {
    few(request.kinds.len(), "kinds")?;
    kinds(&request.kinds, "kinds")?;
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
        .flat_map(move |told| futures::stream::iter(messages(told, &filter, after, in_parts, &reader)));
    let message = "the watch has ended, for it was too slow: watch again";
    let cut_off = retry_later(Code::Unavailable, "WATCH_AGAIN", message, WATCH_AGAIN_AFTER);
    Ok(watch_stream::ended(updates, shutdown, cut_off))
}

/// The watching client, which pays quota for unread data.
#[derive(Debug)]
pub(super) struct Reader {
    pub(super) caller: Caller,
    /// `None` if the server has no quotas.
    pub(super) quotas: Option<Quotas>,
}

impl Reader {
    /// Counts a snapshot that is kept until the client has read it.
    fn keep(&self, resources: &[ResourceView]) -> Result<Option<Permit>, Status> {
        let holders: usize = resources.iter().map(|view| view.holders.live().count()).sum();
        let bytes = std::mem::size_of_val(resources) + holders * size_of::<Holding>();
        let kept = self.quotas.as_ref().map(|quotas| quotas.unread(&self.caller, bytes, Instant::now()));
        Ok(kept.transpose()?.flatten())
    }
}

type Messages = Box<dyn Iterator<Item = Result<v1::ResourceServiceWatchResponse, Status>> + Send>;

/// A snapshot in messages of limited size, each created on demand; other messages unchanged.
fn messages(
    told: WatchMessage,
    filter: &WatchFilter,
    after: Option<WatchPosition>,
    in_parts: bool,
    reader: &Reader,
) -> Messages {
    let WatchMessage::Snapshot { revision, resources, youngest } = told else {
        return Box::new(told.updates(filter, after).into_iter().map(|update| Ok(update.into())));
    };
    let kept = match reader.keep(&resources) {
        Ok(kept) => kept,
        Err(refused) => return Box::new(std::iter::once(Err(refused))),
    };
    let mut at = 0;
    let parts = paging::snapshot_parts(in_parts, move |page, part| {
        let _kept = &kept;
        let more = page.fill(resources[at..].iter().map(|view| wire::resource(view).into()), part)?;
        at += part.items.len();
        Ok(more)
    });
    Box::new(parts.map(move |part| {
        let (resources, more) = part?;
        let snapshot = v1::ResourceSnapshot { resources, more, revision: revision.0, youngest_lease_id: youngest.0 };
        let kind = v1::resource_service_watch_response::Kind::Snapshot(snapshot);
        Ok(v1::ResourceServiceWatchResponse { kind: Some(kind) })
    }))
}
