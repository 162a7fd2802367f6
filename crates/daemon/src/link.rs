//! The link of a provider to the resource manager: it finds the manager, keeps a session alive, and keeps the resources at the manager equal to
//! those that the provider wants to offer. The link goes on when the manager was started again, also at another address.

use crate::demand::DemandLink;
use crate::resource_manager;
use ratn_panic_point::panic_point;
use ratn_proto::types::{Resource, ResourceFilter};
use ratn_worker::client::{CallError, Channels};
use ratn_worker::endpoint::Endpoint;
use ratn_worker::provider::Provider;
use ratn_worker::runtime_directory::RuntimeDirectory;
use ratn_worker::session::Session;
use ratn_worker::tls::ClientTls;
use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;
use tokio::sync::{mpsc, oneshot, watch};
use tokio_util::sync::CancellationToken;

/// The name of this part of a daemon in its log.
pub(crate) const LINK: &str = "the link to the resource manager";
/// A warning is logged each time that this passes without a manager; the link goes on waiting.
const PATIENCE: Duration = Duration::from_secs(10);
/// Interval at which the link checks whether the manager has another address, and whether a resource is still to be offered.
const LOOK_INTERVAL: Duration = Duration::from_millis(250);

/// The resources that the provider wants to offer, by id.
pub(crate) type Wanted = BTreeMap<String, Resource>;

/// What became of a resource that was to be offered or withdrawn.
#[derive(Debug)]
pub(crate) enum OfferEvent {
    /// The resource manager has it.
    Offered(String),
    /// The resource manager does not take it, and why; it may be asked again.
    Refused(String, String),
    /// It was draining, and the resource manager does not have it any more.
    Withdrawn(String),
    /// It is draining, and somebody holds it: the withdrawal is tried again.
    StillHeld(String),
}

/// Reports which resources are offered, and withdraws those that are to drain.
#[derive(Debug)]
pub(crate) struct OfferLifecycle {
    pub(crate) events: mpsc::Sender<OfferEvent>,
    /// The wanted resources that are withdrawn as soon as nobody holds them.
    pub(crate) draining: watch::Receiver<BTreeSet<String>>,
}

/// A session whose id is kept, so that the next process goes on with it.
#[derive(Debug)]
pub(crate) struct LastingSession {
    pub(crate) id: String,
    /// Requests another id where this one belongs to another caller. The answer comes once everybody who has to know the new id does.
    pub(crate) renewals: mpsc::Sender<oneshot::Sender<String>>,
}

/// How the resource manager is found.
#[derive(Debug, Clone)]
pub(crate) struct Manager {
    pub(crate) configured: Option<Endpoint>,
    pub(crate) directory: RuntimeDirectory,
    /// The certificate shown to the manager, and the authority that the manager's certificate has to come from.
    pub(crate) tls: ClientTls,
}

/// A provider's link.
pub(crate) struct Link {
    pub(crate) manager: Manager,
    /// The name of the provider, for people.
    pub(crate) client: String,
    /// The session that outlasts this process; `None` for one of a new id with every manager.
    pub(crate) session: Option<LastingSession>,
    pub(crate) ttl: Duration,
    pub(crate) wanted: watch::Receiver<Wanted>,
    /// For a provider whose resources come and go.
    pub(crate) lifecycle: Option<OfferLifecycle>,
    /// For a provider that makes resources on demand.
    pub(crate) demand: Option<DemandLink>,
}

impl Manager {
    /// The address of the resource manager; waits until there is one.
    pub(crate) async fn find(&self) -> Endpoint {
        loop {
            if let Some(endpoint) = &self.configured {
                return endpoint.clone();
            }
            match self.directory.wait_for(resource_manager::ROLE, PATIENCE).await {
                Ok(endpoint) => return endpoint,
                Err(error) => {
                    tracing::warn!("still waiting for the resource manager: {error}");
                    tokio::time::sleep(LOOK_INTERVAL).await;
                }
            }
        }
    }

    /// Whether the resource manager has another address than this one now.
    pub(crate) fn has_moved_from(&self, endpoint: &Endpoint) -> bool {
        self.configured.is_none() && self.directory.find(resource_manager::ROLE).is_ok_and(|found| found != *endpoint)
    }
}

