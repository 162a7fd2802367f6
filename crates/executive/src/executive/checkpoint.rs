//! A checkpoint: the whole state of an executive as bytes, so that a run resumes without the log before it.
//!
//! A restored executive gives exactly the same commands for the same further events. That needs:
//!
//! | in it | why |
//! |---|---|
//! | the mirror of the root, with the revisions of its facts | reads, and the numbers of commits |
//! | the instances with their places, outputs, waits and urgency | which instance goes on when, and the priority of its acquire |
//! | forecasts, with the earlier versions that readers were shown, and their users | a forecast that changed within its tolerance is not made again: notifications and predictions follow from its *earlier* value |
//! | earlier values of facts that somebody changed within their tolerance | the same, for changes from outside |
//! | estimated durations and paths | they are made when the window has grown enough, and hold until then |
//! | signals that no wait has taken | the next wait for their name takes them |
//! | discarded results | the result cache may use them again |
//! | results that are still being improved, with the best so far and what their goals hold | motions use them, and their leases are given back |
//! | the queue, timers, cursors, branches, lines, the interpreters with their threads | the place of everything |
//! | the remaining way out of a run that was told to end | the run ends after it |
//!
//! | not in it | because |
//! |---|---|
//! | the plan | it follows from the program. The checkpoint has its fingerprint: it fits no other program and no other catalogue |
//! | the sums of hashes of the root's facts | they are recomputed from the root, with the same result |
//! | the depth of nested forecasts, how far an event's commands have been followed | zero between two events |
//!
//! Values that several owners share are written once and shared again (`window/growth/environment/checkpoint.rs`). The mirror's facts have
//! no writers and no measurements; the world pool's facts have them. A world that a routine works on is written as its difference from the
//! root.
//!
//! The bytes: a version, a BLAKE3 hash of the rest, and the rest in postcard, which keeps floats exactly. Bytes that are torn, damaged, of
//! another version or of another program are refused before any of them is used.

use super::{Executive, State};
use crate::plan::Plan;
use crate::signals::Signals;
use crate::window::Beside;
use ratn_model::fact::FactKey;
use ratn_model::id::Revision;
use ratn_model::program::Program;
use ratn_model::time::Timestamp;
use ratn_model::tolerance::Tolerance;
use ratn_model::value::Value;
use ratn_world::world::{Fact, World};
use serde::{Deserialize, Serialize};
use std::fmt::{self, Write};
use std::sync::Arc;

/// Version of the format. Any change of what is written takes a new number: no version reads another's.
const FORMAT: u8 = 12;

type Hash = [u8; blake3::OUT_LEN];

/// Why a checkpoint cannot be restored.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum RestoreError {
    /// Another version of the executive wrote it.
    #[error("it is of format {found}, and this version of ratn reads {FORMAT}")]
    Format {
        /// Its first byte.
        found: u8,
    },
    /// The bytes are truncated, too long or damaged.
    #[error("it is torn or damaged")]
    Torn,
    /// It is intact, but belongs to another program.
    #[error("it is of another program, or the catalogue was another one")]
    OtherProgram,
    /// The bytes are intact, but their content is inconsistent.
    #[error("it contradicts itself: {0}")]
    Broken(String),
}

/// Everything but the root and the window's places.
#[derive(Serialize, Deserialize)]
struct Form<F, S, B> {
    program: Hash,
    revision: Revision,
    /// The facts of the root.
    facts: Vec<F>,
    last_instance: u64,
    seed: u64,
    signals: Signals,
    deadline: Option<Timestamp>,
    state: S,
    beside: Option<B>,
}

impl Executive {
    /// The whole state as bytes. An executive restored from them gives the same commands for the same further events.
    pub fn checkpoint(&self) -> Vec<u8> {
        let facts = self.root.iter().map(|(key, fact)| (key, &fact.value, fact.revision)).collect();
        let body = self.body(facts);
        let mut bytes = Vec::with_capacity(1 + blake3::OUT_LEN + body.len());
        bytes.push(FORMAT);
        bytes.extend(blake3::hash(&body).as_bytes());
        bytes.extend(body);
        bytes
    }

