//! The list of workers in a file of the runtime directory. From it the successor of a killed process manager learns which workers were left behind, and what
//! may still move although its worker has ended. Lines are appended as workers come and go; a lock prevents a second process manager.

use super::template::Template;
use ratn_worker::runtime_directory::RuntimeDirectory;
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, BTreeSet};
use std::fs::{File, OpenOptions, TryLockError};
use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

/// Pause between two tries to take the lock.
const TAKE_AGAIN: Duration = Duration::from_millis(10);
/// Number of lines, beyond two per known worker or motion, above which the file is rewritten.
const MOST_OLD_LINES: usize = 1_000;

/// A worker as its process manager knew it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct Entry {
    pub(super) id: String,
    pub(super) pid: u32,
    /// Start time of its process, in clock ticks of the kernel: a process id alone may be reused.
    pub(super) began: u64,
    /// Its endpoint; `None` until it served.
    pub(super) endpoint: Option<String>,
    /// The address of the resource manager that it was told; `None` in files of older versions.
    #[serde(default)]
    pub(super) manager: Option<String>,
    /// The session that it was told offers it; `None` in files of older versions.
    #[serde(default)]
    pub(super) session: Option<String>,
    /// Its resource limits, for people.
    pub(super) limits: String,
    /// Its cgroups, if it has any.
    pub(super) groups: Vec<PathBuf>,
    /// The template that it was started from.
    pub(super) template: Template,
}

/// A worker that is about to be started: recorded before its process exists, so that the process is known whatever happens next.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct Intent {
    pub(super) id: String,
    /// The cgroup that it is put into, if any.
    pub(super) group: Option<PathBuf>,
    pub(super) template: Template,
}

/// What the last process manager left.
#[derive(Debug, Default, PartialEq)]
pub(super) struct LeftBehind {
    /// Its running workers.
    pub(super) workers: Vec<Entry>,
    /// Its workers that were being started.
    pub(super) starting: Vec<Intent>,
    /// Devices that may still move for a holder.
    pub(super) motions: Motions,
}

/// By template: how long its workers' devices may go on moving after their processes have ended.
pub(super) type Motions = BTreeMap<String, Duration>;

/// An event of a worker.
#[derive(Debug, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
enum Line {
    Starts(Box<Intent>),
    Began(Box<Entry>),
    Serves {
        id: String,
        endpoint: String,
    },
    Gone {
        id: String,
    },
    /// From now on a worker of the template may move something, until this bound after its end.
    Moves {
        template: String,
        standstill_ms: u64,
    },
    /// No worker of the template moves anything any more.
    Rests {
        template: String,
    },
}

/// Why a process manager cannot start.
#[derive(Debug, thiserror::Error)]
pub enum RosterError {
    /// Another process manager runs in this runtime directory.
    #[error("a process manager runs in {} already: end it, or say another --runtime-dir", directory.display())]
    Taken {
        /// The runtime directory.
        directory: PathBuf,
    },
    /// The file cannot be used.
    #[error("cannot keep a list of the workers in {}", file.display())]
    Io {
        /// The file.
        file: PathBuf,
        /// The reason.
        #[source]
        source: io::Error,
    },
}

#[derive(Debug)]
pub(super) struct Roster {
    path: PathBuf,
    file: File,
    lines: usize,
    there: BTreeMap<String, Entry>,
    starting: BTreeMap<String, Intent>,
    /// In milliseconds.
    motions: BTreeMap<String, u64>,
    /// A line was not written, or only in part: the file has to be rewritten.
    unwritten: bool,
    _lock: File,
}

impl Roster {
    /// As [`Roster::take`], tried again for this long while another process manager has the lock.
    pub(super) async fn take_within(
        directory: &RuntimeDirectory,
        patience: Duration,
    ) -> Result<(Roster, LeftBehind), RosterError> {
        let until = Instant::now() + patience;
        loop {
            match Roster::take(directory) {
                Err(RosterError::Taken { .. }) if Instant::now() < until => tokio::time::sleep(TAKE_AGAIN).await,
                taken => return taken,
            }
        }
    }

    /// Becomes the one process manager of a runtime directory; returns what the last one left behind.
    pub(super) fn take(directory: &RuntimeDirectory) -> Result<(Roster, LeftBehind), RosterError> {
        let directory = directory.path();
        let path = directory.join("workers");
        let failed = |source| RosterError::Io { file: path.clone(), source };
        let mut options = OpenOptions::new();
        let lock = options.create(true).write(true).truncate(false).open(directory.join("process-manager.lock"));
        let lock = lock.map_err(failed)?;
        match lock.try_lock() {
            Ok(()) => {}
            Err(TryLockError::WouldBlock) => return Err(RosterError::Taken { directory: directory.to_owned() }),
            Err(TryLockError::Error(source)) => return Err(failed(source)),
        }
        let (there, starting, motions) = read(&path).map_err(failed)?;
        let left = LeftBehind {
            workers: there.values().cloned().collect(),
            starting: starting.values().cloned().collect(),
            motions: motions.iter().map(|(name, ms)| (name.clone(), Duration::from_millis(*ms))).collect(),
        };
        let file = File::options().append(true).create(true).open(&path).map_err(failed)?;
        let mut roster =
            Roster { path: path.clone(), file, lines: 0, there, starting, motions, unwritten: false, _lock: lock };
        roster.write_anew().map_err(failed)?;
        Ok((roster, left))
    }

