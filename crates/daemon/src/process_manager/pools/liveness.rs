//! When a serving worker gets a health check. There is one check at a time; the next follows a while after the answer, together with
//! other checks that are due at about the same time: a thousand workers are checked in a few batches per second, not one by one.

use crate::process_manager::template::Template;
use ratn_model::time::Timestamp;
use std::time::Duration;

/// Checks are made at multiples of this time,
const TURN: Duration = Duration::from_millis(100);
/// or of this fraction of the interval, where that is shorter.
const TURNS_PER_PAUSE: u32 = 20;

/// See the module.
#[derive(Debug)]
pub(super) struct Liveness {
    /// Interval between checks; `None` where the worker cannot be asked.
    pause: Option<Duration>,
    /// Timeout of an answer.
    within: Duration,
    /// When to ask; `None` while an answer is awaited, and before the worker serves.
    next: Option<Timestamp>,
}

impl Liveness {
    pub(super) fn of(template: &Template) -> Liveness {
        let pause = template.readiness.can_be_asked().then(|| template.liveness.interval());
        Liveness { pause, within: template.liveness.timeout(), next: None }
    }

    /// The timeout of a check, where one is due now.
    pub(super) fn ask(&mut self, now: Timestamp) -> Option<Duration> {
        self.next.take_if(|next| *next <= now).map(|_| self.within)
    }

    /// A check is due now, where the worker can be asked.
    pub(super) fn ask_at_once(&mut self, now: Timestamp) {
        self.next = self.pause.map(|_| now);
    }

    /// The worker serves: sets the time of the next check.
    pub(super) fn answered(&mut self, now: Timestamp) {
        self.next = self.pause.map(|pause| turn_after(now + pause, TURN.min(pause / TURNS_PER_PAUSE)));
    }

    pub(super) fn deadline(&self) -> Option<Timestamp> {
        self.next
    }
}

/// The first multiple of `turn` that is not before `at`.
fn turn_after(at: Timestamp, turn: Duration) -> Timestamp {
    let turn_ns = u64::try_from(turn.as_nanos()).unwrap_or(u64::MAX).max(1);
    Timestamp(at.0.div_ceil(turn_ns).saturating_mul(turn_ns))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::process_manager::template::Liveness as Config;

    #[test]
    fn it_is_asked_once_and_again_a_while_after_its_answer() {
        let config = Config { interval_s: 2.0, timeout_s: 5.0 };
        let template = Template { liveness: config, ..Template::new("planner", "PathPlanner") };
        let (mut liveness, at) = (Liveness::of(&template), Timestamp::from_seconds);
        assert_eq!(liveness.ask(at(9.0)), None, "it does not serve yet");
        liveness.answered(at(10.0));
        assert_eq!((liveness.ask(at(11.0)), liveness.deadline()), (None, Some(at(12.0))));
        assert_eq!(liveness.ask(at(12.0)), Some(Duration::from_secs(5)));
        assert_eq!((liveness.ask(at(20.0)), liveness.deadline()), (None, None), "one question at a time");
        liveness.answered(at(20.0));
        assert_eq!(liveness.deadline(), Some(at(22.0)));
    }

    #[test]
    fn those_that_are_due_about_the_same_time_are_asked_together() {
        let asked = |interval_s, answered_s| {
            let config = Config { interval_s, timeout_s: 5.0 };
            let mut liveness = Liveness::of(&Template { liveness: config, ..Template::new("planner", "PathPlanner") });
            liveness.answered(Timestamp::from_seconds(answered_s));
            liveness.deadline().unwrap_or_default()
        };
        assert_eq!([asked(2.0, 10.01), asked(2.0, 10.07)], [Timestamp::from_seconds(12.1); 2]);
        // A short interval stays about as short.
        assert_eq!(asked(0.2, 10.001), Timestamp::from_seconds(10.21));
    }
}
