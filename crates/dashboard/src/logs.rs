//! The logs that pages show: which exist, how far each was read, and the moments at which pages replay them.
//!
//! Nothing is read unless a page asks, and all pages that show the same share one fold, so a hidden page costs a run nothing. A long log is
//! not read from its start, but from far enough before the shown moment ([`Parts`]).

use crate::fold::{Bond, Fold};
use crate::{robot, tell, wire};
use ratn_event_log::{LogError, Parts};
use ratn_model::id::InstanceId;
use ratn_model::time::Timestamp;
use ratn_task_control::control::RunStatus;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

/// Maximum number of logs from the command line,
pub const MAX_LOGS: usize = 16;
/// and of further logs that runs write: as many as there may be runs.
const MAX_LOGS_OF_RUNS: usize = 64;
/// Number of bytes read before the shown moment; a shorter log is read from its start.
const BEFORE_BYTES: u64 = 16 << 20;
/// Maximum number of bytes read for one answer.
const BUDGET_BYTES: u64 = 4 << 20;
/// Maximum number of replays kept, so that each can continue. Beyond it, the one unused for the longest time starts anew.
const MAX_REPLAYS: usize = 4;
/// Maximum number of instances in one answer.
const MOST_INSTANCES: usize = 4_000;
/// Minimum interval between two looks at a log.
const LOOK_INTERVAL: Duration = Duration::from_millis(50);
/// If a run has not reported itself for this long, its log counts as complete.
const HEARD_WITHIN: Duration = Duration::from_secs(3);

/// What a page already knows of a log, and the moment it shows.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Asked {
    /// The moment in seconds; `None` for the newest.
    pub(crate) at_s: Option<f64>,
    /// The fold that it knows.
    pub(crate) epoch: u64,
    /// The version that it knows.
    pub(crate) version: u64,
    /// An instance for which it wants the reason of waiting in any case.
    pub(crate) about: Option<InstanceId>,
}

/// Why a log cannot be shown.
#[derive(Debug, thiserror::Error)]
pub(crate) enum NotTold {
    /// There is no log of this number.
    #[error("there is no log {0}: it was given up for a newer one, or never there")]
    Unknown(u64),
    /// It cannot be read.
    #[error(transparent)]
    Log(#[from] LogError),
}

/// All logs.
#[derive(Debug, Default)]
pub(crate) struct Logs {
    all: Mutex<All>,
}

#[derive(Debug, Default)]
struct All {
    logs: Vec<Followed>,
    /// The last number given to a log or fold; numbers are unique.
    numbers: u64,
    replays: Vec<Replay>,
}

/// A log.
#[derive(Debug)]
struct Followed {
    id: u64,
    path: PathBuf,
    /// Named by the user: never dropped.
    named: bool,
    parts: Option<Parts>,
    live: Option<Fold>,
    looked: Option<Instant>,
    /// The last status reported by its run.
    heard: Option<(Instant, RunStatus)>,
}

/// A replay: a log at a moment.
#[derive(Debug)]
struct Replay {
    log: u64,
    fold: Fold,
    asked: Instant,
}

impl Logs {
    /// The logs from the command line.
    pub(crate) fn of(paths: &[PathBuf]) -> Logs {
        let mut all = All::default();
        for path in paths {
            all.add(path.clone(), true);
        }
        Logs { all: Mutex::new(all) }
    }

    /// Takes the statuses of all runs under way, and adds their logs.
    pub(crate) fn hear(&self, statuses: Vec<RunStatus>) {
        let mut all = self.lock();
        all.logs.iter_mut().for_each(|one| one.heard = None);
        for status in statuses {
            let path = std::fs::canonicalize(&status.log).unwrap_or_else(|_| status.log.clone());
            // A pipe is not a log: opening it would wait for its writer.
            if std::fs::metadata(&path).is_ok_and(|is| !is.is_file()) {
                continue;
            }
            let known = all.logs.iter().position(|one| one.path == path);
            let index = known.unwrap_or_else(|| all.add(path, false));
            if let Some(one) = all.logs.get_mut(index) {
                one.heard = Some((Instant::now(), status));
            }
        }
    }

    /// The list of logs.
    pub(crate) fn told(&self) -> Vec<wire::Log> {
        let tell = |one: &Followed| wire::Log {
            id: one.id,
            name: one.path.file_name().unwrap_or(one.path.as_os_str()).to_string_lossy().into_owned(),
            path: one.path.display().to_string(),
            live: one.status().is_some(),
        };
        self.lock().logs.iter().map(tell).collect()
    }

