//! The newest position of a log that this host has seen, in a file: by it, this host recognises that an older state of etcd was restored.
//! Nothing else depends on the file. Without it, only etcd's cluster id and what this process itself has seen can show that.
//!
//! Accepting an older state begins a new generation of the log, and so does copying a log. A later generation supersedes what was seen of
//! an earlier one, so a state is accepted once, by one host, for all.

use super::term::Seen;
use serde::{Deserialize, Serialize};
use std::path::PathBuf;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

/// See the module. Clones share their knowledge.
#[derive(Debug, Clone)]
pub(super) struct Mark {
    /// `None`: nothing is kept on disk.
    file: Option<PathBuf>,
    known: Arc<Mutex<Option<Known>>>,
}

/// The content of the file.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
struct Known {
    #[serde(flatten)]
    highest: Height,
    /// etcd's revision decreased while this host was watching: it is unknown how much is missing, and no height of this generation or an
    /// earlier one shows that nothing is.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    doubted: Option<u64>,
}

/// The newest state of a log that was seen; it only grows within one log.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct Height {
    pub(super) store: u64,
    #[serde(default)]
    pub(super) generation: u64,
    pub(super) epoch: u64,
    pub(super) position: u64,
}

impl Height {
    /// `None` if there is no log.
    pub(super) fn of(seen: &Seen) -> Option<Height> {
        let meta = seen.meta.as_ref()?;
        let epoch = seen.leader.as_ref().map_or(0, |(_, leader)| leader.epoch);
        let position = seen.head.map_or(0, |(_, head)| head.position);
        Some(Height { store: meta.store, generation: meta.generation, epoch, position })
    }

    /// Whether this state contains everything of the other one, as far as heights tell, or a loss was accepted.
    fn reaches(self, known: Height) -> bool {
        let of_the_same = (self.store, self.generation) == (known.store, known.generation);
        self.generation > known.generation
            || (of_the_same && self.epoch >= known.epoch && self.position >= known.position)
    }
}

impl Mark {
    pub(super) fn new(file: Option<PathBuf>) -> Mark {
        let text = file.as_ref().and_then(|file| std::fs::read(file).ok());
        let known = text.and_then(|text| serde_json::from_slice(&text).ok());
        Mark { file, known: Arc::new(Mutex::new(known)) }
    }

    /// Whether this host has seen more than `there`, or another log.
    pub(super) fn is_above(&self, there: Option<Height>) -> bool {
        let Some(known) = *self.known() else { return false };
        let Some(there) = there else { return true };
        !there.reaches(known.highest) || known.doubted.is_some_and(|doubted| there.generation <= doubted)
    }

    /// The generation that begins if the present state is accepted.
    pub(super) fn next_generation(&self, there: Option<Height>) -> u64 {
        let known = self.known().map(|known| known.highest.generation);
        known.max(there.map(|there| there.generation)).unwrap_or(0) + 1
    }

    /// Records a height.
    pub(super) fn keep(&self, height: Height) {
        let mut known = self.known();
        let doubted = known.and_then(|known| known.doubted).filter(|doubted| *doubted >= height.generation);
        self.replace(&mut known, Known { highest: height, doubted });
    }

    /// etcd's revision has decreased: the present state does not count as complete any more, whatever its height.
    pub(super) fn doubt(&self) {
        let mut known = self.known();
        if let Some(before) = *known {
            self.replace(&mut known, Known { doubted: Some(before.highest.generation), ..before });
        }
    }

    /// A failed write of the file is only logged, because the file is only an aid.
    fn replace(&self, known: &mut Option<Known>, new: Known) {
        if known.replace(new) == Some(new) {
            return;
        }
        let Some(file) = &self.file else { return };
        let temporary = file.with_extension("new");
        let text = serde_json::to_vec(&new).unwrap_or_default();
        let made = file.parent().map_or(Ok(()), std::fs::create_dir_all);
        let written =
            made.and_then(|()| std::fs::write(&temporary, text)).and_then(|()| std::fs::rename(&temporary, file));
        if let Err(error) = written {
            tracing::warn!(file = %file.display(), %error, "it is not kept what was seen of etcd");
        }
    }

    fn known(&self) -> MutexGuard<'_, Option<Known>> {
        self.known.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;

    fn height(generation: u64, epoch: u64, position: u64) -> Height {
        Height { store: 7, generation, epoch, position }
    }

    #[test]
    fn what_was_accepted_takes_the_place_of_what_was_seen_before_and_of_nothing_later() {
        let place = tempfile::tempdir().unwrap();
        let file = Some(place.path().join("mark"));
        let mark = Mark::new(file.clone());
        assert!(!mark.is_above(None), "it has seen nothing");
        mark.keep(height(0, 5, 100));
        for again in [mark, Mark::new(file)] {
            assert!(again.is_above(None));
            assert!(again.is_above(Some(height(0, 5, 99))));
            assert!(again.is_above(Some(height(0, 4, 200))), "its writers are fewer");
            assert!(!again.is_above(Some(height(0, 6, 100))));
            assert!(!again.is_above(Some(height(1, 1, 1))), "it was accepted");
            assert!(again.is_above(Some(Height { store: 8, ..height(0, 9, 900) })));
            assert!(!again.is_above(Some(Height { store: 8, ..height(1, 1, 1) })));
            assert_eq!(again.next_generation(None), 1);
            assert_eq!(again.next_generation(Some(height(3, 1, 1))), 4);
            let again = Mark { file: None, ..again };
            again.keep(height(2, 1, 1));
            assert!(again.is_above(Some(height(1, 9, 900))));
            assert_eq!(again.next_generation(Some(height(1, 9, 900))), 3);
        }
    }

    #[test]
    fn where_etcd_went_back_no_height_of_that_generation_is_enough() {
        let place = tempfile::tempdir().unwrap();
        let file = Some(place.path().join("mark"));
        let mark = Mark::new(file.clone());
        mark.doubt();
        assert!(!mark.is_above(None), "there was nothing that could be missing");
        mark.keep(height(1, 5, 100));
        mark.doubt();
        for again in [mark, Mark::new(file)] {
            assert!(again.is_above(Some(height(1, 9, 900))));
            again.keep(height(1, 9, 900));
            assert!(again.is_above(Some(height(1, 9, 900))), "it is still doubted");
            assert!(!again.is_above(Some(height(2, 1, 1))));
        }
    }

    #[test]
    fn a_mark_of_before_there_were_generations_is_read() {
        let place = tempfile::tempdir().unwrap();
        let file = place.path().join("mark");
        std::fs::write(&file, r#"{"store":7,"epoch":5,"position":100}"#).unwrap();
        assert!(Mark::new(Some(file)).is_above(Some(height(0, 5, 99))));
    }
}
