//! Joins snapshots that arrive in parts, as the first messages of a watch.

use super::CallError;
use crate::endpoint::Endpoint;
use ratn_proto::convert::Malformed;
use ratn_proto::v1;
use tonic::Streaming;

/// A message of a watch.
pub(super) trait InParts {
    /// The item type of a snapshot.
    type Item;

    /// The items of a snapshot, and whether a further part follows; `None` for any other message.
    fn snapshot(&mut self) -> Option<(&mut Vec<Self::Item>, &mut bool)>;
}

impl InParts for v1::ResourceServiceWatchResponse {
    type Item = v1::Resource;

    fn snapshot(&mut self) -> Option<(&mut Vec<v1::Resource>, &mut bool)> {
        use v1::resource_service_watch_response::Kind;
        let Some(Kind::Snapshot(snapshot)) = &mut self.kind else { return None };
        Some((&mut snapshot.resources, &mut snapshot.more))
    }
}

impl InParts for v1::WorldPoolServiceWatchResponse {
    type Item = v1::Fact;

    fn snapshot(&mut self) -> Option<(&mut Vec<v1::Fact>, &mut bool)> {
        use v1::world_pool_service_watch_response::Kind;
        let Some(Kind::Snapshot(snapshot)) = &mut self.kind else { return None };
        Some((&mut snapshot.facts, &mut snapshot.more))
    }
}

/// The next message, with all parts of a snapshot joined; `None` at the end of the stream.
pub(super) async fn next<M: InParts>(endpoint: &Endpoint, stream: &mut Streaming<M>) -> Result<Option<M>, CallError> {
    let failed = |status| CallError::from_status(endpoint, &status);
    let mut message = stream.message().await.map_err(failed)?;
    if let Some((items, more)) = message.as_mut().and_then(InParts::snapshot) {
        while std::mem::take(more) {
            let mut part = stream.message().await.map_err(failed)?;
            let Some((further, again)) = part.as_mut().and_then(InParts::snapshot) else {
                let cut = Malformed::new("snapshot.more", "is set, and no further part follows");
                return Err(CallError::malformed(endpoint, cut));
            };
            items.append(further);
            *more = *again;
        }
    }
    Ok(message)
}
