//! The log in etcd: for those who cannot have it stop when a host does.
//!
//! ```text
//!   Etcd ──open──▶ Term (the place: taken, kept, given up) ──guards──▶ Writing: frames and head, one transaction at a time
//!                                                        └──guards──▶ Compaction: snapshot, then old frames away
//! ```
//! Several processes may try to open one log; one has the writer's place, the others are refused with who it is, and try again. A writer
//! that says nothing for a second loses the place to whoever asks next. Nothing of consensus is here: etcd decides the order of
//! transactions, and every write is a transaction that compares the revisions of `leader` and of `head`. So a writer that was got past
//! writes nothing, and no transaction has an effect twice.
//!
//! etcd keeps every version of every key until it is compacted: run it with `--auto-compaction-retention`.

mod client;
mod compaction;
mod contents;
mod format;
mod keys;
mod term;
mod writer;

/// Generated from `proto/etcd.proto`.
#[allow(missing_docs, unreachable_pub, clippy::all, clippy::allow_attributes_without_reason, reason = "generated code")]
mod wire {
    tonic::include_proto!("etcdserverpb");
}

pub use client::Connect;
pub use format::Holder;
pub use writer::Bounds;

use crate::error::{OpenError, ReadError};
use crate::store::{Position, Recovered, Store, Writer};
use client::Client;
use keys::{Keys, delete_span};
use std::fmt;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Instant;
use term::{Seen, Silence};
use writer::{EtcdWriter, Renewing, Shared};

/// Where a log in etcd is, and who opens it.
#[derive(Clone)]
pub struct EtcdOptions {
    /// The addresses of etcd's members.
    pub endpoints: Vec<String>,
    /// How each of them is reached.
    pub connect: Connect,
    /// Before every key of the log, as `/ratn/cell-7/resource-manager`. Nobody else may use it.
    pub prefix: String,
    /// Who opens it, as others are told.
    pub holder: Holder,
    /// Bounds.
    pub bounds: Bounds,
    /// Opens the log also where an older state of etcd was restored: what was acknowledged since then is gone.
    pub accept_restored: bool,
}

/// A log in etcd.
#[derive(Debug)]
pub struct Etcd {
    options: EtcdOptions,
    keys: Keys,
    client: Arc<Client>,
    silence: Mutex<Option<Silence>>,
}

impl Etcd {
    /// The log of these options. Nothing is asked of etcd yet.
    ///
    /// # Errors
    /// Where the options contradict each other, or the system refuses a thread.
    pub fn new(options: EtcdOptions) -> Result<Etcd, OpenError> {
        let rule = |kept: bool, what: &str| match kept {
            true => Ok(()),
            false => Err(OpenError::Options { what: what.to_owned() }),
        };
        let bounds = &options.bounds;
        rule(!options.endpoints.is_empty(), "no address of etcd is given")?;
        rule(
            options.prefix.starts_with('/') && options.prefix.len() > 1,
            "the prefix has to begin with / and say more",
        )?;
        rule(bounds.part > 2 * format::FRAME_HEADER, "a part has to have at least 73 bytes")?;
        rule(bounds.buffered > bounds.record, "what is buffered has to hold at least one record")?;
        let client = Client::new(&options.endpoints, options.connect.clone());
        let client = client.map_err(|source| OpenError::Io {
            action: "start a thread for",
            place: options.prefix.clone(),
            source,
        })?;
        let keys = Keys::new(&options.prefix);
        Ok(Etcd { options, keys, client: Arc::new(client), silence: Mutex::default() })
    }

    /// Who has the writer's place, as etcd says; it may have left without a word. Blocks.
    ///
    /// # Errors
    /// Where etcd does not answer.
    pub fn holder(&self) -> Result<Option<Holder>, ReadError> {
        Ok(Seen::look(&self.client, &self.keys)?.leader.and_then(|(_, leader)| leader.holder))
    }
}

impl Store for Etcd {
    fn open(&self) -> Result<(Recovered, Box<dyn Writer>), OpenError> {
        let mut silence = self.silence.lock().unwrap_or_else(PoisonError::into_inner);
        let seen = term::await_vacancy(&self.client, &self.keys, &mut silence)?;
        let term = term::take(&self.client, &self.keys, &seen, &self.options.holder, self.options.accept_restored)?;
        let term = Arc::new(term);
        let system =
            |source| OpenError::Io { action: "start a thread for", place: self.options.prefix.clone(), source };
        // From now on: what is there may take longer to read than the place waits.
        let renewing = Renewing::start(term.clone()).map_err(system)?;
        // A transaction of the predecessor may have come between.
        let seen = Seen::look(&self.client, &self.keys)?;
        let contents = contents::read(&self.client, &self.keys, &seen, 0)?;
        let recovered = contents.recovered;
        let compacted = recovered.snapshot.as_ref().map_or(Position(0), |snapshot| snapshot.through);
        let shared =
            Shared::new(term.clone(), self.options.bounds.clone(), recovered.last(), compacted, contents.frames);
        // What predecessors had begun and nobody was told of.
        for left in [
            self.keys.frames_from(recovered.last().next()),
            self.keys.snapshots_before(compacted),
            self.keys.snapshots_after(compacted),
        ] {
            let request = term.guarded(vec![delete_span(left)]);
            let answer = self.client.repeat(&request, writer::PATIENCE, Instant::now() + REACH);
            match answer {
                Ok(answer) if answer.succeeded => {}
                Ok(_) => {
                    let place = self.keys.prefix().to_owned();
                    return Err(OpenError::Held { place, holder: "somebody who took it just now".to_owned() });
                }
                Err(error) => return Err(term::unreadable(&self.client, &error).into()),
            }
        }
        let writer = EtcdWriter::start(Arc::new(shared), contents.head, renewing).map_err(system)?;
        Ok((recovered, Box::new(writer)))
    }

    fn read(&self) -> Result<Recovered, ReadError> {
        let mut attempt = 1;
        loop {
            let seen = Seen::look(&self.client, &self.keys)?;
            match contents::read(&self.client, &self.keys, &seen, seen.revision) {
                // etcd may compact that revision away while it is read.
                Err(ReadError::Remote { .. }) if attempt < READ_ATTEMPTS => attempt += 1,
                read => return Ok(read?.recovered),
            }
        }
    }

    fn place(&self) -> String {
        format!("{} in etcd at {}", self.keys.prefix(), self.client.place())
    }
}

/// How often a whole log is read at one revision of etcd before it is given up.
const READ_ATTEMPTS: u32 = 3;
/// Attempts of what is done once, when the log is opened.
const REACH: std::time::Duration = std::time::Duration::from_secs(10);

impl fmt::Debug for EtcdOptions {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("EtcdOptions")
            .field("endpoints", &self.endpoints)
            .field("prefix", &self.prefix)
            .field("holder", &self.holder)
            .finish_non_exhaustive()
    }
}
