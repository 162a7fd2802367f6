//! The writer's place: who has it, how it is taken, kept and given up.
//!
//! ```text
//!   vacant ──take──▶ held: `alive` is written every 250 ms ──give up──▶ vacant
//!                      │ `alive` was not written for a second
//!                      └──take──▶ held by another: every write of the first is refused from now on
//! ```
//! Safety is in the guards, not in time: every write compares the revision of `leader`, which whoever takes the place changes. Time only
//! decides when somebody else may take it. Who takes it compares `alive`, too: so the last confirmation of its predecessor was asked for
//! before the silence began.
//!
//! A holder that hears no answers may say nothing, so it must not keep the place either: it writes `alive` once, to two members at the most,
//! and from then on only looks, until a look is answered.
//!
//! Nor must a holder keep the place whose owner takes no turns (`owner.rs`): it only looks, and confirms nothing, until the owner takes one.
//!
//! While etcd has no space `alive` cannot be written, and nobody can take the place. The holder confirms itself by taking `writable` away,
//! which needs no space. Who wants the place compares `writable` as well, and writes it where it is not there: silence begins with that, for
//! the last confirmation may be as young.

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

/// Who has the place writes `alive` so often.
pub(super) const RENEW_INTERVAL: Duration = Duration::from_millis(250);
/// How often somebody looks who wants the place.
const LOOK_INTERVAL: Duration = Duration::from_millis(50);
/// A renewal is asked of so many members: one more would arrive when the first has been without an answer for too long.
const RENEWAL_ASKS: usize = 2;
/// A small transaction that takes longer comes too late.
pub(super) const PATIENCE: Duration = Duration::from_millis(900);
/// Where only another cluster answers for so long, the one of before is not waited for any more.
pub(super) const OTHERS_PATIENCE: Duration = Duration::from_secs(5);
/// After so long without an answer of any member there is no etcd.
const REACH: Duration = Duration::from_secs(5);

/// What `unfinished` says until all of a copy is there.
pub(super) const PART_OF_A_COPY: &str = "a copy is being made";

/// Everything small, as it was at one moment.
#[derive(Debug)]
pub(super) struct Seen {
    pub(super) meta: Option<Meta>,
    pub(super) leader: Option<(i64, Leader)>,
    pub(super) head: Option<(i64, Head)>,
    /// When `step` was written.
    pub(super) step: i64,
    /// What the snapshot that counts stands for.
    pub(super) through: Option<u64>,
    /// It is a part of a copy: when that was said, and what.
    pub(super) unfinished: Option<(i64, String)>,
    /// It was moved, where to.
    moved: Option<String>,
    signs: Signs,
    /// etcd's number of its cluster.
    pub(super) cluster: u64,
    /// etcd's revision.
    pub(super) revision: i64,
}

/// The place, held.
#[derive(Debug)]
pub(super) struct Term {
    pub(super) client: Arc<Client>,
    pub(super) keys: Keys,
    pub(super) epoch: Epoch,
    pub(super) store: u64,
    pub(super) generation: u64,
    /// Behind which record an older state was accepted.
    pub(super) accepted: Option<u64>,
    /// The revision of `leader`: every write compares it.
    leader: i64,
    draw: u64,
    lost: AtomicBool,
    /// The last renewal was not answered.
    unheard: AtomicBool,
    /// `writable` was taken away: etcd has no space.
    unwritable: AtomicBool,
    /// Whom the writer belongs to takes no turns.
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

    /// Refuses a part of a copy, and what was moved.
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

    /// Whether an older state was put in place of what there was, as far as can be seen.
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

    /// Holds as long as nobody has said anything since.
    fn unchanged(&self, keys: &Keys) -> Vec<Compare> {
        let Signs { leader, alive, writable } = self.signs;
        vec![written_at(keys.leader(), leader), written_at(keys.alive(), alive), written_at(keys.writable(), writable)]
    }
}

/// Holds as long as it is neither a part of a copy nor moved.
fn unmarked(keys: &Keys) -> Vec<Compare> {
    vec![written_at(keys.unfinished(), 0), written_at(keys.moved(), 0)]
}

