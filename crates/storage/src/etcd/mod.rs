//! The log in etcd: for systems that must go on when a host fails.
//!
//! ```text
//!   Etcd ──open──▶ Term (the place: taken, kept, given up) ──guards──▶ Writing: frames and head, one transaction at a time
//!                                                        └──guards──▶ Compaction: snapshot, then old frames away
//! ```
//! Several processes may try to open one log; one has the writer's place, the others are refused with the name of the holder, and retry. A
//! writer that is silent for a second loses the place to the next process that asks. This module implements no consensus: etcd decides the
//! order of transactions, and every write of a frame or a snapshot is a transaction that compares the revision of `leader` and the result
//! of the write before it (`chain.rs`). So a superseded writer writes nothing, and no transaction has an effect twice.
//!
//! etcd keeps every version of every key until it is compacted: run it with `--auto-compaction-retention`.

mod chain;
mod client;
mod cluster;
mod compaction;
mod contents;
mod format;
mod keys;
mod mark;
mod owner;
mod silence;
mod term;
mod writer;

/// Generated from `proto/etcd.proto` by `scripts/generate-wire`.
#[allow(missing_docs, unreachable_pub, clippy::all, clippy::allow_attributes_without_reason, reason = "generated code")]
mod wire {
    include!("../generated/etcdserverpb.rs");
}

pub use client::Connect;
pub use format::Holder;
pub use writer::Bounds;

use crate::error::{CopyError, Fault, OpenError, ReadError};
use crate::store::{Position, Recovered, Store, Writer};
use chain::Chain;
use client::Client;
use contents::{Contents, Known};
use format::{Head, Step, text};
use keys::{Keys, delete, delete_span, written_at};
use mark::{Height, Mark};
use silence::Silence;
use std::fmt;
use std::path::PathBuf;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Instant;
use term::{Seen, Term, unreadable};
use wire::TxnRequest;
use writer::{EtcdWriter, Renewing, Shared};

/// The options of a log in etcd, and of the process that opens it.
#[derive(Clone)]
pub struct EtcdOptions {
    /// The addresses of etcd's members.
    pub endpoints: Vec<String>,
    /// Makes the connection to a member.
    pub connect: Connect,
    /// The prefix of every key of the log, for example `/ratn/cell-7/resource-manager`. No other program may use it.
    pub prefix: String,
    /// The process that opens the log, as others see it.
    pub holder: Holder,
    /// Size limits.
    pub bounds: Bounds,
    /// The file in which this host keeps the newest state of the log that it has seen; `None`: nothing is kept.
    pub mark: Option<PathBuf>,
    /// Opens the log even if an older state of etcd was restored, once: what was acknowledged since then is lost. The value is the
    /// generation that begins by it, from [`OpenError::Restored`].
    pub accept_restored: Option<u64>,
}

/// A log in etcd.
#[derive(Debug)]
pub struct Etcd {
    options: EtcdOptions,
    keys: Keys,
    client: Mutex<Arc<Client>>,
    mark: Mark,
    standby: Mutex<Standby>,
}

/// The state of a standby, while another process has the place.
#[derive(Debug, Default)]
struct Standby {
    silence: Option<Silence>,
    /// The part of the log that was read.
    known: Option<Known>,
    /// When reading failed last.
    failed: Option<Instant>,
    /// What was found is not the expected log, or may not be: the cluster has to be chosen anew.
    refused: bool,
}

impl Standby {
    /// Reads on, so that little is left to read when the place is taken.
    fn follow(known: &mut Option<Known>, failed: &mut Option<Instant>, client: &Client, keys: &Keys, seen: &Seen) {
        if failed.is_some_and(|at| at.elapsed() < FOLLOW_AGAIN) {
            return;
        }
        match contents::read(client, keys, seen, 0, known.take()) {
            Ok(read) => (*known, *failed) = (read, None),
            Err(error) => {
                // For example, it was read in the middle of a compaction.
                tracing::debug!(%error, "the log is not followed for now");
                *failed = Some(Instant::now());
            }
        }
    }
}

