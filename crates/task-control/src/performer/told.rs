//! What a run was told of the world, and what it has to be told before it uses a resource that another run had.
//!
//! Runs on one system see what each other commits as changes from outside, in the order of the world pool, a moment later. A resource may change
//! hands within that moment: whoever gives one back leaves word with the resource manager of what it had committed and had been told ([`Left`]), and
//! whoever gets it next waits until it has been told as much. So runs that hold the same resource one after the other see each other's
//! doing as one program would. Only where that is late is anybody asked ([`Ask`]).

#[cfg(doc)]
use crate::record::Decided;
use ratn_model::id::Revision;
use ratn_proto::v1::HolderNote;
use std::collections::BTreeMap;
use std::fmt;
use std::str::FromStr;
use std::sync::Arc;
use std::time::{Duration, Instant};
use tokio::sync::watch;

/// Usually everything is told by then; after this it is asked for.
const USUAL: Duration = Duration::from_millis(50);
/// So often what is not told is asked for again.
const AGAIN: Duration = Duration::from_millis(500);
/// What is not known after this time never will be.
const PATIENCE: Duration = Duration::from_secs(60);
/// When so many runs were heard of, they are forgotten: who has to know of one of them asks.
const MOST_RUNS: usize = 1024;

/// What a run had committed and had been told when it gave a lease back.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Left {
    /// The revision of the root that it had been told of.
    pub(super) told: Revision,
    /// Its own number of its last commit, where it had not been told of that; else 0.
    pub(super) pending: Revision,
}

impl fmt::Display for Left {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} {}", self.told.0, self.pending.0)
    }
}

impl FromStr for Left {
    type Err = ();

    fn from_str(text: &str) -> Result<Left, ()> {
        let (told, pending) = text.split_once(' ').ok_or(())?;
        let number = |text: &str| text.parse().map(Revision).map_err(|_| ());
        Ok(Left { told: number(told)?, pending: number(pending)? })
    }
}

/// What can be asked where something is not told in time.
pub(super) trait Ask {
    /// The revision of the pool's root; `None` where it does not answer.
    async fn root(&self) -> Option<Revision>;
    /// Whether a run is under way; `None` where nobody knows.
    async fn is_under_way(&self, run: &str) -> Option<bool>;
}

/// How far the run was told. Clones share it.
#[derive(Debug, Clone)]
pub(super) struct Told(Arc<watch::Sender<Heard>>);

#[derive(Debug, Default)]
struct Heard {
    revision: Revision,
    /// Of runs, its own among them: their own numbers of their last commits.
    runs: BTreeMap<String, Revision>,
    /// Whether another run is under way beside this one, as far as was heard lately.
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

    /// The revision that was told last.
    pub(super) fn revision(&self) -> Revision {
        self.0.borrow().revision
    }

    /// Another run is under way beside this one, or none is.
    pub(super) fn beside_others(&self, has_others: bool) {
        self.0.send_if_modified(|heard| std::mem::replace(&mut heard.has_others, has_others) != has_others);
    }

    /// Whether another run is under way beside this one.
    pub(super) fn has_others(&self) -> bool {
        self.0.borrow().has_others
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
        Left { told: heard.revision, pending }
    }

    /// Waits until everything is told that these notes, of others than `own`, speak of. What a run had on its way that is not under way any more
    /// is in the pool, or never will be.
    ///
    /// # Errors
    /// Where that is not known after [`PATIENCE`]: the resources are not to be used.
    pub(super) async fn until(&self, own: &str, notes: &[HolderNote], ask: &impl Ask) -> Result<(), String> {
        let others = notes.iter().filter(|note| note.session_id != own);
        let mut others: Vec<(&str, Left)> =
            others.filter_map(|note| Some((note.session_id.as_str(), note.note.parse().ok()?))).collect();
        if others.is_empty() {
            return Ok(());
        }
        if self.is_told(&others, USUAL).await {
            return Ok(());
        }
        let began = Instant::now();
        while began.elapsed() < PATIENCE {
            for (run, left) in &mut others {
                if left.pending > Revision::default()
                    && ask.is_under_way(run).await == Some(false)
                    && let Some(root) = ask.root().await
                {
                    // What it had made until then.
                    *left = Left { told: root, pending: Revision::default() };
                }
            }
            // Nobody was told more than there is.
            if let Some(root) = ask.root().await {
                others.iter_mut().for_each(|(_, left)| left.told = left.told.min(root));
            }
            if self.is_told(&others, AGAIN).await {
                return Ok(());
            }
        }
        let runs: Vec<&str> = others.iter().map(|(run, _)| *run).collect();
        Err(format!(
            "what {} had committed when it gave them back was not told within {} s",
            runs.join(", "),
            PATIENCE.as_secs()
        ))
    }

