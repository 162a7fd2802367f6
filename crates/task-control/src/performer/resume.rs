//! Resumes a run whose task control was killed: requests without an answer are repeated, and nothing is done twice.
//!
//! Leases live on with the run's session, if that still lives; leases that the run does not know of go back. Goals are looked for where they were
//! given. Commits that the world pool does not have, and operations that the log does not report as done, are made under their ids. If the session
//! has ended, `made_anew` finds out which operations were done.
//!
//! ```text
//! the session that the log names is found ─► it is the run's, with all that is done in it
//! another is found ─► a resumption opened it and died: it is ended ─┐
//! none is found ────────────────────────────────────────────────────┴► a new one: leases are gone (their goals end as the providers
//!           say), what the run had created and used up is made so again, and then the log names the new session
//! ```

use super::Performer;
use super::came_between::{CameBetween, ChangedByOthers, Untouched, refuse, retry_forgotten};
use super::goal::Given;
use super::made_anew::Rest;
use crate::decided::{Unanswered, Undone, insist};
use crate::ledger::{Confirmed, Ledger, Operated, WentBack, late_request};
use crate::outside;
use crate::record::{Decided, Named, Record, commit_next};
use crate::shell::Place;
use anyhow::bail;
use futures::{StreamExt, stream};
use ratn_executive::protocol::Event;
use ratn_model::fact::FactKey;
use ratn_model::id::{LeaseId, Revision};
use ratn_model::program::Program;
use ratn_model::time::Timestamp;
use ratn_model::value::Value;
use ratn_proto::types::{Resource, WorldUpdate};
use ratn_worker::client::{CallError, Channels, ResourceClient, WorldClient, retry_unanswered};
use ratn_worker::session::Trust;
use ratn_world::world::World;
use std::cmp::Reverse;
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::Instant;
use tokio_util::sync::CancellationToken;

/// Number of earlier withdrawals that are repeated at once.
const WITHDRAWN_AT_ONCE: usize = 64;

/// A revision of the root, and the present values of the facts about which a run is wrong.
pub(crate) type Changed = (Revision, Vec<(FactKey, Option<Value>)>);

/// The commits of a run that the world pool did not have.
struct Missing {
    /// Number of those that were made.
    made: usize,
    /// Those behind an operation that is perhaps not done.
    behind: Vec<Decided>,
    /// Up to this revision no change by others conflicts with them.
    seen: Revision,
}

/// A run that is taken up as far as its goals, its commits and what it had made: the rest comes when its log says the latter.
pub(crate) struct TakenUp {
    ledger: Ledger,
    missing: Missing,
    changed: Option<Event>,
    /// Cancelled when the earlier withdrawals are done.
    withdrawn: CancellationToken,
    /// What is left to do in a new session.
    rest: Option<Rest>,
}

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

/// Whether the world pool needs no commit that the ledger has forgotten. If it does, the run has to be resumed from its whole log.
pub(crate) async fn remembers(place: &Place, ledger: &Ledger) -> anyhow::Result<bool> {
    if ledger.forgotten == 0 {
        return Ok(true);
    }
    let world = WorldClient::new(&Channels::new(&place.tls), &place.endpoints.world_pool)?;
    let (root, _) = retry_unanswered(|| world.root()).await?;
    Ok(youngest_there(&world, ledger, root).await?.youngest.is_some())
}

/// How many of the ledger's commits the world pool lacks; `None` if that cannot be told any more.
pub(crate) async fn missing_commits(place: &Place, ledger: &Ledger) -> anyhow::Result<Option<usize>> {
    let world = WorldClient::new(&Channels::new(&place.tls), &place.endpoints.world_pool)?;
    let (root, _) = retry_unanswered(|| world.root()).await?;
    if root < ledger.first_revision {
        return Ok(None);
    }
    let There { youngest, oldest_kept } = youngest_there(&world, ledger, root).await?;
    let is_unknown = ledger.forgotten > 0 || is_before(ledger, oldest_kept);
    let there = youngest.map(|(count, _)| count).or((!is_unknown).then_some(0));
    Ok(there.map(|there| ledger.commits.len() - there))
}

