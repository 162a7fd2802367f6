//! The planner's clock: it says when the budget, or without one the time for improvement, is over. It leaves the processor to others where more planning
//! hardly helps.

use ratn_model::value::Value;
use ratn_motion::pace::{Control, Progress};
use ratn_worker::action::GoalContext;
use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::{Duration, Instant};

/// How long a first path is searched for at the most, in wall time, where the budget is shorter.
const FIRST_PATH_LIMIT: Duration = Duration::from_secs(10);

/// How long a path is improved where no budget is given, in wall time: the processor needs that, however fast the robot's time goes.
const IMPROVEMENT: Duration = Duration::from_millis(50);

/// After this long without a quicker path the planner lets others have the processor between its iterations, …
const STAGNATION: Duration = Duration::from_millis(100);

/// … for this long each time. Short, because a cancelled goal is noticed only afterwards.
const PAUSE: Duration = Duration::from_millis(1);

pub(super) struct Clock {
    begin: Instant,
    /// The robot's seconds per second of wall time.
    speed: f64,
    budget: Option<Duration>,
    first_path: Option<Duration>,
    /// When the path last became quicker.
    improved: Instant,
    goal: Arc<GoalContext>,
}

/// In the robot's seconds.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Figures {
    /// From the goal's start to the first path.
    pub(super) first_path_s: f64,
    /// From the goal's start to now.
    pub(super) planning_s: f64,
}

impl Clock {
    pub(super) fn new(begin: Instant, speed: f64, budget_s: Option<f64>, goal: Arc<GoalContext>) -> Clock {
        // A budget too long for a duration is none that ends.
        let budget = budget_s.map(|s| Duration::try_from_secs_f64(s / speed).unwrap_or(Duration::MAX));
        Clock { begin, speed, budget, first_path: None, improved: begin, goal }
    }

    /// What the planner shall do now.
    pub(super) fn control(&mut self, progress: Progress) -> Control {
        if self.goal.cancelled.is_cancelled() {
            return Control::Cancelled;
        }
        let elapsed = self.begin.elapsed();
        match progress {
            Progress::FirstPath { length_rad } => {
                self.first_path = Some(elapsed);
                self.improved = self.begin + elapsed;
                let first_path_s = Value::Float(elapsed.as_secs_f64() * self.speed);
                let values = [("first_path_s", first_path_s), ("length_rad", Value::Float(length_rad))];
                let values: BTreeMap<String, Value> = values.map(|(name, value)| (name.to_owned(), value)).into();
                self.goal.progress_with("first path", values);
            }
            Progress::Quicker { .. } => self.improved = self.begin + elapsed,
            Progress::Working => {}
        }
        let limit = match (self.first_path, self.budget) {
            (Some(_), Some(budget)) => budget,
            (Some(first_path), None) => first_path + IMPROVEMENT,
            (None, budget) => budget.unwrap_or_default().max(FIRST_PATH_LIMIT),
        };
        if elapsed >= limit {
            return Control::TimeUp;
        }
        if self.first_path.is_some() && self.improved.elapsed() > STAGNATION {
            std::thread::sleep(PAUSE.min(limit - elapsed));
        }
        Control::Continue
    }

    pub(super) fn figures(&self) -> Figures {
        let planning_s = self.begin.elapsed().as_secs_f64() * self.speed;
        Figures { first_path_s: self.first_path.map_or(planning_s, |t| t.as_secs_f64() * self.speed), planning_s }
    }
}
