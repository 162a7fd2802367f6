//! The state machine of emergency stop and hold. Pure: calls and results of the brakes and of the disk in, commands out.
//!
//! ```text
//!             stop, hold                                          clear, go on
//!  ready ───────────────────▶ held, stopped: brakes applied ◀───▶ latch removed ─▶ brakes released ─▶ ready
//!                              │  ▲                                      │               │
//!                              └──┘ asked again, not confirmed           └─ stop, hold ──┴─▶ brakes applied again
//! ```
//! - A hold that is asked for during a stop is kept: it is in force, instead of ready, when the stop is cleared.
//! - A stop or a hold is in force at once. The brakes, and the disk, follow; the call is confirmed when both have succeeded.
//! - A repeated call for a stop or a hold repeats whatever is not confirmed.
//! - A stop or a hold interrupts whatever the brakes are doing for another state. Clearing and going on never do: they are refused until
//!   the brakes have answered.
//! - A superseded application of the brakes may have had an effect until it was over. So the newer state is applied once more after that,
//!   and only then confirmed.
//! - No operation depends on its caller: what has begun goes on when the caller is gone.

use super::{SafetyError, SafetyState};
use std::collections::BTreeSet;
use tokio::time::{Duration, Instant};

/// If the brakes have not answered for this long, a repeated call for a stop or a hold applies them anew.
pub(super) const BRAKES_PATIENCE: Duration = Duration::from_secs(3);

/// A caller who waits for an answer.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct Call(pub(super) u64);

/// One application of the brakes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct Application(pub(super) u64);

/// The operation that a caller asks for.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum Question {
    Stop {
        reason: String,
    },
    Clear,
    Hold {
        reason: String,
    },
    GoOn,
    /// Bring the driver to rest: end motions that an earlier process may have begun.
    Rest,
}

#[derive(Debug)]
pub(super) enum Event {
    Asked {
        call: Call,
        question: Question,
    },
    /// The caller no longer waits.
    Left {
        call: Call,
    },
    /// An application of the brakes is over; a dropped one also gets this event.
    Braked {
        application: Application,
        result: Result<(), String>,
    },
    /// The stop has been written to the disk, or the write failed.
    Latched(Result<(), String>),
    /// The stop has been removed from the disk, or the removal failed and the stop may still be there.
    Unlatched(Result<(), String>),
}

#[derive(Debug, PartialEq, Eq)]
pub(super) enum Command {
    /// Publish this state as the one in force.
    Show(SafetyState),
    Apply {
        application: Application,
        state: SafetyState,
    },
    /// Drop the application: its result does not matter any more, but its end does.
    Drop {
        application: Application,
    },
    WriteLatch {
        reason: String,
    },
    RemoveLatch,
    Answer {
        call: Call,
        answer: Result<SafetyState, SafetyError>,
    },
}

/// See the module.
#[derive(Debug, Clone)]
pub(super) struct Machine {
    /// The state in force.
    state: SafetyState,
    /// The reason of a hold that was asked for during the stop in force.
    hold_follows: Option<String>,
    brakes: BrakesPhase,
    /// `None` if stops are not kept on disk.
    latch: Option<LatchPhase>,
    /// Applications that are not over.
    running: BTreeSet<Application>,
    last: u64,
    calls: Vec<(Call, Question)>,
}

#[derive(Debug, Clone)]
enum BrakesPhase {
    /// The brakes have confirmed the state in force.
    Confirmed,
    /// The brakes have not confirmed the state in force, and no application is under way for it.
    Failed { reason: String },
    /// The state in force is being applied. `alone`: no other application was running when this one began.
    Applying { application: Application, since: Instant, alone: bool },
    /// The state in force was applied while an earlier application was not over.
    Overlapped,
    /// The stop is being removed from the disk; the brakes are not told to release before that.
    Unlatching,
    /// The brakes are being released. `rested`: after [`BrakesPhase::Resting`].
    LettingGo { application: Application, rested: bool },
    /// While no stop or hold is in force, the brakes end motions that an earlier process may have begun. Then they are released.
    Resting { application: Application },
}

#[derive(Debug, Clone)]
enum LatchPhase {
    OnDisk,
    NotOnDisk,
    Writing,
    Removing,
    Failed { reason: String },
}

