//! Sessions: the pings that keep them alive, their list, and the end of a task.

use super::Streamed;
use super::requests::{Requests, session};
use crate::access::{Caller, speaker};
use crate::audit::{self, Mutation};
use crate::paging::{self, Filled, Page};
use crate::quota::Quotas;
use crate::resource_manager::actor::{Claim, Message};
use ratn_proto::convert::{Malformed, label};
use ratn_proto::v1;
use ratn_resources::{Request, Share};
use std::time::{Duration, Instant};
use tokio::sync::mpsc;
use tokio_util::sync::CancellationToken;
use tonic::{Status, Streaming};

/// Maximum number of answers that wait for a slow reader of a keep-alive stream.
const KEEP_ALIVE_BUFFER: usize = 16;
/// The method as which a ping on a stream counts.
const PING: &str = "/ratn.v1.ResourceService/KeepAlive";

pub(super) async fn kept_alive(
    requests: &Requests,
    caller: &Caller,
    ping: v1::KeepAliveRequest,
) -> Result<v1::KeepAliveResponse, Status> {
    let session = session(&ping.session_id)?;
    label(&ping.client, "client")?;
    let claim = Claim { share: share(ping.share)?, due_in_ms: ping.due_in_ms };
    let client = if ping.client.is_empty() { ping.session_id.clone() } else { ping.client };
    let ttl = Duration::from_millis(ping.ttl_ms);
    let (named, id) = (client.clone(), ping.session_id.clone());
    let kept = requests.actor().keep_alive(speaker(caller), session, client, ttl, claim).await;
    // Pings that change nothing are not logged.
    if ttl.is_zero() {
        audit::begin(caller, "", || Mutation::CloseSession { session: id }).ended(&kept);
    } else if kept.as_ref().map_or(true, |kept| kept.created) {
        let open = || Mutation::OpenSession { session: id, client: named, ttl_ms: ping.ttl_ms };
        audit::begin(caller, "", open).ended(&kept);
    }
    let kept = requests.counted("keep_alive", kept)?;
    Ok(v1::KeepAliveResponse {
        session_id: ping.session_id,
        ttl_ms: u64::try_from(kept.ttl.as_millis()).unwrap_or(u64::MAX),
        created: kept.created,
        revision: kept.revision.0,
        number: kept.number,
    })
}

/// The share in a ping; 0 means none.
fn share(said: f64) -> Result<Share, Malformed> {
    if said == 0.0 {
        return Ok(Share::ONE);
    }
    Share::new(said).map_err(|error| Malformed::new("share", format!("is {said}: {error}")))
}

/// Answers each ping of a stream, until the first refusal.
pub(super) fn keep_alive(
    requests: Requests,
    caller: Caller,
    quotas: Option<Quotas>,
    mut pings: Streaming<v1::KeepAliveRequest>,
    shutdown: CancellationToken,
) -> Streamed<v1::KeepAliveResponse> {
    let (sender, answers) = mpsc::channel(KEEP_ALIVE_BUFFER);
    tokio::spawn(async move {
        loop {
            let ping = tokio::select! {
                ping = pings.message() => ping,
                () = shutdown.cancelled() => return,
            };
            let Ok(Some(ping)) = ping else { return };
            let permit = quotas.as_ref().map(|quotas| quotas.admit(&caller, PING, Instant::now())).transpose();
            let answer = match permit {
                Ok(_permit) => kept_alive(&requests, &caller, ping).await,
                Err(refused) => Err(refused),
            };
            let failed = answer.is_err();
            if sender.send(answer).await.is_err() || failed {
                return;
            }
        }
    });
    Box::pin(tokio_stream::wrappers::ReceiverStream::new(answers))
}

pub(super) async fn list(
    requests: &Requests,
    request: v1::ListSessionsRequest,
) -> Result<v1::ListSessionsResponse, Status> {
    let v1::ListSessionsRequest { page_bytes, page_token } = request;
    let (page, asked) = (Page::of(page_bytes, &page_token), v1::ListSessionsRequest::default());
    let mut filled = Filled::default();
    let mut after = paging::behind(&page_token, &asked)?.to_owned();
    loop {
        let from = after.clone();
        let sessions = requests.actor().ask(|answer| Message::Sessions { after: from, answer }).await?;
        let last = sessions.last().map(|session| session.id.clone());
        let full = page.fill(sessions.into_iter().map(v1::SessionStatus::from), &mut filled)?;
        match last {
            Some(last) if !full => after = last,
            _ => {
                let last =
                    filled.items.last().filter(|_| full).map(|last: &v1::SessionStatus| last.session_id.as_str());
                let next_page_token = paging::token_behind(last, &asked);
                return Ok(v1::ListSessionsResponse { sessions: filled.items, next_page_token });
            }
        }
    }
}

pub(super) async fn end_task(
    requests: &Requests,
    caller: &Caller,
    request: v1::EndTaskRequest,
) -> Result<v1::EndTaskResponse, Status> {
    let end = Request::EndTask { session: session(&request.session_id)? };
    let (_, revision) = requests.perform(caller, request.request_id, end).await?;
    Ok(v1::EndTaskResponse { revision })
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::super::test_actor;
    use crate::durable_actor::slow_disk::SlowDisk;
    use crate::resource_manager::actor::Claim;
    use ratn_resources::{SessionId, Speaker};
    use std::time::Duration;

    #[tokio::test]
    async fn a_ping_that_changes_nothing_is_answered_while_the_disk_hangs() {
        let disk = SlowDisk::default();
        let (actor, _directory) = test_actor::started(|log| log.on(disk.files()));
        let speaker = || Speaker::trusted();
        let ping = async |session: &str, ttl_s| {
            let ttl = Duration::from_secs(ttl_s);
            let session = SessionId::from(session);
            actor.keep_alive(speaker(), session, "a".to_owned(), ttl, Claim::default()).await.unwrap()
        };
        assert!(ping("a", 60).await.created && ping("c", 60).await.created);
        let hangs = disk.hang();
        let answered = ping("a", 60).await;
        assert!(!answered.created, "at once, however long the disk takes");
        let mut opened = Box::pin(ping("b", 60));
        let mut changed = Box::pin(ping("a", 30));
        for waits in [&mut opened, &mut changed] {
            assert!(futures::poll!(&mut *waits).is_pending());
        }
        // A ping after these two waits for the disk as they do, because the session's present state is not on disk.
        let mut behind = Box::pin(ping("a", 30));
        assert!(futures::poll!(&mut behind).is_pending());
        assert!(!ping("c", 60).await.created, "the actor has taken all of them by now");
        for waits in [&mut opened, &mut changed, &mut behind] {
            assert!(futures::poll!(&mut *waits).is_pending());
        }
        drop(hangs);
        assert!(opened.await.created);
        assert!(!changed.await.created && !behind.await.created);
    }
}
