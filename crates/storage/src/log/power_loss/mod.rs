//! A simulated disk that loses power: unsynced changes of files and of directories may be there after it, or not, or in part.
//!
//! ```text
//!   log ──▶ PowerLossDisk ──▶ the real directory, which the running log reads
//!               └── every step, in order ──▶ after(steps so far, dice) ──▶ a directory as the disk may have it then
//! ```
//! The model is harsher than a real disk. Of the writes since a file's last sync each is kept, dropped or torn, in pieces of [`PIECE`]
//! bytes and in any order. Of the renames and removals since a directory's last sync any may be missing; syncing a file makes no name
//! durable. The model does not damage bytes that were synced.

mod steps;
mod tests;

use super::files::{Disk, Files, LogFile};
use std::collections::BTreeMap;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};

/// A write is torn between pieces of this many bytes.
pub(super) const PIECE: usize = 8;

/// The number of a file or a directory, independent of its name.
pub(super) type Node = usize;

/// An operation on the disk, or a promise that was made.
#[derive(Debug, Clone)]
pub(super) enum Step {
    Write {
        file: Node,
        offset: usize,
        bytes: Vec<u8>,
    },
    Cut {
        file: Node,
        length: usize,
    },
    SyncFile(Node),
    Link {
        directory: Node,
        name: String,
        node: Node,
        is_directory: bool,
    },
    Rename {
        directory: Node,
        from: String,
        to: String,
        node: Node,
    },
    Unlink {
        directory: Node,
        name: String,
    },
    SyncDirectory(Node),
    /// Everything in this log through this position was acknowledged.
    Acknowledged {
        log: &'static str,
        through: u64,
    },
    /// The copy was reported as complete.
    Copied {
        log: &'static str,
        through: u64,
    },
}

#[derive(Debug, Default)]
struct Recorded {
    steps: Vec<Step>,
    /// All present names.
    names: BTreeMap<PathBuf, Node>,
    nodes: Node,
}

/// See the module. Clones share one disk.
#[derive(Debug, Clone)]
pub(super) struct PowerLossDisk {
    root: PathBuf,
    recorded: Arc<Mutex<Recorded>>,
    /// Locked by a test to keep syncs of records from ending; the syncs that begin and end a segment go on.
    pub(super) busy: Arc<Mutex<()>>,
}

#[derive(Debug)]
struct RecordedFile {
    disk: PowerLossDisk,
    node: Node,
    end: usize,
    /// The file is a segment with unsynced records.
    has_records: bool,
    begun: bool,
    file: Box<dyn LogFile>,
}

impl PowerLossDisk {
    /// A disk for an empty directory, whose own name is durable.
    pub(super) fn of(root: &Path) -> PowerLossDisk {
        let disk = PowerLossDisk { root: root.to_owned(), recorded: Arc::default(), busy: Arc::default() };
        disk.recorded().names.insert(root.to_owned(), 0);
        disk
    }

    pub(super) fn record(&self, step: Step) {
        self.recorded().steps.push(step);
    }

    pub(super) fn steps(&self) -> Vec<Step> {
        self.recorded().steps.clone()
    }

    /// Number of writes so far.
    pub(super) fn writes(&self) -> usize {
        self.recorded().steps.iter().filter(|step| matches!(step, Step::Write { .. })).count()
    }

    fn recorded(&self) -> std::sync::MutexGuard<'_, Recorded> {
        self.recorded.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// The directory that contains a path, and the name in it.
    fn place(&self, path: &Path) -> (Node, String) {
        let parent = path.parent().unwrap_or(&self.root);
        let directory = self.recorded().names.get(parent).copied();
        let name = path.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default();
        (directory.unwrap_or_else(|| panic!("{} is on this disk", path.display())), name)
    }

    fn link(&self, path: &Path, is_directory: bool) -> Node {
        let (directory, name) = self.place(path);
        let mut recorded = self.recorded();
        recorded.nodes += 1;
        let node = recorded.nodes;
        recorded.names.insert(path.to_owned(), node);
        recorded.steps.push(Step::Link { directory, name, node, is_directory });
        node
    }
}

impl Files for PowerLossDisk {
    fn create(&self, path: &Path) -> io::Result<Box<dyn LogFile>> {
        let file = Disk.create(path)?;
        Ok(Box::new(RecordedFile {
            disk: self.clone(),
            node: self.link(path, false),
            end: 0,
            has_records: false,
            begun: false,
            file,
        }))
    }

    fn create_directory(&self, path: &Path) -> io::Result<()> {
        Disk.create_directory(path)?;
        self.link(path, true);
        Ok(())
    }

    fn rename(&self, from: &Path, to: &Path) -> io::Result<()> {
        Disk.rename(from, to)?;
        let ((directory, before), (_, after)) = (self.place(from), self.place(to));
        let mut recorded = self.recorded();
        let moved: Vec<(PathBuf, Node)> = recorded
            .names
            .iter()
            .filter_map(|(path, node)| path.strip_prefix(from).ok().map(|rest| (rest.to_owned(), *node)))
            .collect();
        recorded.names.retain(|path, _| !path.starts_with(from));
        for (rest, node) in &moved {
            let path = if rest.as_os_str().is_empty() { to.to_owned() } else { to.join(rest) };
            recorded.names.insert(path, *node);
        }
        let node = moved[0].1;
        recorded.steps.push(Step::Rename { directory, from: before, to: after, node });
        Ok(())
    }

    fn remove(&self, path: &Path) -> io::Result<()> {
        Disk.remove(path)?;
        let (directory, name) = self.place(path);
        let mut recorded = self.recorded();
        recorded.names.remove(path);
        recorded.steps.push(Step::Unlink { directory, name });
        Ok(())
    }

    fn sync_directory(&self, path: &Path) -> io::Result<()> {
        let node = self.recorded().names.get(path).copied();
        self.record(Step::SyncDirectory(node.unwrap_or_else(|| panic!("{} is on this disk", path.display()))));
        Ok(())
    }
}

impl LogFile for RecordedFile {
    fn write(&mut self, bytes: &[u8]) -> io::Result<()> {
        self.file.write(bytes)?;
        self.disk.record(Step::Write { file: self.node, offset: self.end, bytes: bytes.to_vec() });
        self.end += bytes.len();
        self.has_records = self.begun;
        Ok(())
    }

    fn reserve(&mut self, bytes: usize) -> io::Result<()> {
        self.file.reserve(bytes)?;
        self.disk.record(Step::Write { file: self.node, offset: self.end, bytes: vec![0; bytes] });
        Ok(())
    }

    fn cut(&mut self) -> io::Result<()> {
        self.file.cut()?;
        self.has_records = false;
        self.disk.record(Step::Cut { file: self.node, length: self.end });
        Ok(())
    }

    fn sync(&mut self) -> io::Result<()> {
        if self.has_records {
            drop(self.disk.busy.lock().unwrap_or_else(PoisonError::into_inner));
        }
        self.begun = true;
        self.disk.record(Step::SyncFile(self.node));
        Ok(())
    }
}