impl LastingSession {
    async fn renew(&mut self) {
        let (answer, renewed) = oneshot::channel();
        if self.renewals.send(answer).await.is_ok()
            && let Ok(id) = renewed.await
        {
            self.id = id;
        } else {
            tokio::time::sleep(LOOK_INTERVAL).await;
        }
    }
}

impl Link {
    /// Keeps the link up until `shutdown`. Then it closes the session, and with the session every resource is gone.
    pub(crate) async fn keep(mut self, shutdown: CancellationToken) {
        let channels = Channels::new(&self.manager.tls);
        let mut demand = self.demand.take();
        // Resources that are wanted from the beginning may have been offered by an earlier process.
        let mut before = self.wanted.borrow().clone();
        loop {
            let endpoint = tokio::select! {
                endpoint = self.manager.find() => endpoint,
                () = shutdown.cancelled() => return,
            };
            let session = match &self.session {
                Some(known) => Session::open_as(&channels, &endpoint, known.id.clone(), &self.client, self.ttl),
                None => Session::open(&channels, &endpoint, &self.client, self.ttl),
            };
            tokio::select! {
                () = session.taken() => match &mut self.session {
                    Some(known) => known.renew().await,
                    None => tokio::time::sleep(LOOK_INTERVAL).await,
                },
                kept = self.keep_at(&channels, &endpoint, &session, &before) => if let Err(error) = kept {
                    tracing::error!(%endpoint, "no link to the resource manager: {error}");
                    tokio::time::sleep(LOOK_INTERVAL).await;
                },
                () = follow(&mut demand, &channels, &endpoint, &session) => {}
                () = shutdown.cancelled() => {
                    session.close().await;
                    return;
                }
            }
            before.clone_from(&self.wanted.borrow());
        }
    }

    /// Returns when the manager has another address. Some of the resources may have been offered, and leased, before.
    async fn keep_at(
        &mut self,
        channels: &Channels,
        endpoint: &Endpoint,
        session: &Session,
        before: &Wanted,
    ) -> Result<(), CallError> {
        while session.alive(LOOK_INTERVAL).await.is_err() {
            if self.manager.has_moved_from(endpoint) {
                return Ok(());
            }
        }
        let provider = Provider::start(channels, endpoint, session)?;
        let found = session.state().borrow().found;
        // The resources that the provider was asked to offer; it keeps trying by itself.
        let mut asked = self.take_over(&provider, session.id(), found, before).await?;
        let mut offered = Wanted::new();
        let mut refused = Wanted::new();
        loop {
            // Read before `wanted`: a resource that was withdrawn while draining leaves both, in the other order.
            let draining = self.draining();
            let wanted = self.wanted.borrow_and_update().clone();
            for id in asked.extract_if(.., |id| !wanted.contains_key(id)) {
                offered.remove(&id);
                if let Err(error) = provider.withdraw(&id).await {
                    tracing::warn!(id, %error, "the resource manager does not let a resource go");
                }
            }
            refused.retain(|id, resource| wanted.get(id) == Some(resource));
            self.withdraw_drained(&provider, &draining, &mut offered, &mut asked).await;
            let is_new = |(id, resource): &(&String, &Resource)| {
                offered.get(*id) != Some(*resource) && !refused.contains_key(*id) && !draining.contains(*id)
            };
            let new: Vec<Resource> = wanted.iter().filter(is_new).map(|(_, resource)| resource.clone()).collect();
            asked.extend(new.iter().map(|resource| resource.id.clone()));
            let mut settled = draining.is_empty();
            for (id, done) in provider.offer_all(new).await {
                let resource = wanted.get(&id).cloned().into_iter().map(|resource| (id.clone(), resource));
                match done {
                    Ok(true) => {
                        offered.extend(resource);
                        self.report(OfferEvent::Offered(id)).await;
                    }
                    // The provider goes on trying by itself. The link asks again to learn when it has succeeded.
                    Ok(false) => {
                        settled = false;
                        if let Some(why) = provider.refusal(&id).await {
                            self.report(OfferEvent::Refused(id, why)).await;
                        }
                    }
                    Err(error) => {
                        tracing::error!(id, %error, "the resource manager does not take the resource");
                        refused.extend(resource);
                        self.report(OfferEvent::Refused(id, error.to_string())).await;
                    }
                }
            }
            if !self.has_news(endpoint, settled).await {
                return Ok(());
            }
        }
    }