impl Etcd {
    /// A log with these options. Does not ask etcd yet.
    ///
    /// # Errors
    /// The options contradict each other, or the system cannot start a thread.
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
        let client = Mutex::new(connected(&options)?);
        let keys = Keys::new(&options.prefix);
        let mark = Mark::new(options.mark.clone());
        Ok(Etcd { options, keys, client, mark, standby: Mutex::default() })
    }

    /// The holder of the writer's place according to etcd; the holder may have gone without giving it up. Blocks.
    ///
    /// # Errors
    /// etcd does not answer.
    pub fn holder(&self) -> Result<Option<Holder>, ReadError> {
        Ok(Seen::look(&*self.client()?, &self.keys)?.leader.and_then(|(_, leader)| leader.holder))
    }
}

impl Etcd {
    /// The client, with its cluster chosen if any member answers.
    fn client(&self) -> Result<Arc<Client>, ReadError> {
        let client = self.client.lock().unwrap_or_else(PoisonError::into_inner).clone();
        cluster::recognise(&client, &self.keys)?;
        Ok(client)
    }

    /// If etcd's revision decreased, or another cluster counts now, a writer with the old client never writes again. A process that opens
    /// the log uses a new client.
    fn client_of_now(&self, standby: &mut Standby) -> Result<Arc<Client>, OpenError> {
        let mut client = self.client.lock().unwrap_or_else(PoisonError::into_inner);
        if client.has_gone_back() {
            self.mark.doubt();
        }
        if client.has_gone_back() || client.has_met_others() || standby.refused {
            *standby = Standby::default();
            *client = connected(&self.options)?;
        }
        let client = client.clone();
        cluster::recognise(&client, &self.keys)?;
        Ok(client)
    }

    /// The generation that begins, if an older state was restored and is to be accepted.
    fn accepted(&self, vacant: &Seen) -> Result<Option<u64>, OpenError> {
        if !vacant.is_restored(&self.mark) {
            return Ok(None);
        }
        let next = self.mark.next_generation(Height::of(vacant));
        match self.options.accept_restored {
            Some(named) if named >= next => Ok(Some(named)),
            _ => Err(vacant.refused(&self.keys, &self.mark)),
        }
    }

    /// Reads the log, and removes unfinished writes of predecessors, which were never acknowledged.
    fn begin(&self, term: &Arc<Term>, known: Option<Known>) -> Result<(Recovered, Shared, Chain), OpenError> {
        let client = &term.client;
        let seen = Seen::look(client, &self.keys)?;
        let known = contents::read(client, &self.keys, &seen, 0, known)?;
        let Contents { recovered, frames, head } = Contents::of(known, &seen);
        let last = recovered.last();
        let compacted = recovered.snapshot.as_ref().map_or(Position(0), |snapshot| snapshot.through);
        let until = Instant::now() + REACH;
        let perform =
            |request: &_| client.repeat(request, writer::PATIENCE, until).map_err(|error| term.fault("clear", &error));
        let failed = |fault: Fault| match fault {
            Fault::Deposed { .. } => self.held("somebody who took it just now"),
            other => ReadError::Remote { place: client.place(), what: other.to_string() }.into(),
        };
        let mut chain = Chain::from(self.keys.head(), head);
        let value = text(&Head { position: last.0, epoch: term.epoch.0, step: 1 });
        let left = vec![delete_span(self.keys.frames_from(last.next()))];
        chain.step(term, left, value, perform).map_err(failed)?;
        let mut snapshots = Chain::from(self.keys.step(), seen.step);
        let value = text(&Step { epoch: term.epoch.0, step: 1 });
        let left = [self.keys.snapshots_before(compacted), self.keys.snapshots_after(compacted)].map(delete_span);
        snapshots.step(term, left.into(), value, perform).map_err(failed)?;
        let shared = Shared::new(term.clone(), self.options.bounds.clone(), last, compacted, frames, snapshots);
        Ok((recovered, shared, chain))
    }

    fn held(&self, holder: &str) -> OpenError {
        OpenError::Held { place: self.keys.prefix().to_owned(), holder: holder.to_owned() }
    }

    fn system(&self, source: std::io::Error) -> OpenError {
        OpenError::Io { action: "start a thread for", place: self.options.prefix.clone(), source }
    }
}

