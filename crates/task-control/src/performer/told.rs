//! What a run was told of the world, and what it has to be told before it uses a resource that another run had.
//!
//! Runs on one system see what each other commits as changes from outside, in the order of the world pool, a moment later. A resource may change
//! hands within that moment: whoever gives one back leaves word with the resource manager of what it had committed and had been told ([`Left`]), and
//! whoever gets it next waits until it has been told as much. So runs that hold the same resource one after the other see each other's
//! doing as one program would, and no call is needed for it.

#[cfg(doc)]
use crate::record::Decided;
use ratn_model::id::Revision;
use std::collections::BTreeMap;
use std::fmt;
use std::str::FromStr;
use std::sync::Arc;
use std::time::Duration;
use tokio::sync::watch;

/// A commit that was on its way for so long has failed, with its run.
const PATIENCE: Duration = Duration::from_secs(2);
/// Of more runs beside each other nothing is kept.
const MOST_RUNS: usize = 1024;

/// What a run had committed and had been told when it gave a lease back.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Left {
    /// The revision of the root that it had been told of.
    pub(super) told: Revision,
    /// Its id.
    pub(super) run: String,
    /// Its own number of its last commit, where it had not been told of that; else 0.
    pub(super) pending: Revision,
}

impl fmt::Display for Left {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} {} {}", self.told.0, self.pending.0, self.run)
    }
}

impl FromStr for Left {
    type Err = ();

    fn from_str(text: &str) -> Result<Left, ()> {
        let mut words = text.splitn(3, ' ');
        let mut number = || words.next().and_then(|word| word.parse().ok()).map(Revision).ok_or(());
        let (told, pending) = (number()?, number()?);
        Ok(Left { told, run: words.next().ok_or(())?.to_owned(), pending })
    }
}

/// How far the run was told. Clones share it.
#[derive(Debug, Clone)]
pub(super) struct Told(Arc<watch::Sender<Heard>>);

#[derive(Debug, Default)]
struct Heard {
    revision: Revision,
    /// Of runs, its own among them: their own numbers of their last commits.
    runs: BTreeMap<String, Revision>,
    /// Whether another run is, or was, under way beside this one.
    has_others: bool,
}

impl Told {
    /// Of nothing yet.
    pub(super) fn new() -> Told {
        Told(Arc::new(watch::Sender::default()))
    }

    /// The root as it was read.
    pub(super) fn root(&self, revision: Revision) {
        self.0.send_modify(|heard| heard.revision = heard.revision.max(revision));
    }

    /// A revision whose event is before everything that is told from now on.
    pub(super) fn hear(&self, change: Revision, commit: Option<(String, Revision)>) {
        self.0.send_modify(|heard| {
            heard.revision = heard.revision.max(change);
            if let Some((run, number)) = commit {
                if heard.runs.len() >= MOST_RUNS {
                    heard.runs.clear();
                }
                let last = heard.runs.entry(run).or_default();
                *last = (*last).max(number);
            }
        });
    }

    /// Another run is under way beside this one.
    pub(super) fn beside_others(&self) {
        self.0.send_modify(|heard| heard.has_others = true);
    }

    /// Waits for so long, and until another run is known of.
    pub(super) async fn others_after(&self, time: Duration) {
        tokio::time::sleep(time).await;
        let mut heard = self.0.subscribe();
        // Whoever could tell of it is this.
        let _ = heard.wait_for(|heard| heard.has_others).await;
    }

    /// What a run leaves whose last commit is its own number `decided`.
    pub(super) fn left(&self, run: &str, decided: Revision) -> Left {
        let heard = self.0.borrow();
        let is_told = heard.runs.get(run).is_some_and(|told| *told >= decided);
        let pending = if is_told { Revision::default() } else { decided };
        Left { told: heard.revision, run: run.to_owned(), pending }
    }

    /// Waits until everything is told that these notes, of others than `own`, speak of: for [`PATIENCE`] at the most.
    pub(super) async fn until(&self, own: &str, notes: &[String]) {
        let notes: Vec<Left> = notes.iter().filter_map(|note| note.parse().ok()).collect();
        let others: Vec<&Left> = notes.iter().filter(|note| note.run != own).collect();
        if others.is_empty() {
            return;
        }
        self.beside_others();
        let is_told = |heard: &Heard| {
            others.iter().all(|note| {
                let of_run = heard.runs.get(&note.run).copied().unwrap_or_default();
                heard.revision >= note.told && of_run >= note.pending
            })
        };
        let mut heard = self.0.subscribe();
        if tokio::time::timeout(PATIENCE, heard.wait_for(is_told)).await.is_err() {
            tracing::warn!(?others, "the world pool did not tell in time what the last holder had committed");
        }
    }
}

/// The run that made a commit, and its own number of it, as [`Decided::id`] says them.
pub(super) fn maker(commit: &str) -> Option<(String, Revision)> {
    let (instance, number) = commit.rsplit_once('/')?;
    let (run, _) = instance.rsplit_once('/')?;
    let number = number.trim_start_matches(|c: char| !c.is_ascii_digit());
    Some((run.to_owned(), Revision(number.parse().ok()?)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::record::Decided;
    use ratn_model::id::InstanceId;

    fn note(told: u64, pending: u64) -> String {
        Left { told: Revision(told), run: "run-b".to_owned(), pending: Revision(pending) }.to_string()
    }

    async fn waits(told: &Told, note: String) -> bool {
        tokio::time::timeout(Duration::from_millis(100), told.until("run-a", &[note])).await.is_err()
    }

    #[tokio::test]
    async fn a_resource_is_used_once_what_its_last_holder_had_committed_is_told() {
        let told = Told::new();
        told.root(Revision(5));
        assert!(!waits(&told, note(5, 0)).await);
        assert!(waits(&told, note(6, 0)).await);
        told.hear(Revision(6), Some(("run-b".to_owned(), Revision(3))));
        assert!(!waits(&told, note(6, 3)).await && waits(&told, note(6, 4)).await);
        told.hear(Revision(7), Some(("run-b".to_owned(), Revision(4))));
        assert!(!waits(&told, note(6, 4)).await);
        assert!(!waits(&told, "nonsense".to_owned()).await);
        let own = Left { told: Revision(99), run: "run-a".to_owned(), pending: Revision(9) };
        assert!(!waits(&told, own.to_string()).await);
        assert_eq!(told.left("run-b", Revision(4)).to_string(), "7 0 run-b");
        assert_eq!(told.left("run-b", Revision(5)).to_string(), "7 5 run-b");
        assert_eq!(told.left("run-c", Revision::default()).to_string(), "7 0 run-c");
    }

    #[test]
    fn a_commit_says_whose_it_is() {
        let (instance, writer) = (InstanceId(7), String::new());
        let decided = Decided { instance, writer, changes: Vec::new(), evidence: Vec::new(), revision: Revision(12) };
        assert_eq!(maker(&decided.id("run-1")), Some(("run-1".to_owned(), Revision(12))));
        assert_eq!(maker("by hand"), None);
    }

    #[tokio::test]
    async fn what_is_never_told_is_waited_for_no_longer_than_a_while() {
        let began = std::time::Instant::now();
        Told::new().until("run-a", &[note(6, 4)]).await;
        assert!(began.elapsed() >= PATIENCE);
    }
}
