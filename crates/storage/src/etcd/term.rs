//! The writer's place: its holder, and how it is taken, kept and given up.
//!
//! ```text
//!   vacant ──take──▶ held: `alive` is written every 250 ms ──give up──▶ vacant
//!                      │ `alive` was not written for a second
//!                      └──take──▶ held by another: every write of the first is refused from now on
//! ```
//! Safety comes from the guards, not from time: every write compares the revision of `leader`, which changes whenever the place is taken.
//! Time only decides when another process may take it. The process that takes it compares `alive`, too: so the last confirmation of its
//! predecessor was requested before the silence began.
//!
//! A holder that gets no answers may not acknowledge anything, so it must not keep the place either: it writes `alive` once, to at most two
//! members, and from then on only reads, until a read is answered.
//!
//! A holder whose owner takes no turns must not keep the place either (`owner.rs`): it only reads, and confirms nothing, until the owner
//! takes a turn.
//!
//! While etcd has no space, `alive` cannot be written, and no process can take the place. The holder confirms itself by deleting
//! `writable`, which needs no space. A process that wants the place compares `writable` as well, and writes it if it does not exist:
//! silence begins with that write, because the last confirmation may be just as recent.

use super::client::{CallError, Client, Patience, cluster_of};
use super::format::{Current, Head, Holder, Leader, Meta, VERSION, parse, text};
use super::keys::{Keys, delete, found_one, get, look, put, written_at};
use super::mark::{Height, Mark};
use super::owner::LONGEST_TURN;
use super::silence::{self, Signs, Silence, Verdict};
use super::wire::{Compare, KeyValue, RequestOp, TxnRequest, TxnResponse};
use crate::error::{Fault, OpenError, ReadError};
use crate::store::{Epoch, Place};
use bytes::Bytes;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

/// Interval at which the holder writes `alive`.
pub(super) const RENEW_INTERVAL: Duration = Duration::from_millis(250);
/// Interval of checks by a process that wants the place.
const LOOK_INTERVAL: Duration = Duration::from_millis(50);
/// Number of members asked for a renewal: a third one would get the request when the first has been without an answer for too long.
const RENEWAL_ASKS: usize = 2;
/// Time limit for a small transaction.
pub(super) const PATIENCE: Duration = Duration::from_millis(900);
/// If only another cluster answers for this long, the original cluster is given up.
pub(super) const OTHERS_PATIENCE: Duration = Duration::from_secs(5);
/// Without an answer of any member for this long, etcd counts as unreachable.
const REACH: Duration = Duration::from_secs(5);

/// The value of `unfinished` until a copy is complete.
pub(super) const PART_OF_A_COPY: &str = "a copy is being made";

/// All small keys, as they were at one revision.
#[derive(Debug)]
pub(super) struct Seen {
    pub(super) meta: Option<Meta>,
    pub(super) leader: Option<(i64, Leader)>,
    pub(super) head: Option<(i64, Head)>,
    /// The revision at which `step` was written.
    pub(super) step: i64,
    /// The position of the snapshot that counts.
    pub(super) through: Option<u64>,
    /// The log is part of a copy: the revision at which that was marked, and the mark's text.
    pub(super) unfinished: Option<(i64, String)>,
    /// The log was moved to this place.
    moved: Option<String>,
    signs: Signs,
    /// etcd's cluster id.
    pub(super) cluster: u64,
    /// etcd's revision.
    pub(super) revision: i64,
}

/// The place, while it is held.
#[derive(Debug)]
pub(super) struct Term {
    pub(super) client: Arc<Client>,
    pub(super) keys: Keys,
    pub(super) epoch: Epoch,
    pub(super) store: u64,
    pub(super) generation: u64,
    /// The record after which an older state was accepted.
    pub(super) accepted: Option<u64>,
    /// The revision of `leader`: every write compares it.
    leader: i64,
    draw: u64,
    lost: AtomicBool,
    /// The last renewal was not answered.
    unheard: AtomicBool,
    /// `writable` was taken away: etcd has no space.
    unwritable: AtomicBool,
    /// The writer's owner takes no turns.
    owner_hangs: AtomicBool,
}

impl Seen {
    pub(super) fn look(client: &Client, keys: &Keys) -> Result<Seen, ReadError> {
        let small = [
            keys.meta(),
            keys.leader(),
            keys.head(),
            keys.alive(),
            keys.step(),
            keys.writable(),
            keys.current(),
            keys.unfinished(),
            keys.moved(),
        ];
        let request = look(small.map(get).into());
        let answer = client.repeat(&request, PATIENCE, Instant::now() + REACH);
        let answer = answer.map_err(|error| unreadable(client, &error))?;
        Seen::of(keys, answer)
    }

