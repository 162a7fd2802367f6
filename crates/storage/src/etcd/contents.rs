//! Reads a log: the snapshot that counts, and the frames after it up to the head.
//!
//! A standby reads along ([`Known`]), so that a new leader only has to read the newest frames. Records up to the head never change; the
//! revision at which the last of them was written shows whether they are still the same. If a snapshot has replaced them, everything is
//! read anew.

use super::client::{CallError, Client};
use super::format::{Current, Frame, damaged, parse};
use super::keys::{Keys, Span, found, found_one, look, range};
use super::term::{Seen, unreadable};
use super::wire::{KeyValue, RangeRequest};
use crate::error::ReadError;
use crate::store::{Epoch, Position, Record, Recovered, Snapshot};
use bytes::{Bytes, BytesMut};
use crc32c::crc32c;
use std::time::{Duration, Instant};

/// Time limit for one page; after it, smaller pages are asked for.
const PATIENCE: Duration = Duration::from_secs(5);
/// Time limit for all attempts at one page.
const REACH: Duration = Duration::from_secs(30);
/// Number of keys in the first page. Later pages have as many keys as make about [`PAGE_BYTES`], judged by the page before.
const FIRST_PAGE: i64 = 4;
/// Maximum number of keys in a page: with parts of 1 MiB, a page stays below the maximum size of an answer.
const LONGEST_PAGE: i64 = 256;
const PAGE_BYTES: usize = 4 << 20;

/// The contents of a log, and the frames that hold them.
#[derive(Debug)]
pub(super) struct Contents {
    pub(super) recovered: Recovered,
    /// (first, last) record of every frame.
    pub(super) frames: Vec<(Position, Position)>,
    /// The revision of `head`.
    pub(super) head: i64,
}

/// What was read of a log at one time, to be continued later.
#[derive(Debug)]
pub(super) struct Known {
    store: u64,
    generation: u64,
    cluster: u64,
    /// The revision of `head`, and the record it names.
    head: (i64, Position),
    snapshot: Option<Snapshot>,
    records: Vec<Record>,
    frames: Vec<(Position, Position)>,
    /// The revision at which the first part of the last frame was written.
    written: i64,
}

impl Known {
    fn through(&self) -> Option<u64> {
        self.snapshot.as_ref().map(|snapshot| snapshot.through.0)
    }

    /// Whether nothing was written since.
    fn is_all(&self, seen: &Seen) -> bool {
        self.is_of(seen) && seen.head.is_some_and(|(at, head)| (at, Position(head.position)) == self.head)
    }

    fn is_of(&self, seen: &Seen) -> bool {
        let same_log = seen.meta.as_ref();
        let same_log = same_log.is_some_and(|meta| (meta.store, meta.generation) == (self.store, self.generation));
        let grown = seen.head.is_some_and(|(at, head)| (at, Position(head.position)) >= self.head);
        same_log && grown && seen.cluster == self.cluster && seen.through == self.through()
    }
}

impl Contents {
    /// The known contents, in the epoch of the present leader.
    pub(super) fn of(known: Option<Known>, seen: &Seen) -> Contents {
        let epoch = Epoch(seen.leader.as_ref().map_or(0, |(_, leader)| leader.epoch));
        match known {
            Some(Known { head, snapshot, records, frames, .. }) => Contents {
                recovered: Recovered { epoch, snapshot, records, ..Recovered::default() },
                frames,
                head: head.0,
            },
            None => Contents { recovered: Recovered { epoch, ..Recovered::default() }, frames: Vec::new(), head: 0 },
        }
    }
}

/// Reads everything at a revision; 0 means the present one. `None` if there is no log.
pub(super) fn read(
    client: &Client,
    keys: &Keys,
    seen: &Seen,
    revision: i64,
    known: Option<Known>,
) -> Result<Option<Known>, ReadError> {
    let Some(meta) = &seen.meta else { return Ok(None) };
    let known = known.filter(|known| revision == 0 && known.is_of(seen));
    if known.as_ref().is_some_and(|known| known.is_all(seen)) {
        return Ok(known);
    }
    if let Some(known) = known
        && let Some(read) = read_on(client, keys, seen, known)?
    {
        return Ok(Some(read));
    }
    let snapshot = read_snapshot(client, keys, revision)?;
    let last = snapshot.as_ref().map_or(Position(0), |snapshot| snapshot.through);
    let head = seen.head.map_or((0, Position(0)), |(at, head)| (at, Position(head.position)));
    let mut reading = Reading { last, records: Vec::new(), frames: Vec::new(), frame: None, written: 0 };
    let span = (keys.frames_from(Position(0)).0, keys.frames(Position(0), head.1.next()).1);
    pages(client, span, revision, |kv| reading.add(meta.store, kv))?;
    let Reading { records, frames, written, .. } = reading.whole(keys, head.1)?;
    Ok(Some(Known {
        store: meta.store,
        generation: meta.generation,
        cluster: seen.cluster,
        head,
        snapshot,
        records,
        frames,
        written,
    }))
}

