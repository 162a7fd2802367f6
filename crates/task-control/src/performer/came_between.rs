//! Detects changes by others since a run lost its resources. A commit that was decided before the loss, or that belongs to a motion begun before it,
//! is made only if others have not changed the facts that the commit is based on or overwrites.
//!
//! The same check applies to a commit that is so late that the next holder of a resource which the run has released does not wait for it any more.
//!
//! The log says from which revision on changes by others count ([`Ledger`]), even after several resumptions. The check is made when a commit is
//! decided, so that nothing begins after a refused commit, and again when the commit is made ([`Untouched`]), because it may have waited for a slow
//! disk.

use super::told::{PENDING_PATIENCE, maker};
use crate::decided::{Unanswered, Undone, insist};
use crate::ledger::{Beginnings, Guard, Ledger};
use anyhow::bail;
use ratn_executive::protocol::{Command, Event};
use ratn_executive::was_overtaken;
use ratn_model::fact::{Change, FactKey};
use ratn_model::id::Revision;
use ratn_model::program::Program;
use ratn_proto::types::{WorldChange, WorldUpdate};
use ratn_worker::client::{CallError, ResourceClient, WorldClient};
use ratn_worker::session::Trust;
use std::collections::{BTreeMap, VecDeque};
use std::fmt;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

/// Reason code: the world pool does not keep a revision any more.
const FORGOTTEN: &str = "REVISION_FORGOTTEN";
/// Maximum number of requests for the oldest revision.
const TRIES: u32 = 8;

/// The facts that others have changed in a range of revisions of the root.
#[derive(Debug, Default)]
pub(super) struct ChangedByOthers {
    /// Exclusive start of the range: earlier changes are unknown.
    behind: Revision,
    /// Inclusive end of the range: later changes are unknown.
    up_to: Revision,
    /// For each changed fact, the last revision of the range that changed it.
    facts: BTreeMap<FactKey, Revision>,
}

/// Why a commit must not be made.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Overtaken {
    /// Others have changed this fact, which the commit changes or is based on.
    By(FactKey),
    /// Others have got this resource since, which guarded what the commit changes, and still have it: what they have begun is not known.
    Held(String),
    /// The world pool's history does not reach back to when the run had its resources.
    Unknown,
}

impl fmt::Display for Overtaken {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Overtaken::By(key) => {
                write!(
                    f,
                    "others have changed {key}, which it changes or is made of, since the run had what that was made with"
                )
            }
            Overtaken::Held(resource) => {
                write!(
                    f,
                    "others have `{resource}` since then, with which that was made, and may have begun by what was before"
                )
            }
            Overtaken::Unknown => write!(
                f,
                "what others have changed since the run had what that was made with is not known: the world pool does not keep it so long"
            ),
        }
    }
}

/// Asks again if the oldest revision has left the pool's history since it was asked for.
pub(super) async fn retry_forgotten<T, F>(mut ask: impl FnMut() -> F) -> Result<T, CallError>
where
    F: Future<Output = Result<T, CallError>>,
{
    for _ in 1..TRIES {
        match ask().await {
            Err(error) if error.reason() == FORGOTTEN => {}
            answered => return answered,
        }
    }
    ask().await
}

impl ChangedByOthers {
    /// The changes by others than the run after a revision, as far as the pool keeps it, up to another revision that the pool has reached.
    pub(super) async fn of(
        world: &WorldClient,
        run: &str,
        behind: Revision,
        up_to: Revision,
    ) -> Result<ChangedByOthers, CallError> {
        retry_forgotten(|| ChangedByOthers::asked(world, run, behind, up_to)).await
    }

    async fn asked(
        world: &WorldClient,
        run: &str,
        behind: Revision,
        up_to: Revision,
    ) -> Result<ChangedByOthers, CallError> {
        // The history of any fact tells how far back the pool's history reaches.
        let any = FactKey { predicate: "at".to_owned(), arguments: Vec::new() };
        let (_, oldest) = world.history(any).await?;
        let behind = behind.max(oldest);
        let mut changed = ChangedByOthers { behind, up_to: behind, facts: BTreeMap::new() };
        if changed.up_to >= up_to {
            return Ok(changed);
        }
        let mut watch = world.watch(Some(behind), &[]).await?;
        while changed.up_to < up_to {
            match watch.next().await? {
                Some(WorldUpdate::Changed(change)) => changed.add(run, &change),
                Some(WorldUpdate::Snapshot { .. }) => {}
                None => {
                    let reason = format!("it does not tell of its revisions up to {up_to}");
                    return Err(CallError::Broken { endpoint: world.endpoint().clone(), reason });
                }
            }
        }
        Ok(changed)
    }

