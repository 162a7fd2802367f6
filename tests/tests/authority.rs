//! Whoever is not the holder moves nothing: a client on the wire's messages alone, against the processes of a real system.

mod support;

use anyhow::{Context, ensure};
use ratn_proto::v1;
use ratn_proto::v1::action_service_client::ActionServiceClient;
use ratn_proto::v1::execute_response::Kind;
use ratn_proto::v1::resource_service_client::ResourceServiceClient;
use ratn_worker::endpoint::{Endpoint, connect};
use ratn_worker::runtime_directory::RuntimeDirectory;
use ratn_worker::tls::ClientTls;
use ratn_worker::trace::Traced;
use std::time::Duration;
use support::{Place, wait_for};
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use tonic::{Code, Status};

/// One module of the cell and one pooled worker: kind and an action that needs no input (or says that it does).
const PROVIDERS: [(&str, &str); 2] = [("Gripper", "release"), ("PathPlanner", "plan")];
const TTL_MS: u64 = 60_000;

/// A session of the honest holder.
struct Holder {
    resources: ResourceServiceClient<Traced>,
    _pings: mpsc::Sender<v1::KeepAliveRequest>,
}

impl Holder {
    async fn open(manager: &Endpoint) -> anyhow::Result<Holder> {
        let mut resources = ResourceServiceClient::new(connect(manager, &ClientTls::none()).await?);
        let (pings, outgoing) = mpsc::channel(1);
        pings
            .send(v1::KeepAliveRequest {
                session_id: "holder".into(),
                ttl_ms: TTL_MS,
                client: "holder".into(),
                ..Default::default()
            })
            .await?;
        resources
            .keep_alive(ReceiverStream::new(outgoing))
            .await?
            .into_inner()
            .message()
            .await?
            .context("a session")?;
        Ok(Holder { resources, _pings: pings })
    }

    async fn block(&mut self, kind: &str) -> anyhow::Result<v1::Lease> {
        let requirement = v1::Requirement {
            operation: v1::ResourceOperation::Block.into(),
            kind: kind.to_owned(),
            count: 1.0,
            ..Default::default()
        };
        let block = v1::BlockRequest {
            // Empty: each call is its own.
            session_id: "holder".into(),
            requirement: Some(requirement),
            deadline_ms: 60_000,
            ..Default::default()
        };
        self.resources.block(block).await?.into_inner().lease.context("a lease")
    }

    async fn release(&mut self, lease_id: u64) -> anyhow::Result<()> {
        let request_id = format!("release-{lease_id}");
        let session_id = "holder".to_owned();
        let release =
            v1::ResourceServiceReleaseRequest { request_id, session_id, lease_id, note: String::new(), at_rest: true };
        ensure!(self.resources.release(release).await?.into_inner().released);
        Ok(())
    }
}

/// Gives a goal under a lease that says what it says; the outcome.
async fn give(lease: v1::Lease, action: &str, goal_id: String) -> anyhow::Result<Result<String, Status>> {
    let endpoint: Endpoint = lease.resources.first().context("a resource")?.endpoint.parse()?;
    let goal = v1::Goal { goal_id, action: action.to_owned(), lease: Some(lease), ..Default::default() };
    let request = v1::ExecuteRequest { goal: Some(goal) };
    let mut heard = match ActionServiceClient::new(connect(&endpoint, &ClientTls::none()).await?).execute(request).await
    {
        Ok(heard) => heard.into_inner(),
        Err(refused) => return Ok(Err(refused)),
    };
    while let Some(message) = heard.message().await? {
        if let Some(Kind::Result(result)) = message.kind {
            return Ok(Ok(result.outcome));
        }
    }
    anyhow::bail!("the goal had no result")
}

#[test]
fn a_client_without_a_lease_moves_neither_the_cell_nor_a_worker_and_keeps_nobody_from_them() -> anyhow::Result<()> {
    let place = Place::new()?;
    let directory = place.path().join("run");
    let arguments = ["up", "--runtime-dir", directory.to_str().context("a path")?, "--planners", "1", "--boxes", "1"];
    let up = place.start(&arguments)?;
    wait_for("the system", || Ok(up.said().contains("is ready").then_some(()))).with_context(|| up.said())?;
    tokio::runtime::Runtime::new()?.block_on(async {
        let manager = RuntimeDirectory::at(&directory).find("resource-manager")?;
        let mut holder = Holder::open(&manager).await?;
        let camera = holder.block("Camera").await?;
        for (kind, action) in PROVIDERS {
            let before = holder.block(kind).await?;
            holder.release(before.id).await?;
            let forged = |id, token, session_id: &str| v1::Lease {
                id,
                token,
                session_id: session_id.to_owned(),
                ..before.clone()
            };
            let held = [
                ("made up", forged(u64::MAX, u64::MAX, "")),
                ("made up, of a living session", forged(u64::MAX, u64::MAX, "holder")),
                ("made up, old", forged(1, u64::MAX, "")),
                ("another resource's", forged(camera.id, camera.token, "holder")),
                ("released a moment ago", before.clone()),
            ];
            for (number, (what, lease)) in held.into_iter().enumerate() {
                let refused = give(lease, action, format!("forged-{kind}-{number}")).await?;
                let code = refused.as_ref().err().map(Status::code);
                ensure!(code == Some(Code::FailedPrecondition), "{kind}, {what}: {refused:?}");
            }
            // Whose lease is copied from a list, with a token that wins.
            let own = holder.block(kind).await?;
            let stolen = give(forged(own.id, u64::MAX, ""), action, format!("stolen-{kind}")).await?;
            ensure!(stolen.as_ref().is_err_and(|status| status.message().contains("token")), "{kind}: {stolen:?}");
            ensure!(own.session_id == "holder", "{own:?}");
            let performed = give(own.clone(), action, format!("own-{kind}")).await?;
            ensure!(performed.is_ok(), "{kind}: {performed:?}");
            holder.release(own.id).await?;
        }
        // However often that is tried at once, others are served.
        let mut forging = Vec::new();
        for number in 0..64 {
            let lease = v1::Lease { id: u64::MAX - 1, token: u64::MAX, ..camera.clone() };
            forging.push(tokio::spawn(give(lease, "capture", format!("flood-{number}"))));
        }
        let own = holder.block("Gripper").await?;
        let served =
            tokio::time::timeout(Duration::from_secs(30), give(own, "release", "in-the-flood".into())).await??;
        ensure!(served.is_ok(), "{served:?}");
        for forged in forging {
            ensure!(forged.await??.is_err());
        }
        Ok(())
    })
}
