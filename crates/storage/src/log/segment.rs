//! Reads a segment: its header, its frames, and where they end.
//!
//! Every frame was synced before the next was begun. So a wrong frame was torn by a crash only if no correct one follows it, and only in
//! the last segment; anything else is damage to possibly acknowledged records. After the last frame of the last segment there may be zeros,
//! reserved for further frames.

use super::format::{FRAME_HEADER, FrameHeader, RECORD_HEADER, SEGMENT_HEADER, SEGMENT_MAGIC, SegmentHeader, VERSION};
use super::format::{u32_at, version};
use crate::error::ReadError;
use crate::store::{Position, Record, TornEnd};
use bytes::Bytes;

/// A segment that was read.
#[derive(Debug)]
pub(super) struct Segment {
    pub(super) header: SegmentHeader,
    /// Its frames as in the file, up to the first wrong one.
    pub(super) frames: Bytes,
    pub(super) records: Vec<Record>,
    pub(super) torn: Option<TornEnd>,
}

impl Segment {
    /// The position after its last record.
    pub(super) fn end(&self) -> Position {
        Position(self.header.first.0 + self.records.len() as u64)
    }
}

/// Reads a header, of any supported version.
pub(super) fn header(place: &str, bytes: &[u8]) -> Result<SegmentHeader, ReadError> {
    let damaged = |what: &str| ReadError::Damaged { place: place.to_owned(), offset: 0, what: what.to_owned() };
    match version(bytes, SEGMENT_MAGIC) {
        None => Err(damaged("it does not begin as a segment of a log does")),
        // A later version adds its reader here, and goes on reading this one.
        Some(VERSION) => bytes
            .first_chunk::<SEGMENT_HEADER>()
            .and_then(SegmentHeader::decode)
            .ok_or_else(|| damaged("the checksum of its header is wrong")),
        Some(0) => Err(damaged("there is no format version 0")),
        Some(found) => Err(ReadError::Newer { place: place.to_owned(), found, supported: VERSION }),
    }
}

/// Reads a whole segment; the last one may end in a torn frame.
pub(super) fn read(place: &str, bytes: &Bytes, last: bool) -> Result<Segment, ReadError> {
    let header = header(place, bytes)?;
    let mut records = Vec::new();
    let mut offset = SEGMENT_HEADER;
    let mut expected = header.first;
    let damaged =
        |offset: usize, what: String| ReadError::Damaged { place: place.to_owned(), offset: offset as u64, what };
    let mut torn = None;
    while offset < bytes.len() {
        match frame_at(&header, bytes, offset) {
            Some(frame) if frame.first == expected => {
                expected = records_of(&frame, bytes, offset, &mut records)
                    .ok_or_else(|| damaged(offset, "its records are not as its checksum says".to_owned()))?;
                offset += FRAME_HEADER + frame.length as usize;
            }
            Some(frame) => {
                let what = format!("here stands record {}, and {expected} was expected", frame.first);
                return Err(damaged(offset, what));
            }
            None if !last => return Err(damaged(offset, "the checksum is wrong".to_owned())),
            None => match later_frame(&header, bytes, offset, expected) {
                Some(later) => {
                    let what = format!("the checksum is wrong, and right records follow at byte {later}");
                    return Err(damaged(offset, what));
                }
                None => {
                    let written = bytes[offset..].iter().rposition(|byte| *byte != 0).map_or(0, |last| last + 1);
                    let end = || TornEnd { place: place.to_owned(), offset: offset as u64, bytes: written as u64 };
                    torn = (written > 0).then(end);
                    break;
                }
            },
        }
    }
    Ok(Segment { header, frames: bytes.slice(SEGMENT_HEADER..offset), records, torn })
}

/// The frame at an offset, if it is correct.
fn frame_at(header: &SegmentHeader, bytes: &[u8], offset: usize) -> Option<FrameHeader> {
    let frame = FrameHeader::decode(&bytes[offset..])?;
    let begin = offset + FRAME_HEADER;
    let body = bytes.get(begin..begin.checked_add(frame.length as usize)?)?;
    let right = frame.count > 0 && header.checksum(offset as u64, frame.first, frame.count, body) == frame.crc;
    right.then_some(frame)
}

/// The offset of a correct frame after a wrong one, if any. Frames that cannot follow are skipped without a checksum.
fn later_frame(header: &SegmentHeader, bytes: &[u8], wrong: usize, expected: Position) -> Option<usize> {
    let most = expected.0 + (bytes.len() - wrong) as u64;
    (wrong + 1..bytes.len().saturating_sub(FRAME_HEADER)).find(|&offset| {
        let plausible = FrameHeader::decode(&bytes[offset..])
            .is_some_and(|frame| frame.first > expected && frame.first.0 <= most && frame.length > 0);
        plausible && frame_at(header, bytes, offset).is_some()
    })
}

/// Extracts the records of a correct frame; returns the next position.
fn records_of(frame: &FrameHeader, bytes: &Bytes, offset: usize, records: &mut Vec<Record>) -> Option<Position> {
    let mut at = offset + FRAME_HEADER;
    let end = at + frame.length as usize;
    let mut position = frame.first;
    for _ in 0..frame.count {
        let begin = at + RECORD_HEADER;
        if begin > end {
            return None;
        }
        let length = u32_at(bytes, at) as usize;
        at = begin.checked_add(length).filter(|next| *next <= end)?;
        records.push(Record { position, payload: bytes.slice(begin..at) });
        position = position.next();
    }
    (at == end).then_some(position)
}