/// The generation of a copy that is made now: the seconds since 1970. Generations that begin otherwise are counted on.
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

/// Looks until the place can be taken, or somebody who has it says something: then `held` is told of it.
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
                // Whether it is there, the next look shows.
                if let Err(error) = client.attempt(request, PATIENCE) {
                    return Err(unreadable(client, &error).into());
                }
            }
            Verdict::Undecided => {}
        }
        std::thread::sleep(LOOK_INTERVAL);
    }
}

/// Takes the place, if nobody has taken it or said something since it was looked at, and it is still a whole log that was not moved: from then
/// on only whoever has taken it can mark it as such. `accepts`: the generation that begins, where an older
/// state is accepted.
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
    // Repeated it finds what it wrote itself.
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
    /// Held since a revision, for tests of what it guards.
    #[cfg(test)]
    pub(super) fn since(client: Arc<Client>, keys: Keys, leader: i64) -> Term {
        let [lost, unheard, unwritable, owner_hangs] = [(); 4].map(|()| AtomicBool::new(false));
        let (epoch, store, generation, accepted, draw) = (Epoch(1), 1, 0, None, 1);
        Term { client, keys, epoch, store, generation, accepted, leader, draw, lost, unheard, unwritable, owner_hangs }
    }

    /// What is said of a log that becomes a copy. Its generation is above that of every state which was here or anywhere else before, so that
    /// hosts which have seen one of those accept the copy, and none of those in place of the copy.
    pub(super) fn meta_of_a_copy(&self) -> Meta {
        let generation = self.generation.max(copied_now());
        let cluster = self.client.cluster().unwrap_or_default();
        Meta { version: VERSION, store: self.store, cluster, generation, accepted: None }
    }

    /// Holds as long as the place is held.
    pub(super) fn guard(&self) -> Compare {
        written_at(self.keys.leader(), self.leader)
    }

    /// Only performed while the place is held.
    pub(super) fn guarded(&self, success: Vec<RequestOp>) -> TxnRequest {
        TxnRequest { compare: vec![self.guard()], success, failure: Vec::new() }
    }

    /// Whether `leader`, written at this revision, says that the place is held.
    pub(super) fn is_since(&self, leader: i64) -> bool {
        leader == self.leader
    }

    pub(super) fn deposed(&self) -> Fault {
        self.lost.store(true, Ordering::SeqCst);
        Fault::Deposed { place: self.keys.prefix().to_owned() }
    }

    /// That the place is held, said to everybody, and confirmed.
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
        // Given up meanwhile.
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
            // It cannot be said, but whoever wants the place can be kept from taking it.
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

    /// Why the place will not be held again, whoever has it: etcd went back, or only another cluster has answered for long.
    pub(super) fn is_gone(&self) -> Option<Fault> {
        let error = self.client.went_back().or_else(|| self.client.only_others_for(OTHERS_PATIENCE))?;
        Some(self.fault("keep", &error))
    }

    /// Whether whom the writer belongs to hangs. While it does, nothing is confirmed, and the place is not kept.
    pub(super) fn owner_hangs(&self, hangs: bool) {
        if self.owner_hangs.swap(hangs, Ordering::SeqCst) != hangs {
            let place = self.keys.prefix();
            match hangs {
                true => tracing::error!(place, "this process takes no turns: it does not keep its place"),
                false => tracing::warn!(place, "this process takes its turns again"),
            }
        }
    }

    /// Whether the place is still held. It does not keep it.
    fn look(&self) -> Result<(), Fault> {
        self.held(self.client.attempt(self.guarded(vec![get(self.keys.leader())]), PATIENCE))
    }

    /// What the answer to something guarded says.
    fn held(&self, answer: Result<TxnResponse, CallError>) -> Result<(), Fault> {
        match answer {
            Ok(answer) if answer.succeeded => Ok(()),
            Ok(_) => Err(self.deposed()),
            Err(error) => Err(self.fault("ask for", &error)),
        }
    }

    /// The place is free for the next one at once. Whether that was heard is not known where etcd does not answer.
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

/// The place, for those who ask beside the writer.
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