    async fn report(&self, event: OfferEvent) {
        if let Some(lifecycle) = &self.lifecycle {
            let _ = lifecycle.events.send(event).await;
        }
    }

    /// Waits until other resources are wanted, or until those that are not settled can be tried again. Returns false when the manager
    /// has another address, or when the provider has ended.
    async fn has_news(&mut self, endpoint: &Endpoint, settled: bool) -> bool {
        loop {
            panic_point("link");
            tokio::select! {
                changed = self.wanted.changed() => return changed.is_ok(),
                () = drains_changed(&mut self.lifecycle) => return true,
                () = tokio::time::sleep(LOOK_INTERVAL) => match self.manager.has_moved_from(endpoint) {
                    true => return false,
                    false if !settled => return true,
                    false => {}
                },
            }
        }
    }

    /// Takes over what an earlier process offered in the same session, and withdraws what this one does not want. Returns the ids of the wanted
    /// resources that were found. The provider learns what may be leased before the manager is asked anything else, so that the end of the
    /// session meanwhile is noticed for every leased resource.
    async fn take_over(
        &mut self,
        provider: &Provider,
        session: &str,
        found: bool,
        before: &Wanted,
    ) -> Result<BTreeSet<String>, CallError> {
        let own = ResourceFilter { session: session.to_owned(), ..ResourceFilter::default() };
        let there = if found { provider.client().list_where(own).await? } else { Vec::new() };
        let wanted = self.wanted.borrow().clone();
        let (left, unwanted): (Vec<Resource>, Vec<Resource>) =
            there.into_iter().partition(|resource| wanted.contains_key(&resource.id));
        let ids: BTreeSet<String> = left.iter().map(|resource| resource.id.clone()).collect();
        let as_wanted = |left: Resource| Some((wanted.get(&left.id)?.clone(), left.standstill()));
        provider.offered_before(left.into_iter().filter_map(as_wanted).collect()).await;
        // Holders of a resource that the manager has lost may not have heard of that yet.
        let lost = before.values().filter(|resource| !ids.contains(&resource.id));
        provider.may_move(&lost.cloned().collect::<Vec<_>>()).await;
        for resource in unwanted {
            provider.withdraw(&resource.id).await?;
        }
        Ok(ids)
    }

    /// The resources that are to be withdrawn as soon as nobody holds them.
    fn draining(&mut self) -> BTreeSet<String> {
        self.lifecycle.as_mut().map(|lifecycle| lifecycle.draining.borrow_and_update().clone()).unwrap_or_default()
    }

    /// Withdraws the draining resources that nobody holds.
    async fn withdraw_drained(
        &mut self,
        provider: &Provider,
        draining: &BTreeSet<String>,
        offered: &mut Wanted,
        asked: &mut BTreeSet<String>,
    ) {
        let Some(lifecycle) = &self.lifecycle else { return };
        for id in draining {
            let gone = !asked.contains(id) || provider.withdraw_unless_held(id).await;
            if gone {
                offered.remove(id);
                asked.remove(id);
            }
            let _ = lifecycle
                .events
                .send(if gone { OfferEvent::Withdrawn(id.clone()) } else { OfferEvent::StillHeld(id.clone()) })
                .await;
        }
    }
}

async fn drains_changed(lifecycle: &mut Option<OfferLifecycle>) {
    let changed = async { lifecycle.as_mut()?.draining.changed().await.ok() };
    if changed.await.is_none() {
        std::future::pending().await
    }
}

/// Follows the demand, for a provider that makes resources on demand. Never returns.
async fn follow(demand: &mut Option<DemandLink>, channels: &Channels, endpoint: &Endpoint, session: &Session) {
    match demand {
        Some(demand) => demand.follow(channels, endpoint, session).await,
        None => std::future::pending().await,
    }
}
