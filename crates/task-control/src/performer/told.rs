//! Tracks what the world pool has reported to a run, and what it has to report before the run uses a resource that another run had.
//!
//! Runs on one system see each other's commits as changes from outside, in the order of the world pool, with a short delay. A resource may change
//! hands within that delay. So a run that releases a resource leaves a note with the resource manager about what it had committed and received
//! ([`Left`]), and the next holder waits until it has received as much. Runs that hold the same resource in turn therefore see each other's effects
//! as one program would. The pool and the resource manager are asked ([`Ask`]) only if a report is late.

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

/// Usually every report has arrived after this time; later, the pool is asked.
const USUAL: Duration = Duration::from_millis(50);
/// Interval at which a missing report is asked for again.
const AGAIN: Duration = Duration::from_millis(500);
/// After this time the run stops waiting for an answer.
const PATIENCE: Duration = Duration::from_secs(60);
/// A commit of a running run that has not reached an answering pool after this time is not waited for: it will not come, or was never made. This is
/// longer than the time for which the calls before it in its run are repeated ([`crate::decided`]); a later commit is made only if nobody has changed
/// what it is based on (`came_between`).
pub(super) const PENDING_PATIENCE: Duration = Duration::from_secs(45);
/// Maximum number of other runs that are remembered; beyond it the run with the oldest report is forgotten, and asked about if needed.
const MOST_RUNS: usize = 1024;

/// The note of a run: what it had committed and received when it released a lease.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Left {
    /// The newest revision of the root that it had received.
    pub(super) told: Revision,
    /// The number of its last commit, if the pool had not reported that commit yet; else 0.
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

/// What can be asked if a report is late.
pub(super) trait Ask {
    /// The revision of the pool's root; `None` if the pool does not answer.
    async fn root(&self) -> Option<Revision>;
    /// Whether a run is under way; `None` if unknown.
    async fn is_under_way(&self, run: &str) -> Option<bool>;
}

/// What the run has received from the pool. Clones share it.
#[derive(Debug, Clone)]
pub(super) struct Told {
    /// The id of this run.
    run: Arc<str>,
    heard: Arc<watch::Sender<Heard>>,
}

#[derive(Debug, Default)]
struct Heard {
    revision: Revision,
    /// The number of the run's own last reported commit.
    own: Revision,
    /// For other runs: the number of their last reported commit, and the serial number of that report.
    runs: BTreeMap<String, (Revision, u64)>,
    /// The last serial number.
    hearings: u64,
    /// Whether another run is under way beside this one, according to the last news.
    has_others: bool,
}

impl Heard {
    /// The number of another run's last reported commit.
    fn number(&self, run: &str) -> Revision {
        self.runs.get(run).map(|(number, _)| *number).unwrap_or_default()
    }

    /// Records that a run has committed, by the run's own number.
    fn of(&mut self, own: &str, run: String, number: Revision) {
        if run == own {
            self.own = self.own.max(number);
            return;
        }
        if self.runs.len() >= MOST_RUNS
            && !self.runs.contains_key(&run)
            && let Some(oldest) = self.runs.iter().min_by_key(|(_, (_, heard))| *heard)
        {
            let oldest = oldest.0.clone();
            self.runs.remove(&oldest);
        }
        self.hearings += 1;
        let last = self.runs.entry(run).or_default();
        *last = (last.0.max(number), self.hearings);
    }
}

impl Told {
    /// A run that has received nothing yet.
    pub(super) fn new(run: &str) -> Told {
        Told { run: run.into(), heard: Arc::new(watch::Sender::default()) }
    }

    /// The run's commits up to this number are contained in the root that was read.
    pub(super) fn committed(&self, number: Revision) {
        self.heard.send_modify(|heard| heard.own = heard.own.max(number));
    }

    /// The root was read at this revision.
    pub(super) fn root(&self, revision: Revision) {
        self.heard.send_modify(|heard| heard.revision = heard.revision.max(revision));
    }

    /// A revision was reported; its event comes before all later ones.
    pub(super) fn hear(&self, change: Revision, commit: Option<(String, Revision)>) {
        self.heard.send_modify(|heard| {
            heard.revision = heard.revision.max(change);
            if let Some((run, number)) = commit {
                heard.of(&self.run, run, number);
            }
        });
    }