impl Machine {
    /// A machine in the state ready; `is_kept`: stops are kept on disk.
    pub(super) fn new(is_kept: bool) -> Machine {
        Machine {
            state: SafetyState::Ready,
            hold_follows: None,
            brakes: BrakesPhase::Confirmed,
            latch: is_kept.then_some(LatchPhase::NotOnDisk),
            running: BTreeSet::new(),
            last: 0,
            calls: Vec::new(),
        }
    }

    /// A machine with a stop that the disk holds; the brakes have not been told yet.
    pub(super) fn stopped_before(reason: String) -> Machine {
        let reason_of_brakes = "they have not been asked yet".to_owned();
        Machine {
            state: SafetyState::Stopped { reason },
            brakes: BrakesPhase::Failed { reason: reason_of_brakes },
            latch: Some(LatchPhase::OnDisk),
            ..Machine::new(true)
        }
    }

    /// The state in force.
    #[cfg(test)]
    pub(super) fn state(&self) -> &SafetyState {
        &self.state
    }

    pub(super) fn handle(&mut self, now: Instant, event: Event) -> Vec<Command> {
        let mut commands = Vec::new();
        match event {
            Event::Asked { call, question } => self.asked(now, call, question, &mut commands),
            Event::Left { call } => self.calls.retain(|(waiting, _)| *waiting != call),
            Event::Braked { application, result } => self.braked(now, application, result, &mut commands),
            Event::Latched(result) => {
                self.latch = Some(match result {
                    Ok(()) => LatchPhase::OnDisk,
                    Err(reason) => LatchPhase::Failed { reason },
                });
            }
            Event::Unlatched(result) => self.unlatched(now, result, &mut commands),
        }
        self.answer_those_in_force(&mut commands);
        commands
    }

    fn asked(&mut self, now: Instant, call: Call, question: Question, commands: &mut Vec<Command>) {
        let wanted = match &question {
            Question::Clear | Question::GoOn => return self.asked_to_release(now, call, question, commands),
            Question::Stop { reason } => Some(SafetyState::Stopped { reason: reason.clone() }),
            Question::Hold { reason } => Some(SafetyState::Held { reason: reason.clone() }),
            Question::Rest => None,
        };
        if let (Question::Hold { reason }, SafetyState::Stopped { .. }) = (&question, &self.state) {
            self.hold_follows.get_or_insert_with(|| reason.clone());
        }
        self.calls.push((call, question));
        match wanted.filter(|wanted| severity(wanted) > severity(&self.state)) {
            Some(state) => {
                self.state = state.clone();
                commands.push(Command::Show(state));
                self.apply(now, commands);
            }
            None if self.state == SafetyState::Ready => self.rest(commands),
            None => self.insist(now, commands),
        }
        self.write_latch(commands);
    }

    /// Repeats whatever is neither confirmed nor under way.
    fn insist(&mut self, now: Instant, commands: &mut Vec<Command>) {
        match self.brakes {
            BrakesPhase::Confirmed => {}
            BrakesPhase::Applying { since, .. } if now.duration_since(since) < BRAKES_PATIENCE => {}
            _ => self.apply(now, commands),
        }
    }

    /// Applies the state in force, whatever the brakes are doing.
    fn apply(&mut self, now: Instant, commands: &mut Vec<Command>) {
        self.apply_state(now, commands);
        // Callers that wait for a release are refused.
        let refused = match &self.state {
            SafetyState::Stopped { reason } => SafetyError::Stopped { reason: reason.clone() },
            state => SafetyError::NotConfirmed { state: state.clone() },
        };
        self.answer(&Err(refused), commands, |question| matches!(question, Question::Clear | Question::GoOn));
    }

    fn apply_state(&mut self, now: Instant, commands: &mut Vec<Command>) {
        let alone = self.running.is_empty();
        commands.extend(self.running.iter().map(|&application| Command::Drop { application }));
        let application = self.begin(self.state.clone(), commands);
        self.brakes = BrakesPhase::Applying { application, since: now, alone };
    }

