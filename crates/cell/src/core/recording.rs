//! The recording of a cell, line by line, and its replay: a new cell of the same config gets the same events.
//!
//! ```text
//! {"form":2,"config":{…},"robot":{…}}                      first: the cell's config and its robot
//! {"at":…,"event":{…}}                                     an event, at a time of the robot in nanoseconds
//! {"at":…,"ended":…,"how":"done"}                          the result of a goal
//! {"at":…,"contact":{…}}                                   an unintended contact
//! {"at":…,"world":"…"}                                     after each event: the digest of the environment
//! ```
//! The core is a function of its events, so a recording is replayed by sending them again; the results and the digests show whether the replay is the
//! same. Ticks are left out: nothing depends on when they come.

use super::cell::Cell;
use super::contacts::Contact;
use super::placement::PlacementError;
use super::protocol::{Command, Ending, Event, Ticket, Tracking};
use crate::config::CellConfig;
use ratn_model::time::Timestamp;
use ratn_motion::robot::RobotIdentity;
use serde::{Deserialize, Serialize};
use std::collections::VecDeque;
use std::io;

/// The format version of recordings.
const FORM: u32 = 2;

/// A line of a recording.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(untagged)]
pub enum Line {
    /// The first line.
    Header {
        /// The format version; any other is refused.
        form: u32,
        /// The config of the cell.
        config: Box<CellConfig>,
        /// The robot of the cell; missing in recordings of earlier versions.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        robot: Option<RobotIdentity>,
    },
    /// An event.
    Event {
        /// When it happened.
        at: Timestamp,
        /// The event.
        event: Event,
    },
    /// A goal ended.
    Ended {
        /// When it ended.
        at: Timestamp,
        /// The goal.
        ended: Ticket,
        /// `done`, `aborted`, `preempted` or `stopped`.
        how: String,
        /// The reason, unless it succeeded.
        #[serde(default, skip_serializing_if = "String::is_empty")]
        reason: String,
        /// The tracking errors, if it followed a trajectory.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        tracking: Option<Tracking>,
    },
    /// An unintended contact of two bodies.
    Contact {
        /// When it was reported.
        at: Timestamp,
        /// The two bodies, the depth of their overlap, and their speed.
        contact: Contact,
    },
    /// The environment after an event.
    World {
        /// When the event happened.
        at: Timestamp,
        /// The digest of the environment.
        world: String,
    },
}

/// The result of a replay that is equal to the recording.
#[derive(Debug, Clone, PartialEq)]
pub struct Replayed {
    /// Number of events.
    pub events: usize,
    /// Number of goals, each of which ended as recorded.
    pub goals: usize,
    /// When the last event happened, in the robot's seconds.
    pub end_s: f64,
    /// The maximum tracking errors of all trajectories.
    pub tracking: Tracking,
}

/// Why a recording cannot be replayed, or where the replay differs from it.
#[derive(Debug, thiserror::Error)]
pub enum ReplayError {
    /// A line cannot be read.
    #[error("line {line} cannot be read")]
    Unreadable {
        /// The line number, from 1.
        line: usize,
        /// Why.
        #[source]
        source: io::Error,
    },
    /// A line is not a line of a recording.
    #[error("line {line} is none of a recording: {reason}")]
    NoRecording {
        /// The line number, from 1.
        line: usize,
        /// Why.
        reason: String,
    },
    /// The cell cannot be created.
    #[error(transparent)]
    Table(#[from] PlacementError),
    /// The robot's description has changed.
    #[error(
        "this recording is of the robot {of}, and the robot that its config names is {here} now: replay it with the description of then"
    )]
    AnotherRobot {
        /// The robot of the recording.
        of: RobotIdentity,
        /// The robot that the config names now.
        here: RobotIdentity,
    },
    /// The replay differs from what was recorded.
    #[error("line {line}: recorded was {recorded}, and now it is {replayed}")]
    Differs {
        /// The line number, from 1.
        line: usize,
        /// The recorded value.
        recorded: String,
        /// The value in the replay.
        replayed: String,
    },
}

impl Line {
    /// The first line of a recording of a cell.
    pub fn header(cell: &Cell) -> Line {
        let (config, robot) = (Box::new(cell.config().clone()), Some(cell.robot().identity()));
        Line::Header { form: FORM, config, robot }
    }