/// Whether commits of the run may be older than what the pool can report.
fn is_before(ledger: &Ledger, oldest: Revision) -> bool {
    oldest > ledger.first_revision && !ledger.commits.is_empty()
}

/// The commits of a run that the pool has.
struct There {
    /// The number of the ledger's commits that it has, and the pool's revision of the last of them; `None` if it reports none.
    youngest: Option<(usize, Revision)>,
    /// The oldest revision that it can report.
    oldest_kept: Revision,
}

/// How many of the ledger's commits the pool has: they were made in order, so all up to the youngest that it reports.
async fn youngest_there(world: &WorldClient, ledger: &Ledger, root: Revision) -> Result<There, CallError> {
    // If many others commit, the reported revision may leave the pool before it was read.
    retry_unanswered(|| retry_forgotten(|| youngest_told(world, ledger, root))).await
}

async fn youngest_told(world: &WorldClient, ledger: &Ledger, root: Revision) -> Result<There, CallError> {
    // The history of any fact says how far back the pool can report.
    let any = FactKey { predicate: "at".to_owned(), arguments: Vec::new() };
    let (_, oldest) = world.history(any).await?;
    let after = oldest.max(ledger.first_revision);
    let run = &ledger.origin.run;
    let ids: BTreeMap<String, usize> =
        ledger.commits.iter().enumerate().map(|(place, decided)| (decided.id(run), place + 1)).collect();
    let mut watch = world.watch(Some(after), &[]).await?;
    let (mut told, mut youngest) = (after, None);
    while told < root {
        let Some(WorldUpdate::Changed(change)) = watch.next().await? else {
            let reason = format!("it does not tell of its revisions up to {root}");
            return Err(CallError::Broken { endpoint: world.endpoint().clone(), reason });
        };
        told = change.revision;
        youngest = ids.get(&change.commit).map(|count| (*count, told)).or(youngest);
    }
    Ok(There { youngest, oldest_kept: oldest })
}

impl Performer {
    /// The event that the run has lost its leases, if its session is gone: it is logged before anything is made in another session.
    ///
    /// # Errors
    /// If the world pool does not say what it has of the run.
    pub(crate) async fn session_lost(&self, ledger: &Ledger) -> anyhow::Result<Option<Event>> {
        if self.is_own {
            return Ok(None);
        }
        let (root, _) = retry_unanswered(|| self.world.root()).await?;
        let there = youngest_there(&self.world, ledger, root).await?;
        let held_until = there.youngest.map_or(ledger.first_revision, |(_, revision)| revision);
        Ok(Some(Event::SessionLost { held_until }))
    }

    /// The changes from outside during the absence of task control, in the root together with all commits that the run had decided, whether or not
    /// the world pool has them. What is due is decided on that.
    ///
    /// # Errors
    /// If the world pool does not say what it has of the run.
    pub(crate) async fn changed_meanwhile(&self, ledger: &Ledger, mirror: &World) -> anyhow::Result<Option<Changed>> {
        let (revision, facts) = retry_unanswered(|| self.world.root()).await?;
        let there = self.commits_there(ledger, revision).await?;
        let facts = facts.into_iter().map(|fact| (fact.key, fact.value)).collect();
        Ok(changed(revision, facts, &ledger.commits[there..], mirror))
    }