    fn begin(&mut self, state: SafetyState, commands: &mut Vec<Command>) -> Application {
        self.last += 1;
        let application = Application(self.last);
        self.running.insert(application);
        commands.push(Command::Apply { application, state });
        application
    }

    fn rest(&mut self, commands: &mut Vec<Command>) {
        if let BrakesPhase::Confirmed | BrakesPhase::Failed { .. } = self.brakes {
            let starting = SafetyState::Held { reason: "the driver has started".to_owned() };
            self.brakes = BrakesPhase::Resting { application: self.begin(starting, commands) };
        }
    }

    fn asked_to_release(&mut self, now: Instant, call: Call, question: Question, commands: &mut Vec<Command>) {
        let refusal = match (&question, &self.state) {
            // There is nothing to release, unless the brakes failed to release after the start.
            (_, SafetyState::Ready) if !matches!(self.brakes, BrakesPhase::Failed { .. }) => {
                Some(Ok(SafetyState::Ready))
            }
            (Question::Clear, SafetyState::Held { .. }) => Some(Ok(self.state.clone())),
            (Question::GoOn, SafetyState::Stopped { reason }) => {
                Some(Err(SafetyError::Stopped { reason: reason.clone() }))
            }
            _ => None,
        };
        if let Some(answer) = refusal {
            commands.push(Command::Answer { call, answer });
            return;
        }
        let is_disk_busy = matches!(self.latch, Some(LatchPhase::Writing | LatchPhase::Removing));
        match self.brakes {
            // Another caller has begun the release.
            BrakesPhase::Unlatching | BrakesPhase::LettingGo { .. } => {}
            BrakesPhase::Confirmed | BrakesPhase::Failed { .. } if self.running.is_empty() && !is_disk_busy => {
                self.release(now, commands);
            }
            _ => {
                let answer = Err(SafetyError::NotConfirmed { state: self.state.clone() });
                commands.push(Command::Answer { call, answer });
                return;
            }
        }
        self.calls.push((call, question));
    }

    /// Removes the stop from the disk first; only then may anything move.
    fn release(&mut self, now: Instant, commands: &mut Vec<Command>) {
        match &mut self.latch {
            Some(latch) if matches!(self.state, SafetyState::Stopped { .. }) => {
                *latch = LatchPhase::Removing;
                self.brakes = BrakesPhase::Unlatching;
                commands.push(Command::RemoveLatch);
            }
            _ => self.cleared(now, commands),
        }
    }

    /// Nothing keeps the state in force any more: the brakes are released, or a hold that was asked for during the stop follows.
    fn cleared(&mut self, now: Instant, commands: &mut Vec<Command>) {
        match self.hold_follows.take() {
            Some(reason) => {
                self.state = SafetyState::Held { reason };
                commands.push(Command::Show(self.state.clone()));
                self.apply_state(now, commands);
            }
            None => self.let_go(false, commands),
        }
    }

    fn let_go(&mut self, rested: bool, commands: &mut Vec<Command>) {
        self.brakes = BrakesPhase::LettingGo { application: self.begin(SafetyState::Ready, commands), rested };
    }

    fn braked(&mut self, now: Instant, over: Application, result: Result<(), String>, commands: &mut Vec<Command>) {
        self.running.remove(&over);
        let is_last = self.running.is_empty();
        match self.brakes {
            BrakesPhase::Applying { application, alone, .. } if application == over => match result {
                Ok(()) if alone => self.brakes = BrakesPhase::Confirmed,
                Ok(()) if is_last => self.apply(now, commands),
                Ok(()) => self.brakes = BrakesPhase::Overlapped,
                Err(reason) => self.brakes = BrakesPhase::Failed { reason },
            },
            BrakesPhase::Overlapped if is_last => self.apply(now, commands),
            BrakesPhase::Resting { application } if application == over => match result {
                Ok(()) => self.let_go(true, commands),
                Err(reason) => self.rest_failed(reason, commands),
            },
            BrakesPhase::LettingGo { application, rested } if application == over => match result {
                Ok(()) => self.released(rested, commands),
                Err(reason) if self.state == SafetyState::Ready => self.rest_failed(reason, commands),
                Err(reason) => {
                    self.answer(&Err(SafetyError::Brakes(reason)), commands, is_release);
                    // The brakes may have been released partly.
                    self.apply(now, commands);
                    self.write_latch(commands);
                }
            },
            _ => {}
        }
    }

