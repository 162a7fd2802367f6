//! Reads a log: the snapshot that counts, and the frames behind it up to the head.

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

/// A page may take so long; one that takes longer is asked for in smaller ones.
const PATIENCE: Duration = Duration::from_secs(5);
/// And all attempts of it.
const REACH: Duration = Duration::from_secs(30);
/// Keys of the first page. Later ones have as many as make about [`PAGE_BYTES`], judged by the page before.
const FIRST_PAGE: i64 = 4;
/// With parts of a MiB not more than an answer may have.
const LONGEST_PAGE: i64 = 256;
const PAGE_BYTES: usize = 4 << 20;

/// What is there, and by which frames.
#[derive(Debug)]
pub(super) struct Contents {
    pub(super) recovered: Recovered,
    /// (first, last) of every frame.
    pub(super) frames: Vec<(Position, Position)>,
    /// The revision of `head`.
    pub(super) head: i64,
}

/// Everything as it was at a revision; at 0, as it is.
pub(super) fn read(client: &Client, keys: &Keys, seen: &Seen, revision: i64) -> Result<Contents, ReadError> {
    let epoch = Epoch(seen.leader.as_ref().map_or(0, |(_, leader)| leader.epoch));
    let (head_revision, head) = seen.head.map_or((0, Position(0)), |(at, head)| (at, Position(head.position)));
    let Some(meta) = &seen.meta else {
        return Ok(Contents { recovered: Recovered { epoch, ..Recovered::default() }, frames: Vec::new(), head: 0 });
    };
    let snapshot = read_snapshot(client, keys, revision)?;
    let mut last = snapshot.as_ref().map_or(Position(0), |snapshot| snapshot.through);
    let mut reading = Reading { last, records: Vec::new(), frames: Vec::new(), frame: None };
    let span = (keys.frames_from(Position(0)).0, keys.frames(Position(0), head.next()).1);
    pages(client, span, revision, |kv| reading.add(meta.store, kv))?;
    last = last.max(reading.last);
    if reading.frame.is_some() || last < head {
        let what = format!("its head is record {head}, and {last} is the last that is there");
        return Err(ReadError::Incomplete { place: keys.prefix().to_owned(), what });
    }
    let Reading { records, frames, .. } = reading;
    Ok(Contents { recovered: Recovered { epoch, snapshot, records, torn: None }, frames, head: head_revision })
}

struct Reading {
    last: Position,
    records: Vec<Record>,
    frames: Vec<(Position, Position)>,
    frame: Option<Frame>,
}

impl Reading {
    fn add(&mut self, store: u64, kv: KeyValue) -> Result<(), ReadError> {
        let key = kv.key.clone();
        match &mut self.frame {
            Some(frame) => frame.add(&kv.value),
            None => self.frame = Some(Frame::begin(kv.key, store, kv.value)?),
        }
        let Some(frame) = self.frame.take_if(|frame| frame.is_whole()) else { return Ok(()) };
        let first = frame.first();
        let records = frame.records()?;
        let end = records.last().map_or(first, |record| record.position);
        if first > self.last.next() {
            return Err(damaged(&key, &format!("records {} to {first} are missing before it", self.last.next())));
        }
        self.frames.push((first, end));
        // What a snapshot stands for may still be there.
        self.records.extend(records.into_iter().filter(|record| record.position > self.last));
        self.last = self.last.max(end);
        Ok(())
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