    /// Marks all other workers as gone.
    pub(super) fn keep_only(&mut self, kept: &BTreeSet<&str>) {
        let known = self.there.keys().chain(self.starting.keys());
        let gone: Vec<String> = known.filter(|id| !kept.contains(id.as_str())).cloned().collect();
        gone.iter().for_each(|id| self.gone(id));
    }

    /// To be called before the process is started.
    pub(super) fn starts(&mut self, intent: Intent) {
        self.starting.insert(intent.id.clone(), intent.clone());
        self.append(&Line::Starts(Box::new(intent)));
    }

    pub(super) fn began(&mut self, entry: Entry) {
        self.starting.remove(&entry.id);
        self.there.insert(entry.id.clone(), entry.clone());
        self.append(&Line::Began(Box::new(entry)));
    }

    pub(super) fn serves(&mut self, id: &str, endpoint: &str) {
        if let Some(entry) = self.there.get_mut(id) {
            entry.endpoint = Some(endpoint.to_owned());
            self.append(&Line::Serves { id: id.to_owned(), endpoint: endpoint.to_owned() });
        }
    }

    pub(super) fn gone(&mut self, id: &str) {
        let started = self.starting.remove(id).is_some();
        if self.there.remove(id).is_some() || started {
            self.append(&Line::Gone { id: id.to_owned() });
        }
    }

    /// Records what may move now; called before a worker that moves something is offered. A successor that reads of a motion waits for its bound, however this
    /// process manager and its workers end. Returns false where the file could not be written, now or before: then a successor would not know.
    pub(super) fn keep_motions(&mut self, now: &Motions) -> bool {
        let ms = |bound: &Duration| u64::try_from(bound.as_millis()).unwrap_or(u64::MAX);
        let now: BTreeMap<String, u64> = now.iter().map(|(name, bound)| (name.clone(), ms(bound))).collect();
        if self.unwritten {
            self.motions = now;
            let written = self.write_anew();
            self.note(written);
            return !self.unwritten;
        }
        let before = std::mem::replace(&mut self.motions, now.clone());
        for (template, standstill_ms) in &now {
            if before.get(template) != Some(standstill_ms) {
                self.append(&Line::Moves { template: template.clone(), standstill_ms: *standstill_ms });
            }
        }
        for template in before.into_keys().filter(|template| !now.contains_key(template)) {
            self.append(&Line::Rests { template });
        }
        !self.unwritten
    }

    /// If the file cannot be written, the workers go on: only a successor would not know of them. After a failed line nothing is appended, because a partial
    /// line would make the next one unreadable: instead the whole file is rewritten, until that succeeds.
    fn append(&mut self, line: &Line) {
        self.lines += 1;
        let written = if self.unwritten || self.lines > self.known() * 2 + MOST_OLD_LINES {
            self.write_anew()
        } else {
            write(&mut self.file, line)
        };
        self.note(written);
    }

    fn note(&mut self, written: io::Result<()>) {
        let (file, before) = (self.path.display(), self.unwritten);
        self.unwritten = written.is_err();
        match written {
            Err(error) if !before => tracing::error!(
                %file, %error,
                "the list of workers is not written: a successor would not know what is there and what moves; it is tried again, and no \
                 worker that moves something is offered before. Is the disk full?"
            ),
            Ok(()) if before => tracing::info!(%file, "the list of workers is written again"),
            _ => {}
        }
    }

    fn known(&self) -> usize {
        self.there.len() + self.starting.len() + self.motions.len()
    }

    /// Written beside the old file, so that there is always a complete one.
    fn write_anew(&mut self) -> io::Result<()> {
        let next = self.path.with_extension("new");
        let mut file = File::create(&next)?;
        for entry in self.there.values() {
            write(&mut file, &Line::Began(Box::new(entry.clone())))?;
        }
        for intent in self.starting.values() {
            write(&mut file, &Line::Starts(Box::new(intent.clone())))?;
        }
        for (template, standstill_ms) in &self.motions {
            write(&mut file, &Line::Moves { template: template.clone(), standstill_ms: *standstill_ms })?;
        }
        std::fs::rename(&next, &self.path)?;
        (self.file, self.lines) = (file, self.known());
        Ok(())
    }
}

