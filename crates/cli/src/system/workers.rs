//! The descriptions of a running system's workers. They extend the catalogue that tasks are checked against; differences from the
//! catalogue are reported.

use ratn_daemon::process_manager::HOST_KIND;
use ratn_model::catalogue::{Catalogue, WorkerDescription};
use ratn_model::program::Program;
use ratn_model::resource::{Quantity, ResourceClass, ResourceOperation};
use ratn_proto::types::{PoolStatus, Resource};
use ratn_worker::client::{ActionClient, CallError, Channels, DescribeError, ProcessClient, ResourceClient};
use ratn_worker::endpoint::Endpoint;
use ratn_worker::tls::ClientTls;
use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;

/// Timeout of a worker's description.
const PATIENCE: Duration = Duration::from_secs(2);
/// Timeout for the whole system.
const PATIENCE_OF_ALL: Duration = Duration::from_secs(5);
/// Maximum number of workers that are asked, the first by id.
const MOST_ASKED: usize = 128;

/// What a running system offers.
#[derive(Debug, Default)]
pub(crate) struct Offered {
    /// The workers that were asked.
    pub(crate) workers: Vec<Described>,
    /// The amount of each kind of resource.
    pub(crate) kinds: BTreeMap<String, Quantity>,
    /// Kinds of which a process manager can start workers.
    pub(crate) startable: BTreeSet<String>,
    /// Kinds of which there are workers, or should be.
    pub(crate) kept: BTreeSet<String>,
    /// Kinds of which there should be workers but are none, because their programs crash repeatedly; with the process manager's reason.
    pub(crate) given_up: BTreeMap<String, String>,
    /// Hosts whose process managers do not answer: what they can start is unknown.
    pub(crate) unheard: BTreeSet<String>,
}

/// A worker with its description.
#[derive(Debug)]
pub(crate) struct Described {
    pub(crate) id: String,
    pub(crate) kind: String,
    pub(crate) description: Result<WorkerDescription, DescribeError>,
}

impl Offered {
    /// What the system offers, as far as it answers. The rest is noticed when it is used.
    pub(crate) async fn known(tls: &ClientTls, resource_manager: &Endpoint) -> Offered {
        let channels = Channels::new(tls);
        let asked = tokio::time::timeout(PATIENCE_OF_ALL, Offered::ask(&channels, resource_manager));
        asked.await.ok().and_then(Result::ok).unwrap_or_default()
    }

    /// Asks the resource manager, the process managers and the workers.
    async fn ask(channels: &Channels, resource_manager: &Endpoint) -> Result<Offered, CallError> {
        let resources = ResourceClient::new(channels, resource_manager, "")?.list(&[]).await?;
        let mut kinds = BTreeMap::<String, Quantity>::new();
        for resource in &resources {
            *kinds.entry(resource.kind.clone()).or_default() += resource.capacity;
        }
        let is_worker = |one: &&Resource| one.class == ResourceClass::Process && one.kind != HOST_KIND;
        let asked = resources.iter().filter(is_worker).take(MOST_ASKED).filter_map(|one| {
            let endpoint: Endpoint = one.endpoint().parse().ok()?;
            Some(async move {
                let description = ActionClient::new(channels.clone()).description(&endpoint, PATIENCE).await;
                Described { id: one.id.clone(), kind: one.kind.clone(), description }
            })
        });
        let hosts = resources.iter().filter(|one| one.kind == HOST_KIND).filter_map(|host| {
            let client = ProcessClient::new(channels, &host.endpoint().parse().ok()?).ok()?;
            Some(async move { (host.host.clone(), tokio::time::timeout(PATIENCE, client.pools()).await) })
        });
        let (workers, hosts) = tokio::join!(futures::future::join_all(asked), futures::future::join_all(hosts));
        let (mut pools, mut unheard) = (Vec::new(), BTreeSet::new());
        for (host, answer) in hosts {
            match answer {
                Ok(Ok(host)) => pools.extend(host.pools.into_iter().filter(|pool| pool.max > 0)),
                // A process manager that refuses to answer exists, and will go on refusing.
                Ok(Err(error)) if !error.is_crash() => {}
                Ok(Err(_)) | Err(_) => drop(unheard.insert(host)),
            }
        }
        Ok(Offered { workers, kinds, unheard, ..Offered::of_pools(pools) })
    }