    /// Takes up what is open, up to the operations that are perhaps not done; `now` is the time of the run. Returns the events that the log has to have
    /// before [`Performer::go_on`]: that everything was made again in a new session.
    ///
    /// # Errors
    /// If the run cannot go on.
    pub(crate) async fn take_up(
        &mut self,
        program: &Arc<Program>,
        mut ledger: Ledger,
        mirror: &World,
        now: Timestamp,
    ) -> anyhow::Result<(Vec<Event>, TakenUp)> {
        let settled = if self.is_own { None } else { Some(self.settle(&ledger).await?) };
        let (missing, revision, facts) = self.commit_again(program, &ledger, now).await?;
        let changed = changed(revision, facts, &missing.behind, mirror);
        let changed = changed.map(|(revision, facts)| Event::WorldChanged { revision, facts });
        self.stop_again(&ledger);
        // First, because all else takes a while: providers wait for their goals' run no longer than its grace.
        for (instance, (attempt, goal)) in std::mem::take(&mut ledger.goals) {
            self.start(instance, attempt, goal, Given::Before, None);
        }
        // Operations wait for these withdrawals.
        let withdrawn = self.withdraw_again(std::mem::take(&mut ledger.withdrawn));
        let (told, rest) = match settled {
            Some(settled) => self.make_anew(settled, &ledger).await.map(|(told, rest)| (told, Some(rest)))?,
            None => (Vec::new(), None),
        };
        Ok((told, TakenUp { ledger, missing, changed, withdrawn, rest }))
    }