    /// The newest reported revision.
    pub(super) fn revision(&self) -> Revision {
        self.heard.borrow().revision
    }

    /// Records whether another run is under way beside this one.
    pub(super) fn beside_others(&self, has_others: bool) {
        self.heard.send_if_modified(|heard| std::mem::replace(&mut heard.has_others, has_others) != has_others);
    }

    /// Whether another run is under way beside this one.
    pub(super) fn has_others(&self) -> bool {
        self.heard.borrow().has_others
    }

    /// Waits for this time, and until another run is known.
    pub(super) async fn others_after(&self, time: Duration) {
        tokio::time::sleep(time).await;
        let mut heard = self.heard.subscribe();
        // The sender is `self`.
        let _ = heard.wait_for(|heard| heard.has_others).await;
    }

    /// The note of this run if its last commit has the number `decided`.
    pub(super) fn left(&self, decided: Revision) -> Left {
        let heard = self.heard.borrow();
        let pending = if heard.own >= decided { Revision::default() } else { decided };
        Left { told: heard.revision, pending }
    }

    /// Waits until everything that these notes of others mention has been reported. What an ended run had not committed yet is in the pool, or never
    /// will be. A note is only a claim of its author: if the pool answers, it can delay the run by at most [`PENDING_PATIENCE`], but not block it; a
    /// false claim of a run is not waited for again.
    ///
    /// # Errors
    /// The pool, or the resource manager, has not answered after [`PATIENCE`]: the resources must not be used.
    pub(super) async fn until(&self, notes: &[HolderNote], ask: &impl Ask) -> Result<(), String> {
        self.until_claimed(notes, ask, PENDING_PATIENCE).await
    }

