//! The planner's clock: decides when a result is good enough, and when to stop. It yields the processor when more planning hardly helps.
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
use rustix::time::{ClockId, clock_gettime};
use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;
use std::time::{Duration, Instant};

/// Maximum processor time of the search for a first path, unless the budget is longer: whether a path is found does not depend on what else the
/// machine does, …
const FIRST_PATH_LIMIT: Duration = Duration::from_secs(10);

/// … and its maximum wall time, where it hardly gets a processor.
const FIRST_PATH_LONGEST: Duration = Duration::from_secs(60);

/// Minimum wall time of improvement without a budget: the processor needs it, however fast robot time goes. After that, improvement goes on
/// as long as the motion got quicker in the last interval of this length by more than the interval took.
const IMPROVEMENT: Duration = Duration::from_millis(50);

/// After this long without a quicker path, the planner yields the processor between its iterations, …
const STAGNATION: Duration = Duration::from_millis(100);

/// … for this long each time. Short, because a cancelled goal is noticed only afterwards.
const PAUSE: Duration = Duration::from_millis(1);

/// A published result is improved until there was no better one for as long as it took from the first to the last result, but for at least
/// this long, …
const STILL: Duration = Duration::from_secs(1);

/// … and never for longer than this: another goal may need the planner.
const LONGEST: Duration = Duration::from_secs(20);

/// Goals that wait for a first result have priority over goals that only improve one: this is added to the nice value of the latter's
/// thread.
const NICER: i32 = 10;

pub(super) struct Clock {
    begin: Instant,
    /// Seconds of robot time per second of wall time.
    speed: f64,
    budget: Option<Duration>,
    first_path: Option<Duration>,
    /// When the path last became quicker.
    improved: Instant,
    /// Estimated durations of the motion with their times: those of the last interval, and the one before it.
    estimates: VecDeque<(Duration, f64)>,
    /// Times of the first and the last published result.
    given: Option<(Duration, Duration)>,
    goal: Arc<GoalContext>,
}

/// Times in seconds of robot time.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Figures {
    /// From the goal's start to the first path.
    pub(super) first_path_s: f64,
    /// From the goal's start to now.
    pub(super) planning_s: f64,
}

impl Clock {
    pub(super) fn new(begin: Instant, speed: f64, budget_s: Option<f64>, goal: Arc<GoalContext>) -> Clock {
        // A budget too long for a `Duration` never ends.
        let budget = budget_s.map(|s| Duration::try_from_secs_f64(s / speed).unwrap_or(Duration::MAX));
        let estimates = VecDeque::new();
        Clock { begin, speed, budget, first_path: None, improved: begin, estimates, given: None, goal }
    }

    /// Tells the planner what to do next.
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
                    // Only this thread, which ends with its goal. Without permission it keeps its nice value.
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
            (None, budget) if is_searched_on(elapsed, processor_time(), budget) => Control::Continue,
            (Some(first_path), None) if elapsed < first_path + IMPROVEMENT || self.is_worth_waiting(elapsed) => {
                Control::Continue
            }
            // A goal with a budget wants its result when the budget is used up, and no sooner.
            (Some(_), None) if self.goal.improves().is_some() => Control::Settle,
            _ => Control::TimeUp,
        }
    }

    /// Whether the motion got quicker in the last interval by more than the interval took.
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

/// Whether the search for a first path goes on after so much wall time, of which the planner had a processor for `computed`.
fn is_searched_on(elapsed: Duration, computed: Duration, budget: Option<Duration>) -> bool {
    let is_within_limits = computed < FIRST_PATH_LIMIT && elapsed < FIRST_PATH_LONGEST;
    is_within_limits || budget.is_some_and(|budget| elapsed < budget)
}

/// The processor time of this thread, which plans for one goal alone.
fn processor_time() -> Duration {
    Duration::try_from(clock_gettime(ClockId::ThreadCPUTime)).unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_first_path_is_searched_for_ten_seconds_of_a_processor_however_busy_the_machine_is() {
        let goes_on = |elapsed_s, computed_s, budget_s: Option<u64>| {
            let [elapsed, computed] = [elapsed_s, computed_s].map(Duration::from_secs);
            is_searched_on(elapsed, computed, budget_s.map(Duration::from_secs))
        };
        assert!(goes_on(9, 9, None) && !goes_on(10, 10, None));
        assert!(goes_on(30, 2, None) && goes_on(30, 2, Some(5)), "it waits for a processor");
        assert!(!goes_on(60, 2, None), "somebody waits for the answer");
        assert!(goes_on(70, 70, Some(80)) && !goes_on(80, 70, Some(80)));
    }

    #[test]
    fn time_without_a_processor_is_not_counted() {
        let before = processor_time();
        std::thread::sleep(Duration::from_millis(50));
        assert!(processor_time().saturating_sub(before) < Duration::from_millis(50));
    }
}
