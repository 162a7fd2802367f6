//! Coming back to a run whose task control was killed: what it had asked for is asked for again, and nothing twice.
//!
//! Leases live on with the run's session, if that still lives; what nobody knows to have goes back. Goals are looked for where
//! they were given. Commits and operations are repeated under their ids. If the session has ended meanwhile, leases are gone
//! with it (their goals end as the providers say), and what the run had created and used up is made so again.

use super::Performer;
use super::goal::Given;
use crate::task_control::Endpoints;
use crate::task_control::ledger::Ledger;
use crate::task_control::record::{Record, operate_once, said};
use crate::task_control::retry::{Attempts, patiently};
use anyhow::bail;
use ratn_model::id::{InstanceId, LeaseId, Revision};
use ratn_proto::types::Resource;
use ratn_worker::client::{Channels, WorldClient};
use ratn_world::world::World;
use std::cmp::Reverse;
use std::collections::BTreeSet;

/// Refuses a world that is not the run's, or that somebody has changed since. Changes nothing.
pub(in crate::task_control) async fn check_world(
    endpoints: &Endpoints,
    ledger: &Ledger,
    mirror: &World,
) -> anyhow::Result<()> {
    let world = WorldClient::new(&Channels::new(), &endpoints.world_pool)?;
    let (root, _) = patiently(Attempts::IDEMPOTENT, || world.root()).await?;
    if root < ledger.first_revision {
        bail!(
            "the world pool's root is at {root}, and the run began at {}: the world pool has lost its \
               state, or has another's, and what the run knew is gone; run the task again",
            ledger.first_revision
        );
    }
    if root > mirror.revision() {
        bail!(
            "the world pool's root is at {root}, and the run had come to {}: somebody else has changed the world since; run \
               the task again",
            mirror.revision()
        );
    }
    Ok(())
}

impl Performer {
    /// Takes up everything that is open, in the order in which it was decided.
    ///
    /// # Errors
    /// Where the run cannot go on.
    pub(in crate::task_control) async fn take_up(&mut self, ledger: Ledger, mirror: &World) -> anyhow::Result<()> {
        (self.acquires, self.operations, self.resumptions) = (ledger.acquires, ledger.operations, ledger.resumptions);
        self.commit_again(&ledger, mirror).await?;
        if self.session.state().borrow().found {
            for (number, instance, operations) in &ledger.operated {
                let (number, instance, operations) = (*number, *instance, operations.clone());
                self.record(Record::Operate { instance, number, operations })?;
            }
            self.sweep(&ledger).await?;
        } else {
            self.make_anew(&ledger).await?;
        }
        // What crossed with the end of task control goes back; a waiting one has left the queue with its connection.
        for request in &ledger.withdrawn {
            let _ = patiently(Attempts::IDEMPOTENT, || self.resources.withdraw(request)).await;
        }
        for (instance, asked) in ledger.projecting {
            let attempt = asked.attempt;
            let (base, changes, reads, lease) = (asked.base, asked.changes, asked.reads, asked.lease);
            self.record(Record::Project { instance, attempt, base, changes, reads, lease })?;
        }
        for (instance, (attempt, goal)) in ledger.goals {
            self.start(instance, attempt, goal, Given::Before);
        }
        let mut waiting: Vec<_> = ledger.waiting.into_iter().collect();
        waiting.sort_by_key(|(instance, asked)| (Reverse(asked.priority), *instance));
        for (instance, asked) in waiting {
            self.acquire(instance, asked.number, asked.requirements, asked.priority);
        }
        Ok(())
    }

    /// Every commit that the world pool does not have, then a comparison of the two worlds.
    async fn commit_again(&self, ledger: &Ledger, mirror: &World) -> anyhow::Result<()> {
        let (root, _) = patiently(Attempts::IDEMPOTENT, || self.world.root()).await?;
        for (instance, changes, revision) in ledger.commits.iter().filter(|(_, _, revision)| *revision > root) {
            let commit = commit_request(&self.run, *instance, *revision);
            let ask = || self.world.commit(&commit, changes.clone(), Some(*revision));
            if let Err(error) = patiently(Attempts::IDEMPOTENT, ask).await {
                bail!("the world pool does not take what the run had decided: {}", said(&error));
            }
        }
        let (_, facts) = patiently(Attempts::IDEMPOTENT, || self.world.root()).await?;
        let differs = facts.iter().find(|fact| mirror.get(&fact.key) != Some(&fact.value));
        if let Some(fact) = differs {
            bail!(
                "the world pool has `{} = {}`, which is not what the run knows: somebody else has changed the world; run the \
                   task again",
                fact.key,
                fact.value
            );
        }
        if facts.len() != mirror.iter().count() {
            bail!(
                "the world pool has {} facts, and the run knows {}: somebody else has changed the world; run the task again",
                facts.len(),
                mirror.iter().count()
            );
        }
        Ok(())
    }

    /// Gives back what the session holds and the run does not know of: grants that nobody heard of.
    async fn sweep(&mut self, ledger: &Ledger) -> anyhow::Result<()> {
        for lease in self.living_leases().await?.difference(&ledger.held) {
            self.give_back(InstanceId(0), Vec::new(), Some(*lease), None);
        }
        Ok(())
    }

    async fn living_leases(&self) -> anyhow::Result<BTreeSet<LeaseId>> {
        let resources = patiently(Attempts::IDEMPOTENT, || self.resources.list(&[])).await?;
        let own = |resource: Resource| {
            let holdings = resource.holdings.into_iter().filter(|holding| holding.session == self.run);
            holdings.map(|holding| holding.lease).collect::<Vec<_>>()
        };
        Ok(resources.into_iter().flat_map(own).collect())
    }

    /// The old session is gone with what it had made and used up.
    async fn make_anew(&self, ledger: &Ledger) -> anyhow::Result<()> {
        let created = ledger.created();
        for (index, operation) in created.iter().chain(ledger.used_up()).enumerate() {
            let request = format!("{}/again-{}.{index}", self.run, self.resumptions);
            if let Err(error) = operate_once(&self.resources, &request, operation).await {
                bail!("`{operation}` was so before and cannot be made so again: {}", said(&error));
            }
        }
        Ok(())
    }
}

/// The id of a commit. One instance may commit more than once (the parts of a routine); the revision tells its commits apart.
pub(in crate::task_control) fn commit_request(run: &str, instance: InstanceId, revision: Revision) -> String {
    format!("{run}/{instance}/{revision}")
}
