//! Coming back to a run whose task control was killed: what it had asked for is asked for again, and nothing twice.
//!
//! Leases live on with the run's session, if that still lives; what nobody knows to have goes back. Goals are looked for where
//! they were given. Commits and operations are repeated under their ids. If the session has ended meanwhile, leases are gone
//! with it (their goals end as the providers say), and what the run had created and used up is made so again.

use super::Performer;
use super::acquiring::late_request;
use super::goal::Given;
use crate::decided::{Unanswered, insist};
use crate::ledger::{Confirmed, Ledger};
use crate::outside;
use crate::record::{Decided, Named, Record, commit_next, operate_once};
use crate::shell::Place;
use anyhow::bail;
use futures::{StreamExt, stream};
use ratn_executive::protocol::Event;
use ratn_executive::was_overtaken;
use ratn_model::fact::FactKey;
use ratn_model::id::{LeaseId, Revision};
use ratn_model::program::Program;
use ratn_proto::types::{Resource, WorldUpdate};
use ratn_worker::client::retry_unanswered;
use ratn_worker::client::{Channels, WorldClient};
use ratn_world::world::World;
use std::cmp::Reverse;
use std::collections::{BTreeMap, BTreeSet};

/// So many withdrawals of before are under way at once.
const WITHDRAWN_AT_ONCE: usize = 64;

/// Refuses a world that is not the run's. Changes nothing.
pub(crate) async fn check_world(place: &Place, ledger: &Ledger) -> anyhow::Result<()> {
    let world = WorldClient::new(&Channels::new(&place.tls), &place.endpoints.world_pool)?;
    let (root, _) = retry_unanswered(|| world.root()).await?;
    if root < ledger.first_revision {
        bail!(
            "the world pool's root is at {root}, and the run began at {}: the world pool has lost its \
               state, or has another's, and what the run knew is gone; run the task again",
            ledger.first_revision
        );
    }
    Ok(())
}

/// Whether the world pool needs no commit that the ledger has forgotten. Where it does, the run has to be resumed from its whole log.
pub(crate) async fn remembers(place: &Place, ledger: &Ledger) -> anyhow::Result<bool> {
    if ledger.forgotten == 0 {
        return Ok(true);
    }
    let world = WorldClient::new(&Channels::new(&place.tls), &place.endpoints.world_pool)?;
    let (root, _) = retry_unanswered(|| world.root()).await?;
    Ok(youngest_there(&world, ledger, root).await?.0.is_some())
}

/// How many of the ledger's commits the pool has: they were made in order, so those up to the youngest that it tells of. `None`
/// where it tells of none; with the oldest revision that it can tell of.
async fn youngest_there(
    world: &WorldClient,
    ledger: &Ledger,
    root: Revision,
) -> anyhow::Result<(Option<usize>, Revision)> {
    // Any fact says how far back the pool can tell.
    let any = FactKey { predicate: "at".to_owned(), arguments: Vec::new() };
    let (_, oldest) = retry_unanswered(|| world.history(any.clone())).await?;
    let after = oldest.max(ledger.first_revision);
    let run = &ledger.origin.run;
    let ids: BTreeMap<String, usize> =
        ledger.commits.iter().enumerate().map(|(place, decided)| (decided.id(run), place + 1)).collect();
    let mut watch = retry_unanswered(|| world.watch(Some(after), &[])).await?;
    let (mut told, mut there) = (after, None);
    while told < root {
        let Some(WorldUpdate::Changed(change)) = watch.next().await? else {
            bail!("the world pool does not tell of its revisions up to {root}");
        };
        told = change.revision;
        there = ids.get(&change.commit).copied().or(there);
    }
    Ok((there, oldest))
}

impl Performer {
    /// Takes up everything that is open, in the order in which it was decided; what has changed from outside meanwhile.
    ///
    /// # Errors
    /// Where the run cannot go on.
    pub(crate) async fn take_up(
        &mut self,
        program: &Program,
        mut ledger: Ledger,
        mirror: &World,
    ) -> anyhow::Result<Option<Event>> {
        (self.acquires, self.operations, self.resumptions) = (ledger.acquires, ledger.operations, ledger.resumptions);
        let changed = self.commit_again(program, &ledger, mirror).await?;
        let commit = ledger.commits.last().map(|decided| decided.revision).unwrap_or_default();
        // All of it is in the root that was read.
        self.decided = commit;
        self.told.committed(commit);
        self.confirm(Confirmed { commit, ..Confirmed::default() });
        for (instance, attempt, goal) in &ledger.stopped {
            self.start(*instance, *attempt, goal.clone(), Given::ToStop, None);
        }
        // Before all that takes a while: whoever performs them waits for their run no longer than its grace.
        for (instance, (attempt, goal)) in std::mem::take(&mut ledger.goals) {
            self.start(instance, attempt, goal, Given::Before, None);
        }
        // Operations wait for that.
        self.withdraw_again(std::mem::take(&mut ledger.withdrawn));
        if self.session.state().borrow().found {
            self.sweep(&ledger).await?;
            for (number, instance, operations) in &ledger.operated {
                self.operate(*instance, *number, operations.clone(), None)?;
            }
        } else {
            self.make_anew(&ledger).await?;
            self.confirm(Confirmed { commit, operation: ledger.operations });
        }
        for (instance, asked) in ledger.projecting {
            let named = asked.named.map(|id| Named { id, made: self.making.begin(id), again: true });
            self.record(Record::Project { instance, asked, named })?;
        }
        let mut waiting: Vec<_> = ledger.waiting.into_iter().collect();
        waiting.sort_by_key(|(instance, asked)| (Reverse(asked.priority), *instance));
        for (instance, asked) in waiting {
            self.acquire(instance, asked.number, asked.requirements, asked.priority);
        }
        Ok(changed)
    }

