//! A log read up to a moment: the run, its world, and the changes since a page last asked.
//!
//! It reads a bounded part of the file at a time and keeps a bounded number of instances, so that neither a long log nor an endless run
//! costs more than a short one. `logs.rs` decides where reading begins, `tell.rs` makes the answers.

use crate::film::Film;
use crate::world::World;
use ratn_event_log::{Lines, LogError};
use ratn_executive::protocol::{Command, Event, LogEntry, LogLine};
use ratn_model::id::InstanceId;
use ratn_model::time::Timestamp;
use ratn_report::timeline::{Cause, Instance, Stage, Timeline};
use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::path::Path;
use std::sync::Arc;

/// Number of instances kept after they have left the window.
pub(crate) const KEPT: usize = 12_000;
/// Number of dropped instances that are reported one by one; a page that has not asked for longer gets everything anew.
const MOST_GONE: usize = 4 * KEPT;

/// A log, read up to a moment.
#[derive(Debug)]
pub(crate) struct Fold {
    /// The number of this fold, which is unique.
    pub(crate) epoch: u64,
    /// Everything from this moment on was read.
    pub(crate) from_s: f64,
    /// The run.
    pub(crate) run: Timeline,
    /// Its world.
    pub(crate) world: World,
    /// The visible part of the run.
    pub(crate) film: Film,
    /// Why the log cannot be read further; empty if it can.
    pub(crate) problem: String,
    /// The digest of the task's files.
    pub(crate) digest: String,
    /// Offset and line number after what was read.
    position: (u64, usize),
    /// Number of changes so far.
    version: u64,
    changed_at: BTreeMap<InstanceId, u64>,
    changes: BTreeSet<(u64, InstanceId)>,
    gone: VecDeque<(u64, InstanceId)>,
    /// Changes up to this one are not reported any more.
    forgotten: u64,
    edges: BTreeMap<InstanceId, BTreeSet<(InstanceId, Bond)>>,
    by_path: BTreeMap<Arc<str>, BTreeSet<InstanceId>>,
}

/// Why an instance depended on another one.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Bond {
    /// It began when the other one had a result.
    Data,
    /// Its projection shows an effect of the other one.
    World,
    /// The other one held a resource that it wanted.
    Resource,
    /// The other one decided whether it is needed.
    Condition,
}

impl Bond {
    /// The name in the pages' notation.
    pub(crate) fn name(self) -> &'static str {
        match self {
            Bond::Data => "data",
            Bond::World => "world",
            Bond::Resource => "resource",
            Bond::Condition => "condition",
        }
    }
}

/// The changes since a version.
#[derive(Debug)]
pub(crate) struct News {
    /// Nothing of what was known before is valid.
    pub(crate) fresh: bool,
    /// The version that this describes.
    pub(crate) version: u64,
    /// There are more changes.
    pub(crate) more: bool,
    /// Instances that are new or have changed.
    pub(crate) changed: Vec<InstanceId>,
    /// Instances that were dropped.
    pub(crate) gone: Vec<InstanceId>,
}

impl Fold {
    /// Begins to read a log at an offset where a line begins, and with that line's time. Of the earlier lines only the first is read.
    ///
    /// # Errors
    /// The log cannot be read.
    pub(crate) fn begin(epoch: u64, path: &Path, (byte, from): (u64, Timestamp)) -> Result<Fold, LogError> {
        let mut fold = Fold {
            epoch,
            from_s: if byte == 0 { 0.0 } else { from.seconds() },
            run: Timeline::following(KEPT),
            world: World::default(),
            film: Film::default(),
            problem: String::new(),
            digest: String::new(),
            position: (byte, 0),
            version: 0,
            changed_at: BTreeMap::new(),
            changes: BTreeSet::new(),
            gone: VecDeque::new(),
            forgotten: 0,
            edges: BTreeMap::new(),
            by_path: BTreeMap::new(),
        };
        if byte > 0 {
            let line = ratn_event_log::first(path)?;
            fold.digest = digest(&line).unwrap_or_default();
            fold.world.apply(&line);
            fold.film.apply(&line);
            fold.run.apply(&line);
            fold.run.wait_until(fold.from_s);
        }
        Ok(fold)
    }

    /// Reads up to a moment, inclusive, but at most about `most_bytes` per call. Returns whether the moment was reached.
    ///
    /// # Errors
    /// The log cannot be read.
    pub(crate) fn read(&mut self, path: &Path, until: Timestamp, most_bytes: u64) -> Result<bool, LogError> {
        let mut lines = Lines::behind(path, self.position.0, self.position.1)?;
        let stop = self.position.0.saturating_add(most_bytes);
        while let Some(line) = lines.next() {
            let line = match line {
                // What comes before the wrong line is shown, with the error.
                Err(error @ LogError::Foreign { .. }) if self.position.0 > 0 => {
                    let from = if self.from_s > 0.0 {
                        format!(", counted from {:.1} s on", self.from_s)
                    } else {
                        String::new()
                    };
                    self.problem = format!("{error}{from}");
                    return Ok(true);
                }
                other => other?,
            };
            if line.at > until {
                return Ok(true);
            }
            self.position = lines.position();
            if let Some(digest) = digest(&line) {
                self.digest = digest;
            }
            self.world.apply(&line);
            self.film.apply(&line);
            let changed = self.run.apply(&line);
            self.version += 1;
            if let LogEntry::Command(Command::Project { instance, writers, .. }) = &line.entry {
                self.projected(*instance, writers);
            }
            if let Some(id) = changed.instance {
                self.change(id);
            }
            for one in changed.left {
                self.leaves(&one);
            }
            if self.position.0 >= stop {
                return Ok(false);
            }
        }
        Ok(true)
    }

