//! Clients that take tools and give them back, make resources and delete them, over and over; and what must hold of what they were
//! told: nothing that was acknowledged is lost, nothing is granted twice, tokens grow.

use super::crashes::{AGAIN, PATIENCE, Random, wait_until};
use anyhow::{bail, ensure};
use ratn_model::id::{FencingToken, LeaseId};
use ratn_model::resource::{Lease, Requirement, ResourceClass, ResourceOperation};
use ratn_proto::types::Resource;
use ratn_worker::client::{AcquireOptions, CallError, Channels, ResourceClient};
use ratn_worker::endpoint::Endpoint;
use ratn_worker::session::Session;
use ratn_worker::tls::ClientTls;
use std::collections::{BTreeMap, BTreeSet};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};
use tokio::task::JoinSet;
use tokio_util::sync::CancellationToken;

pub(crate) const CLIENTS: usize = 32;
/// Fewer than the clients want, so that there is always a queue.
const TOOLS: usize = 12;
/// Longer than everything together that a session may not be heard for.
const TTL: Duration = Duration::from_secs(60);
/// Of the resources that a client made it keeps at most so many.
const KEPT: usize = 4;

/// What the clients were told.
#[derive(Debug, Default)]
pub(crate) struct Told {
    /// Who has what: from the answer of an acquire to the begin of a release.
    held: BTreeMap<String, (usize, LeaseId)>,
    tokens: BTreeMap<String, FencingToken>,
    /// Resources whose creation was acknowledged, and whose deletion has not begun.
    there: BTreeSet<String>,
    /// Resources whose deletion was acknowledged.
    gone: BTreeSet<String>,
    pub(crate) grants: usize,
    /// When the last grant came, and the longest time without one since this was cleared.
    last_grant: Option<Instant>,
    pub(crate) longest_gap: Duration,
    /// Answers only got by asking again.
    pub(crate) repeated: usize,
    pub(crate) failures: Vec<String>,
    /// Clients that do nothing more.
    ended: usize,
}

pub(crate) type Shared = Arc<Mutex<Told>>;

pub(crate) fn told<T>(shared: &Shared, look: impl FnOnce(&mut Told) -> T) -> T {
    look(&mut shared.lock().unwrap_or_else(PoisonError::into_inner))
}

impl Told {
    fn granted(&mut self, client: usize, lease: &Lease) {
        self.grants += 1;
        let now = Instant::now();
        let gap = self.last_grant.replace(now).map_or(Duration::ZERO, |before| now - before);
        self.longest_gap = self.longest_gap.max(gap);
        let ids: BTreeSet<&String> = lease.resources.iter().map(|resource| &resource.id).collect();
        for id in ids {
            if let Some((other, before)) = self.held.insert(id.clone(), (client, lease.id)) {
                self.failures
                    .push(format!("{id} was granted to {client} by {} while {other} has it by {before}", lease.id));
            }
            if let Some(before) = self.tokens.insert(id.clone(), lease.token).filter(|before| *before >= lease.token) {
                self.failures.push(format!("{id}: token {} after {before}", lease.token));
            }
        }
    }

    fn releasing(&mut self, lease: &Lease) {
        self.held.retain(|_, (_, id)| *id != lease.id);
    }
}

/// Asks until there is an answer: a manager that is not there is asked again.
pub(crate) async fn answered<T, F: Future<Output = Result<T, CallError>>>(
    shared: &Shared,
    mut ask: impl FnMut() -> F,
) -> anyhow::Result<T> {
    let begin = Instant::now();
    let mut asked = 0;
    loop {
        match ask().await {
            Ok(answer) => {
                told(shared, |told| told.repeated += usize::from(asked > 0));
                return Ok(answer);
            }
            Err(error) if error.is_crash() && begin.elapsed() < PATIENCE => tokio::time::sleep(AGAIN).await,
            Err(error) => bail!("{error} (asked {} times)", asked + 1),
        }
        asked += 1;
    }
}

fn tools(count: u32) -> Requirement {
    Requirement { count: count.into(), ..Requirement::new(ResourceOperation::Block, "Tool") }
}

/// Takes and gives back, makes and deletes, until it is told to end.
async fn client(
    number: usize,
    endpoint: Endpoint,
    shared: Shared,
    end: CancellationToken,
    leave: CancellationToken,
    seed: u64,
) -> anyhow::Result<()> {
    let channels = Channels::new(&ClientTls::none());
    let session = Session::open_as(&channels, &endpoint, format!("client-{number}"), "client", TTL);
    session.alive(PATIENCE).await?;
    let resources = ResourceClient::new(&channels, &endpoint, session.id())?;
    let mut random = Random(seed.wrapping_mul(31).wrapping_add(number as u64 * 7_919) | 1);
    let mut made: Vec<String> = Vec::new();
    for round in 0.. {
        if end.is_cancelled() {
            break;
        }
        let request = format!("client-{number}/{round}");
        let options = AcquireOptions { request: request.clone(), deadline: PATIENCE, ..AcquireOptions::default() };
        let wanted = vec![tools(1 + random.below(3) as u32)];
        let lease = answered(&shared, || resources.acquire(wanted.clone(), options.clone())).await?;
        told(&shared, |told| told.granted(number, &lease));
        tokio::time::sleep(Duration::from_micros(random.below(3_000))).await;
        if random.below(4) == 0 {
            let resource = Resource::new(format!("made-{number}-{round}"), ResourceClass::Task, "Made");
            let request = format!("client-{number}/{round}/make");
            answered(&shared, || resources.create_once(&request, resource.clone())).await?;
            told(&shared, |told| told.there.insert(resource.id.clone()));
            made.push(resource.id);
        }
        if made.len() > KEPT {
            let id = made.remove(0);
            told(&shared, |told| told.there.remove(&id));
            delete(&shared, &resources, &id).await?;
            told(&shared, |told| told.gone.insert(id));
        }
        told(&shared, |told| told.releasing(&lease));
        answered(&shared, || resources.release(lease.id)).await?;
    }
    told(&shared, |told| told.ended += 1);
    // What it made goes with its session.
    leave.cancelled().await;
    ensure!(session.state().borrow().generation == 1, "the session of client {number} was forgotten");
    Ok(())
}

