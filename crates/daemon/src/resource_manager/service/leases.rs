//! Calls that end a lease: a release, and the confirmation that a machine stands still.

use super::notes::Notes;
use super::requests::{Requests, odd_reply, optional_session};
use crate::access::Caller;
use crate::details::status;
use crate::resource_manager::actor::Message;
use ratn_model::id::LeaseId;
use ratn_proto::convert::{label, name};
use ratn_proto::v1;
use ratn_resources::{Reply, Request};
use std::time::Instant;
use tonic::{Code, Status};

/// Maximum length of a note, in bytes.
const MAX_NOTE_BYTES: usize = 256;

/// Checks a note for the next holder.
fn note(text: &str) -> Result<(), Status> {
    label(text, "note")?;
    if text.len() > MAX_NOTE_BYTES {
        let message = format!("note: has {} bytes: at most {MAX_NOTE_BYTES} are told to the next holder", text.len());
        return Err(status(Code::InvalidArgument, "MALFORMED", message));
    }
    Ok(())
}

pub(super) async fn release(
    requests: &Requests,
    notes: &Notes,
    caller: &Caller,
    request: v1::ResourceServiceReleaseRequest,
) -> Result<v1::ResourceServiceReleaseResponse, Status> {
    note(&request.note)?;
    let session = optional_session(&request.session_id)?;
    let lease = LeaseId(request.lease_id);
    // First, because the next holder may get the resources, and read the note, in the same turn.
    let left = notes.left(lease, &request.session_id, &caller.name, &request.note, Instant::now());
    let release = Request::Release { session, lease, at_rest: request.at_rest };
    let performed = requests.perform(caller, request.request_id, release).await;
    if performed.is_err() {
        notes.take_back(left);
    }
    if performed.as_ref().err().is_none_or(|refused| refused.code() == Code::NotFound) {
        notes.ended(lease);
    }
    let (released, revision) = match performed {
        Ok((_, revision)) => (true, revision),
        Err(refused) if refused.code() == Code::NotFound => {
            (false, requests.actor().ask(|answer| Message::Revision { answer }).await?.0)
        }
        Err(refused) => return Err(refused),
    };
    Ok(v1::ResourceServiceReleaseResponse { released, revision })
}

pub(super) async fn confirm_standstill(
    requests: &Requests,
    caller: &Caller,
    request: v1::ConfirmStandstillRequest,
) -> Result<v1::ConfirmStandstillResponse, Status> {
    name(&request.resource_id, "resource_id")?;
    let session = optional_session(&request.session_id)?;
    let (lease, resource) = (LeaseId(request.lease_id), request.resource_id);
    let confirm = Request::ConfirmStandstill { session, lease, resource };
    let (reply, revision) = requests.perform(caller, request.request_id, confirm).await?;
    let Reply::Touched(freed) = reply else { return Err(odd_reply(&reply)) };
    Ok(v1::ConfirmStandstillResponse { freed: !freed.is_empty(), revision })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_note_has_at_most_256_bytes() {
        assert!(note(&"x".repeat(256)).is_ok());
        let refused = note(&"x".repeat(257)).err().map(|refused| refused.message().to_owned());
        assert_eq!(refused.as_deref(), Some("note: has 257 bytes: at most 256 are told to the next holder"));
    }
}