fn write(file: &mut File, line: &Line) -> io::Result<()> {
    let mut text = serde_json::to_string(line).map_err(io::Error::other)?;
    text.push('\n');
    file.write_all(text.as_bytes())
}

/// The running workers, those that were being started, and the motions.
type Known = (BTreeMap<String, Entry>, BTreeMap<String, Intent>, BTreeMap<String, u64>);

/// Lines that cannot be read, such as one that was cut off when its writer ended, are ignored. A worker that moves something may have moved it even where no
/// line says so: older versions recorded no motions, and another caller's session may have offered a worker that this host had not offered yet.
fn read(path: &Path) -> io::Result<Known> {
    let bytes = match std::fs::read(path) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => Vec::new(),
        read => read?,
    };
    let mut there: BTreeMap<String, Entry> = BTreeMap::new();
    let mut starting: BTreeMap<String, Intent> = BTreeMap::new();
    let mut motions: BTreeMap<String, u64> = BTreeMap::new();
    for line in readable(&bytes, path) {
        match line {
            Line::Starts(intent) => drop(starting.insert(intent.id.clone(), *intent)),
            Line::Began(entry) => {
                starting.remove(&entry.id);
                there.insert(entry.id.clone(), *entry);
            }
            Line::Serves { id, endpoint } => {
                if let Some(entry) = there.get_mut(&id) {
                    entry.endpoint = Some(endpoint);
                }
            }
            Line::Gone { id } => {
                starting.remove(&id);
                there.remove(&id);
            }
            Line::Moves { template, standstill_ms } => drop(motions.insert(template, standstill_ms)),
            Line::Rests { template } => drop(motions.remove(&template)),
        }
    }
    let left = there.values().map(|entry| &entry.template).chain(starting.values().map(|intent| &intent.template));
    for (name, bound) in left.filter_map(|template| Some((&template.name, template.standstill_ms?))) {
        let known = motions.entry(name.clone()).or_default();
        *known = bound.max(*known);
    }
    Ok((there, starting, motions))
}

