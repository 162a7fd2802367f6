//! Resumes a run from its event log: the executive is restored, open items are continued, and the loop goes on as usual.

use super::{Ended, LOOK, Place, Shell, advisor_of, syncer_of, unix_ms};
use crate::alarm::Alarm;
use crate::checkpoint::{Checkpointer, ReplayedState};
use crate::control::Control;
use crate::history::{History, HistoryError};
use crate::interrupt::Interrupt;
use crate::ledger::Ledger;
use crate::performer::{self, Performer};
use crate::replay::{self, ReplayError, Replayed};
use crate::shell::MAX_PENDING_EVENTS;
use crate::spans::{Before, Spans, trace_of};
use anyhow::Context;
use ratn_event_log::{Log, LogWriter};
use ratn_executive::lookahead::Lookout;
use ratn_executive::protocol::Event;
use ratn_model::program::Program;
use ratn_worker::robot_clock::RobotClock;
use ratn_worker::session::Standing;
use std::sync::Arc;
use std::time::Instant;
use tokio::sync::mpsc;

/// A run to resume, as described by its log.
pub struct Resumption {
    program: Arc<Program>,
    history: History,
    replayed: Replayed,
    log: LogWriter,
    checkpoint_every: u64,
}

impl Resumption {
    /// Replays the log. Changes nothing of the run.
    ///
    /// # Errors
    /// The log does not match this program or this version.
    pub fn new(
        program: Program,
        history: History,
        log: LogWriter,
        checkpoint_every: u64,
    ) -> Result<Resumption, HistoryError> {
        let program = Arc::new(program);
        let replayed = history.replay(&program)?;
        Ok(Resumption::of(program, history, replayed, log, checkpoint_every))
    }

    /// The last share of the run, if the log has one.
    pub fn share(&self) -> Option<f64> {
        self.replayed.standing.ledger.origin.share
    }

    /// The same from the whole log, if the checkpoint is not sufficient.
    fn whole(self) -> Result<Resumption, HistoryError> {
        let Resumption { program, history, log, checkpoint_every, .. } = self;
        let replayed = history.replay_whole(&program)?;
        Ok(Resumption::of(program, history, replayed, log, checkpoint_every))
    }

    fn of(
        program: Arc<Program>,
        history: History,
        (replayed, read): (Replayed, Log),
        mut log: LogWriter,
        checkpoint_every: u64,
    ) -> Resumption {
        if let Some(line) = read.torn {
            history
                .messages()
                .say(format_args!("{}:{line}: the last line is torn and is cut off", log.path().display()));
        }
        log.go_on_behind(&read);
        Resumption { program, history, replayed, log, checkpoint_every }
    }
}