    fn released(&mut self, rested: bool, commands: &mut Vec<Command>) {
        self.brakes = BrakesPhase::Confirmed;
        if self.state != SafetyState::Ready {
            self.state = SafetyState::Ready;
            commands.push(Command::Show(SafetyState::Ready));
        }
        self.answer(&Ok(SafetyState::Ready), commands, |question| rested || *question != Question::Rest);
        if !self.calls.is_empty() {
            self.rest(commands);
        }
    }

    fn rest_failed(&mut self, reason: String, commands: &mut Vec<Command>) {
        self.answer(&Err(SafetyError::Brakes(reason.clone())), commands, |_| true);
        self.brakes = BrakesPhase::Failed { reason };
    }

    fn unlatched(&mut self, now: Instant, result: Result<(), String>, commands: &mut Vec<Command>) {
        // A removal without sync: the file may be there again after a crash, or not.
        self.latch = Some(LatchPhase::NotOnDisk);
        match (&self.brakes, result) {
            (BrakesPhase::Unlatching, Ok(())) => self.cleared(now, commands),
            (BrakesPhase::Unlatching, Err(reason)) => {
                self.answer(&Err(SafetyError::Latch(reason)), commands, is_release);
                self.apply(now, commands);
                self.write_latch(commands);
            }
            // A stop came meanwhile.
            _ => self.write_latch(commands),
        }
    }

    /// Writes a stop that is in force to the disk, unless it is there already or being written.
    fn write_latch(&mut self, commands: &mut Vec<Command>) {
        let is_being_released = matches!(self.brakes, BrakesPhase::Unlatching | BrakesPhase::LettingGo { .. });
        if let (SafetyState::Stopped { reason }, Some(latch), false) = (&self.state, &mut self.latch, is_being_released)
            && matches!(latch, LatchPhase::NotOnDisk | LatchPhase::Failed { .. })
        {
            *latch = LatchPhase::Writing;
            commands.push(Command::WriteLatch { reason: reason.clone() });
        }
    }

    /// Answers the callers that wait for the state in force, as far as the result is known.
    fn answer_those_in_force(&mut self, commands: &mut Vec<Command>) {
        if self.state == SafetyState::Ready {
            return;
        }
        let brakes = match &self.brakes {
            BrakesPhase::Confirmed => Ok(self.state.clone()),
            BrakesPhase::Failed { reason } => {
                let failed = Err(SafetyError::Brakes(reason.clone()));
                return self.answer(&failed, commands, |_| true);
            }
            _ => return,
        };
        let is_held = matches!(self.state, SafetyState::Held { .. });
        self.answer(&brakes, commands, |question| match question {
            Question::Rest => true,
            // The stop is cleared, and a hold has followed.
            Question::Clear => is_held,
            _ => false,
        });
        let latch = match &self.latch {
            Some(latch) if matches!(self.state, SafetyState::Stopped { .. }) => match latch {
                LatchPhase::OnDisk => Ok(()),
                LatchPhase::Failed { reason } => Err(SafetyError::Latch(reason.clone())),
                LatchPhase::NotOnDisk | LatchPhase::Writing | LatchPhase::Removing => return,
            },
            _ => Ok(()),
        };
        let answer = brakes.and_then(|state| latch.map(|()| state));
        self.answer(&answer, commands, |question| !is_release(question));
    }

    fn answer(
        &mut self,
        answer: &Result<SafetyState, SafetyError>,
        commands: &mut Vec<Command>,
        of: impl Fn(&Question) -> bool,
    ) {
        let answered = self.calls.extract_if(.., |(_, question)| of(question));
        commands.extend(answered.map(|(call, _)| Command::Answer { call, answer: answer.clone() }));
    }
}

fn severity(state: &SafetyState) -> u8 {
    match state {
        SafetyState::Ready => 0,
        SafetyState::Held { .. } => 1,
        SafetyState::Stopped { .. } => 2,
    }
}

fn is_release(question: &Question) -> bool {
    matches!(question, Question::Clear | Question::GoOn)
}

#[cfg(test)]
mod tests;