/// The readable lines. A line may be cut off inside a character.
fn readable(bytes: &[u8], path: &Path) -> impl Iterator<Item = Line> {
    let lines = bytes.split(|byte| *byte == b'\n').enumerate().filter(|(_, line)| !line.is_empty());
    lines.filter_map(|(i, line)| {
        let read = serde_json::from_str(&String::from_utf8_lossy(line));
        let unreadable = |error: &serde_json::Error| {
            tracing::warn!(file = %path.display(), line = i + 1, %error, "a line of the list of workers cannot be read: it is left out");
        };
        read.inspect_err(unreadable).ok()
    })
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;

    fn entry(id: &str) -> Entry {
        Entry {
            id: id.to_owned(),
            pid: 42,
            began: 7,
            endpoint: None,
            manager: Some("file:/run/resource-manager.endpoint".to_owned()),
            session: Some("process-manager-1".to_owned()),
            limits: String::new(),
            groups: Vec::new(),
            template: Template::new("planner", "PathPlanner"),
        }
    }

    #[test]
    fn a_successor_knows_whom_the_last_one_left_and_two_at_a_time_there_are_not() {
        let parent = tempfile::tempdir().unwrap();
        let directory = RuntimeDirectory::create(parent.path().join("run")).unwrap();
        let (mut roster, left) = Roster::take(&directory).unwrap();
        assert_eq!(left, LeftBehind::default());
        assert!(matches!(Roster::take(&directory), Err(RosterError::Taken { .. })));
        for id in ["a", "b", "c"] {
            roster.began(entry(id));
        }
        roster.serves("b", "unix:/b");
        roster.gone("a");
        roster.file.write_all(b"{\"gone\":{\"id\":\"b").unwrap();
        drop(roster);
        let (mut roster, left) = Roster::take(&directory).unwrap();
        let served = Entry { endpoint: Some("unix:/b".to_owned()), ..entry("b") };
        assert_eq!(left.workers, [served.clone(), entry("c")]);
        roster.keep_only(&["b"].into());
        drop(roster);
        assert_eq!(Roster::take(&directory).unwrap().1.workers, [served]);
    }

    #[test]
    fn a_successor_knows_whom_the_last_one_was_starting() {
        let parent = tempfile::tempdir().unwrap();
        let directory = RuntimeDirectory::create(parent.path().join("run")).unwrap();
        let intent = |id: &str| Intent { id: id.to_owned(), group: Some("/g".into()), template: entry(id).template };
        let (mut roster, ..) = Roster::take(&directory).unwrap();
        for id in ["began", "failed", "unknown"] {
            roster.starts(intent(id));
        }
        roster.began(entry("began"));
        roster.gone("failed");
        drop(roster);
        for _ in 0..2 {
            let (_, left) = Roster::take(&directory).unwrap();
            assert_eq!((left.workers, left.starting), (vec![entry("began")], vec![intent("unknown")]));
        }
        let (mut roster, ..) = Roster::take(&directory).unwrap();
        roster.keep_only(&["began"].into());
        drop(roster);
        assert!(Roster::take(&directory).unwrap().1.starting.is_empty());
    }

    #[test]
    fn every_successor_hears_of_what_moves_until_it_rests_whatever_became_of_the_workers() {
        let parent = tempfile::tempdir().unwrap();
        let directory = RuntimeDirectory::create(parent.path().join("run")).unwrap();
        let moving = Template { standstill_ms: Some(6_000), ..Template::new("arm", "Arm") };
        let motions = |ms| Motions::from([("arm".to_owned(), Duration::from_millis(ms))]);
        let (mut roster, ..) = Roster::take(&directory).unwrap();
        roster.began(Entry { template: moving.clone(), ..entry("arm-1") });
        roster.keep_motions(&motions(9_000));
        roster.gone("arm-1");
        drop(roster);
        for _ in 0..2 {
            let (mut roster, left) = Roster::take(&directory).unwrap();
            assert_eq!(left, LeftBehind { motions: motions(9_000), ..LeftBehind::default() });
            roster.keep_only(&BTreeSet::new());
        }
        let (mut roster, _) = Roster::take(&directory).unwrap();
        roster.keep_motions(&Motions::new());
        roster.starts(Intent { id: "arm-2".to_owned(), group: None, template: moving.clone() });
        drop(roster);
        let (mut roster, left) = Roster::take(&directory).unwrap();
        assert_eq!(left.motions, motions(6_000), "as an older version wrote it");
        roster.keep_only(&BTreeSet::new());
        roster.keep_motions(&Motions::new());
        drop(roster);
        assert_eq!(Roster::take(&directory).unwrap().1, LeftBehind::default());
    }

    #[test]
    fn a_line_that_is_cut_inside_a_character_is_left_out_and_the_next_manager_starts() {
        let parent = tempfile::tempdir().unwrap();
        let directory = RuntimeDirectory::create(parent.path().join("run")).unwrap();
        let (mut roster, _) = Roster::take(&directory).unwrap();
        roster.began(entry("a"));
        roster.file.write_all(b"{\"gone\":{\"id\":\"\xc3").unwrap();
        drop(roster);
        assert_eq!(Roster::take(&directory).unwrap().1.workers, [entry("a")]);
    }

    #[test]
    fn what_could_not_be_written_is_written_with_the_next_line_and_swallows_nothing() {
        let parent = tempfile::tempdir().unwrap();
        let directory = RuntimeDirectory::create(parent.path().join("run")).unwrap();
        let (mut roster, _) = Roster::take(&directory).unwrap();
        roster.file.write_all(b"{\"began\":{\"id\":").unwrap();
        let real = std::mem::replace(&mut roster.file, File::options().write(true).open("/dev/full").unwrap());
        roster.began(entry("a"));
        roster.file = real;
        roster.began(entry("b"));
        drop(roster);
        assert_eq!(Roster::take(&directory).unwrap().1.workers, [entry("a"), entry("b")]);
    }

    #[test]
    fn a_motion_that_could_not_be_written_is_tried_again_until_a_successor_would_hear_of_it() {
        let parent = tempfile::tempdir().unwrap();
        let directory = RuntimeDirectory::create(parent.path().join("run")).unwrap();
        let motions = Motions::from([("arm".to_owned(), Duration::from_secs(6))]);
        let (mut roster, _) = Roster::take(&directory).unwrap();
        roster.file = File::options().write(true).open("/dev/full").unwrap();
        // It cannot be rewritten either.
        let obstacle = directory.path().join("workers.new");
        std::fs::create_dir(&obstacle).unwrap();
        assert!(!roster.keep_motions(&motions));
        assert!(!roster.keep_motions(&motions));
        std::fs::remove_dir(&obstacle).unwrap();
        assert!(roster.keep_motions(&motions));
        drop(roster);
        assert_eq!(Roster::take(&directory).unwrap().1.motions, motions);
    }

    #[test]
    fn it_does_not_grow_with_those_that_are_gone() {
        let parent = tempfile::tempdir().unwrap();
        let directory = RuntimeDirectory::create(parent.path().join("run")).unwrap();
        let (mut roster, ..) = Roster::take(&directory).unwrap();
        roster.began(entry("stays"));
        for i in 0..MOST_OLD_LINES {
            roster.began(entry(&format!("w-{i}")));
            roster.gone(&format!("w-{i}"));
        }
        assert!(roster.lines <= MOST_OLD_LINES + 3);
        drop(roster);
        assert_eq!(Roster::take(&directory).unwrap().1.workers, [entry("stays")]);
    }
}