/// Resumes a run whose task control was killed, on the same system. For a run that has ended, performs the decisions that may not have been performed
/// when it was killed.
///
/// # Errors
/// As when a run begins; also if the run cannot be resumed: its log belongs to another program, its world does not exist any more, or it is under
/// way. [`ReplayError::Ended`] if it has ended and nothing is left to do.
pub async fn resume(mut resumption: Resumption, place: &Place, interrupt: &Interrupt) -> anyhow::Result<Ended> {
    let ledger = &resumption.replayed.standing.ledger;
    if resumption.replayed.ended.is_none() {
        performer::check_world(place, ledger).await?;
    }
    if !performer::remembers(place, ledger).await? {
        resumption.history.say(&"the world pool has lost commits that are older");
        resumption = resumption.whole()?;
    }
    if let Some(ended) = resumption.replayed.ended.take() {
        return Box::pin(finish(resumption, ended, place)).await;
    }
    let Resumption { program, history, replayed, log, checkpoint_every } = resumption;
    let Replayed { executive, standing, missing, events: replayed, .. } = replayed;
    let ReplayedState { mut ledger, states, progress } = standing;
    let (mode, seed) = history.mode_and_seed();
    // The checkpointer's ledger has the missing commands before they are logged: no checkpoint is made until they are.
    let mut kept = ledger.clone();
    let others = missing.iter().filter(|command| !replay::is_recorded(command));
    others.for_each(|command| kept.command(command));
    let checkpointer = Checkpointer::start(&log, &program.digest, checkpoint_every, kept, replayed);
    let (events, answers) = mpsc::channel(MAX_PENDING_EVENTS);
    // A refused resumption does not replace the control socket of a run that is under way.
    let origin = &ledger.origin;
    // The trace is the same as before.
    let trace = trace_of(&origin.run, &program.name, seed, origin.began_unix_ms);
    let before = Some(ledger.session);
    let performer = Performer::connect(place, &origin.run, &program, before, trace, events).await;
    let performer = performer.context("cannot go on with the run")?;
    let shell = Shell {
        executive,
        states,
        mode,
        timers: std::mem::take(&mut ledger.wakes),
        progress,
        messages: place.messages.clone(),
        lines: String::new(),
        at_once: 0,
        program,
        syncer: syncer_of(&log)?,
        log,
        checkpointer,
        clock: RobotClock::going_on(replay::now(&ledger, unix_ms(), place.speed), place.speed),
        control: Control::listen_if_possible(&place.directory, &ledger.origin.run, &place.messages),
        advisor: advisor_of(mode, seed),
        lookout: Lookout::default(),
        ask_at: None,
        look_at: Instant::now() + LOOK,
        wake_at: None,
        alarm: Alarm::at(Instant::now() + LOOK),
        confirm: Vec::new(),
        performer,
        answers,
        spans: None,
    };
    let begin = async |shell: &mut Shell| {
        shell.log.append_commands(ledger.last, &missing)?;
        let before = Before { log: shell.log.path().to_owned(), bytes: shell.log.written(), last: ledger.last };
        shell.spans = Spans::of_a_run_that_goes_on(before, shell.clock.now(), place.speed, &place.messages);
        // Timed decisions are made on the present world: it changed while task control was away.
        let (mut mirror, mut commands) = (shell.executive.root().clone(), Vec::new());
        if let Some((revision, facts)) = shell.performer.changed_meanwhile(&ledger, &mirror).await? {
            mirror.overwrite(facts.iter().cloned());
            let changed = Event::WorldChanged { revision, facts };
            commands = shell.decide_at(ledger.last, &changed)?;
            ledger.event(ledger.last, &changed);
        }
        // Later request ids contain the number of this resumption: it is logged before they are used.
        let resumed = Event::Resumed { share: another_share(&ledger, place.standing) };
        let (mut now, more) = shell.decide(&resumed)?;
        commands.extend(more);
        ledger.event(now, &resumed);
        shell.hand_over()?;
        let lost = shell.performer.session_lost(&ledger).await?;
        if let Some(lost) = &lost {
            // Time has passed: what was due in the meantime causes commands, too.
            let (later, more) = shell.decide(lost)?;
            ledger.event(later, lost);
            now = later;
            commands.extend(more);
        }
        shell.hand_over()?;
        shell.log.make_durable()?;
        shell.performer.know(shell.progress.paths());
        let program = Arc::clone(&shell.program);
        let (made, taken) = shell.performer.take_up(&program, ledger, &mirror, now).await?;
        if !made.is_empty() {
            for event in &made {
                let (later, more) = shell.decide(event)?;
                now = later;
                commands.extend(more);
            }
            shell.hand_over()?;
            shell.log.make_durable()?;
        }
        let told = shell.performer.go_on(&program, taken).await?;
        // Recorded commands were taken from the ledger.
        let missing = missing.into_iter().filter(|command| !replay::is_recorded(command));
        let mut ended = shell.perform(now, missing.chain(commands), None)?;
        for event in told {
            if ended.is_none() {
                ended = shell.step(event)?;
            }
        }
        Ok(ended)
    };
    Box::pin(shell.run_to_its_end(begin, interrupt)).await
}

/// The share of a resumed run, if it differs from the previous one.
fn another_share(ledger: &Ledger, standing: Standing) -> Option<f64> {
    let before = ledger.origin.share.unwrap_or(Standing::default().share);
    (standing.share != before).then_some(standing.share)
}

/// Performs the remaining decisions of a run that was killed after its end.
async fn finish(resumption: Resumption, ended: Ended, place: &Place) -> anyhow::Result<Ended> {
    let Resumption { program, history, replayed, mut log, .. } = resumption;
    let mut ledger = replayed.standing.ledger;
    let nothing = || ReplayError::Ended { outcome: ended.outcome.clone() };
    let path = log.path().to_owned();
    let say = |what: String| history.messages().say(format_args!("{}: {what}", path.display()));
    let Some(missing) = performer::missing_commits(place, &ledger).await? else {
        say("whether all that the run did is in the world is not known: the world pool does not go back so far"
            .to_owned());
        return Err(nothing().into());
    };
    if missing == 0 && ledger.open_operations().next().is_none() {
        return Err(nothing().into());
    }
    let (origin, seed) = (&ledger.origin, history.mode_and_seed().1);
    let trace = trace_of(&origin.run, &program.name, seed, origin.began_unix_ms);
    // There is no receiver of events any more.
    let events = mpsc::channel(1).0;
    let performer = Performer::connect(place, &origin.run, &program, Some(ledger.session), trace, events).await;
    let mut performer = performer.context("cannot do what the run had decided")?;
    let at = ledger.last;
    if let Some(lost) = performer.session_lost(&ledger).await? {
        log.append(at, &lost, &[])?;
        log.make_durable()?;
        ledger.event(at, &lost);
    }
    let now = replay::now(&ledger, unix_ms(), place.speed);
    let makes_durable = |told: &[Event]| {
        told.iter().try_for_each(|event| log.append(at, event, &[]))?;
        Ok(log.make_durable()?)
    };
    let finished = performer.finish(&program, ledger, now, makes_durable).await;
    let (done, closed) = performer.close().await;
    done.iter().try_for_each(|event| log.append(at, event, &[]))?;
    let (commits, operations) = finished?;
    closed?;
    if (commits, operations) == (0, 0) {
        return Err(nothing().into());
    }
    say(format!(
        "the run had ended with {}, and was killed before all that it had decided was recorded; made now: commits {commits}, operations \
         {operations}",
        ended.outcome
    ));
    Ok(ended)
}
