//! A durable log: append with group commit, snapshots, recovery. Daemons keep their state in it.
//!
//! ```text
//!   append ──▶ buffer ──▶ one thread: write, sync, "durable through 4711", again ──▶ answers that waited for it leave
//! ```
//! [`Store`] and [`Writer`] are the interface, wherever the log is kept: append, read, compact, one guarded writer. [`Log`] keeps it in
//! files, [`Etcd`] in etcd, where several processes may stand by for its writer; [`transfer`] copies it from one to the other. Payloads are
//! bytes; their meaning and version are up to their owner.
//!
//! ```
//! use ratn_storage::{Log, Options, Store};
//!
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! # let directory = tempfile::tempdir()?;
//! let log = Log::new(directory.path(), Options::default());
//! let (recovered, mut writer) = log.open()?;
//! assert!(recovered.records.is_empty());
//! let position = writer.append(b"the arm is blocked")?; // only buffered
//! writer.durable().wait_blocking(position)?; // on the disk: now it may be acknowledged
//! writer.close()?;
//! assert_eq!(log.read()?.records[0].payload, "the arm is blocked");
//! # Ok(())
//! # }
//! ```
//!
//! # What is promised
//!
//! - **Acknowledged means on disk.** [`Durable`] never shows a position that a loss of power could take away (with [`Durability::None`] it
//!   does: nothing waits then). Recovery returns every acknowledged record, and perhaps records after them.
//! - **A torn end is cut, damage is refused.** Frames are synced one after the other, so a wrong frame is a torn end only if no correct one
//!   follows it. Any other wrong frame may have been acknowledged: it is an error that names the file and the byte.
//! - **After the first error of a write or a sync nothing is accepted any more**, and no sync is retried: the system may have dropped the
//!   data that it could not write. Reading goes on. A new start reads the log, rewrites the last segment and syncs it.
//! - **One writer.** A second one is refused with the name of the holder. A writer that was superseded in spite of the lock acknowledges
//!   nothing more.
//! - **Limits** for a record, for the bytes that wait to be written, and for a segment: [`Options`]. An append beyond a limit is refused
//!   and never waits.
//! - A snapshot replaces the records before it, and is written concurrently with appends. Formats have a version; an unknown newer one is
//!   refused before anything is changed. [`backup()`] copies a running log, [`restore()`] overwrites nothing.
//!
//! # Why a log and not a store
//!
//! Daemons keep their state in memory and only need it back after a restart: no query goes to the disk. A store brings a tree, its
//! compactions and its transactions for that, and the commit of a single writer costs up to twice the sync that it waits for: on a machine
//! whose plain append and fdatasync takes 60 to 83 µs, three small puts took durably (p50) with fjall 44 µs, rusqlite (WAL) 64, heed 151,
//! redb 166. The group commit decides, with one actor for many callers: the actor has to know, without a thread for each caller, which
//! answers may leave now. That, and faults that tests can inject one by one, is about as much code as this crate.
//!
//! # What it costs
//!
//! `cargo run --release -p ratn-storage --example commit [DIRECTORY]`, records of 200 bytes, 2 cores; medians of one run each:
//!
//! | | a disk whose fdatasync takes 4 ms | one where it takes 0.1 ms | memory, where it takes nothing |
//! |---|---|---|---|
//! | plain append and fdatasync, p50 | 3 999 µs | 131 µs | 0.8 µs |
//! | commit of one writer, p50 | 3 998 µs (ratio 1.00) | 106 µs (ratio 0.81: written over zeros) | 34 µs: two threads wake each other |
//! | append, without waiting | 0.4 µs | 0.1 µs | 0.4 µs |
//! | 64 writers, each waits for every record | 12 400 records/s (plain: 250) | 282 000 records/s | 726 000 records/s |
//! | 64 writers, each 64 records ahead | 686 000 records/s | 1 709 000 records/s | 2 213 000 records/s |

mod draw;
pub mod durable;
mod error;
pub mod etcd;
pub mod log;
mod pending;
pub mod store;
mod transfer;

pub use durable::{Durable, Progress};
pub use error::{AppendError, CompactError, CompactionFailure, CopyError, Fault, OpenError, ReadError};
pub use etcd::{Etcd, EtcdOptions};
pub use log::{Copied, Disk, Durability, Files, Log, LogFile, Options, backup, restore};
pub use store::{Epoch, MakeSnapshot, Place, Position, Record, Recovered, Snapshot, Store, TornEnd, Turns, Writer};
pub use transfer::{transfer, transfer_running};