    /// Whether all of it is told, within this time.
    async fn is_told(&self, others: &[(&str, Left)], within: Duration) -> bool {
        let is_told = |heard: &Heard| {
            others.iter().all(|(run, left)| {
                let of_run = heard.runs.get(*run).copied().unwrap_or_default();
                heard.revision >= left.told && of_run >= left.pending
            })
        };
        let mut heard = self.0.subscribe();
        tokio::time::timeout(within, heard.wait_for(is_told)).await.is_ok()
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

    /// A pool that is at a revision, or does not answer, and a run that is under way or not.
    struct Known(Option<u64>, bool);

    impl Ask for Known {
        async fn root(&self) -> Option<Revision> {
            self.0.map(Revision)
        }

        async fn is_under_way(&self, _: &str) -> Option<bool> {
            Some(self.1)
        }
    }

    async fn waits_knowing(told: &Told, session: &str, note: &str, known: Known) -> bool {
        let note = HolderNote { session_id: session.to_owned(), note: note.to_owned() };
        tokio::time::timeout(Duration::from_millis(200), told.until("run-a", &[note], &known)).await.is_err()
    }

    async fn waits(told: &Told, note: &str) -> bool {
        waits_knowing(told, "run-b", note, Known(Some(100), true)).await
    }

    #[tokio::test]
    async fn a_resource_is_used_once_what_its_last_holder_had_committed_is_told() {
        let told = Told::new();
        told.root(Revision(5));
        assert!(!waits(&told, "5 0").await);
        assert!(waits(&told, "6 0").await);
        told.hear(Revision(6), Some(("run-b".to_owned(), Revision(3))));
        assert!(!waits(&told, "6 3").await && waits(&told, "6 4").await);
        told.hear(Revision(7), Some(("run-b".to_owned(), Revision(4))));
        assert!(!waits(&told, "6 4").await);
        assert!(!waits(&told, "nonsense").await);
        assert!(!waits_knowing(&told, "run-a", "99 9", Known(Some(100), true)).await, "its own");
        assert_eq!(told.left("run-b", Revision(4)).to_string(), "7 0");
        assert_eq!(told.left("run-b", Revision(5)).to_string(), "7 5");
        assert_eq!(told.left("run-c", Revision::default()).to_string(), "7 0");
    }

    #[tokio::test]
    async fn what_a_run_had_on_its_way_that_has_ended_is_there_or_never_will_be() {
        let told = Told::new();
        told.root(Revision(5));
        assert!(!waits_knowing(&told, "run-b", "5 9", Known(Some(5), false)).await);
        assert!(
            waits_knowing(&told, "run-b", "5 9", Known(Some(6), false)).await,
            "what there is by then is to be told"
        );
        assert!(waits_knowing(&told, "run-b", "5 9", Known(None, false)).await, "nobody knows what there is");
        assert!(!waits_knowing(&told, "liar", "18446744073709551615 0", Known(Some(5), true)).await);
    }

    #[test]
    fn a_commit_says_whose_it_is() {
        let (instance, writer) = (InstanceId(7), String::new());
        let decided = Decided { instance, writer, changes: Vec::new(), evidence: Vec::new(), revision: Revision(12) };
        assert_eq!(maker(&decided.id("run-1")), Some(("run-1".to_owned(), Revision(12))));
        assert_eq!(maker("by hand"), None);
    }
}