/// Reads what was written since. `None` if the log has other contents than what was known.
fn read_on(client: &Client, keys: &Keys, seen: &Seen, known: Known) -> Result<Option<Known>, ReadError> {
    let (Some((at, head)), Some(&(first, last))) = (seen.head, known.frames.last()) else { return Ok(None) };
    let head = (at, Position(head.position));
    let (begin, behind) = (keys.frame(first, 0), keys.frames_from(last.next()).0);
    let span = (begin.clone(), keys.frames(Position(0), head.1.next()).1);
    let Known { store, generation, cluster, snapshot, records, frames, written, .. } = known;
    let mut reading = Reading { last, records, frames, frame: None, written };
    let mut is_the_same = false;
    pages(client, span, 0, |kv| {
        is_the_same |= kv.key == begin && kv.mod_revision == written;
        // The parts of the last known frame are read once more.
        if kv.key < behind || !is_the_same { Ok(()) } else { reading.add(store, kv) }
    })?;
    if !is_the_same {
        return Ok(None);
    }
    let Reading { records, frames, written, .. } = reading.whole(keys, head.1)?;
    Ok(Some(Known { store, generation, cluster, head, snapshot, records, frames, written }))
}

struct Reading {
    last: Position,
    records: Vec<Record>,
    frames: Vec<(Position, Position)>,
    frame: Option<Frame>,
    /// The revision at which the first part of the newest frame was written.
    written: i64,
}

impl Reading {
    fn add(&mut self, store: u64, kv: KeyValue) -> Result<(), ReadError> {
        let key = kv.key.clone();
        match &mut self.frame {
            Some(frame) => frame.add(&kv.value),
            None => {
                self.written = kv.mod_revision;
                self.frame = Some(Frame::begin(kv.key, store, kv.value)?);
            }
        }
        let Some(frame) = self.frame.take_if(|frame| frame.is_whole()) else { return Ok(()) };
        let first = frame.first();
        let records = frame.records()?;
        let end = records.last().map_or(first, |record| record.position);
        if first > self.last.next() {
            return Err(damaged(&key, &format!("records {} to {first} are missing before it", self.last.next())));
        }
        self.frames.push((first, end));
        // Records that a snapshot replaces may still exist.
        self.records.extend(records.into_iter().filter(|record| record.position > self.last));
        self.last = self.last.max(end);
        Ok(())
    }

    /// The complete contents up to the head, or an error.
    fn whole(self, keys: &Keys, head: Position) -> Result<Reading, ReadError> {
        if self.frame.is_some() || self.last < head {
            let what = format!("its head is record {head}, and {} is the last that is there", self.last);
            return Err(ReadError::Incomplete { place: keys.prefix().to_owned(), what });
        }
        Ok(self)
    }
}

fn read_snapshot(client: &Client, keys: &Keys, revision: i64) -> Result<Option<Snapshot>, ReadError> {
    let one = RangeRequest { key: keys.current(), revision, ..RangeRequest::default() };
    let answer = client.repeat(&look(vec![range(one)]), PATIENCE, Instant::now() + REACH);
    let answer = answer.map_err(|error| unreadable(client, &error))?;
    let Some(kv) = found_one(answer.responses.into_iter().next()) else { return Ok(None) };
    let current: Current = parse(&keys.current(), &kv.value)?;
    let (mut payload, mut parts) = (BytesMut::new(), 0);
    pages(client, keys.snapshot(Position(current.through)), revision, |kv| {
        payload.extend_from_slice(&kv.value);
        parts += 1;
        Ok(())
    })?;
    if (parts, payload.len() as u64, crc32c(&payload)) != (current.parts, current.bytes, current.crc) {
        return Err(damaged(&keys.current(), "the snapshot that it names is not whole"));
    }
    Ok(Some(Snapshot { through: Position(current.through), payload: payload.freeze() }))
}

/// Every key of a range, in order.
fn pages(
    client: &Client,
    (mut key, range_end): Span,
    revision: i64,
    mut each: impl FnMut(KeyValue) -> Result<(), ReadError>,
) -> Result<(), ReadError> {
    let mut limit = FIRST_PAGE;
    loop {
        let until = Instant::now() + REACH;
        let answer = loop {
            let page =
                RangeRequest { key: key.clone(), range_end: range_end.clone(), limit, revision, keys_only: false };
            match client.attempt(look(vec![range(page)]), PATIENCE) {
                Err(CallError::Unknown(_)) if Instant::now() < until => limit = (limit / 2).max(1),
                answered => break answered.map_err(|error| unreadable(client, &error))?,
            }
        };
        let (kvs, more) = found(answer.responses.into_iter().next());
        let bytes: usize = kvs.iter().map(|kv| kv.value.len()).sum();
        let last = kvs.last().map(|kv| kv.key.clone());
        kvs.into_iter().try_for_each(&mut each)?;
        let Some(last) = last.filter(|_| more) else { return Ok(()) };
        let per_key = i64::try_from(bytes).unwrap_or(i64::MAX) / limit;
        limit = (PAGE_BYTES as i64 / per_key.max(1)).clamp(1, LONGEST_PAGE);
        // The next key after it.
        key = Bytes::from([&last[..], &[0]].concat());
    }
}