    async fn until_claimed(&self, notes: &[HolderNote], ask: &impl Ask, claimed: Duration) -> Result<(), String> {
        let others = notes.iter().filter(|note| *note.session_id != *self.run);
        let mut others: Vec<(&str, Left)> =
            others.filter_map(|note| Some((note.session_id.as_str(), note.note.parse().ok()?))).collect();
        if others.is_empty() {
            return Ok(());
        }
        if self.is_told(&others, USUAL).await {
            return Ok(());
        }
        let began = Instant::now();
        let mut pool_answers: Option<Instant> = None;
        while began.elapsed() < PATIENCE {
            for (run, left) in &mut others {
                if left.pending == Revision::default() || self.has_heard(run, left.pending) {
                    continue;
                }
                let is_claim = pool_answers.is_some_and(|since| since.elapsed() >= claimed);
                if (is_claim || ask.is_under_way(run).await == Some(false))
                    && let Some(root) = ask.root().await
                {
                    if is_claim {
                        let (pending, run) = (left.pending, (*run).to_owned());
                        tracing::warn!(run, %pending, "what it left word of was not committed in time, and is not waited for any more");
                        self.hear(Revision::default(), Some((run, pending)));
                    }
                    // What the run had committed until then.
                    *left = Left { told: root, pending: Revision::default() };
                }
            }
            // A run cannot have received more than the pool has.
            match ask.root().await {
                Some(root) => {
                    pool_answers.get_or_insert_with(Instant::now);
                    others.iter_mut().for_each(|(_, left)| left.told = left.told.min(root));
                }
                None => pool_answers = None,
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

    /// Whether a commit of another run was reported, by that run's number.
    fn has_heard(&self, run: &str, number: Revision) -> bool {
        self.heard.borrow().number(run) >= number
    }

    /// Whether everything is reported within this time.
    async fn is_told(&self, others: &[(&str, Left)], within: Duration) -> bool {
        let is_told = |heard: &Heard| {
            others.iter().all(|(run, left)| heard.revision >= left.told && heard.number(run) >= left.pending)
        };
        let mut heard = self.heard.subscribe();
        tokio::time::timeout(within, heard.wait_for(is_told)).await.is_ok()
    }
}

/// The run that made a commit, and the run's number of it, from the commit id ([`Decided::id`]).
pub(super) fn maker(commit: &str) -> Option<(String, Revision)> {
    let (instance, number) = commit.rsplit_once('/')?;
    let (run, _) = instance.rsplit_once('/')?;
    let number = number.trim_start_matches(|c: char| !c.is_ascii_digit());
    Some((run.to_owned(), Revision(number.parse().ok()?)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ledger::Began;
    use crate::record::Decided;
    use ratn_model::id::InstanceId;

    /// A pool at a revision, or one that does not answer, and a run that is under way or not.
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
        tokio::time::timeout(Duration::from_millis(200), told.until(&[note], &known)).await.is_err()
    }

    async fn waits(told: &Told, note: &str) -> bool {
        waits_knowing(told, "run-b", note, Known(Some(100), true)).await
    }

    #[tokio::test]
    async fn a_resource_is_used_once_what_its_last_holder_had_committed_is_told() {
        let told = Told::new("run-a");
        told.root(Revision(5));
        assert!(!waits(&told, "5 0").await);
        assert!(waits(&told, "6 0").await);
        told.hear(Revision(6), Some(("run-b".to_owned(), Revision(3))));
        assert!(!waits(&told, "6 3").await && waits(&told, "6 4").await);
        told.hear(Revision(7), Some(("run-b".to_owned(), Revision(4))));
        assert!(!waits(&told, "6 4").await);
        assert!(!waits(&told, "nonsense").await);
        assert!(!waits_knowing(&told, "run-a", "99 9", Known(Some(100), true)).await, "its own");
        assert_eq!(told.left(Revision::default()).to_string(), "7 0");
        assert_eq!(told.left(Revision(5)).to_string(), "7 5");
        told.hear(Revision(8), Some(("run-a".to_owned(), Revision(5))));
        assert_eq!(told.left(Revision(5)).to_string(), "8 0");
    }

    #[tokio::test]
    async fn however_many_others_are_heard_of_a_run_knows_of_itself_and_of_those_heard_last() {
        let told = Told::new("run-a");
        told.hear(Revision(1), Some(("run-a".to_owned(), Revision(12))));
        told.hear(Revision(2), Some(("run-old".to_owned(), Revision(1))));
        told.hear(Revision(3), Some(("run-b".to_owned(), Revision(3))));
        for number in 0..2 * MOST_RUNS as u64 {
            told.hear(Revision(4 + number), Some((format!("other-{number}"), Revision(1))));
            told.hear(Revision(4 + number), Some(("run-b".to_owned(), Revision(4 + number))));
            assert!(told.heard.borrow().runs.len() <= MOST_RUNS);
        }
        assert_eq!(told.left(Revision(12)).pending, Revision(0), "what it has heard of itself");
        assert!(!waits(&told, "5 1000").await, "run-b is heard of all the time");
        assert!(waits_knowing(&told, "run-old", "5 1", Known(Some(100), true)).await, "it is forgotten, and asked for");
    }

    #[tokio::test]
    async fn a_note_of_what_is_never_committed_delays_and_does_not_refuse() {
        let told = Told::new("run-a");
        told.root(Revision(5));
        let note = |pending: u64| HolderNote { session_id: "liar".to_owned(), note: format!("0 {pending}") };
        let (began, known) = (Instant::now(), Known(Some(5), true));
        let patience = Duration::from_secs(2);
        assert_eq!(told.until_claimed(&[note(u64::MAX)], &known, patience).await, Ok(()));
        let took = began.elapsed();
        assert!(patience <= took && took < patience + Duration::from_secs(3), "{took:?}");
        // Nor does a second claim of the liar cause a wait.
        assert!(!waits_knowing(&told, "liar", "0 7", Known(Some(5), true)).await);
        // A pool that does not answer does not say that it lacks the commit.
        let told = Told::new("run-a");
        let (notes, silent) = ([note(7)], Known(None, true));
        let silent = told.until_claimed(&notes, &silent, patience);
        assert!(tokio::time::timeout(patience + Duration::from_secs(2), silent).await.is_err());
    }

    #[tokio::test]
    async fn what_a_run_had_on_its_way_that_has_ended_is_there_or_never_will_be() {
        let told = Told::new("run-a");
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
        let decided = Decided {
            instance,
            writer,
            changes: Vec::new(),
            evidence: Vec::new(),
            revision: Revision(12),
            began: Began::default(),
            guard: None,
            knew: Revision::default(),
            behind: 0,
        };
        assert_eq!(maker(&decided.id("run-1")), Some(("run-1".to_owned(), Revision(12))));
        assert_eq!(maker("by hand"), None);
    }
}