    /// Offset up to which the log was read.
    pub(crate) fn position(&self) -> u64 {
        self.position.0
    }

    /// The instances on which an instance depended, as far as the log tells.
    pub(crate) fn edges(&self, id: InstanceId) -> impl Iterator<Item = (InstanceId, Bond)> {
        self.edges.get(&id).into_iter().flatten().copied()
    }

    /// The changes since a version, with at most `most` instances.
    pub(crate) fn since(&self, version: u64, most: usize) -> News {
        let fresh = version == 0 || version < self.forgotten || version > self.version;
        let known = if fresh { 0 } else { version };
        let mut news = self.changes.range((known + 1, InstanceId(0))..);
        let some: Vec<(u64, InstanceId)> = news.by_ref().take(most).copied().collect();
        let more = news.next().is_some();
        let version = if more { some.last().map_or(self.version, |(version, _)| *version) } else { self.version };
        let gone = self.gone.iter().filter(|(at, _)| !fresh && *at > known && *at <= version).map(|(_, id)| *id);
        News { fresh, version, more, changed: some.into_iter().map(|(_, id)| id).collect(), gone: gone.collect() }
    }

    fn change(&mut self, id: InstanceId) {
        let Some(instance) = self.run.instance(id) else { return };
        let found = bonds(instance, &self.run);
        if !found.is_empty() {
            self.edges.entry(id).or_default().extend(found);
        }
        match self.changed_at.insert(id, self.version) {
            Some(before) => _ = self.changes.remove(&(before, id)),
            None => _ = self.by_path.entry(instance.path.clone()).or_default().insert(id),
        }
        self.changes.insert((self.version, id));
    }

    fn leaves(&mut self, one: &Instance) {
        let id = one.id;
        self.edges.remove(&id);
        if let Some(of_path) = self.by_path.get_mut(&one.path) {
            of_path.remove(&id);
            if of_path.is_empty() {
                self.by_path.remove(&one.path);
            }
        }
        if let Some(at) = self.changed_at.remove(&id) {
            self.changes.remove(&(at, id));
            self.gone.push_back((self.version, id));
        }
        if self.gone.len() > MOST_GONE
            && let Some((at, _)) = self.gone.pop_front()
        {
            self.forgotten = at;
        }
    }

    /// Records that an instance's projection shows effects of these writers.
    fn projected(&mut self, id: InstanceId, writers: &[Arc<str>]) {
        let distinct: BTreeSet<&str> = writers.iter().map(|path| &**path).collect();
        for path in distinct {
            // A writer that is not kept any more has retired: its effects are in the root.
            let writer = self.by_path.get(path).and_then(|of_path| of_path.range(..id).next_back());
            if let Some(writer) = writer {
                self.edges.entry(id).or_default().insert((*writer, Bond::World));
            }
        }
    }
}

/// The dependencies that follow from the stages and waits of an instance. The latest stage and wait are enough: earlier ones were examined
/// when they were the latest.
fn bonds(instance: &Instance, run: &Timeline) -> Vec<(InstanceId, Bond)> {
    let mut found = Vec::new();
    let goes_on = !matches!(instance.stage, Stage::Squashed | Stage::Waiting);
    let last = instance.phases.last().filter(|phase| goes_on && phase.stage == Stage::Waiting);
    if let Some(Cause::Result(of, _)) = last.map(|phase| &phase.ended_by) {
        found.push((*of, if decides(run, *of) { Bond::Condition } else { Bond::Data }));
    }
    if let Cause::Result(of, _) = &instance.expanded_by
        && decides(run, *of)
    {
        found.push((*of, Bond::Condition));
    }
    let behind = instance.waits.last().into_iter().flat_map(|wait| &wait.behind);
    let last = behind.filter(|one| one.released).max_by(|a, b| a.to_s.total_cmp(&b.to_s));
    found.extend(last.map(|one| (one.instance, Bond::Resource)));
    found.retain(|(of, _)| *of != instance.id);
    found
}

fn digest(line: &LogLine) -> Option<String> {
    match &line.entry {
        LogEntry::Event(Event::Started { digest, .. }) => Some(digest.clone()),
        _ => None,
    }
}

fn decides(run: &Timeline, id: InstanceId) -> bool {
    run.instance(id).is_some_and(|one| one.decision.is_some())
}