    /// Adds the next revision.
    fn add(&mut self, run: &str, change: &WorldChange) {
        if maker(&change.commit).is_none_or(|(maker, _)| maker != run) {
            let facts = change.written.iter().map(|fact| &fact.key).chain(&change.gone);
            self.facts.extend(facts.map(|fact| (fact.clone(), change.revision)));
        }
        self.up_to = change.revision;
    }

    /// Why a state's changes must not be committed, if changes by others after revision `behind` count.
    pub(super) fn overtakes(
        &self,
        program: &Program,
        writer: &str,
        changes: &[Change],
        behind: Revision,
    ) -> Option<Overtaken> {
        if behind < self.behind {
            return Some(Overtaken::Unknown);
        }
        let counts = self.facts.iter().filter(|(_, revision)| **revision > behind).map(|(key, _)| key);
        let mut counts = counts.filter(|key| was_overtaken(program, writer, changes, key));
        counts.next().cloned().map(Overtaken::By)
    }
}

/// Checks the commits of a run that was resumed without its resources, while work from before is under way.
pub(super) struct CameBetween {
    program: Arc<Program>,
    run: String,
    /// The beginnings of all instances, before and after the resumption.
    beginnings: Beginnings,
    changed: ChangedByOthers,
    resources: ResourceClient,
}

impl CameBetween {
    /// From the log, and the changes by others.
    pub(super) fn new(
        program: &Arc<Program>,
        run: &str,
        ledger: &Ledger,
        changed: ChangedByOthers,
        resources: &ResourceClient,
    ) -> CameBetween {
        let (beginnings, resources) = (ledger.beginnings.clone(), resources.clone());
        CameBetween { program: Arc::clone(program), run: run.to_owned(), beginnings, changed, resources }
    }

    /// The root has reached another revision.
    pub(super) fn told(&mut self, change: &WorldChange) {
        self.changed.add(&self.run, change);
    }

    /// The run handles an event, and knows the root up to this revision.
    pub(super) fn event(&mut self, event: &Event, knows: Revision) {
        self.beginnings.event(event, knows);
    }

    /// The run performs a command. For a commit, [`CameBetween::check`] is called first.
    pub(super) fn command(&mut self, command: &Command, knows: Revision) {
        self.beginnings.command(command, knows);
    }

    /// Whether all work from before the loss has ended.
    pub(super) fn is_over(&self) -> bool {
        self.beginnings.others_count().is_none()
    }

    /// The condition for a commit of work that had begun before the loss; `None` for other commands.
    ///
    /// # Errors
    /// Others have changed the facts, as far as the pool has reported.
    pub(super) fn check(&self, command: &Command) -> anyhow::Result<Option<Untouched>> {
        let Command::Commit { instance, writer, changes, .. } = command else { return Ok(None) };
        let began = self.beginnings.of(*instance, writer);
        let Some(behind) = began.and_then(|began| began.others_count()) else { return Ok(None) };
        match self.changed.overtakes(&self.program, writer, changes, behind) {
            Some(overtaken) => refuse(writer, &overtaken),
            None => {
                let guard = self.beginnings.guard(*instance).cloned();
                let untouched = Untouched::behind(&self.program, &self.run, self.changed.up_to);
                Ok(Some(untouched.and_guarded(&self.resources, guard)))
            }
        }
    }
}

/// Fails: others have changed what a commit overwrites or is based on.
pub(super) fn refuse<T>(writer: &str, overtaken: &Overtaken) -> anyhow::Result<T> {
    let next = match overtaken {
        Overtaken::Held(_) => "resume the run when they have given it back",
        Overtaken::By(_) | Overtaken::Unknown => "run the task again, or begin it in the middle (`--from`)",
    };
    bail!("what {writer} has changed is not in the world yet, and {overtaken}: {next}");
}