    fn of(keys: &Keys, answer: TxnResponse) -> Result<Seen, ReadError> {
        let (cluster, revision) =
            (cluster_of(answer.header.as_ref()), answer.header.as_ref().map_or(0, |header| header.revision));
        let mut found = answer.responses.into_iter();
        let mut next = || found_one(found.next());
        let meta: Option<Meta> = next().map(|kv| parse(&keys.meta(), &kv.value)).transpose()?;
        let leader = with_revision(next(), &keys.leader())?;
        let head = with_revision(next(), &keys.head())?;
        let [alive, step, writable] = [(); 3].map(|()| next().map_or(0, |kv| kv.mod_revision));
        let signs = Signs { leader: leader.as_ref().map_or(0, |(revision, _)| *revision), alive, writable };
        let current: Option<Current> = next().map(|kv| parse(&keys.current(), &kv.value)).transpose()?;
        let through = current.map(|current| current.through);
        let says = |kv: KeyValue| (kv.mod_revision, String::from_utf8_lossy(&kv.value).into_owned());
        let unfinished = next().map(says);
        let moved = next().map(|kv| says(kv).1);
        if let Some(newer) = meta.as_ref().filter(|meta| meta.version > VERSION) {
            let place = keys.prefix().to_owned();
            return Err(ReadError::Newer { place, found: newer.version, supported: VERSION });
        }
        Ok(Seen { meta, leader, head, step, signs, through, unfinished, moved, cluster, revision })
    }

    /// Refuses an unfinished copy, and a log that was moved.
    pub(super) fn whole(self, keys: &Keys) -> Result<Seen, ReadError> {
        let prefix = keys.prefix();
        let place = format!("{prefix} in etcd");
        match (&self.unfinished, &self.moved) {
            (Some((_, says)), _) => {
                let complete = says != PART_OF_A_COPY;
                Err(ReadError::Unfinished { place, complete, how: format!("etcdctl del --prefix {prefix}/") })
            }
            (None, Some(to)) => {
                let how = format!("etcdctl del {}", String::from_utf8_lossy(&keys.moved()));
                Err(ReadError::Moved { place, to: to.clone(), how })
            }
            (None, None) => Ok(self),
        }
    }

    /// Whether an older state was restored, as far as this host can see.
    pub(super) fn is_restored(&self, mark: &Mark) -> bool {
        mark.is_above(Height::of(self)) || self.meta.as_ref().is_some_and(|meta| meta.cluster != self.cluster)
    }

    pub(super) fn refused(&self, keys: &Keys, mark: &Mark) -> OpenError {
        let generation = mark.next_generation(Height::of(self));
        OpenError::Restored { place: keys.prefix().to_owned(), generation }
    }

    fn holder(&self) -> Option<&Holder> {
        self.leader.as_ref().and_then(|(_, leader)| leader.holder.as_ref())
    }

    /// A condition: no holder has written anything since.
    fn unchanged(&self, keys: &Keys) -> Vec<Compare> {
        let Signs { leader, alive, writable } = self.signs;
        vec![written_at(keys.leader(), leader), written_at(keys.alive(), alive), written_at(keys.writable(), writable)]
    }
}

/// A condition: the log is neither an unfinished copy nor moved.
fn unmarked(keys: &Keys) -> Vec<Compare> {
    vec![written_at(keys.unfinished(), 0), written_at(keys.moved(), 0)]
}

/// The generation of a copy that is made now: the seconds since 1970. Other generations continue from the one before.
fn copied_now() -> u64 {
    #[expect(
        clippy::disallowed_methods,
        reason = "it has to grow from one host to another; where it does not, the copy is refused"
    )]
    let now = SystemTime::now();
    now.duration_since(UNIX_EPOCH).map_or(0, |since| since.as_secs())
}

fn with_revision<T: serde::de::DeserializeOwned>(
    kv: Option<KeyValue>,
    key: &Bytes,
) -> Result<Option<(i64, T)>, ReadError> {
    kv.map(|kv| parse(key, &kv.value).map(|value| (kv.mod_revision, value))).transpose()
}

