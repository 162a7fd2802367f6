//! Tests of the machine with brakes and a disk that answer at any time, or not, and callers who leave: every short sequence of steps, and
//! long random ones. The oracle sees only the machine's commands, and derives from them in which state the brakes surely are.

#![allow(clippy::unwrap_used, reason = "a test may panic")]

use super::*;
use rand::rngs::StdRng;
use rand::{RngExt, SeedableRng};
use std::collections::BTreeMap;

/// Length of the sequences that are tried exhaustively.
const DEPTH: usize = 5;
/// Number of random sequences, and the steps of each.
const WALKS: u64 = 3_000;
const WALK_STEPS: usize = 60;

#[derive(Debug, Clone)]
struct Running {
    state: SafetyState,
    /// The machine ignores its result.
    dropped: bool,
    /// No application for another state has been running since it began.
    undisturbed: bool,
}

#[derive(Debug, Clone)]
struct Bench {
    machine: Machine,
    now: Instant,
    is_kept: bool,
    running: BTreeMap<Application, Running>,
    /// The state in which the brakes surely are, if known.
    surely: Option<SafetyState>,
    /// Whether the brakes surely were in a state in which nothing moves.
    rested: bool,
    /// The operation on the disk that is under way: true for writing.
    writing: Option<bool>,
    on_disk: bool,
    shown: SafetyState,
    /// A hold was asked for during the stop in force.
    hold_follows: bool,
    open: BTreeMap<Call, Question>,
    calls: u64,
    releases_asked: u64,
    trace: Vec<String>,
}

#[derive(Debug, Clone)]
enum Step {
    Ask(Question),
    Leave(Call),
    Brake(Application, bool),
    Disk(bool),
    Wait,
}

impl Bench {
    fn new(is_kept: bool, was_stopped: bool) -> Bench {
        let reason = "before".to_owned();
        let (machine, shown) = match was_stopped {
            true => (Machine::stopped_before(reason.clone()), SafetyState::Stopped { reason }),
            false => (Machine::new(is_kept), SafetyState::Ready),
        };
        Bench {
            machine,
            now: Instant::now(),
            is_kept,
            running: BTreeMap::new(),
            surely: None,
            rested: false,
            writing: None,
            on_disk: was_stopped,
            shown,
            hold_follows: false,
            open: BTreeMap::new(),
            calls: 0,
            releases_asked: 0,
            trace: Vec::new(),
        }
    }

    fn steps(&self) -> Vec<Step> {
        let reason = || "a hand".to_owned();
        let (stop, hold) = (Question::Stop { reason: reason() }, Question::Hold { reason: reason() });
        let mut steps: Vec<Step> =
            [stop, hold, Question::Clear, Question::GoOn, Question::Rest].into_iter().map(Step::Ask).collect();
        for &application in self.running.keys() {
            steps.extend([Step::Brake(application, true), Step::Brake(application, false)]);
        }
        if self.writing.is_some() {
            steps.extend([Step::Disk(true), Step::Disk(false)]);
        }
        if !self.running.is_empty() {
            steps.push(Step::Wait);
        }
        steps.extend(self.open.keys().next().map(|&call| Step::Leave(call)));
        steps
    }

    fn take(&mut self, step: Step) {
        self.trace.push(format!("{step:?}"));
        let event = match step.clone() {
            Step::Ask(question) => {
                self.calls += 1;
                self.releases_asked += u64::from(is_release(&question));
                self.open.insert(Call(self.calls), question.clone());
                Event::Asked { call: Call(self.calls), question }
            }
            Step::Leave(call) => {
                self.open.remove(&call);
                Event::Left { call }
            }
            Step::Brake(application, confirmed) => {
                let over = self.running.remove(&application).unwrap();
                if confirmed && over.undisturbed {
                    self.rested |= over.state != SafetyState::Ready;
                    self.surely = Some(over.state);
                }
                let result = if confirmed { Ok(()) } else { Err("stuck".to_owned()) };
                Event::Braked { application, result }
            }
            Step::Disk(done) => {
                let writing = self.writing.take().unwrap();
                // After a failed removal the file may be there or not.
                self.on_disk = writing && done;
                let result = if done { Ok(()) } else { Err("full".to_owned()) };
                if writing { Event::Latched(result) } else { Event::Unlatched(result) }
            }
            Step::Wait => {
                self.now += BRAKES_PATIENCE;
                return;
            }
        };
        for command in self.machine.handle(self.now, event) {
            self.trace.push(format!("    {command:?}"));
            self.perform(command);
        }
        self.check(&step);
    }

