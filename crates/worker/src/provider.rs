//! Offering resources under a session, again whenever the resource manager has forgotten them.

use crate::client::{CallError, Channels, ResourceClient};
use crate::endpoint::Endpoint;
use crate::session::{Session, SessionState};
use ratn_proto::types::Resource;
use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;
use tokio::sync::{Mutex, Notify, watch};
use tokio_util::sync::{CancellationToken, DropGuard};
use tonic::Code;

/// The pause before the manager is asked again.
const RETRY_INTERVAL: Duration = Duration::from_millis(100);

/// Keeps the resources that it was given with the resource manager, as long as the session lives.
#[derive(Debug)]
pub struct Provider {
    shared: Arc<Shared>,
    _end: DropGuard,
}

#[derive(Debug)]
struct Shared {
    client: ResourceClient,
    state: watch::Receiver<SessionState>,
    /// What shall be there, by id. Held during a call, so that an older offer never overtakes a newer one.
    wanted: Mutex<BTreeMap<String, Resource>>,
    missing: Notify,
}

impl Provider {
    /// A provider of nothing yet, at the resource manager of `session`.
    ///
    /// # Errors
    /// As [`Channels::get`].
    pub fn start(channels: &Channels, endpoint: &Endpoint, session: &Session) -> Result<Provider, CallError> {
        let client = ResourceClient::new(channels, endpoint, session.id())?;
        let shared =
            Arc::new(Shared { client, state: session.state(), wanted: Mutex::default(), missing: Notify::new() });
        let end = CancellationToken::new();
        tokio::spawn(end.clone().run_until_cancelled_owned(restore(Arc::clone(&shared))));
        Ok(Provider { shared, _end: end.drop_guard() })
    }

    /// The client, in the session's name.
    pub fn client(&self) -> &ResourceClient {
        &self.shared.client
    }

    /// Offers a resource (its id must not be empty), or updates one offered before. True once it is there; false when the
    /// manager cannot be asked now: it will be offered as soon as it can.
    ///
    /// # Errors
    /// [`CallError::Refused`] when the manager does not want it; it is not offered again.
    pub async fn offer(&self, resource: Resource) -> Result<bool, CallError> {
        let mut wanted = self.shared.wanted.lock().await;
        let id = resource.id.clone();
        wanted.insert(id.clone(), resource.clone());
        if !self.shared.state.borrow().alive {
            self.shared.missing.notify_one();
            return Ok(false);
        }
        match self.shared.client.create(resource).await {
            Ok(_) => Ok(true),
            Err(error) if is_passing(&error) => {
                self.shared.missing.notify_one();
                Ok(false)
            }
            Err(error) => {
                wanted.remove(&id);
                Err(error)
            }
        }
    }

    /// Withdraws a resource; who holds a lease of it loses it.
    ///
    /// # Errors
    /// [`CallError`] when the manager does not answer; it is not offered again all the same.
    pub async fn withdraw(&self, id: &str) -> Result<(), CallError> {
        let mut wanted = self.shared.wanted.lock().await;
        wanted.remove(id);
        match self.shared.client.delete(id).await {
            Err(error) if error.code() == Some(Code::NotFound) => Ok(()),
            done => done,
        }
    }

    /// What is offered, by id.
    pub async fn offered(&self) -> Vec<Resource> {
        self.shared.wanted.lock().await.values().cloned().collect()
    }
}

/// Whether asking again later may help: nobody answers, or the session is not known (yet, or any more).
fn is_passing(error: &CallError) -> bool {
    matches!(error.code(), None | Some(Code::FailedPrecondition | Code::ResourceExhausted | Code::DeadlineExceeded))
}

/// Offers everything again whenever the session was made anew, and what could not be offered.
async fn restore(shared: Arc<Shared>) {
    let mut state = shared.state.clone();
    let mut restored = 0;
    loop {
        let Ok(generation) = state.wait_for(|s| s.alive).await.map(|s| s.generation) else { return };
        if generation == restored {
            tokio::select! {
                () = shared.missing.notified() => {}
                changed = state.changed() => match changed {
                    Ok(()) => continue,
                    Err(_) => return,
                },
            }
        }
        if offer_all(&shared).await {
            restored = generation;
        } else {
            tokio::time::sleep(RETRY_INTERVAL).await;
            shared.missing.notify_one();
        }
    }
}

/// Offers everything; whether all is there (or refused for good).
async fn offer_all(shared: &Shared) -> bool {
    let mut wanted = shared.wanted.lock().await;
    let mut refused = Vec::new();
    for (id, resource) in wanted.iter() {
        match shared.client.create(resource.clone()).await {
            Ok(_) => {}
            Err(error) if is_passing(&error) => return false,
            Err(error) => {
                tracing::warn!(resource = %id, %error, "the resource manager does not want the resource any more");
                refused.push(id.clone());
            }
        }
    }
    for id in refused {
        wanted.remove(&id);
    }
    true
}