/// Checks until the place can be taken, or its holder writes something: then `held` is called.
pub(super) fn await_vacancy(
    client: &Client,
    keys: &Keys,
    silence: &mut Option<Silence>,
    mark: &Mark,
    held: impl FnOnce(&Seen),
) -> Result<Seen, OpenError> {
    loop {
        let seen = Seen::look(client, keys)?;
        let Some(holder) = seen.holder() else { return Ok(seen) };
        match silence::look(silence, seen.signs, Instant::now()) {
            Verdict::Over => return Ok(seen),
            Verdict::Spoke => {
                let holder = format!("{}, {}", holder.about, holder.address);
                let height = Height::of(&seen);
                if mark.is_above(height) {
                    return Err(seen.refused(keys, mark));
                }
                height.into_iter().for_each(|height| mark.keep(height));
                held(&seen);
                return Err(OpenError::Held { place: keys.prefix().to_owned(), holder });
            }
            Verdict::Unwritable => {
                let success = vec![put(keys.writable(), text(&seen.signs.leader))];
                let request = TxnRequest { compare: seen.unchanged(keys), success, failure: Vec::new() };
                // The next check shows whether it exists.
                if let Err(error) = client.attempt(request, PATIENCE) {
                    return Err(unreadable(client, &error).into());
                }
            }
            Verdict::Undecided => {}
        }
        std::thread::sleep(LOOK_INTERVAL);
    }
}

/// Takes the place, if no process has taken it or written anything since the check, and if the log is still complete and not moved: from
/// then on only the new holder can mark it so. `accepts`: the generation that begins if an older state is accepted.
pub(super) fn take(
    client: &Arc<Client>,
    keys: &Keys,
    seen: &Seen,
    holder: &Holder,
    accepts: Option<u64>,
) -> Result<Term, OpenError> {
    let draw = || {
        crate::draw::number().map_err(|source| OpenError::Io {
            action: "draw a number for",
            place: keys.prefix().to_owned(),
            source,
        })
    };
    let mut meta = match &seen.meta {
        Some(meta) => Meta { cluster: seen.cluster, ..meta.clone() },
        None => Meta { version: VERSION, store: draw()?, cluster: seen.cluster, generation: 0, accepted: None },
    };
    if let Some(generation) = accepts {
        (meta.generation, meta.accepted) = (generation, Some(seen.head.map_or(0, |(_, head)| head.position)));
    }
    let epoch = seen.leader.as_ref().map_or(0, |(_, leader)| leader.epoch) + 1;
    let leader = Leader { epoch, holder: Some(holder.clone()), draw: draw()? };
    let success = vec![
        put(keys.leader(), text(&leader)),
        put(keys.alive(), text(&epoch)),
        put(keys.writable(), text(&epoch)),
        put(keys.meta(), text(&meta)),
    ];
    let compare = [seen.unchanged(keys), unmarked(keys)].concat();
    let request = TxnRequest { compare, success, failure: vec![get(keys.leader())] };
    // A repetition finds what the transaction itself wrote.
    let answer = client.repeat(&request, PATIENCE, Instant::now() + REACH);
    let answer = answer.map_err(|error| OpenError::Read(unreadable(client, &error)))?;
    let revision = match answer.succeeded {
        true => answer.header.as_ref().map_or(0, |header| header.revision),
        false => {
            let found: Option<(i64, Leader)> =
                with_revision(found_one(answer.responses.into_iter().next()), &keys.leader())?;
            match found {
                Some((revision, found)) if found == leader => revision,
                found => {
                    let holder = found.and_then(|(_, leader)| leader.holder).unwrap_or_default();
                    let holder = format!("{}, {}", holder.about, holder.address);
                    return Err(OpenError::Held { place: keys.prefix().to_owned(), holder });
                }
            }
        }
    };
    Ok(Term {
        client: client.clone(),
        keys: keys.clone(),
        epoch: leader.epoch(),
        store: meta.store,
        generation: meta.generation,
        accepted: meta.accepted,
        leader: revision,
        draw: leader.draw,
        lost: AtomicBool::new(false),
        unheard: AtomicBool::new(false),
        unwritable: AtomicBool::new(false),
        owner_hangs: AtomicBool::new(false),
    })
}

impl Term {
    /// Held since a revision, for tests of guarded transactions.
    #[cfg(test)]
    pub(super) fn since(client: Arc<Client>, keys: Keys, leader: i64) -> Term {
        let [lost, unheard, unwritable, owner_hangs] = [(); 4].map(|()| AtomicBool::new(false));
        let (epoch, store, generation, accepted, draw) = (Epoch(1), 1, 0, None, 1);
        Term { client, keys, epoch, store, generation, accepted, leader, draw, lost, unheard, unwritable, owner_hangs }
    }

    /// The metadata of a log that becomes a copy. Its generation is above those of all earlier states, here or elsewhere: so a host that
    /// has seen one of those accepts the copy, and accepts none of those in place of the copy.
    pub(super) fn meta_of_a_copy(&self) -> Meta {
        let generation = self.generation.max(copied_now());
        let cluster = self.client.cluster().unwrap_or_default();
        Meta { version: VERSION, store: self.store, cluster, generation, accepted: None }
    }

    /// A condition: the place is still held.
    pub(super) fn guard(&self) -> Compare {
        written_at(self.keys.leader(), self.leader)
    }