    /// What the pools of process managers offer.
    fn of_pools(pools: Vec<PoolStatus>) -> Offered {
        let mut offered = Offered::default();
        for pool in pools {
            let keeps = pool.min > 0 || pool.spares > 0 || !pool.workers.is_empty();
            if keeps && pool.workers.is_empty() && !pool.failure.is_empty() {
                offered.given_up.insert(pool.kind.clone(), pool.failure);
            } else if keeps {
                offered.kept.insert(pool.kind.clone());
            }
            offered.startable.insert(pool.kind);
        }
        offered
    }

    /// Sources of missing information that may still answer: workers that are being started, and process managers that do not answer.
    pub(crate) fn awaited(&self) -> Vec<String> {
        let workers = self.away().into_iter().map(|kind| format!("workers of {kind}"));
        workers.chain(self.unheard.iter().map(|host| format!("the process manager of {host}"))).collect()
    }

    /// Kinds of which there are workers, or should be, with none offered: they are being started, perhaps again.
    pub(crate) fn away(&self) -> Vec<&str> {
        let is_there = |kind: &str| self.workers.iter().any(|worker| worker.kind == kind);
        self.kept.iter().map(String::as_str).filter(|kind| !is_there(kind)).collect()
    }

    /// Differences between workers and the catalogue, and rejected descriptions, each as a sentence with the worker's id.
    pub(crate) fn mismatches(&self, catalogue: &Catalogue) -> Vec<String> {
        let of = |worker: &Described| -> Vec<String> {
            match &worker.description {
                Ok(said) => said.mismatches(catalogue, &worker.kind),
                Err(refused @ DescribeError::Refused(_)) => vec![refused.to_string()],
                // A worker need not have a description.
                Err(DescribeError::Unanswered(_)) => Vec::new(),
            }
        };
        let told = |worker: &Described| -> Vec<String> {
            of(worker).into_iter().map(|what| format!("{}: {what}", worker.id)).collect()
        };
        self.workers.iter().flat_map(told).collect()
    }

    /// Adds what workers describe and the catalogue does not have.
    pub(crate) fn extend(&self, catalogue: &mut Catalogue) {
        for Described { kind, description, .. } in &self.workers {
            if let Ok(said) = description {
                catalogue.extend_by(kind, self.kinds.get(kind).copied().unwrap_or(Quantity::ONE), said);
            }
        }
    }