impl Store for Etcd {
    fn open(&self) -> Result<(Recovered, Box<dyn Writer>), OpenError> {
        let mut standby = self.standby.lock().unwrap_or_else(PoisonError::into_inner);
        let client = self.client_of_now(&mut standby)?;
        let Standby { silence, known, failed, refused } = &mut *standby;
        // A process that asks only once whether there is a writer does not read the log.
        let stands_by = silence.is_some();
        let vacant = term::await_vacancy(&client, &self.keys, silence, &self.mark, |seen| {
            if stands_by {
                Standby::follow(known, failed, &client, &self.keys, seen);
            }
        });
        let vacant = vacant.inspect_err(|error| *refused = matches!(error, OpenError::Restored { .. }))?;
        let vacant = vacant.whole(&self.keys)?;
        let accepts = self.accepted(&vacant).inspect_err(|_| *refused = true)?;
        if vacant.meta.is_none() {
            cluster::may_begin(&client, &self.keys).inspect_err(|_| *refused = true)?;
        }
        let taken = term::take(&client, &self.keys, &vacant, &self.options.holder, accepts);
        if taken.is_err() {
            // The holder may have been unable to renew, as this process was: silence counts from now on.
            *silence = None;
        }
        let term = Arc::new(taken?);
        if accepts.is_some() {
            self.mark.keep(Height { store: term.store, generation: term.generation, epoch: term.epoch.0, position: 0 });
        }
        // Renew from now on: reading the log may take longer than the place lasts without renewal.
        let renewing = Renewing::start(term.clone(), self.mark.clone()).map_err(|error| self.system(error))?;
        let begun = self.begin(&term, known.take()).map_err(|error| match term.renew() {
            // What was read during another writer's changes has no meaning.
            Err(Fault::Deposed { .. }) => self.held("somebody who took it just now"),
            _ => error,
        });
        let (mut recovered, shared, chain) = begun?;
        recovered.restored = term.accepted == Some(recovered.last().0);
        let writer = EtcdWriter::start(Arc::new(shared), chain, renewing).map_err(|error| self.system(error))?;
        Ok((recovered, Box::new(writer)))
    }

    fn read(&self) -> Result<Recovered, ReadError> {
        let mut attempt = 1;
        loop {
            let client = self.client()?;
            let seen = Seen::look(&client, &self.keys)?.whole(&self.keys)?;
            match contents::read(&client, &self.keys, &seen, seen.revision, None) {
                // etcd may compact this revision while it is being read.
                Err(ReadError::Remote { .. }) if attempt < READ_ATTEMPTS => attempt += 1,
                read => return Ok(Contents::of(read?, &seen).recovered),
            }
        }
    }

    fn finish_copy(&self, moved: &str) -> Result<Option<Position>, CopyError> {
        let client = self.client()?;
        let seen = Seen::look(&client, &self.keys)?;
        let Some((written, _)) = seen.unfinished.as_ref().filter(|(_, says)| says == moved) else { return Ok(None) };
        let compare = vec![written_at(self.keys.unfinished(), *written)];
        let success = vec![delete(self.keys.unfinished())];
        let request = TxnRequest { compare, success, failure: Vec::new() };
        // If the mark is not as expected any more, an earlier attempt or the copying process has removed it, or the place was emptied.
        let answer = client.repeat(&request, term::PATIENCE, Instant::now() + REACH);
        answer.map_err(|error| unreadable(&client, &error))?;
        let seen = Seen::look(&client, &self.keys)?.whole(&self.keys)?;
        Ok(seen.head.map(|(_, head)| Position(head.position)))
    }

    fn place(&self) -> String {
        format!("{} in etcd at {}", self.keys.prefix(), self.options.endpoints.join(", "))
    }
}

fn connected(options: &EtcdOptions) -> Result<Arc<Client>, OpenError> {
    let client = Client::new(&options.endpoints, options.connect.clone());
    let place = options.prefix.clone();
    Ok(Arc::new(client.map_err(|source| OpenError::Io { action: "start a thread for", place, source })?))
}

/// Number of attempts to read a whole log at one revision of etcd.
const READ_ATTEMPTS: u32 = 3;
/// Pause after which a standby retries reading the log.
const FOLLOW_AGAIN: std::time::Duration = std::time::Duration::from_secs(1);
/// Time limit for the single operations when the log is opened.
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