    /// Makes every commit that the world pool does not have, and compares the two worlds: what is otherwise in the pool was changed
    /// from outside.
    async fn commit_again(
        &mut self,
        program: &Program,
        ledger: &Ledger,
        mirror: &World,
    ) -> anyhow::Result<Option<Event>> {
        let (mut root, _) = retry_unanswered(|| self.world.root()).await?;
        let there = self.commits_there(ledger, root).await?;
        if !self.session.state().borrow().found {
            self.refuse_what_came_between(program, ledger, there, root).await?;
        }
        for decided in &ledger.commits[there..] {
            let commit = decided.clone().commit(&self.run);
            match commit_next(&self.world, &self.trust, root, commit).await {
                Ok(revision) => root = revision,
                Err(undone) => bail!("the world pool does not take what the run had decided: {undone}"),
            }
        }
        let (revision, facts) = self.root().await?;
        let pool = World::from_facts(facts, revision);
        let facts = outside::differences(&pool, mirror);
        Ok((!facts.is_empty()).then_some(Event::WorldChanged { revision, facts }))
    }

    /// The run had lost what it held: where others have changed since what it has yet to commit, or what that is made of, it is not true any more.
    async fn refuse_what_came_between(
        &self,
        program: &Program,
        ledger: &Ledger,
        there: usize,
        root: Revision,
    ) -> anyhow::Result<()> {
        let missing = &ledger.commits[there..];
        if missing.is_empty() {
            return Ok(());
        }
        let last = there.checked_sub(1).map(|last| ledger.commits[last].id(&self.run));
        let any = FactKey { predicate: "at".to_owned(), arguments: Vec::new() };
        let (_, oldest) = retry_unanswered(|| self.world.history(any.clone())).await?;
        let (mut told, mut is_behind) = (oldest.max(ledger.first_revision), last.is_none());
        let mut watch = retry_unanswered(|| self.world.watch(Some(told), &[])).await?;
        while told < root {
            let Some(WorldUpdate::Changed(change)) = watch.next().await? else {
                bail!("the world pool does not tell of its revisions up to {root}");
            };
            told = change.revision;
            if is_behind {
                let written = change.written.iter().map(|fact| &fact.key);
                for key in written.chain(&change.gone) {
                    let is_meant = |decided: &&Decided| was_overtaken(program, &decided.writer, &decided.changes, key);
                    if let Some(decided) = missing.iter().find(is_meant) {
                        bail!(
                            "what {} has changed is not in the world yet, and others have changed {key}, which it changes or is made of, \
                             since the run lost its resources: run the task again, or begin it in the middle (`--from`)",
                            decided.writer
                        );
                    }
                }
            }
            is_behind |= last.as_ref() == Some(&change.commit);
        }
        Ok(())
    }

    async fn commits_there(&self, ledger: &Ledger, root: Revision) -> anyhow::Result<usize> {
        match youngest_there(&self.world, ledger, root).await? {
            (None, _) if ledger.forgotten > 0 => {
                bail!("the world pool has lost commits of the run since it was asked for them; resume the run again")
            }
            (None, oldest) if oldest > ledger.first_revision && !ledger.commits.is_empty() => bail!(
                "the world pool keeps no revision of this run any more (the oldest is {oldest}): what it has of the run's commits \
                   is not known; run the task again"
            ),
            (there, _) => Ok(there.unwrap_or(0)),
        }
    }

    /// Undoes what was withdrawn before, if that was not heard: what crossed with the end of task control goes back; a waiting one has left the queue
    /// with its connection. Nothing waits for that but operations.
    fn withdraw_again(&mut self, withdrawn: Vec<String>) {
        if withdrawn.is_empty() {
            return;
        }
        let (resources, trust, returns) = (self.resources.clone(), self.trust.clone(), self.order.returning.begin());
        let requests = withdrawn.into_iter().flat_map(|request| [late_request(&request), request]);
        self.giving_back.spawn(async move {
            let withdrawing = stream::iter(requests).map(move |request| {
                let (resources, trust) = (resources.clone(), trust.clone());
                async move { insist(&trust, Unanswered::Waits, || resources.withdraw(&request)).await }
            });
            withdrawing.buffer_unordered(WITHDRAWN_AT_ONCE).for_each(|_| std::future::ready(())).await;
            drop(returns);
        });
    }

    /// Gives back what the session holds and the run does not: what it was about to give back, with word of what it has committed; and grants that
    /// nobody heard of. What others left to be told of these stays there.
    async fn sweep(&mut self, ledger: &Ledger) -> anyhow::Result<()> {
        for lease in self.living_leases().await?.difference(&ledger.held) {
            let (lease, resources, trust) = (*lease, self.resources.clone(), self.trust.clone());
            let is_known = ledger.returned.contains(&lease);
            let note = if is_known { self.told.left(self.decided).to_string() } else { String::new() };
            let (idle, returns) = (self.stopping.under(lease), self.order.returning.begin());
            self.giving_back.spawn(async move {
                for goal in idle {
                    goal.cancelled().await;
                }
                let release = || resources.release_with_note(lease, note.clone());
                if let Err(undone) = insist(&trust, Unanswered::Waits, release).await {
                    tracing::warn!("a lease that was left from before was not given back: {undone}");
                }
                drop(returns);
            });
        }
        Ok(())
    }

    async fn living_leases(&self) -> anyhow::Result<BTreeSet<LeaseId>> {
        let resources = retry_unanswered(|| self.resources.list(&[])).await?;
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
            if let Err(undone) = operate_once(&self.resources, &self.trust, &request, operation).await {
                bail!("`{operation}` was so before and cannot be made so again: {undone}");
            }
        }
        Ok(())
    }
}
