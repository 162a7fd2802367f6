//! The recording of a cell, line by line, and its replay: the same cell is made again and given the same events.
//!
//! ```text
//! {"form":2,"config":{…},"robot":{…}}                      first: how the cell was made, and of which robot
//! {"at":…,"event":{…}}                                     what came in, in the robot's nanoseconds
//! {"at":…,"ended":…,"how":"done"}                          what a goal came to
//! {"at":…,"contact":{…}}                                    what touched that should not have
//! {"at":…,"world":"…"}                                     after each event: the digest of the environment
//! ```
//! The core is a function of its events, so a recording is replayed by giving them again; the endings and the digests say whether the
//! same came of it. Ticks are left out: nothing depends on when the core is asked.

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

/// The form of what is written.
const FORM: u32 = 2;

/// One line.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(untagged)]
pub enum Line {
    /// The first.
    Header {
        /// The form of the lines; another one is refused.
        form: u32,
        /// How the cell was made.
        config: Box<CellConfig>,
        /// Of which robot; a recording of an earlier version does not say.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        robot: Option<RobotIdentity>,
    },
    /// Something came in.
    Event {
        /// When it came in.
        at: Timestamp,
        /// What came in.
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
        /// Why, where it was not done.
        #[serde(default, skip_serializing_if = "String::is_empty")]
        reason: String,
        /// How well it followed its trajectory, where it followed one.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        tracking: Option<Tracking>,
    },
    /// Two bodies touched that should not have.
    Contact {
        /// When it was told.
        at: Timestamp,
        /// The two bodies, how deep they were in each other, and how they moved.
        contact: Contact,
    },
    /// The environment after an event.
    World {
        /// When.
        at: Timestamp,
        /// The digest of the environment.
        world: String,
    },
}

/// The result of a replay in which everything happened as recorded.
#[derive(Debug, Clone, PartialEq)]
pub struct Replayed {
    /// How many events came in.
    pub events: usize,
    /// How many goals ended, each as recorded.
    pub goals: usize,
    /// When the last event was, in the robot's seconds.
    pub end_s: f64,
    /// How well trajectories were followed: the worst of all.
    pub tracking: Tracking,
}

/// Why a recording is not replayed, or where the replay differs from it.
#[derive(Debug, thiserror::Error)]
pub enum ReplayError {
    /// A line cannot be read.
    #[error("line {line} cannot be read")]
    Unreadable {
        /// Which, from 1.
        line: usize,
        /// Why.
        #[source]
        source: io::Error,
    },
    /// A line is not a line of a recording.
    #[error("line {line} is none of a recording: {reason}")]
    NoRecording {
        /// Which, from 1.
        line: usize,
        /// Why.
        reason: String,
    },
    /// The cell cannot be made.
    #[error(transparent)]
    Table(#[from] PlacementError),
    /// The robot's description is another one now.
    #[error(
        "this recording is of the robot {of}, and the robot that its config names is {here} now: replay it with the description of then"
    )]
    AnotherRobot {
        /// The recording's.
        of: RobotIdentity,
        /// The one that the config names.
        here: RobotIdentity,
    },
    /// The replay differs from what was recorded.
    #[error("line {line}: recorded was {recorded}, and now it is {replayed}")]
    Differs {
        /// Which, from 1.
        line: usize,
        /// What the recording says.
        recorded: String,
        /// What the replay came to.
        replayed: String,
    },
}

impl Line {
    /// The first line of a recording of a cell.
    pub fn header(cell: &Cell) -> Line {
        let (config, robot) = (Box::new(cell.config().clone()), Some(cell.robot().identity()));
        Line::Header { form: FORM, config, robot }
    }

    /// What is recorded of a step of the cell: its event, what ended, and the world after it.
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

/// Goes through a recording again.
///
/// # Errors
/// [`ReplayError`] where it is none, and at the first line that something else comes of.
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
            // What is made of the same world by the same rules is the same.
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