/// The condition of a commit: in the revisions after `seen`, up to the one that the commit is made on, others have not changed what it overwrites or
/// is based on.
#[derive(Debug)]
pub(crate) struct Untouched {
    program: Arc<Program>,
    run: String,
    /// The last revision that has been checked.
    seen: Revision,
    /// The commit's number in its run, if the condition only applies when the commit is late.
    late: Option<(Left, Revision)>,
    /// What the run had lost, if nobody else may have it.
    guard: Option<(ResourceClient, Guard)>,
}

/// The deadlines after which the next holders of released resources do not wait for the run's decided commits any more. Clones share them.
#[derive(Debug, Clone, Default)]
pub(crate) struct Left(Arc<Mutex<VecDeque<(Revision, Instant)>>>);

impl Left {
    /// A resource is released while the commits after `made` up to `decided` have not reached the world pool.
    pub(super) fn goes_back(&self, decided: Revision, made: Revision, at: Instant) {
        self.is_waited_for(decided, made, at + PENDING_PATIENCE);
    }

    /// A resource was released this long ago, before the run was resumed; to be called in the order of releases.
    pub(super) fn went_back(&self, decided: Revision, made: Revision, ago: Duration) {
        self.is_waited_for(decided, made, Instant::now() + PENDING_PATIENCE.saturating_sub(ago));
    }

    fn is_waited_for(&self, decided: Revision, made: Revision, until: Instant) {
        let mut left = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        while left.front().is_some_and(|(number, _)| *number <= made) {
            left.pop_front();
        }
        let is_known = left.back().is_some_and(|(number, _)| *number >= decided);
        if decided > made && !is_known {
            left.push_back((decided, until));
        }
    }

    /// Whether the next holder of what the run held when it decided this commit may have gone on without the commit.
    pub(super) fn is_late(&self, commit: Revision) -> bool {
        let left = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        // Ordered by number and by time.
        let first = left.iter().find(|(number, _)| *number >= commit);
        first.is_some_and(|(_, until)| Instant::now() >= *until)
    }

    /// For tests: no holder waits any more.
    #[cfg(test)]
    pub(super) fn all_is_late(&self) {
        let mut left = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        left.iter_mut().for_each(|(_, until)| *until = Instant::now());
    }
}

impl Untouched {
    /// The condition, checked up to revision `seen`.
    pub(super) fn behind(program: &Arc<Program>, run: &str, seen: Revision) -> Untouched {
        Untouched { program: Arc::clone(program), run: run.to_owned(), seen, late: None, guard: None }
    }

    /// Applies the condition only if the run's commit with this number is late.
    pub(super) fn when_late(self, left: &Left, commit: Revision) -> Untouched {
        Untouched { late: Some((left.clone(), commit)), ..self }
    }

    /// Holds only where nobody else has, instead of the run, what guarded the commit.
    pub(super) fn and_guarded(self, resources: &ResourceClient, guard: Option<Guard>) -> Untouched {
        Untouched { guard: guard.map(|guard| (resources.clone(), guard)), ..self }
    }

    /// Checks the condition up to another revision.
    ///
    /// # Errors
    /// [`Undone::Overtaken`] if it does not hold.
    pub(crate) async fn up_to(
        &mut self,
        root: Revision,
        (world, trust): (&WorldClient, &Trust),
        (writer, changes): (&str, &[Change]),
    ) -> Result<(), Undone> {
        if let Some((resources, guard)) = &self.guard {
            let all = insist(trust, Unanswered::Waits, || resources.list(&[])).await?;
            if let Some(taken) = all.into_iter().find(|resource| guard.is_taken(resource, &self.run)) {
                return Err(Undone::Overtaken(Overtaken::Held(taken.id)));
            }
        }
        let counts = self.late.as_ref().is_none_or(|(left, commit)| left.is_late(*commit));
        if root <= self.seen || !counts {
            return Ok(());
        }
        let look = || ChangedByOthers::of(world, &self.run, self.seen, root);
        let changed = insist(trust, Unanswered::GivenUp, look).await?;
        match changed.overtakes(&self.program, writer, changes, self.seen) {
            Some(overtaken) => return Err(Undone::Overtaken(overtaken)),
            None => self.seen = root,
        }
        Ok(())
    }
}
