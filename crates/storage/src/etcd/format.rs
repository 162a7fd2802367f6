//! Format version 1 of the keys in etcd. Small values are JSON, readable with `etcdctl`; frames are bytes, with little-endian numbers.
//!
//! ```text
//!   meta      {"version":1, "store":N, "cluster":N, "generation":N, "accepted":N}
//!             the log's number, etcd's cluster id, the generation (0; of a copy, the seconds since 1970; plus one whenever an
//!             older state is accepted), and the record after which an older state was last accepted
//!   leader    {"epoch":N, "holder":{…} or null, "draw":N}
//!   head      {"position":N, "epoch":N, "step":N}
//!   step      {"epoch":N, "step":N}
//!   current   {"through":N, "parts":N, "bytes":N, "crc":N}
//!   frame     crc32c u32 | store u64 | first u64 | count u32 | bytes u64 | parts u32 | bytes of part 0; part K: bytes
//!             all bytes together: count × ( length u32 | payload )
//!   snapshot  bytes
//! ```

use crate::error::ReadError;
use crate::pending::RECORD_HEADER;
use crate::store::{Epoch, Position, Record};
use bytes::{Buf, BufMut, Bytes, BytesMut};
use crc32c::{crc32c, crc32c_append};
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

/// The version that this program writes.
pub(super) const VERSION: u32 = 1;
/// Size of the header before the bytes of a frame's first part.
pub(super) const FRAME_HEADER: usize = 36;

#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct Meta {
    pub(super) version: u32,
    /// A random number drawn when the log was made.
    pub(super) store: u64,
    /// etcd's cluster id: it differs after a snapshot of etcd was restored.
    pub(super) cluster: u64,
    /// Grows with every copy, and with every older state that was restored and accepted.
    #[serde(default)]
    pub(super) generation: u64,
    /// The last record of the state that was accepted.
    #[serde(default)]
    pub(super) accepted: Option<u64>,
}

/// The process that has the writer's place.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Holder {
    /// The address at which it can be reached.
    pub address: String,
    /// A description for people.
    pub about: String,
}

#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct Leader {
    pub(super) epoch: u64,
    /// `None` if the place was given up.
    pub(super) holder: Option<Holder>,
    /// A random number by which the writer of this value recognises it.
    pub(super) draw: u64,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct Head {
    pub(super) position: u64,
    pub(super) epoch: u64,
    /// A counter within the epoch, so that no value occurs twice.
    pub(super) step: u64,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct Step {
    pub(super) epoch: u64,
    pub(super) step: u64,
}

#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct Current {
    pub(super) through: u64,
    pub(super) parts: u32,
    pub(super) bytes: u64,
    pub(super) crc: u32,
}

impl Leader {
    pub(super) fn epoch(&self) -> Epoch {
        Epoch(self.epoch)
    }
}

/// Encodes as JSON.
pub(super) fn text(value: &impl Serialize) -> Bytes {
    // The values are numbers, strings and structs of them, which JSON can always represent.
    Bytes::from(serde_json::to_vec(value).unwrap_or_default())
}

/// Decodes JSON.
pub(super) fn parse<T: DeserializeOwned>(key: &Bytes, value: &[u8]) -> Result<T, ReadError> {
    serde_json::from_slice(value).map_err(|error| damaged(key, &error.to_string()))
}

pub(super) fn damaged(key: &Bytes, what: &str) -> ReadError {
    ReadError::Damaged { place: String::from_utf8_lossy(key).into_owned(), offset: 0, what: what.to_owned() }
}

/// Encodes records as parts of at most `most` bytes, one per key.
pub(super) fn encode_frame(store: u64, first: Position, count: u32, records: &[u8], most: usize) -> Vec<Bytes> {
    let (begin, rest) = records.split_at(records.len().min(most.saturating_sub(FRAME_HEADER)));
    let rest: Vec<&[u8]> = rest.chunks(most).collect();
    let mut part = BytesMut::with_capacity(FRAME_HEADER + begin.len());
    part.put_u32_le(checksum(store, first, count, records));
    part.put_u64_le(store);
    part.put_u64_le(first.0);
    part.put_u32_le(count);
    part.put_u64_le(records.len() as u64);
    // There are at most as many parts as bytes.
    part.put_u32_le(u32::try_from(1 + rest.len()).unwrap_or(u32::MAX));
    part.put_slice(begin);
    let mut parts = vec![part.freeze()];
    parts.extend(rest.into_iter().map(Bytes::copy_from_slice));
    parts
}