    /// The id of the run that writes this log, if any.
    pub(crate) fn run_of(&self, id: u64) -> Option<String> {
        self.lock().logs.iter().find(|one| one.id == id)?.status().map(|status| status.run.clone())
    }

    /// The run in a log at a moment.
    pub(crate) fn frame(&self, id: u64, asked: &Asked) -> Result<wire::Frame, NotTold> {
        self.at(id, asked, |fold, there, one| {
            let version = if fold.epoch == asked.epoch { asked.version } else { 0 };
            let news = fold.since(version, MOST_INSTANCES);
            let mut frame = tell::frame(fold, &news, asked.about);
            frame.more |= !there;
            frame.run.live = one.status().is_some();
            let now = one.status().filter(|_| asked.at_s.is_none());
            frame.run.awaits = now.map(tell::awaits).unwrap_or_default();
            // In a long log, the line that sets them may not have been read.
            if let Some(status) = now {
                frame.run.breakpoints = tell::breakpoints(status);
            }
            frame.run.last_s = frame.run.at_s.max(one.parts.as_ref().map_or(0.0, |parts| parts.last().seconds()));
            frame
        })
    }

    /// The task file of a log, and the digest of the task.
    pub(crate) fn task(&self, id: u64) -> Result<(PathBuf, String), NotTold> {
        self.at(id, &Asked::default(), |fold, _, _| (PathBuf::from(&fold.run.file), fold.digest.clone()))
    }

    /// The robot named in a log; empty in a log of an earlier version.
    pub(crate) fn robot(&self, id: u64) -> Result<String, NotTold> {
        self.at(id, &Asked::default(), |fold, _, _| fold.run.robot.clone())
    }

    /// The world in a log at a moment.
    pub(crate) fn world(&self, id: u64, asked: &Asked, filter: &str) -> Result<wire::World, NotTold> {
        self.at(id, asked, |fold, _, _| {
            let path =
                |id: InstanceId| fold.run.instance(id).map_or_else(|| id.to_string(), |one| one.path.to_string());
            let world = fold.world.told(filter, path);
            wire::World { at_s: fold.run.end_s, from_s: fold.from_s, ..world }
        })
    }

    /// The cell in a log at a moment, with a robot, or the reason why none is known.
    pub(crate) fn cell(
        &self,
        id: u64,
        asked: &Asked,
        shown: Result<&robot::Shown, &str>,
    ) -> Result<wire::Cell, NotTold> {
        self.at(id, asked, |fold, there, _| {
            let version = if fold.epoch == asked.epoch { asked.version } else { 0 };
            let path =
                |id: InstanceId| fold.run.instance(id).map_or_else(|| id.to_string(), |one| one.path.to_string());
            let cell = robot::cell(&fold.film, version, shown, path);
            wire::Cell { epoch: fold.epoch, more: !there, at_s: fold.run.end_s, from_s: fold.from_s, ..cell }
        })
    }

    /// Whether a run writes this log.
    pub(crate) fn is_live(&self, id: u64) -> bool {
        self.run_of(id).is_some()
    }

