//! What others have changed since a run lost what it held: a commit that it had decided before, or that a motion leads to which it had begun before,
//! is made only where that is not what the commit is made of, or overwrites.
//!
//! The same of a commit that is so late that whoever holds now what its run has given back does not wait for it any more.
//!
//! From when on others count the log says ([`Ledger`]), however often the run was taken up since. It is looked at when a commit is decided, so that
//! nothing begins behind one that is refused, and once more when it is made ([`Untouched`]), as it may have waited for a slow disk.

use super::told::{PENDING_PATIENCE, maker};
use crate::decided::{Unanswered, Undone, insist};
use crate::ledger::{Beginnings, Ledger};
use anyhow::bail;
use ratn_executive::protocol::{Command, Event};
use ratn_executive::was_overtaken;
use ratn_model::fact::{Change, FactKey};
use ratn_model::id::Revision;
use ratn_model::program::Program;
use ratn_proto::types::{WorldChange, WorldUpdate};
use ratn_worker::client::{CallError, WorldClient};
use ratn_worker::session::Trust;
use std::collections::{BTreeMap, VecDeque};
use std::fmt;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

/// The world pool does not keep a revision any more.
const FORGOTTEN: &str = "REVISION_FORGOTTEN";
/// So often the oldest revision is asked for.
const TRIES: u32 = 8;

/// What others have changed in some revisions of the root.
#[derive(Debug, Default)]
pub(super) struct ChangedByOthers {
    /// What was changed up to this one is not known.
    behind: Revision,
    /// What was changed behind this one is not known either.
    up_to: Revision,
    /// The last of these revisions in which each fact was changed.
    facts: BTreeMap<FactKey, Revision>,
}

/// What stands against a commit.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Overtaken {
    /// Others have changed this fact, which it changes or is made of.
    By(FactKey),
    /// The world pool does not go back to where the run had what it held.
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
            Overtaken::Unknown => write!(
                f,
                "what others have changed since the run had what that was made with is not known: the world pool does not keep it so long"
            ),
        }
    }
}

/// Asks anew where others have made the oldest revision leave the pool since that was asked for.
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
    /// What others than a run have changed behind a revision, as far as the pool keeps that, up to another one that it has had.
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
        // Any fact says how far back the pool can tell.
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

    /// The next revision.
    fn add(&mut self, run: &str, change: &WorldChange) {
        if maker(&change.commit).is_none_or(|(maker, _)| maker != run) {
            let facts = change.written.iter().map(|fact| &fact.key).chain(&change.gone);
            self.facts.extend(facts.map(|fact| (fact.clone(), change.revision)));
        }
        self.up_to = change.revision;
    }

    /// What stands against changes of a state where others' changes behind a revision count.
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

/// Of a run that came back without what it held, while anything of before is under way.
pub(super) struct CameBetween {
    program: Arc<Program>,
    run: String,
    /// What has begun, before and since.
    beginnings: Beginnings,
    changed: ChangedByOthers,
}

impl CameBetween {
    /// By the log, and what others have changed.
    pub(super) fn new(program: &Arc<Program>, run: &str, ledger: &Ledger, changed: ChangedByOthers) -> CameBetween {
        let beginnings = ledger.beginnings.clone();
        CameBetween { program: Arc::clone(program), run: run.to_owned(), beginnings, changed }
    }

    /// The root has this revision, too.
    pub(super) fn told(&mut self, change: &WorldChange) {
        self.changed.add(&self.run, change);
    }

    /// An event that the run is given, which knows of this revision.
    pub(super) fn event(&mut self, event: &Event, knows: Revision) {
        self.beginnings.event(event, knows);
    }

    /// A command that it performs. Of a commit [`CameBetween::check`] is asked before.
    pub(super) fn command(&mut self, command: &Command, knows: Revision) {
        self.beginnings.command(command, knows);
    }

    /// Whether nothing is left of which it could say anything.
    pub(super) fn is_over(&self) -> bool {
        self.beginnings.others_count().is_none()
    }

    /// Under which condition a commit is made, where the command is one of what had begun before.
    ///
    /// # Errors
    /// With what others have changed, as far as that was told.
    pub(super) fn check(&self, command: &Command) -> anyhow::Result<Option<Untouched>> {
        let Command::Commit { instance, writer, changes, .. } = command else { return Ok(None) };
        let began = self.beginnings.of(*instance, writer);
        let Some(behind) = began.and_then(|began| began.others_count()) else { return Ok(None) };
        match self.changed.overtakes(&self.program, writer, changes, behind) {
            Some(overtaken) => refuse(writer, &overtaken),
            None => Ok(Some(Untouched::behind(&self.program, &self.run, self.changed.up_to))),
        }
    }
}

/// Refuses to go on where others have changed what a commit overwrites or is made of.
pub(super) fn refuse<T>(writer: &str, overtaken: &Overtaken) -> anyhow::Result<T> {
    bail!(
        "what {writer} has changed is not in the world yet, and {overtaken}: run the task again, or begin it in the middle (`--from`)"
    );
}

/// The condition of a commit: others have not changed what it overwrites or is made of behind a revision up to the very one on which it is made.
#[derive(Debug)]
pub(crate) struct Untouched {
    program: Arc<Program>,
    run: String,
    /// Up to here that is so.
    seen: Revision,
    /// The commit's number in its run, where others count only when it is late.
    late: Option<(Left, Revision)>,
}

/// From when on others may not wait any more for what a run had decided when it gave something back. Clones share it.
#[derive(Debug, Clone, Default)]
pub(crate) struct Left(Arc<Mutex<VecDeque<(Revision, Instant)>>>);

impl Left {
    /// Something goes back while the commits up to `decided`, but for those up to `made`, are on their way.
    pub(super) fn goes_back(&self, decided: Revision, made: Revision, at: Instant) {
        self.is_waited_for(decided, made, at + PENDING_PATIENCE);
    }

    /// The same went back so long ago, before its run was taken up; in the order in which that was.
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

    /// Whether whoever holds now what the run held when it decided this commit may have gone on without it.
    pub(super) fn is_late(&self, commit: Revision) -> bool {
        let left = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        // In the order of numbers, and of time.
        let first = left.iter().find(|(number, _)| *number >= commit);
        first.is_some_and(|(_, until)| Instant::now() >= *until)
    }

    /// Nobody waits for anything any more.
    #[cfg(test)]
    pub(super) fn all_is_late(&self) {
        let mut left = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        left.iter_mut().for_each(|(_, until)| *until = Instant::now());
    }
}

impl Untouched {
    /// Up to this revision it is so.
    pub(super) fn behind(program: &Arc<Program>, run: &str, seen: Revision) -> Untouched {
        Untouched { program: Arc::clone(program), run: run.to_owned(), seen, late: None }
    }

    /// It counts only when the run's commit of this number is later than others wait for it.
    pub(super) fn when_late(self, left: &Left, commit: Revision) -> Untouched {
        Untouched { late: Some((left.clone(), commit)), ..self }
    }

    /// Looks whether it is so up to another revision.
    ///
    /// # Errors
    /// [`Undone::Overtaken`] where it is not.
    pub(crate) async fn up_to(
        &mut self,
        root: Revision,
        (world, trust): (&WorldClient, &Trust),
        (writer, changes): (&str, &[Change]),
    ) -> Result<(), Undone> {
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