/// A frame that is read part by part.
#[derive(Debug)]
pub(super) struct Frame {
    key: Bytes,
    crc: u32,
    store: u64,
    first: Position,
    count: u32,
    bytes: usize,
    parts: u32,
    read: u32,
    records: BytesMut,
}

impl Frame {
    /// Begins with the first part.
    pub(super) fn begin(key: Bytes, store: u64, mut value: Bytes) -> Result<Frame, ReadError> {
        if value.len() < FRAME_HEADER {
            return Err(damaged(&key, "it is too short for a frame"));
        }
        let crc = value.get_u32_le();
        let frame = Frame {
            crc,
            store: value.get_u64_le(),
            first: Position(value.get_u64_le()),
            count: value.get_u32_le(),
            bytes: usize::try_from(value.get_u64_le()).unwrap_or(usize::MAX),
            parts: value.get_u32_le(),
            read: 1,
            records: BytesMut::from(value),
            key,
        };
        if frame.store != store { Err(damaged(&frame.key, "it is of another log")) } else { Ok(frame) }
    }

    /// Adds the next part.
    pub(super) fn add(&mut self, part: &[u8]) {
        self.read += 1;
        self.records.put_slice(part);
    }

    pub(super) fn first(&self) -> Position {
        self.first
    }

    pub(super) fn is_whole(&self) -> bool {
        self.read >= self.parts
    }

    /// The records of the frame, in order.
    pub(super) fn records(self) -> Result<Vec<Record>, ReadError> {
        let Frame { key, crc, store, first, count, bytes, records, .. } = self;
        if records.len() != bytes || checksum(store, first, count, &records) != crc {
            return Err(damaged(&key, "its checksum is wrong"));
        }
        let mut rest = records.freeze();
        let mut read = Vec::new();
        for index in 0..u64::from(count) {
            let length = if rest.len() < RECORD_HEADER { usize::MAX } else { rest.get_u32_le() as usize };
            if rest.len() < length {
                return Err(damaged(&key, "a record is cut off"));
            }
            read.push(Record { position: Position(first.0 + index), payload: rest.split_to(length) });
        }
        Ok(read)
    }
}

fn checksum(store: u64, first: Position, count: u32, records: &[u8]) -> u32 {
    let crc = crc32c(&store.to_le_bytes());
    let crc = crc32c_append(crc, &first.0.to_le_bytes());
    let crc = crc32c_append(crc, &count.to_le_bytes());
    crc32c_append(crc, records)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;

    fn records(payloads: &[&[u8]]) -> Vec<u8> {
        let mut bytes = Vec::new();
        for payload in payloads {
            bytes.extend_from_slice(&u32::try_from(payload.len()).unwrap().to_le_bytes());
            bytes.extend_from_slice(payload);
        }
        bytes
    }

    fn read(parts: &[Bytes]) -> Result<Vec<Record>, ReadError> {
        let mut frame = Frame::begin(Bytes::from_static(b"key"), 7, parts[0].clone())?;
        for part in &parts[1..] {
            assert!(!frame.is_whole());
            frame.add(part);
        }
        assert!(frame.is_whole());
        frame.records()
    }

    #[test]
    fn a_frame_is_read_back_however_many_parts_it_has() {
        let payloads: [&[u8]; 3] = [&[1; 100], &[], &[3; 57]];
        for most in [FRAME_HEADER + 1, 50, 64, 168, 1_000] {
            let parts = encode_frame(7, Position(41), 3, &records(&payloads), most);
            assert!(parts.iter().all(|part| part.len() <= most), "{most}");
            let read = read(&parts).unwrap();
            let positions: Vec<u64> = read.iter().map(|record| record.position.0).collect();
            assert_eq!(positions, [41, 42, 43]);
            assert!(read.iter().zip(payloads).all(|(record, payload)| record.payload == payload));
        }
    }

    #[test]
    fn a_wrong_byte_anywhere_is_found() {
        let whole = encode_frame(7, Position(1), 2, &records(&[b"one", b"two"]), 1_000).remove(0);
        for at in 0..whole.len() {
            let mut bytes = whole.to_vec();
            bytes[at] ^= 1;
            // The number of parts is not in the checksum: a larger number makes the frame incomplete, and a smaller one does not occur
            // here.
            if !(32..36).contains(&at) {
                assert!(read(&[Bytes::from(bytes)]).is_err(), "byte {at}");
            }
        }
    }
}