    /// Resources of a task that nobody offers, and what to do: a run would wait for them.
    pub(crate) fn lacking(&self, program: &Program) -> Vec<String> {
        let asks = |operation| matches!(operation, ResourceOperation::Block | ResourceOperation::Consume);
        let all =
            || program.states.iter().flat_map(|state| state.annotations.resources.iter().map(move |r| (state, r)));
        let created: BTreeSet<&str> = all()
            .filter(|(_, resource)| resource.operation == ResourceOperation::Create)
            .map(|(_, resource)| resource.kind.as_str())
            .collect();
        let mut lacking = BTreeMap::<&str, &str>::new();
        for (state, resource) in all().filter(|(_, resource)| asks(resource.operation)) {
            let kind = resource.kind.as_str();
            let is_there = self.kinds.contains_key(kind) || self.startable.contains(kind) || created.contains(kind);
            if !is_there {
                lacking.entry(kind).or_insert(&state.path);
            }
        }
        // A system that did not answer counts as lacking nothing.
        if self.kinds.is_empty() {
            return Vec::new();
        }
        let sentence = |(kind, path): (&str, &str)| {
            format!(
                "nobody offers a `{kind}`, which `{path}` asks for: the run will wait there. Start a worker with `--kind {kind}`, add what is no \
                 worker with `ratn resource create {kind}`, or add a \
                 [[process-manager.template]] with kind = \"{kind}\" to the system's config and start the system anew; \
                 `ratn resource list` and `ratn ps` show what there is"
            )
        };
        lacking.into_iter().map(sentence).collect()
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;
    use ratn_model::value::Type;

    const TASK: &str = "task: read\nstates:\n  - make: { action: gripper/release, resources: [Gripper, { create: Token, class: task }] }\n  \
        - read: { action: pan_tilt/look_at, in: { target: \"pose(1, 0, 0)\" }, resources: [PanTilt, { consume: Token }, { block: Detector }] }\n";

    fn program() -> Program {
        ratn_model::load::load(TASK, "task.yaml", &Catalogue::standard()).unwrap().program
    }

    #[test]
    fn what_nobody_offers_is_told_with_the_state_and_what_a_pool_can_start_is_there() {
        let kinds = ["Gripper", "PanTilt"].map(|kind| (kind.to_owned(), Quantity::ONE)).into();
        let mut offered = Offered { kinds, ..Offered::default() };
        let told = offered.lacking(&program());
        assert_eq!(told.len(), 1, "{told:?}");
        assert!(
            told[0].contains("`Detector`") && told[0].contains("`read`") && told[0].contains("--kind Detector"),
            "{told:?}"
        );
        offered.startable.insert("Detector".to_owned());
        assert_eq!(offered.lacking(&program()), Vec::<String>::new());
    }

    #[test]
    fn workers_that_shall_be_there_and_are_not_are_away() {
        let there = Described {
            id: "planner-1@compute".to_owned(),
            kind: "PathPlanner".to_owned(),
            // The worker exists, and has no description.
            description: Err(DescribeError::Unanswered(String::new())),
        };
        let kinds = |all: &[&str]| all.iter().map(|kind| (*kind).to_owned()).collect();
        let kept = kinds(&["Inspector", "PathPlanner"]);
        let startable = kinds(&["Inspector", "PathPlanner", "Welder"]);
        let unheard = kinds(&["compute"]);
        let offered = Offered { workers: vec![there], startable, kept, unheard, ..Offered::default() };
        assert_eq!(offered.away(), ["Inspector"]);
        assert_eq!(offered.awaited(), ["workers of Inspector", "the process manager of compute"]);
    }

    #[test]
    fn workers_of_a_pool_that_has_given_up_are_not_waited_for() {
        let pool = |kind: &str, failure: &str| PoolStatus {
            template: kind.to_lowercase(),
            kind: kind.to_owned(),
            min: 1,
            max: 1,
            workers: Vec::new(),
            failure: failure.to_owned(),
            spares: 0,
            crashes: 5,
            last_exit: String::new(),
        };
        let offered = Offered::of_pools(vec![pool("Inspector", "5 crashes in a row"), pool("Welder", "")]);
        assert_eq!((offered.awaited(), offered.startable.len()), (vec!["workers of Welder".to_owned()], 2));
        assert_eq!(offered.given_up["Inspector"], "5 crashes in a row");
    }

    #[test]
    fn a_worker_that_is_known_by_its_own_words_alone_extends_the_catalogue_and_another_one_is_compared() {
        let signature = |port: &str| ratn_model::catalogue::ActionSignature {
            inputs: [(port.to_owned(), Type::Pose)].into(),
            ..Default::default()
        };
        let described = |id: &str, kind: &str, provider: &str, action: &str| Described {
            id: id.to_owned(),
            kind: kind.to_owned(),
            description: Ok(WorkerDescription {
                provider: provider.to_owned(),
                kind: kind.to_owned(),
                actions: [(action.to_owned(), Some(signature("from")))].into(),
            }),
        };
        let workers = vec![
            described("nearest-1@compute", "Inspector", "inspector", "nearest"),
            described("planner-1@compute", "PathPlanner", "path_planner", "plan"),
        ];
        let offered = Offered { workers, ..Offered::default() };
        let mut catalogue = Catalogue::standard();
        let told = offered.mismatches(&catalogue);
        assert!(told.iter().all(|line| line.starts_with("planner-1@compute: ")), "{told:?}");
        assert!(told.iter().any(|line| line.contains("`path_planner/plan`: the catalogue has an input")), "{told:?}");
        offered.extend(&mut catalogue);
        assert!(catalogue.action("inspector", "nearest").is_some());
        assert_eq!(catalogue.action("path_planner", "plan"), Catalogue::standard().action("path_planner", "plan"));
    }
}