    /// A transaction that is performed only while the place is held.
    pub(super) fn guarded(&self, success: Vec<RequestOp>) -> TxnRequest {
        TxnRequest { compare: vec![self.guard()], success, failure: Vec::new() }
    }

    /// Whether `leader`, written at this revision, means that the place is still held.
    pub(super) fn is_since(&self, leader: i64) -> bool {
        leader == self.leader
    }

    pub(super) fn deposed(&self) -> Fault {
        self.lost.store(true, Ordering::SeqCst);
        Fault::Deposed { place: self.keys.prefix().to_owned() }
    }

    /// Renews the place, visible to all, and confirms that it is held.
    pub(super) fn renew(&self) -> Result<(), Fault> {
        if self.lost.load(Ordering::SeqCst) {
            return Err(self.deposed());
        }
        let owner_hangs = self.owner_hangs.load(Ordering::SeqCst);
        if self.unheard.load(Ordering::SeqCst) || owner_hangs {
            self.look()?;
        }
        if owner_hangs {
            let what = format!("its process has taken no turn for {} s", LONGEST_TURN.as_secs());
            return Err(Fault::Remote { action: "keep", place: self.keys.prefix().to_owned(), what });
        }
        // The place was given up meanwhile.
        if self.lost.load(Ordering::SeqCst) {
            return Err(self.deposed());
        }
        let mut alive = vec![put(self.keys.alive(), text(&self.epoch.0))];
        let was_unwritable = self.unwritable.load(Ordering::SeqCst);
        if was_unwritable {
            alive.push(put(self.keys.writable(), text(&self.epoch.0)));
        }
        let patience = Patience { answer: PATIENCE, asks: RENEWAL_ASKS };
        let renewed = match self.client.attempt(self.guarded(alive), patience) {
            // `alive` cannot be written, but others can be kept from taking the place.
            Err(CallError::NoSpace) => {
                self.unwritable.store(true, Ordering::SeqCst);
                self.held(self.client.attempt(self.guarded(vec![delete(self.keys.writable())]), PATIENCE))
            }
            answer => {
                if was_unwritable && answer.is_ok() {
                    self.unwritable.store(false, Ordering::SeqCst);
                }
                self.held(answer)
            }
        };
        self.unheard.store(matches!(renewed, Err(Fault::Remote { .. })), Ordering::SeqCst);
        renewed
    }

    /// Why the place will never be held again: etcd's revision decreased, or only another cluster has answered for long.
    pub(super) fn is_gone(&self) -> Option<Fault> {
        let error = self.client.went_back().or_else(|| self.client.only_others_for(OTHERS_PATIENCE))?;
        Some(self.fault("keep", &error))
    }

    /// Sets whether the writer's owner hangs. While it does, the place is neither confirmed nor kept.
    pub(super) fn owner_hangs(&self, hangs: bool) {
        if self.owner_hangs.swap(hangs, Ordering::SeqCst) != hangs {
            let place = self.keys.prefix();
            match hangs {
                true => tracing::error!(place, "this process takes no turns: it does not keep its place"),
                false => tracing::warn!(place, "this process takes its turns again"),
            }
        }
    }

    /// Checks whether the place is still held, without renewing it.
    fn look(&self) -> Result<(), Fault> {
        self.held(self.client.attempt(self.guarded(vec![get(self.keys.leader())]), PATIENCE))
    }

    /// Interprets the answer to a guarded transaction.
    fn held(&self, answer: Result<TxnResponse, CallError>) -> Result<(), Fault> {
        match answer {
            Ok(answer) if answer.succeeded => Ok(()),
            Ok(_) => Err(self.deposed()),
            Err(error) => Err(self.fault("ask for", &error)),
        }
    }

    /// Gives the place up, so that the next process can take it at once. If etcd does not answer, it is unknown whether this had an effect.
    pub(super) fn give_up(&self) {
        let vacant = Leader { epoch: self.epoch.0, holder: None, draw: self.draw };
        let request = self.guarded(vec![put(self.keys.leader(), text(&vacant)), delete(self.keys.alive())]);
        self.lost.store(true, Ordering::SeqCst);
        let _ = self.client.attempt(request, PATIENCE);
    }

    pub(super) fn fault(&self, action: &'static str, error: &CallError) -> Fault {
        Fault::Remote { action, place: self.keys.prefix().to_owned(), what: error.to_string() }
    }
}

/// The place, for checks independent of the writer.
#[derive(Debug, Clone)]
pub(super) struct HeldPlace(pub(super) Arc<Term>);

impl Place for HeldPlace {
    fn check(&self) -> Result<(), Fault> {
        self.0.renew()
    }
}

pub(super) fn unreadable(client: &Client, error: &CallError) -> ReadError {
    ReadError::Remote { place: client.place(), what: error.to_string() }
}