/// One that was done before its answer was lost finds nothing to delete.
async fn delete(shared: &Shared, resources: &ResourceClient, id: &str) -> anyhow::Result<()> {
    let mut first = true;
    answered(shared, || {
        let again = !std::mem::take(&mut first);
        async move {
            match resources.delete(id).await {
                Err(error) if again && error.code() == Some(tonic::Code::NotFound) => Ok(()),
                deleted => deleted,
            }
        }
    })
    .await
}

/// What the manager says now holds all that the clients were told.
pub(crate) async fn verify(shared: &Shared, endpoint: &Endpoint) -> anyhow::Result<()> {
    let resources = ResourceClient::new(&Channels::new(&ClientTls::none()), endpoint, "")?;
    let before = told(shared, |told| (told.held.clone(), told.there.clone(), told.gone.clone()));
    let listed = answered(shared, || resources.list(&[])).await?;
    let after = told(shared, |told| (told.held.clone(), told.there.clone()));
    let by_id: BTreeMap<&str, &Resource> = listed.iter().map(|resource| (resource.id.as_str(), resource)).collect();
    for (id, holder) in before.0.iter().filter(|(id, holder)| after.0.get(*id) == Some(holder)) {
        let has =
            by_id.get(id.as_str()).is_some_and(|one| one.holdings.iter().any(|holding| holding.lease == holder.1));
        ensure!(has, "client {} was granted {id} by {}, and the manager does not know it", holder.0, holder.1);
    }
    for id in before.1.intersection(&after.1) {
        ensure!(by_id.contains_key(id.as_str()), "{id} was created, and the manager does not know it");
    }
    for id in &before.2 {
        ensure!(!by_id.contains_key(id.as_str()), "{id} was deleted, and the manager has it");
    }
    let units: u32 = listed.iter().filter(|one| one.kind == "Tool").map(|one| one.capacity.units()).sum();
    ensure!(units as usize == TOOLS, "{units} tools of {TOOLS}");
    Ok(())
}

/// All of them, at work.
pub(crate) struct Crowd {
    pub(crate) shared: Shared,
    pub(crate) endpoint: Endpoint,
    end: CancellationToken,
    leave: CancellationToken,
    clients: JoinSet<anyhow::Result<()>>,
    seed: u64,
}

impl Crowd {
    /// With tools to take.
    pub(crate) async fn begin(endpoint: &Endpoint, seed: u64) -> anyhow::Result<Crowd> {
        let (shared, end, leave) = (Shared::default(), CancellationToken::new(), CancellationToken::new());
        let operator = ResourceClient::new(&Channels::new(&ClientTls::none()), endpoint, "")?;
        for number in 0..TOOLS {
            let id = format!("tool-{number}");
            let tool = Resource::new(id.clone(), ResourceClass::Module, "Tool");
            answered(&shared, || operator.create_once(&id, tool.clone())).await?;
        }
        let mut clients = JoinSet::new();
        for number in 0..CLIENTS {
            clients.spawn(client(number, endpoint.clone(), shared.clone(), end.clone(), leave.clone(), seed));
        }
        Ok(Crowd { shared, endpoint: endpoint.clone(), end, leave, clients, seed })
    }

    /// Waits for so many grants more; nothing may have gone wrong by then.
    pub(crate) async fn await_grants(&mut self, more: usize) -> anyhow::Result<()> {
        let before = told(&self.shared, |told| told.grants);
        let shared = self.shared.clone();
        wait_until(&mut self.clients, || told(&shared, |told| told.grants >= before + more)).await?;
        self.ensure_right()
    }

    pub(crate) fn ensure_right(&self) -> anyhow::Result<()> {
        let failures = told(&self.shared, |told| told.failures.clone());
        ensure!(failures.is_empty(), "seed {}: {failures:#?}", self.seed);
        Ok(())
    }

    pub(crate) async fn verify(&self) -> anyhow::Result<()> {
        verify(&self.shared, &self.endpoint).await
    }

    /// Everybody finishes what is begun, and leaves.
    pub(crate) async fn end(mut self) -> anyhow::Result<Shared> {
        self.end.cancel();
        let shared = self.shared.clone();
        wait_until(&mut self.clients, || told(&shared, |told| told.ended == CLIENTS)).await?;
        self.verify().await?;
        self.leave.cancel();
        while let Some(ended) = self.clients.join_next().await {
            ended??;
        }
        self.ensure_right()?;
        Ok(self.shared)
    }
}