    fn lock(&self) -> std::sync::MutexGuard<'_, All> {
        // A panic leaves what was read so far.
        self.all.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Calls `then` with the fold of a log at a moment, and with whether everything until then was read.
    fn at<T>(&self, id: u64, asked: &Asked, then: impl FnOnce(&Fold, bool, &Followed) -> T) -> Result<T, NotTold> {
        let mut all = self.lock();
        let All { logs, numbers, replays } = &mut *all;
        let one = logs.iter_mut().find(|one| one.id == id).ok_or(NotTold::Unknown(id))?;
        let looked = one.look();
        if !matches!(looked, Ok(true)) {
            // The path leads to another log now, or to none.
            one.live = None;
            replays.retain(|replay| replay.log != id);
        }
        looked?;
        match asked.at_s {
            None => {
                let there = one.follow(numbers)?;
                let fold = one.live.as_ref().ok_or(NotTold::Unknown(id))?;
                Ok(then(fold, there, one))
            }
            Some(at_s) => {
                let moment = Timestamp::from_seconds(at_s);
                let index = replay(replays, numbers, one, asked.epoch, moment)?;
                let replay = &mut replays[index];
                replay.asked = Instant::now();
                let there = replay.fold.read(&one.path, moment, BUDGET_BYTES)?;
                if there {
                    let last = one.parts.as_ref().map_or(moment, Parts::last);
                    replay.fold.run.wait_until(moment.min(last).seconds());
                }
                Ok(then(&replay.fold, there, one))
            }
        }
    }
}

/// The replay that a page continues; a new one if the page wants an earlier moment than was read, or one far ahead.
fn replay(
    replays: &mut Vec<Replay>,
    numbers: &mut u64,
    one: &Followed,
    epoch: u64,
    moment: Timestamp,
) -> Result<usize, NotTold> {
    let begin = one.begin(moment);
    let goes_on = |replay: &Replay| {
        let ahead = begin.0.saturating_sub(replay.fold.position());
        replay.log == one.id && replay.fold.epoch == epoch && replay.fold.run.end_s <= moment.seconds() && ahead == 0
    };
    if let Some(index) = replays.iter().position(goes_on) {
        return Ok(index);
    }
    // A page has one replay of a log.
    replays.retain(|replay| replay.fold.epoch != epoch);
    if replays.len() >= MAX_REPLAYS
        && let Some(oldest) = (0..replays.len()).min_by_key(|index| replays[*index].asked)
    {
        replays.remove(oldest);
    }
    *numbers += 1;
    let fold = Fold::begin(*numbers, &one.path, begin)?;
    replays.push(Replay { log: one.id, fold, asked: Instant::now() });
    Ok(replays.len() - 1)
}

impl All {
    /// Adds a log; returns its index. At the maximum, a log that was not named by the user is dropped for it.
    fn add(&mut self, path: PathBuf, named: bool) -> usize {
        if self.logs.len() >= MAX_LOGS + MAX_LOGS_OF_RUNS {
            let Some(oldest) = self.logs.iter().position(|one| !one.named && one.heard.is_none()) else {
                return usize::MAX;
            };
            let given_up = self.logs.remove(oldest).id;
            self.replays.retain(|replay| replay.log != given_up);
        }
        self.numbers += 1;
        let (id, parts) = (self.numbers, None);
        self.logs.push(Followed { id, path, named, parts, live: None, looked: None, heard: None });
        self.logs.len() - 1
    }
}

impl Followed {
    /// The status of its run, if one writes it.
    fn status(&self) -> Option<&RunStatus> {
        self.heard.as_ref().filter(|(heard, _)| heard.elapsed() < HEARD_WITHIN).map(|(_, status)| status)
    }

    /// Checks the length of the log. Returns whether it is still the same log.
    fn look(&mut self) -> Result<bool, LogError> {
        let mut is_same = true;
        self.parts = Some(match self.parts.take() {
            Some(parts) if self.looked.is_some_and(|looked| looked.elapsed() < LOOK_INTERVAL) => parts,
            Some(mut parts) => {
                is_same = parts.look()?;
                self.looked = Some(Instant::now());
                parts
            }
            None => {
                self.looked = Some(Instant::now());
                Parts::of(&self.path)?
            }
        });
        Ok(is_same)
    }

    /// Where reading begins for a moment.
    fn begin(&self, moment: Timestamp) -> (u64, Timestamp) {
        self.parts.as_ref().map_or((0, Timestamp(0)), |parts| parts.before(moment, BEFORE_BYTES))
    }

    /// Reads on to the end of the log. Returns whether the end was reached.
    fn follow(&mut self, numbers: &mut u64) -> Result<bool, LogError> {
        let end = Timestamp(u64::MAX);
        if self.live.is_none() {
            *numbers += 1;
            self.live = Some(Fold::begin(*numbers, &self.path, self.begin(end))?);
        }
        let now_s = self.status().map(|status| status.at_s);
        let Some(fold) = &mut self.live else { return Ok(true) };
        let there = fold.read(&self.path, end, BUDGET_BYTES)?;
        if let Some(now_s) = now_s.filter(|_| there && fold.run.outcome.is_none()) {
            fold.run.wait_until(now_s);
        }
        Ok(there)
    }
}

/// Dependencies in the pages' notation.
pub(crate) fn edges(fold: &Fold, id: InstanceId) -> Vec<wire::Edge> {
    fold.edges(id).map(|(from, bond): (InstanceId, Bond)| wire::Edge { from: from.0, kind: bond.name() }).collect()
}

/// The canonical path, so that a log is recognised by the path that its run reports, too.
pub(crate) fn absolute(path: &Path) -> std::io::Result<PathBuf> {
    std::fs::canonicalize(path)
}