    /// Takes up the rest, in the order of decision. Returns the events for the executive: the operations that are done in a new session, and what has
    /// changed from outside meanwhile.
    ///
    /// # Errors
    /// If the run cannot go on.
    pub(crate) async fn go_on(&mut self, program: &Arc<Program>, taken: TakenUp) -> anyhow::Result<Vec<Event>> {
        let TakenUp { ledger, missing, changed, withdrawn, rest } = taken;
        let mut recorded = Vec::new();
        if let Some(rest) = rest {
            recorded = self.do_the_rest(rest).await?;
            let operation = ledger.operations;
            self.confirm(Confirmed { operation, ..self.confirmed() });
        } else {
            self.sweep(&ledger, withdrawn).await?;
        }
        self.go_on_recording(program, &ledger, missing)?;
        if ledger.failed.is_some() {
            self.record(Record::Failed("an operation had failed before task control came back".to_owned()))?;
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
        Ok(recorded.into_iter().chain(changed).collect())
    }

    /// Performs what a run that has ended had decided and perhaps not done: its commits and its operations. If its session has ended, only the
    /// operations that take something away: what it had created is gone with the session. Returns the number of each. `now` is the time of the run;
    /// `log` makes events durable in the run's log.
    ///
    /// # Errors
    /// If the commits cannot be made.
    pub(crate) async fn finish(
        &mut self,
        program: &Arc<Program>,
        mut ledger: Ledger,
        now: Timestamp,
        log: impl FnOnce(&[Event]) -> anyhow::Result<()>,
    ) -> anyhow::Result<(usize, usize)> {
        let settled = if self.is_own { None } else { Some(self.settle(&ledger).await?) };
        let (missing, ..) = self.commit_again(program, &ledger, now).await?;
        let commits = missing.made + missing.behind.len();
        if let Some(settled) = settled {
            let removed = settled.removals();
            if removed > 0 {
                let (told, rest) = self.make_anew(settled, &ledger).await?;
                log(&told)?;
                self.do_the_rest(rest).await?;
            }
            // Nothing of the run is open any more for later resumptions.
            self.recorded.send_modify(|recorded| recorded.operation = ledger.operations);
            self.go_on_recording(program, &ledger, missing)?;
            return Ok((commits, removed));
        }
        self.stop_again(&ledger);
        let withdrawn = self.withdraw_again(std::mem::take(&mut ledger.withdrawn));
        self.sweep(&ledger, withdrawn).await?;
        Ok((commits, self.go_on_recording(program, &ledger, missing)?))
    }

    /// Makes every commit that the world pool does not have, up to the first one behind an operation that is perhaps not done. Returns what these
    /// were, and the root with them.
    async fn commit_again(
        &mut self,
        program: &Arc<Program>,
        ledger: &Ledger,
        now: Timestamp,
    ) -> anyhow::Result<(Missing, Revision, Vec<(FactKey, Value)>)> {
        (self.acquires, self.operations, self.resumptions) = (ledger.acquires, ledger.operations, ledger.resumptions);
        let (seen, _) = retry_unanswered(|| self.world.root()).await?;
        let mut root = seen;
        let there = self.commits_there(ledger, root).await?;
        if self.is_own {
            self.knows_what_went_back(ledger, there, now);
        }
        self.refuse_what_came_between(program, &ledger.commits[there..], root).await?;
        let first = ledger.open_operations().next().map_or(u64::MAX, |one| one.number);
        let (missing, mut made) = (&ledger.commits[there..], 0);
        for decided in missing.iter().take_while(|decided| decided.behind < first) {
            let untouched = self.untouched(program, decided, seen);
            let commit = decided.clone().commit(&self.run);
            match commit_next(&self.world, &self.trust, root, commit, Some(untouched)).await {
                Ok(revision) => root = revision,
                Err(Undone::Overtaken(overtaken)) => return refuse(&decided.writer, &overtaken),
                Err(undone) => bail!("the world pool does not take what the run had decided: {undone}"),
            }
            made += 1;
        }
        let (revision, facts) = self.root().await?;
        if let Some(since) = ledger.beginnings.others_count() {
            // Goals that ended well meanwhile, without task control, have to pass the same test.
            let changed = self.changed_by_others(since, revision).await?;
            self.came_between = Some(CameBetween::new(program, &self.run, ledger, changed, &self.resources));
        }
        let commit = ledger.commits[..there + made].last().map(|decided| decided.revision).unwrap_or_default();
        // All of these commits are in the root that was read.
        self.told.committed(commit);
        // The next holder of what is given back waits for the other commits.
        self.decided = ledger.commits.last().map(|decided| decided.revision).unwrap_or_default();
        let operation = if self.is_own { ledger.recorded } else { 0 };
        self.confirm(Confirmed { commit, operation, failed: None });
        Ok((Missing { made, behind: missing[made..].to_vec(), seen }, revision, facts))
    }

    /// Notes the leases that the run had given back while commits were under way that the pool does not have yet, and how long ago.
    fn knows_what_went_back(&self, ledger: &Ledger, there: usize, now: Timestamp) {
        let made = ledger.commits[..there].last().map(|decided| decided.revision).unwrap_or_default();
        for WentBack { decided, at, .. } in &ledger.went_back {
            let ago = now.since(*at).div_f64(self.speed);
            self.left.went_back(*decided, made, ago);
        }
    }

    /// The condition for an earlier commit, with which no change up to revision `seen` conflicts. If the run has lost its leases: others have not
    /// changed the same facts since `seen`. If it has not: they have not since the decision; this is checked once nobody waits for the commit any
    /// more.
    fn untouched(&self, program: &Arc<Program>, decided: &Decided, seen: Revision) -> Untouched {
        match decided.began.held_until {
            Some(_) => Untouched::behind(program, &self.run, seen).and_guarded(&self.resources, decided.guard.clone()),
            None => Untouched::behind(program, &self.run, decided.knew).when_late(&self.left, decided.revision),
        }
    }

    /// Cancels goals that may not have got their cancel.
    fn stop_again(&mut self, ledger: &Ledger) {
        for (instance, attempt, goal) in &ledger.stopped {
            self.start(*instance, *attempt, goal.clone(), Given::ToStop, None);
        }
    }

    /// Performs the operations that are perhaps not done, under their ids, if the session is the run's own; and the commits behind them, all in the
    /// order of decision. Returns the number of operations.
    fn go_on_recording(&mut self, program: &Arc<Program>, ledger: &Ledger, missing: Missing) -> anyhow::Result<usize> {
        let seen = missing.seen;
        let open: Vec<_> = if self.is_own { ledger.open_operations().cloned().collect() } else { Vec::new() };
        let (operations, mut behind) = (open.len(), missing.behind.into_iter().peekable());
        for Operated { number, instance, operations, .. } in open {
            while let Some(decided) = behind.next_if(|decided| decided.behind < number) {
                let untouched = self.untouched(program, &decided, seen);
                self.commit(decided, Some(untouched), None)?;
            }
            self.operate(instance, number, operations, None)?;
        }
        behind.try_for_each(|decided| {
            let untouched = self.untouched(program, &decided, seen);
            self.commit(decided, Some(untouched), None)
        })?;
        Ok(operations)
    }

    /// Refuses to resume if others have changed facts that a missing commit changes or is based on. Checks commits whose leases were lost before they
    /// were made, and commits for which nobody waits any more.
    async fn refuse_what_came_between(
        &self,
        program: &Program,
        missing: &[Decided],
        root: Revision,
    ) -> anyhow::Result<()> {
        let late = |decided: &Decided| self.left.is_late(decided.revision).then_some(decided.knew);
        let behind = |decided: &Decided| decided.began.others_count().or_else(|| late(decided));
        let lost = || missing.iter().filter_map(|decided| Some((decided, behind(decided)?)));
        let Some(since) = lost().map(|(_, behind)| behind).min() else { return Ok(()) };
        let changed = self.changed_by_others(since, root).await?;
        let overtaken = lost().find_map(|(decided, behind)| {
            let overtaken = changed.overtakes(program, &decided.writer, &decided.changes, behind)?;
            Some((decided, overtaken))
        });
        overtaken.map_or(Ok(()), |(decided, overtaken)| refuse(&decided.writer, &overtaken))
    }

    async fn changed_by_others(&self, behind: Revision, root: Revision) -> anyhow::Result<ChangedByOthers> {
        Ok(retry_unanswered(|| ChangedByOthers::of(&self.world, &self.run, behind, root)).await?)
    }

    async fn commits_there(&self, ledger: &Ledger, root: Revision) -> anyhow::Result<usize> {
        match youngest_there(&self.world, ledger, root).await? {
            There { youngest: None, .. } if ledger.forgotten > 0 => {
                bail!("the world pool has lost commits of the run since it was asked for them; resume the run again")
            }
            There { youngest: None, oldest_kept } if is_before(ledger, oldest_kept) => bail!(
                "the world pool keeps no revision of this run any more (the oldest is {oldest_kept}): what it has of the run's \
                 commits is not known; run the task again"
            ),
            There { youngest, .. } => Ok(youngest.map_or(0, |(count, _)| count)),
        }
    }

    /// Repeats earlier withdrawals that may not have arrived: a lease whose grant crossed with the end of task control goes back; a waiting request
    /// has left the queue with its connection. Only operations, and the return of leases that nobody knows of, wait for this. The returned token is
    /// cancelled when all of it is done.
    fn withdraw_again(&mut self, withdrawn: Vec<String>) -> CancellationToken {
        let over = CancellationToken::new();
        let ends = over.clone().drop_guard();
        if withdrawn.is_empty() {
            return over;
        }
        let (resources, trust, returns) = (self.resources.clone(), self.trust.clone(), self.order.returning.begin());
        self.giving_back.spawn(async move {
            let withdrawing = stream::iter(newest_first(withdrawn)).map(move |request| {
                let (resources, trust) = (resources.clone(), trust.clone());
                async move { insist(&trust, Unanswered::Waits, || resources.withdraw(&request)).await }
            });
            withdrawing.buffer_unordered(WITHDRAWN_AT_ONCE).for_each(|_| std::future::ready(())).await;
            drop((returns, ends));
        });
        over
    }

    /// Gives back the leases that the session holds and the run does not: those that it was about to give back, with a note about its commits, and at
    /// rest if that is known of all goals under them; and, after the withdrawals (which also return what was used up), grants that nobody heard of, as
    /// such for which something may still move. Notes of earlier holders stay at the resources.
    async fn sweep(&mut self, ledger: &Ledger, withdrawn: CancellationToken) -> anyhow::Result<()> {
        // Of goals that are looked for again it is known when their end is heard.
        self.goals.doubtful.add(ledger.doubtful.iter().copied());
        let living = living_leases(&self.resources, &self.run).await?;
        let (known, unheard): (Vec<LeaseId>, BTreeSet<LeaseId>) = {
            let is_known = |lease: &&LeaseId| ledger.returned.contains(lease);
            let (known, unheard): (Vec<_>, Vec<_>) = living.difference(&ledger.held).partition(is_known);
            (known.into_iter().copied().collect(), unheard.into_iter().copied().collect())
        };
        for lease in known {
            let (resources, trust) = (self.resources.clone(), self.trust.clone());
            let note = self.told.left(self.decided).to_string();
            self.left.goes_back(self.decided, self.confirmed().commit, Instant::now());
            let (idle, returns) = (self.goals.under(lease), self.order.returning.begin());
            let doubtful = self.goals.doubtful.clone();
            self.giving_back.spawn(async move {
                for goal in idle {
                    goal.cancelled().await;
                }
                release(&resources, &trust, lease, &note, doubtful.goes_back_at_rest(lease)).await;
                drop(returns);
            });
        }
        if unheard.is_empty() {
            return Ok(());
        }
        let (resources, trust, run) = (self.resources.clone(), self.trust.clone(), self.run.clone());
        let returns = self.order.returning.begin();
        self.giving_back.spawn(async move {
            withdrawn.cancelled().await;
            match living_leases(&resources, &run).await {
                Ok(living) => {
                    for lease in unheard.intersection(&living) {
                        // What was begun under it is not known.
                        release(&resources, &trust, *lease, "", false).await;
                    }
                }
                Err(error) => tracing::warn!("leases that nobody heard of were not given back: {error:#}"),
            }
            drop(returns);
        });
        Ok(())
    }
}

/// The facts that differ from a mirror, in a root of these facts to which the missing commits are applied.
fn changed(revision: Revision, facts: Vec<(FactKey, Value)>, missing: &[Decided], mirror: &World) -> Option<Changed> {
    let mut root = World::from_facts(facts, revision);
    for decided in missing {
        // What cannot be applied to others' changes is refused when it is its turn.
        let _ = root.apply(&decided.changes);
    }
    let facts = outside::differences(&root, mirror);
    (!facts.is_empty()).then_some((revision, facts))
}

/// The requests of withdrawn acquires, newest first: the last ones may have been granted meanwhile and keep others waiting; older ones were answered long ago.
fn newest_first(withdrawn: Vec<String>) -> impl Iterator<Item = String> {
    withdrawn.into_iter().rev().flat_map(|request| [late_request(&request), request])
}

async fn living_leases(resources: &ResourceClient, run: &str) -> anyhow::Result<BTreeSet<LeaseId>> {
    let resources = retry_unanswered(|| resources.list(&[])).await?;
    let own = |resource: Resource| {
        let holdings = resource.holdings.into_iter().filter(|holding| holding.session == run);
        holdings.map(|holding| holding.lease).collect::<Vec<_>>()
    };
    Ok(resources.into_iter().flat_map(own).collect())
}

async fn release(resources: &ResourceClient, trust: &Trust, lease: LeaseId, note: &str, at_rest: bool) {
    let release = || resources.release_with_note(lease, note.to_owned(), at_rest);
    if let Err(undone) = insist(trust, Unanswered::Waits, release).await {
        tracing::warn!("a lease that was left from before was not given back: {undone}");
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_was_withdrawn_last_is_withdrawn_first_also_where_it_was_asked_for_again_late() {
        let withdrawn = ["r/1", "r/2", "r/3"].map(str::to_owned).to_vec();
        let requests: Vec<String> = newest_first(withdrawn).collect();
        assert_eq!(requests, ["r/3/late", "r/3", "r/2/late", "r/2", "r/1/late", "r/1"]);
    }
}