    fn perform(&mut self, command: Command) {
        match command {
            Command::Show(SafetyState::Ready) => {
                assert_eq!(self.surely, Some(SafetyState::Ready), "ready before the brakes let go: {self:#?}");
                assert!(!self.on_disk && self.writing.is_none(), "a restart would stop: {self:#?}");
                assert!(self.releases_asked > 0, "nobody asked for it: {self:#?}");
                assert!(!self.hold_follows, "a hold is forgotten: {self:#?}");
                self.shown = SafetyState::Ready;
            }
            Command::Show(state) => {
                self.hold_follows &= matches!(state, SafetyState::Stopped { .. });
                self.shown = state;
            }
            Command::Apply { application, state } => {
                let others = self.running.values_mut().filter(|running| running.state != state);
                let undisturbed = others.map(|other| other.undisturbed = false).count() == 0;
                if self.surely.as_ref() != Some(&state) {
                    self.surely = None;
                }
                let releases = state == SafetyState::Ready && self.shown != SafetyState::Ready;
                assert!(!releases || !self.on_disk && self.writing.is_none(), "let go before the disk: {self:#?}");
                self.running.insert(application, Running { state, dropped: false, undisturbed });
            }
            Command::Drop { application } => self.running.get_mut(&application).unwrap().dropped = true,
            Command::WriteLatch { .. } => assert_eq!(self.writing.replace(true), None, "one at a time: {self:#?}"),
            Command::RemoveLatch => assert_eq!(self.writing.replace(false), None, "one at a time: {self:#?}"),
            Command::Answer { call, answer } => {
                let question =
                    self.open.remove(&call).unwrap_or_else(|| panic!("not asked, or answered twice: {self:#?}"));
                self.check_answer(&question, &answer);
            }
        }
    }

    fn check_answer(&self, question: &Question, answer: &Result<SafetyState, SafetyError>) {
        let Ok(state) = answer else { return };
        assert_eq!(*state, self.shown, "{self:#?}");
        match question {
            Question::Stop { .. } | Question::Hold { .. } => {
                assert_ne!(*state, SafetyState::Ready, "{self:#?}");
                assert_eq!(self.surely.as_ref(), Some(state), "something may move: {self:#?}");
                let is_stopped = matches!(state, SafetyState::Stopped { .. });
                assert!(!(is_stopped && self.is_kept) || self.on_disk, "a restart forgets it: {self:#?}");
            }
            Question::Rest => assert!(self.rested && self.surely.as_ref() == Some(state), "{self:#?}"),
            Question::Clear | Question::GoOn => {}
        }
    }

    fn check(&mut self, step: &Step) {
        assert_eq!(*self.machine.state(), self.shown, "{self:#?}");
        let is_told = |state: &SafetyState| {
            self.surely.as_ref() == Some(state)
                || self.running.values().any(|running| !running.dropped && running.state == *state)
        };
        match step {
            Step::Ask(Question::Stop { .. }) => {
                assert!(matches!(self.shown, SafetyState::Stopped { .. }), "not in force at once: {self:#?}");
                assert!(is_told(&self.shown), "the brakes are not told: {self:#?}");
                assert!(!self.is_kept || self.on_disk || self.writing.is_some(), "the disk is not told: {self:#?}");
            }
            Step::Ask(Question::Hold { .. }) => {
                assert!(self.shown != SafetyState::Ready && is_told(&self.shown), "{self:#?}");
                self.hold_follows |= matches!(self.shown, SafetyState::Stopped { .. });
            }
            _ => {}
        }
        let is_quiet = self.running.is_empty() && self.writing.is_none();
        assert!(!is_quiet || self.open.is_empty(), "nobody will answer these: {self:#?}");
    }
}

