//! Why there is no plan.

use crate::cloud::CloudError;
use crate::collision::Collision;
use crate::pace::Stop;

/// How many different reasons an error names.
pub(super) const MAX_REASONS: usize = 5;

/// Why there is no plan.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum PlanError {
    /// A part of the request is out of range or contradicts the robot.
    #[error("{what} is {value}: expected {expected}")]
    Malformed {
        /// Which part of it.
        what: String,
        /// What it is.
        value: String,
        /// What it should be.
        expected: String,
    },
    /// What was seen is too far away.
    #[error("`cloud`: {0}")]
    Seen(#[from] CloudError),
    /// The arm touches something where it stands.
    #[error("at the start {collision}")]
    StartInCollision {
        /// What touches what.
        collision: Collision,
    },
    /// The gripper touches something where the arm stands, and no straight way out of it is free.
    #[error("at the start {collision}, and it cannot be left: {}", reasons.join("; "))]
    NoRetreat {
        /// What is touched deepest.
        collision: Collision,
        /// Which ways were tried, and what ends each of them.
        reasons: Vec<String>,
    },
    /// The straight part at the start cannot be followed.
    #[error("departing {part}: {reason}")]
    Depart {
        /// How far it should go, and where.
        part: String,
        /// What is in the way.
        reason: String,
    },
    /// The start is free, but nothing around it.
    #[error("at the start {reason}")]
    NoRoom {
        /// What is close.
        reason: String,
    },
    /// No alternative of the goal has a posture that is free.
    #[error("none of the {goals} goals can be reached: {}", reasons.join("; "))]
    NoGoal {
        /// How many alternatives there were.
        goals: usize,
        /// The different reasons.
        reasons: Vec<String>,
    },
    /// The tool reaches none of the goals in a straight line.
    #[error("no straight way to any of the {goals} goals: {}", reasons.join("; "))]
    NoStraightWay {
        /// How many alternatives there were.
        goals: usize,
        /// How far the tool gets and why no further, of some of them.
        reasons: Vec<String>,
    },
    /// A constraint on the tool is broken where it has to hold.
    #[error("{place} {reason}")]
    NotKept {
        /// Where.
        place: &'static str,
        /// What is broken.
        reason: String,
    },
    /// By the shapes something meets on the way that was found, where the search has looked at some postures of it alone.
    #[error(
        "on the way that was found, {reason}, on a straight part or between the postures that the search has looked at: pass a posture aside"
    )]
    Unseen {
        /// When, and which.
        reason: String,
    },
    /// There are goals, but no way was found.
    #[error(
        "no way found to any of {postures} goal postures after {iterations} iterations; on the straight way {collision}"
    )]
    NoPath {
        /// How many goal postures were tried.
        postures: usize,
        /// Iterations of the search.
        iterations: usize,
        /// What blocks the straight way to the nearest of them.
        collision: String,
    },
    /// The caller's time was up before there was any path.
    #[error("no path was found in the time given")]
    TimeUp,
    /// The caller cancelled the planning.
    #[error("planning was cancelled")]
    Cancelled,
}

impl PlanError {
    pub(crate) fn no_straight_way(mut reasons: Vec<String>) -> PlanError {
        let goals = reasons.len();
        reasons.truncate(MAX_REASONS);
        PlanError::NoStraightWay { goals, reasons }
    }
}

impl From<Stop> for PlanError {
    fn from(stop: Stop) -> PlanError {
        match stop {
            Stop::TimeUp => PlanError::TimeUp,
            Stop::Cancelled => PlanError::Cancelled,
        }
    }
}
