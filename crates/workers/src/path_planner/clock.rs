//! The planner's clock: when what was found will do, and when to stop. It leaves the processor to others where more planning hardly helps.
//!
//! ```text
//! search ─ first path ─ improvement that is worth waiting for ─┬─ stop: the result
//!                                                              └─ a goal that may improve its result: the first one is given,
//!                                                                 better ones follow until there are hardly any or it is stopped
//! ```

use super::outputs;
use ratn_model::value::Value;
use ratn_motion::pace::{Control, Progress};
use ratn_worker::action::GoalContext;
use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;
use std::time::{Duration, Instant};

/// How long a first path is searched for at the most, in wall time, where the budget is shorter.
const FIRST_PATH_LIMIT: Duration = Duration::from_secs(10);

/// How long a path is improved at least where no budget is given, in wall time: the processor needs that, however fast the robot's time
/// goes. After that it is improved as long as in the last stretch of that length the motion got quicker by more than the stretch took.
const IMPROVEMENT: Duration = Duration::from_millis(50);

/// After this long without a quicker path the planner lets others have the processor between its iterations, …
const STAGNATION: Duration = Duration::from_millis(100);

/// … for this long each time. Short, because a cancelled goal is noticed only afterwards.
const PAUSE: Duration = Duration::from_millis(1);

/// A result that was given is improved until there was no better one for as long as the last one took, but for this long at least …
const STILL: Duration = Duration::from_secs(1);

/// … and never for longer than this: somebody else may want the planner.
const LONGEST: Duration = Duration::from_secs(20);

/// Whoever waits for a first result comes before one that only gets better: its thread is this much nicer.
const NICER: i32 = 10;

pub(super) struct Clock {
    begin: Instant,
    /// The robot's seconds per second of wall time.
    speed: f64,
    budget: Option<Duration>,
    first_path: Option<Duration>,
    /// When the path last became quicker.
    improved: Instant,
    /// What the motion was estimated to take, and when: those of the last stretch and the one before them.
    estimates: VecDeque<(Duration, f64)>,
    /// When results were given: the first and the last one.
    given: Option<(Duration, Duration)>,
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
        let estimates = VecDeque::new();
        Clock { begin, speed, budget, first_path: None, improved: begin, estimates, given: None, goal }
    }

    /// What the planner shall do now.
    pub(super) fn control(&mut self, progress: Progress<'_>) -> Control {
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
            Progress::Quicker { about_s } => {
                self.improved = self.begin + elapsed;
                self.estimates.push_back((elapsed, about_s));
            }
            Progress::Usable(plan) => {
                self.improved = self.begin + elapsed;
                if self.given.is_none() {
                    // Only this thread: it ends with its goal. Where that is not allowed, it is as nice as before.
                    let _ = rustix::process::nice(NICER);
                }
                self.given = Some((self.given.map_or(elapsed, |(first, _)| first), elapsed));
                let given = self.goal.improved(outputs(plan, &self.figures()), plan.trajectory.duration_s());
                if given.is_err() {
                    return Control::TimeUp;
                }
            }
            Progress::Working => {}
        }
        let answer = self.answer(elapsed);
        if answer == Control::Continue && self.first_path.is_some() && self.improved.elapsed() > STAGNATION {
            std::thread::sleep(PAUSE);
        }
        answer
    }

    fn answer(&mut self, elapsed: Duration) -> Control {
        if let Some((first, last)) = self.given {
            let is_still = elapsed.saturating_sub(last) > STILL.max(last.saturating_sub(first));
            let is_long = elapsed.saturating_sub(first) > LONGEST;
            return if is_still || is_long { Control::TimeUp } else { Control::Continue };
        }
        match (self.first_path, self.budget) {
            (Some(_), Some(budget)) if elapsed < budget => Control::Continue,
            (None, budget) if elapsed < budget.unwrap_or_default().max(FIRST_PATH_LIMIT) => Control::Continue,
            (Some(first_path), None) if elapsed < first_path + IMPROVEMENT || self.is_worth_waiting(elapsed) => {
                Control::Continue
            }
            // Whoever says how long it may take wants it then, and no sooner.
            (Some(_), None) if self.goal.improves().is_some() => Control::Settle,
            _ => Control::TimeUp,
        }
    }

    /// Whether the motion got quicker in the last stretch by more than that took.
    fn is_worth_waiting(&mut self, elapsed: Duration) -> bool {
        let Some(before) = elapsed.checked_sub(IMPROVEMENT) else { return true };
        while self.estimates.get(1).is_some_and(|(at, _)| *at <= before) {
            self.estimates.pop_front();
        }
        let (Some((_, then_s)), Some((_, now_s))) = (self.estimates.front(), self.estimates.back()) else {
            return false;
        };
        then_s - now_s > IMPROVEMENT.as_secs_f64() * self.speed
    }

    pub(super) fn figures(&self) -> Figures {
        let planning_s = self.begin.elapsed().as_secs_f64() * self.speed;
        Figures { first_path_s: self.first_path.map_or(planning_s, |t| t.as_secs_f64() * self.speed), planning_s }
    }
}