fn benches() -> [Bench; 3] {
    [Bench::new(false, false), Bench::new(true, false), Bench::new(true, true)]
}

fn every_sequence(bench: &Bench, depth: usize) -> u64 {
    if depth == 0 {
        return 1;
    }
    let after = |step| {
        let mut bench = bench.clone();
        bench.take(step);
        every_sequence(&bench, depth - 1)
    };
    bench.steps().into_iter().map(after).sum()
}

#[test]
fn in_every_sequence_of_a_few_steps_only_what_is_true_is_confirmed_and_a_stop_is_in_force_at_once() {
    let sequences: u64 = benches().iter().map(|bench| every_sequence(bench, DEPTH)).sum();
    assert!(sequences > 70_000, "{sequences}");
}

#[test]
fn so_it_is_in_long_sequences() {
    for seed in 0..WALKS {
        let mut random = StdRng::seed_from_u64(seed);
        let [plain, kept, stopped] = benches();
        let mut bench = match seed % 3 {
            0 => plain,
            1 => kept,
            _ => stopped,
        };
        for _ in 0..WALK_STEPS {
            let mut steps = bench.steps();
            let chosen = random.random_range(0..steps.len());
            bench.take(steps.swap_remove(chosen));
        }
        // When everything has been answered, no caller waits.
        while let Some(step) =
            bench.steps().into_iter().find(|step| matches!(step, Step::Brake(_, true) | Step::Disk(true)))
        {
            bench.take(step);
        }
        assert!(bench.open.is_empty(), "seed {seed}: {bench:#?}");
    }
}

#[test]
fn brakes_that_hang_are_asked_anew_by_who_asks_again_later_and_not_by_who_asks_at_once() {
    let mut bench = Bench::new(false, false);
    let stop = || Step::Ask(Question::Stop { reason: "a hand".to_owned() });
    bench.take(stop());
    bench.take(stop());
    assert_eq!(bench.running.len(), 1, "it had no time to answer");
    bench.take(Step::Wait);
    bench.take(stop());
    assert_eq!(bench.running.values().map(|running| running.dropped).collect::<Vec<_>>(), [true, false]);
    // The second application is not confirmed while the first may still have an effect.
    bench.take(Step::Brake(Application(2), true));
    assert_eq!(bench.open.len(), 3);
    bench.take(Step::Brake(Application(1), false));
    bench.take(Step::Brake(Application(3), true));
    assert!(bench.open.is_empty());
}

#[test]
fn clearing_and_going_on_wait_for_nothing_and_end_nothing() {
    let mut bench = Bench::new(true, false);
    bench.take(Step::Ask(Question::Stop { reason: "a hand".to_owned() }));
    bench.take(Step::Ask(Question::Clear));
    assert_eq!(bench.open.len(), 1, "the brakes have not answered: refused");
    bench.take(Step::Brake(Application(1), true));
    bench.take(Step::Ask(Question::Clear));
    assert_eq!(bench.open.len(), 1, "the disk has not answered: refused");
    assert_eq!(bench.running.len(), 0);
    bench.take(Step::Disk(true));
    bench.take(Step::Ask(Question::Clear));
    assert_eq!(bench.writing, Some(false));
    // A stop while the earlier one is being cleared.
    bench.take(Step::Ask(Question::Stop { reason: "another".to_owned() }));
    bench.take(Step::Disk(true));
    assert_eq!(bench.writing, Some(true), "written again");
    bench.take(Step::Disk(true));
    bench.take(Step::Brake(Application(2), true));
    assert!(bench.open.is_empty() && bench.on_disk);
    assert_eq!(bench.shown, SafetyState::Stopped { reason: "a hand".to_owned() });
}
