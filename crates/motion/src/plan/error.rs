//! Why there is no plan.

use crate::cloud::CloudError;
use crate::collision::Collision;
use crate::pace::Stop;

/// Maximum number of different reasons in an error.
pub(super) const MAX_REASONS: usize = 5;

/// Why there is no plan.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum PlanError {
    /// A part of the request is out of range or contradicts the robot.
    #[error("{what} is {value}: expected {expected}")]
    Malformed {
        /// The part of the request.
        what: String,
        /// Its value.
        value: String,
        /// The expected value.
        expected: String,
    },
    /// The point cloud is too far away.
    #[error("`cloud`: {0}")]
    Seen(#[from] CloudError),
    /// The arm is in collision at the start.
    #[error("at the start {collision}")]
    StartInCollision {
        /// The collision.
        collision: Collision,
    },
    /// The gripper is in contact at the start, and no straight way out of it is free.
    #[error("at the start {collision}, and it cannot be left: {}", reasons.join("; "))]
    NoRetreat {
        /// The deepest contact.
        collision: Collision,
        /// The ways that were tried, and what ends each of them.
        reasons: Vec<String>,
    },
    /// The straight part at the start cannot be followed.
    #[error("departing {part}: {reason}")]
    Depart {
        /// Its direction and length.
        part: String,
        /// What ends it.
        reason: String,
    },
    /// The start is free, but has no room around it.
    #[error("at the start {reason}")]
    NoRoom {
        /// What is too close.
        reason: String,
    },
    /// No alternative of the goal has a free posture.
    #[error("none of the {goals} goals can be reached: {}", reasons.join("; "))]
    NoGoal {
        /// Number of alternatives.
        goals: usize,
        /// The different reasons.
        reasons: Vec<String>,
    },
    /// The tool reaches no goal in a straight line.
    #[error("no straight way to any of the {goals} goals: {}", reasons.join("; "))]
    NoStraightWay {
        /// Number of alternatives.
        goals: usize,
        /// For some of them, how far the tool gets and what ends the line.
        reasons: Vec<String>,
    },
    /// A constraint on the tool is violated where it has to hold.
    #[error("{place} {reason}")]
    NotKept {
        /// Where on the motion.
        place: &'static str,
        /// The violation.
        reason: String,
    },
    /// The path found has a collision by the exact shapes: the search checks some couples only at some postures.
    #[error(
        "on the way that was found, {reason}, on a straight part or between the postures that the search has looked at: pass a posture aside"
    )]
    Unseen {
        /// The time and the collision.
        reason: String,
    },
    /// There are goal postures, but no path was found.
    #[error(
        "no way found to any of {postures} goal postures after {iterations} iterations; on the straight way {collision}"
    )]
    NoPath {
        /// Number of goal postures tried.
        postures: usize,
        /// Number of iterations of the search.
        iterations: usize,
        /// The collision on the straight way to the nearest goal posture.
        collision: String,
    },
    /// The caller's time was up before a path was found.
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
