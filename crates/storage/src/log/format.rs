//! Format version 1 of the files. Numbers are little-endian.
//!
//! ```text
//!   segment   header 48: "ratn-log" | version u32 | store u64 | number u64 | first u64 | epoch u64 | crc32c u32
//!             frame, frame, …; in the last segment then zeros, for frames to come
//!   frame     length u32 | crc32c u32 | first u64 | count u32 | count × ( length u32 | payload )
//!   snapshot  header 44: "ratn-snp" | version u32 | store u64 | through u64 | length u64 | crc32c u32, of payload u32
//!             payload
//! ```
//! A frame is the content of one write, made durable by one sync: it is there as a whole, or not at all. Its checksum also covers the
//! store, the segment and the offset, so that the same bytes are no valid frame anywhere else: not in a payload that contains a copy of a
//! log, nor in a file whose blocks belonged to another file before.

use crate::store::{Epoch, Position};
use crc32c::{crc32c, crc32c_append};

/// The version that this program writes. [`super::segment`] and [`super::snapshot`] choose the reader for older ones.
pub(super) const VERSION: u32 = 1;
pub(super) const SEGMENT_MAGIC: [u8; 8] = *b"ratn-log";
pub(super) const SNAPSHOT_MAGIC: [u8; 8] = *b"ratn-snp";
pub(super) const SEGMENT_HEADER: usize = 48;
pub(super) const FRAME_HEADER: usize = 20;
pub(super) const SNAPSHOT_HEADER: usize = 44;
pub(super) use crate::pending::RECORD_HEADER;

/// Identifies a log: a random number drawn when it was made, so that files of two logs are not mixed up.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct StoreId(pub(super) u64);

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct SegmentHeader {
    pub(super) store: StoreId,
    /// 1 for the first, then without gaps.
    pub(super) number: u64,
    /// The position of its first record.
    pub(super) first: Position,
    /// The epoch of the writer that began the segment, or took it over.
    pub(super) epoch: Epoch,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct SnapshotHeader {
    pub(super) store: StoreId,
    pub(super) through: Position,
    pub(super) length: u64,
    pub(super) payload_crc: u32,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct FrameHeader {
    /// Length of what follows the header, in bytes.
    pub(super) length: u32,
    pub(super) crc: u32,
    pub(super) first: Position,
    pub(super) count: u32,
}

impl SegmentHeader {
    pub(super) fn encode(&self) -> [u8; SEGMENT_HEADER] {
        let mut bytes = [0; SEGMENT_HEADER];
        bytes[..8].copy_from_slice(&SEGMENT_MAGIC);
        bytes[8..12].copy_from_slice(&VERSION.to_le_bytes());
        bytes[12..20].copy_from_slice(&self.store.0.to_le_bytes());
        bytes[20..28].copy_from_slice(&self.number.to_le_bytes());
        bytes[28..36].copy_from_slice(&self.first.0.to_le_bytes());
        bytes[36..44].copy_from_slice(&self.epoch.0.to_le_bytes());
        let crc = crc32c(&bytes[..44]);
        bytes[44..].copy_from_slice(&crc.to_le_bytes());
        bytes
    }

    /// `None` if the checksum is wrong.
    pub(super) fn decode(bytes: &[u8; SEGMENT_HEADER]) -> Option<SegmentHeader> {
        (crc32c(&bytes[..44]) == u32_at(bytes, 44)).then(|| SegmentHeader {
            store: StoreId(u64_at(bytes, 12)),
            number: u64_at(bytes, 20),
            first: Position(u64_at(bytes, 28)),
            epoch: Epoch(u64_at(bytes, 36)),
        })
    }

    /// The checksum of a frame at this offset of this segment, over its position, its count and its body.
    pub(super) fn checksum(&self, offset: u64, first: Position, count: u32, body: &[u8]) -> u32 {
        let mut place = [0; 36];
        place[..8].copy_from_slice(&self.store.0.to_le_bytes());
        place[8..16].copy_from_slice(&self.number.to_le_bytes());
        place[16..24].copy_from_slice(&offset.to_le_bytes());
        place[24..32].copy_from_slice(&first.0.to_le_bytes());
        place[32..].copy_from_slice(&count.to_le_bytes());
        crc32c_append(crc32c(&place), body)
    }
}

impl SnapshotHeader {
    pub(super) fn encode(&self) -> [u8; SNAPSHOT_HEADER] {
        let mut bytes = [0; SNAPSHOT_HEADER];
        bytes[..8].copy_from_slice(&SNAPSHOT_MAGIC);
        bytes[8..12].copy_from_slice(&VERSION.to_le_bytes());
        bytes[12..20].copy_from_slice(&self.store.0.to_le_bytes());
        bytes[20..28].copy_from_slice(&self.through.0.to_le_bytes());
        bytes[28..36].copy_from_slice(&self.length.to_le_bytes());
        bytes[36..40].copy_from_slice(&self.payload_crc.to_le_bytes());
        let crc = crc32c(&bytes[..40]);
        bytes[40..].copy_from_slice(&crc.to_le_bytes());
        bytes
    }

    /// `None` if the checksum is wrong.
    pub(super) fn decode(bytes: &[u8; SNAPSHOT_HEADER]) -> Option<SnapshotHeader> {
        (crc32c(&bytes[..40]) == u32_at(bytes, 40)).then(|| SnapshotHeader {
            store: StoreId(u64_at(bytes, 12)),
            through: Position(u64_at(bytes, 20)),
            length: u64_at(bytes, 28),
            payload_crc: u32_at(bytes, 36),
        })
    }
}

impl FrameHeader {
    pub(super) fn encode(&self) -> [u8; FRAME_HEADER] {
        let mut bytes = [0; FRAME_HEADER];
        bytes[..4].copy_from_slice(&self.length.to_le_bytes());
        bytes[4..8].copy_from_slice(&self.crc.to_le_bytes());
        bytes[8..16].copy_from_slice(&self.first.0.to_le_bytes());
        bytes[16..].copy_from_slice(&self.count.to_le_bytes());
        bytes
    }

    /// `None` if there are too few bytes.
    pub(super) fn decode(bytes: &[u8]) -> Option<FrameHeader> {
        let bytes = bytes.first_chunk::<FRAME_HEADER>()?;
        Some(FrameHeader {
            length: u32_at(bytes, 0),
            crc: u32_at(bytes, 4),
            first: Position(u64_at(bytes, 8)),
            count: u32_at(bytes, 16),
        })
    }
}

/// The format version of a file, after its magic; `None` if the magic differs or the file is too short.
pub(super) fn version(bytes: &[u8], magic: [u8; 8]) -> Option<u32> {
    (bytes.len() >= 12 && bytes[..8] == magic).then(|| u32_at(bytes, 8))
}

pub(super) fn u32_at(bytes: &[u8], at: usize) -> u32 {
    let mut number = [0; 4];
    number.copy_from_slice(&bytes[at..at + 4]);
    u32::from_le_bytes(number)
}

fn u64_at(bytes: &[u8], at: usize) -> u64 {
    let mut number = [0; 8];
    number.copy_from_slice(&bytes[at..at + 8]);
    u64::from_le_bytes(number)
}
