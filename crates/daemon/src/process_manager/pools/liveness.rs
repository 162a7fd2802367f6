//! When a worker that serves is asked whether it still does. One question at a time; the next one a while after the answer, together with
//! others that are due about then: a thousand workers are asked in some turns a second, not one by one.

use crate::process_manager::template::Template;
use ratn_model::time::Timestamp;
use std::time::Duration;

/// Questions are asked at multiples of this,
const TURN: Duration = Duration::from_millis(100);
/// or of this part of the pause, where that is less.
const TURNS_PER_PAUSE: u32 = 20;

/// See the module.
#[derive(Debug)]
pub(super) struct Liveness {
    /// `None` where it cannot be asked.
    pause: Option<Duration>,
    /// The time for an answer.
    within: Duration,
    /// When to ask; `None` while an answer is awaited, and before it serves.
    next: Option<Timestamp>,
}

impl Liveness {
    pub(super) fn of(template: &Template) -> Liveness {
        let pause = template.readiness.can_be_asked().then(|| template.liveness.interval());
        Liveness { pause, within: template.liveness.timeout(), next: None }
    }

    /// How long it has to answer, where it is to be asked now.
    pub(super) fn ask(&mut self, now: Timestamp) -> Option<Duration> {
        self.next.take_if(|next| *next <= now).map(|_| self.within)
    }

    /// It is to be asked now, where it can be.
    pub(super) fn ask_at_once(&mut self, now: Timestamp) {
        self.next = self.pause.map(|_| now);
    }

    /// It serves.
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
        // A short pause stays about as short.
        assert_eq!(asked(0.2, 10.001), Timestamp::from_seconds(10.21));
    }
}