    /// The lines for a step of the cell: its event, the ended goals, and the world after it.
    pub fn of_step(at: Timestamp, event: Event, commands: &[Command], cell: &Cell) -> Vec<Line> {
        let is_tick = event == Event::Tick;
        let begin = (!is_tick).then_some(Line::Event { at, event });
        let ended = commands.iter().filter_map(|command| {
            ended(command).map(|(ended, how, reason)| Line::Ended {
                at,
                ended,
                how: how.to_owned(),
                reason: reason.to_owned(),
                tracking: tracking(command),
            })
        });
        let touched = commands.iter().filter_map(|command| match command {
            Command::Touched { contact } => Some(Line::Contact { at, contact: contact.clone() }),
            _ => None,
        });
        let world = (!is_tick).then(|| Line::World { at, world: cell.environment.digest().to_string() });
        begin.into_iter().chain(ended).chain(touched).chain(world).collect()
    }
}

/// Replays a recording.
///
/// # Errors
/// [`ReplayError`] if it is not a recording, and at the first line that differs.
pub fn replay(lines: impl Iterator<Item = io::Result<String>>) -> Result<Replayed, ReplayError> {
    let mut cell: Option<Cell> = None;
    let mut endings: VecDeque<(Ticket, String)> = VecDeque::new();
    let mut replayed = Replayed { events: 0, goals: 0, end_s: 0.0, tracking: Tracking::default() };
    for (index, text) in lines.enumerate() {
        let line = index + 1;
        let text = text.map_err(|source| ReplayError::Unreadable { line, source })?;
        let none = |reason: String| ReplayError::NoRecording { line, reason };
        let read = serde_json::from_str(&text).map_err(|error| none(error.to_string()))?;
        let Some(cell) = &mut cell else {
            match read {
                Line::Header { form: FORM, config, robot } => {
                    config.check().map_err(|error| none(error.to_string()))?;
                    let made = Cell::new(*config)?;
                    let here = made.robot().identity();
                    if let Some(of) = robot.filter(|of| *of != here) {
                        return Err(ReplayError::AnotherRobot { of, here });
                    }
                    cell = Some(made);
                }
                _ => return Err(none(format!("a recording begins with form {FORM} and a config"))),
            }
            continue;
        };
        let mut pass = |cell: &mut Cell, at: Timestamp, event: Event| {
            let commands = cell.handle(at, event);
            endings.extend(commands.iter().filter_map(ended).map(|(ticket, how, _)| (ticket, how.to_owned())));
            let followed = commands.iter().filter_map(tracking);
            replayed.tracking = followed.fold(replayed.tracking, Tracking::or_worse);
            replayed.end_s = at.seconds();
        };
        match read {
            Line::Header { .. } => return Err(none("it has a second beginning".to_owned())),
            Line::Event { at, event } => {
                if let Event::PutBack { snapshot } = &event {
                    snapshot.check_robot(cell.robot()).map_err(|error| none(error.to_string()))?;
                }
                pass(cell, at, event);
                replayed.events += 1;
            }
            Line::Ended { at, ended, how, .. } => {
                pass(cell, at, Event::Tick);
                let found = endings.pop_front();
                if found != Some((ended, how.clone())) {
                    let say = |ticket: Ticket, how: &str| format!("goal {} {how}", ticket.0);
                    let now = found.map_or("none ended".to_owned(), |(ticket, how)| say(ticket, &how));
                    return Err(ReplayError::Differs { line, recorded: say(ended, &how), replayed: now });
                }
                replayed.goals += 1;
            }
            // Contacts follow from the world, which is compared.
            Line::Contact { .. } => {}
            Line::World { world, .. } => {
                let now = cell.environment.digest().to_string();
                if now != world {
                    return Err(ReplayError::Differs { line, recorded: world, replayed: now });
                }
            }
        }
    }
    Ok(replayed)
}

fn ended(command: &Command) -> Option<(Ticket, &'static str, &str)> {
    let Command::Ended { ticket, ending, .. } = command else { return None };
    Some(match ending {
        Ending::Done(_) => (*ticket, "done", ""),
        Ending::Aborted(reason) => (*ticket, "aborted", reason),
        Ending::Preempted(reason) => (*ticket, "preempted", reason),
        Ending::Stopped(reason) => (*ticket, "stopped", reason),
    })
}

fn tracking(command: &Command) -> Option<Tracking> {
    if let Command::Ended { tracking, .. } = command { *tracking } else { None }
}