    /// Restores an executive from a [`Executive::checkpoint`].
    ///
    /// # Errors
    /// The bytes are torn, damaged, of another version or of another program.
    pub fn restore(program: Arc<Program>, tolerance: Tolerance, bytes: &[u8]) -> Result<Executive, RestoreError> {
        let (format, rest) = bytes.split_first().ok_or(RestoreError::Torn)?;
        if *format != FORMAT {
            return Err(RestoreError::Format { found: *format });
        }
        let (hash, body) = rest.split_first_chunk::<{ blake3::OUT_LEN }>().ok_or(RestoreError::Torn)?;
        if blake3::hash(body) != *hash {
            return Err(RestoreError::Torn);
        }
        Executive::new(program, tolerance).with_body(body, World::of)
    }

    /// A copy of this executive, made through a checkpoint; only the root is cloned directly.
    pub(super) fn copy(&self) -> Result<Executive, RestoreError> {
        let new = Executive {
            program: self.program.clone(),
            plan: self.plan.clone(),
            fingerprint: self.fingerprint.clone(),
            tolerance: self.tolerance,
            root: World::default(),
            last_instance: 0,
            seed: 0,
            signals: Signals::default(),
            deadline: None,
            state: State::Fresh,
        };
        new.with_body(&self.body(Vec::new()), |_, _| self.root.clone())
    }

    fn body(&self, facts: Vec<(&FactKey, &Value, Revision)>) -> Vec<u8> {
        let beside = match &self.state {
            State::Cdtn(window) => Some(window.beside(&self.root)),
            State::Fresh | State::Hsm(_) | State::Leaving(_) | State::Ended => None,
        };
        let Executive { last_instance, seed, signals, deadline, state, .. } = self;
        let (program, revision) = (self.fingerprint(), self.root.revision());
        let (last_instance, seed, deadline) = (*last_instance, *seed, *deadline);
        let signals = signals.clone();
        let form = Form { program, revision, facts, last_instance, seed, signals, deadline, state, beside };
        // Serialization cannot fail: everything has a form, and there is no I/O.
        postcard::to_extend(&form, Vec::new()).unwrap_or_default()
    }

    fn with_body(
        mut self,
        body: &[u8],
        root: impl FnOnce(Vec<(Arc<FactKey>, Arc<Fact>)>, Revision) -> World,
    ) -> Result<Executive, RestoreError> {
        let broken = |reason: &str| RestoreError::Broken(reason.to_owned());
        // The program is checked first: the form of another program may not be readable.
        let (program, _): (Hash, _) = postcard::take_from_bytes(body).map_err(|error| broken(&error.to_string()))?;
        if program != self.fingerprint() {
            return Err(RestoreError::OtherProgram);
        }
        let (form, rest): (Form<(FactKey, Value, Revision), State, Beside<'static>>, _) =
            postcard::take_from_bytes(body).map_err(|error| broken(&error.to_string()))?;
        if !rest.is_empty() {
            return Err(broken("there are bytes behind it"));
        }
        let Form { revision, facts, last_instance, seed, signals, deadline, state, beside, .. } = form;
        let fact =
            |(key, value, revision)| (Arc::new(key), Arc::new(Fact { value, revision, writer: None, measured: None }));
        self.root = root(facts.into_iter().map(fact).collect(), revision);
        (self.last_instance, self.seed, self.signals) = (last_instance, seed, signals);
        (self.deadline, self.state) = (deadline, state);
        match (&mut self.state, beside) {
            (State::Cdtn(window), Some(beside)) => {
                window.restore(&self.plan, &self.root, self.tolerance, beside).map_err(broken)?;
            }
            (State::Cdtn(_), None) => return Err(broken("a window without its places")),
            (_, Some(_)) => return Err(broken("places without a window")),
            (_, None) => {}
        }
        Ok(self)
    }

    /// Fingerprint of the program, its plan and the catalogue.
    fn fingerprint(&self) -> Hash {
        *self.fingerprint.get_or_init(|| fingerprint(&self.program, &self.plan))
    }
}

fn fingerprint(program: &Program, plan: &Plan) -> Hash {
    let mut hasher = Hashing(blake3::Hasher::new());
    // It writes into memory only, so it cannot fail.
    let _ = write!(hasher, "{} {} {plan:?}", program.name, program.digest);
    *hasher.0.finalize().as_bytes()
}

/// A writer that hashes what is written.
struct Hashing(blake3::Hasher);

impl Write for Hashing {
    fn write_str(&mut self, text: &str) -> fmt::Result {
        self.0.update(text.as_bytes());
        Ok(())
    }
}
