//! `ratn reset`: a new table, and a world model without the old facts.
//!
//! The boxes of a new table have the same names as the old ones, so old facts would be taken for facts about the new boxes. The
//! reset counts as a run that needs the system alone: it is refused while a run is in progress, and no run begins meanwhile.

use super::blocking_on;
use crate::arguments::ResetArguments;
use crate::failure::Failure;
use crate::output::{self, counted};
use crate::system::public_directory;
use anyhow::Context;
use ratn_daemon::{resource_manager, world_pool};
use ratn_model::fact::{Change, FactPattern};
use ratn_proto::v1::cell_service_client::CellServiceClient;
use ratn_proto::v1::{GetGroundTruthRequest, ResetRequest};
use ratn_task_control::claim;
use ratn_worker::client::{Channels, Commit, ResourceClient, WorldClient, fresh_id};
use ratn_worker::runtime_directory::RuntimeDirectory;
use ratn_worker::session::{DEFAULT_TTL, Session};
use ratn_worker::tls::ClientTls;
use std::collections::BTreeSet;
use std::time::Duration;

/// Timeout of opening a session at the resource manager.
const SESSION_DEADLINE: Duration = Duration::from_secs(5);

/// Lays out the scene again and deletes every fact.
pub(crate) fn run(arguments: &ResetArguments, tls: &ClientTls) -> Result<(), Failure> {
    blocking_on(tokio::runtime::Builder::new_current_thread(), async {
        let directory = RuntimeDirectory::at(public_directory(arguments.runtime_dir.as_deref())?);
        let find = |role| directory.find(role).map_err(|error| Failure::Refused(format!("ratn: {error}")));
        let (manager, pool, cell) = (find(resource_manager::ROLE)?, find(world_pool::ROLE)?, find(ratn_cell::ROLE)?);
        let channels = Channels::new(tls);
        let session = Session::open(&channels, &manager, "ratn reset", DEFAULT_TTL);
        session.alive(SESSION_DEADLINE).await?;
        let resources = ResourceClient::new(&channels, &manager, session.id())?;
        let done = match claim(&resources, session.id(), "reset", true).await {
            Ok(_) => {
                let world = WorldClient::new(&channels, &pool)?;
                reset(arguments, &world, CellServiceClient::new(channels.get(&cell)?)).await
            }
            Err(error) => Err(error),
        };
        session.close().await;
        output::result(done?).map_err(Failure::from)
    })
}

async fn reset(
    arguments: &ResetArguments,
    world: &WorldClient,
    mut cell: CellServiceClient<ratn_worker::trace::Traced>,
) -> anyhow::Result<String> {
    let before =
        cell.get_ground_truth(GetGroundTruthRequest {}).await.context("the cell does not answer")?.into_inner();
    let seed = arguments.seed.unwrap_or(before.seed);
    let as_many = |kind: &str| before.objects.iter().filter(|one| one.kind == kind).count();
    let many = |given: Option<u32>, kind: &str| given.map_or_else(|| u32::try_from(as_many(kind)), Ok);
    let goods = &arguments.goods;
    let request = ResetRequest {
        seed,
        boxes: many(goods.boxes, "box")?,
        bowls: many(goods.bowls, "bowl")?,
        forks: many(goods.forks, "fork")?,
        cups: many(goods.cups, "cup")?,
        plates: many(goods.plates, "plate")?,
    };
    let objects = cell.reset(request).await.context("the scene is not laid anew")?.into_inner().objects;
    let (_, facts) = world.root().await.context("the scene is new, the facts are not forgotten")?;
    let every: BTreeSet<FactPattern> = facts
        .iter()
        .map(|fact| FactPattern {
            predicate: fact.key.predicate.clone(),
            arguments: vec![None; fact.key.arguments.len()],
        })
        .collect();
    if !every.is_empty() {
        let changes = every.into_iter().map(|pattern| Change::Delete { pattern }).collect();
        let commit = Commit { id: fresh_id("reset"), changes, writer: "ratn reset".to_owned(), ..Commit::default() };
        world.commit_as(commit).await.context("the table is new, the facts are not forgotten")?;
    }
    let many = |kind: &str| objects.iter().filter(|one| one.kind == kind).count();
    let laid = match many("box") {
        0 => {
            let laid = |kind: &str| counted(many(kind), kind);
            let rack = format!("a new rack with {}, {} and {}", laid("bowl"), laid("fork"), laid("cup"));
            format!("{rack}, {} on the table", laid("plate"))
        }
        1 => "a new table with 1 box".to_owned(),
        boxes => format!("a new table with {boxes} boxes"),
    };
    Ok(format!("{laid}, from seed {seed}; {} forgotten", counted(facts.len(), "fact")))
}
