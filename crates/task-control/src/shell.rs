//! The loop of task control: receive an event, log it, give it to the executive, log its commands, perform them.
//!
//! The shell decides nothing. Every result of a command returns as an event through one bounded queue, so the event log is a complete record of the
//! run, and a run whose task control was killed is resumed from it ([`resume`]).
//!
//! Commands leave the process when other tasks have their turn, so the events that have arrived by then are handled first, and one write to the log
//! covers them all: a node that starts when another has ended causes three events, two of which arrive immediately.

mod resume;

pub use resume::{Resumption, resume};

use super::Endpoints;
use super::advisor::{self, Advisor};
use super::alarm::Alarm;
use super::checkpoint::Checkpointer;
use super::control::{ANY_RUN, Asked, Control, Message, RunStatus};
use super::ledger::Ledger;
use super::messages::Messages;
use super::performer::{self, Performer};
use super::progress::Progress;
use super::replay::{self, VERSION};
use super::safe_on_disk::{Mark, Syncer};
use super::spans::{Spans, trace_of};
use crate::interrupt::Interrupt;
use anyhow::{Context, bail};
use ratn_event_log::{LogWriter, without_visits};
use ratn_executive::MOST_SIGNALS_KEPT;
use ratn_executive::executive::Executive;
use ratn_executive::lookahead::Lookout;
use ratn_executive::protocol::{Awaited, Command, Event, Learned, Mode, Natures, Origin};
use ratn_model::catalogue::{Catalogue, ResourceOffer};
use ratn_model::expression::scope::NothingKnown;
use ratn_model::id::{InstanceId, StateId};
use ratn_model::load::suggestion;
use ratn_model::program::{Exceptions, Nature, Program, SUCCESS, State, StateKind};
use ratn_model::resource::ResourceClass;
use ratn_model::time::Timestamp;
use ratn_model::tolerance::Tolerance;
use ratn_model::value::Value;
use ratn_model::wait::Wait;
use ratn_worker::client::fresh_id;
use ratn_worker::robot_clock::RobotClock;
use ratn_worker::session::Standing;
use ratn_worker::tls::ClientTls;
use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;
use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};
use tokio::runtime::{Handle, RuntimeFlavor};
use tokio::sync::{mpsc, oneshot};

/// Maximum number of answers that the executive has not received yet.
pub(super) const MAX_PENDING_EVENTS: usize = 1024;

/// Maximum number of events that are handled before the resulting commands leave the process.
const MOST_AT_ONCE: u32 = 16;

/// The maximum for this runtime: if tasks run on several threads, commands leave immediately.
fn most_at_once() -> u32 {
    let is_one_thread = Handle::current().runtime_flavor() == RuntimeFlavor::CurrentThread;
    if is_one_thread { MOST_AT_ONCE } else { 0 }
}

/// Minimum interval between reports of what a run waits for.
const LOOK: Duration = Duration::from_secs(5);
/// Maximum number of breakpoints.
const MOST_BREAKPOINTS: usize = 256;

/// A task to run once.
#[derive(Debug, Clone)]
pub struct Run {
    /// The task, loaded and checked.
    pub program: Arc<Program>,
    /// The absolute path of the task file; empty if there is none.
    pub file: String,
    /// The state at which the run begins, if the program was loaded with one.
    pub from: Option<String>,
    /// The bound parameters of the task.
    pub parameters: BTreeMap<String, Value>,
    /// The execution mode.
    pub mode: Mode,
    /// The seed of the run's random choices.
    pub seed: u64,
    /// Statistics from earlier runs.
    pub learned: Learned,
    /// The path of the event log.
    pub log: PathBuf,
    /// The breakpoints, as paths of states.
    pub breakpoints: Vec<String>,
    /// Whether to omit the lines about nodes that start and end from [`Place::messages`].
    pub quiet: bool,
    /// Number of events between checkpoints; 0 for no checkpoints.
    pub checkpoint_every: u64,
}

/// The system on which a run executes.
#[derive(Debug, Clone)]
pub struct Place {
    /// The endpoints of its daemons.
    pub endpoints: Endpoints,
    /// The certificates that the run trusts and presents there.
    pub tls: ClientTls,
    /// The runtime directory, with the endpoint files.
    pub directory: PathBuf,
    /// The catalogue of the system.
    pub catalogue: Arc<Catalogue>,
    /// The robot: the name of a built-in one, or the absolute path of its description.
    pub robot: String,
    /// Seconds of the robot's time per second of wall time.
    pub speed: f64,
    /// Receives messages about the run for people.
    pub messages: Messages,
    /// Whether the run must be the only one on the system.
    pub alone: bool,
    /// The priority of the run among runs that compete for resources.
    pub urgency: Urgency,
    /// The run's share (weight) of these resources, and when the run is due.
    pub standing: Standing,
}

/// The urgency of a run beside others. Certain needs come before speculative ones, however urgent these are.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Default)]
pub enum Urgency {
    /// It gets what others leave.
    Low,
    /// The usual urgency.
    #[default]
    Normal,
    /// Others wait for it.
    High,
}

/// How a run ended.
#[derive(Debug, Clone, PartialEq)]
pub struct Ended {
    /// The outcome of the task.
    pub outcome: String,
    /// The outputs of the task.
    pub outputs: BTreeMap<String, Value>,
    /// The reason for the outcome; empty for a success.
    pub reason: String,
    /// Time from the first event to the last, in seconds of the robot's time.
    pub makespan_s: f64,
}

/// Runs a task on a running system.
///
/// # Errors
/// The system cannot be reached, the log cannot be written, or the user insists on ending. A task that fails is no error: its outcome says so.
pub async fn run(run: Run, place: &Place, interrupt: &Interrupt) -> anyhow::Result<Ended> {
    let (events, answers) = mpsc::channel(MAX_PENDING_EVENTS);
    let id = fresh_id("run");
    let began_unix_ms = unix_ms();
    let trace = trace_of(&id, &run.program.name, run.seed, began_unix_ms);
    let performer = Performer::connect(place, &id, &run.program, None, trace, events).await;
    let performer = performer.context("cannot begin the run")?;
    // A run that is refused leaves no log.
    let log = LogWriter::create(&run.log)?;
    let checkpointer = Checkpointer::start(&log, &run.program.digest, run.checkpoint_every, Ledger::default(), 0);
    let shell = Shell {
        executive: Executive::new(run.program.clone(), Tolerance::ROBOT),
        states: BTreeMap::new(),
        mode: run.mode,
        timers: BTreeSet::new(),
        progress: Progress::new(run.quiet),
        messages: place.messages.clone(),
        lines: String::new(),
        at_once: 0,
        program: run.program.clone(),
        syncer: syncer_of(&log)?,
        log,
        checkpointer,
        clock: RobotClock::start(place.speed),
        control: Control::listen_if_possible(&place.directory, &id, &place.messages),
        advisor: advisor_of(run.mode, run.seed),
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
        let (revision, world) = shell.performer.root().await.context("cannot read the root world")?;
        shell.clock = RobotClock::start(place.speed);
        shell.spans = Spans::of_a_run_that_begins(place.speed);
        let begun = Event::Started {
            task: run.program.name.clone(),
            digest: run.program.digest.clone(),
            mode: run.mode,
            parameters: run.parameters,
            seed: run.seed,
            world,
            revision,
            capacity: place.catalogue.resources.iter().map(|(kind, offer)| (kind.clone(), offer.count)).collect(),
            learned: run.learned,
            breakpoints: run.breakpoints.into_boxed_slice(),
            origin: Box::new(Origin {
                run: id,
                session: shell.performer.session(),
                version: VERSION.to_owned(),
                file: run.file,
                from: run.from,
                robot: place.robot.clone(),
                began_unix_ms,
                share: share_told(place.standing),
                imprecise: imprecise(&run.program),
                natures: natures(&run.program, &place.catalogue),
            }),
        };
        shell.step(begun)
    };
    Box::pin(shell.run_to_its_end(begin, interrupt)).await
}

/// Checks breakpoints of a program, given by the paths of states with or without visits.
///
/// # Errors
/// There is no such state, a run would never stop at it, or there are too many breakpoints.
pub fn breakpoints(program: &Program, states: &[String]) -> Result<Vec<String>, String> {
    if states.len() > MOST_BREAKPOINTS {
        return Err(format!("a run has at most {MOST_BREAKPOINTS} breakpoints: take one away first"));
    }
    let breakpoint = |state: &String| {
        let path = without_visits(state);
        let known = || program.states.iter().map(|state| state.path.as_str()).filter(|path| !path.is_empty());
        if !known().any(|known| known == path) {
            let help = suggestion(&path, known(), "", "`ratn check TASK --annotations` lists the states");
            return Err(format!("{} has no state `{path}`: {help}", program.name));
        }
        if !Executive::stops_for(program, &path) {
            return Err(format!("`{path}` changes nothing, and may run ahead of its turn: break at a state that acts"));
        }
        Ok(path)
    };
    states.iter().map(breakpoint).collect()
}

/// An unusual share is logged, so that a resumed run keeps it.
fn share_told(standing: Standing) -> Option<f64> {
    (standing.share != Standing::default().share).then_some(standing.share)
}

fn syncer_of(log: &LogWriter) -> anyhow::Result<Syncer> {
    Syncer::start(log.handle()?).context("cannot make the event log safe")
}

/// If the disk takes longer at the end of a run, the user is told.
const SLOW_DISK: Duration = Duration::from_secs(2);

/// A run under way.
struct Shell {
    program: Arc<Program>,
    executive: Executive,
    /// The state of each instance.
    states: BTreeMap<InstanceId, StateId>,
    mode: Mode,
    /// The times at which the executive wants to be woken.
    timers: BTreeSet<Timestamp>,
    log: LogWriter,
    syncer: Syncer,
    /// `None` if checkpoints are disabled or impossible.
    checkpointer: Option<Checkpointer>,
    progress: Progress,
    messages: Messages,
    /// Lines that are shown when the log has been written.
    lines: String,
    /// Number of events handled since the log was last written.
    at_once: u32,
    clock: RobotClock,
    control: Option<Control>,
    /// `None` in HSM mode, which has only one order.
    advisor: Option<Advisor>,
    /// Tracks whether enough has changed since the advisor was last asked.
    lookout: Lookout,
    /// When the advisor may be asked again.
    ask_at: Option<Instant>,
    /// When waiting instances are reported again.
    look_at: Instant,
    /// The first timer, and its time on the wall clock.
    wake_at: Option<(Timestamp, Instant)>,
    /// Fires at the next of these times.
    alarm: Alarm,
    /// Clients to notify when their message is in the log, each with the answer.
    confirm: Vec<(oneshot::Sender<Result<String, String>>, String)>,
    performer: Performer,
    answers: mpsc::Receiver<performer::Answer>,
    /// The spans of the run, if its process sends them.
    spans: Option<Spans>,
}

impl Shell {
    /// Runs from `begin` until the run has ended; then everything is recorded and released in any case.
    async fn run_to_its_end(
        mut self,
        begin: impl AsyncFnOnce(&mut Shell) -> anyhow::Result<Option<Ended>>,
        interrupt: &Interrupt,
    ) -> anyhow::Result<Ended> {
        let ended = self.until_ended(begin, interrupt).await;
        // The log also needs the event that led to a failure.
        let handed_over = self.hand_over();
        let ended = ended.and_then(|ended| handed_over.map(|()| ended));
        let spans = self.spans.take();
        self.performer.begin_no_more();
        self.all_is_safe().await;
        // Grants to withdrawn requests are released, even if they are received only now.
        self.answers.close();
        while let Ok(answer) = self.answers.try_recv() {
            self.performer.accept(answer, self.executive.root());
        }
        let (done, closed) = self.performer.close().await;
        if ended.is_ok() {
            // A resumption then knows what is left to do.
            let now = self.clock.now();
            if let Err(error) = done.iter().try_for_each(|event| self.log.append(now, event, &[])) {
                tracing::warn!("the event log does not say what was recorded at the end: {error:#}");
            }
        }
        Spans::end(spans).await;
        match (ended, closed) {
            // A success that is not completely recorded is an error.
            (Ok(ended), Err(error)) if ended.outcome == SUCCESS => Err(error),
            // The error is part of the outcome already, or matters less.
            (ended, _) => ended,
        }
    }

    /// Waits until the event log is synced to disk, or never will be: decisions of the run are not given up because the disk is slow.
    async fn all_is_safe(&mut self) {
        let mark = self.syncer.mark();
        self.syncer.written();
        let mut safe = std::pin::pin!(mark.safe());
        if tokio::time::timeout(SLOW_DISK, &mut safe).await.is_err() {
            self.messages.say(format_args!("{} is being made safe on its disk", self.log.path().display()));
            safe.await;
        }
    }

    async fn until_ended(
        &mut self,
        begin: impl AsyncFnOnce(&mut Shell) -> anyhow::Result<Option<Ended>>,
        interrupt: &Interrupt,
    ) -> anyhow::Result<Ended> {
        let mut ended = begin(self).await?;
        let mut asked = EndRequests::default();
        loop {
            if let Some(ended) = ended {
                self.hand_over()?;
                self.checkpointer.take().into_iter().for_each(Checkpointer::end);
                return Ok(ended);
            }
            let event = self.next(interrupt, &mut asked).await?;
            ended = self.step(event)?;
        }
    }

    /// Gives an event to the executive, and its commands to the performer.
    fn step(&mut self, event: Event) -> anyhow::Result<Option<Ended>> {
        let (now, commands) = self.decide(&event)?;
        let safe = replay::must_be_durable(&self.program, &self.states, &commands).then(|| self.syncer.mark());
        self.performer.prepare(&event, &commands);
        self.perform(now, commands, safe)
    }

    /// Gives an event to the executive, and logs it with the commands.
    fn decide(&mut self, event: &Event) -> anyhow::Result<(Timestamp, Vec<Command>)> {
        let now = self.clock.now();
        if *event == Event::Woken {
            self.timers.retain(|at| *at > now);
        }
        Ok((now, self.decide_at(now, event)?))
    }

    /// The same at a given time, when nothing later has happened yet.
    fn decide_at(&mut self, now: Timestamp, event: &Event) -> anyhow::Result<Vec<Command>> {
        let commands = self.executive.handle(now, event.clone());
        // Before the states of those that are discarded are forgotten.
        let (program, states) = (&self.program, &self.states);
        let acts = |instance| {
            let state = states.get(&instance).map(|id| program.state(*id));
            state.is_some_and(|state| !state.is_pause() && state.annotations.nature != Nature::Computes)
        };
        let lines = self.progress.follow(now, event, &commands, acts);
        commands.iter().for_each(|command| replay::follow(&mut self.states, command));
        self.log.note(now, event, &commands)?;
        for (say, said) in std::mem::take(&mut self.confirm) {
            let safe = self.syncer.mark();
            tokio::spawn(async move {
                let unsafe_on_disk =
                    || "the event log cannot be made safe on its disk: it is not known whether this counts".to_owned();
                // The receiver may have been dropped.
                let _ = say.send(if safe.safe().await { Ok(said) } else { Err(unsafe_on_disk()) });
            });
        }
        if let Some(checkpointer) = &mut self.checkpointer {
            checkpointer.follow(now, event, &commands);
        }
        if let Some(spans) = &mut self.spans {
            spans.follow(now, event, &commands);
        }
        for line in lines {
            self.say(&line);
        }
        self.lookout.observe(now, &commands);
        if self.lookout.is_due() || self.lookout.is_surprised() {
            self.ask_at.get_or_insert_with(|| Instant::now() + advisor::PAUSE);
        }
        Ok(commands)
    }

    /// Adds a line; lines shown together are separated by line breaks.
    fn say(&mut self, line: &str) {
        if !self.lines.is_empty() {
            self.lines.push('\n');
        }
        self.lines.push_str(line);
    }

    /// Writes the noted lines to the log file, before any of their effects leaves the process, and requests a sync if something waits for it.
    fn hand_over(&mut self) -> anyhow::Result<()> {
        self.at_once = 0;
        // After a failed write, nothing that waits for a sync may be done.
        self.log.write().inspect_err(|_| self.syncer.give_up())?;
        self.syncer.written();
        if !self.lines.is_empty() {
            self.messages.say(&self.lines);
            self.lines.clear();
        }
        Ok(())
    }

    /// Performs commands: irreversible ones, and those that enable others to act, after the log is synced; all others at once.
    fn perform(
        &mut self,
        now: Timestamp,
        commands: impl IntoIterator<Item = Command>,
        safe: Option<Mark>,
    ) -> anyhow::Result<Option<Ended>> {
        for command in commands {
            match command {
                Command::Wake { at } => drop(self.timers.insert(at)),
                Command::End { .. } => return Ok(Ended::of(command, now)),
                command => {
                    let waits = replay::must_be_durable(&self.program, &self.states, std::slice::from_ref(&command));
                    let safe = match &command {
                        Command::Release { .. } => Some(self.syncer.marked()),
                        _ => safe.clone().filter(|_| waits),
                    };
                    self.performer.perform_when(safe, command)?;
                }
            }
        }
        Ok(None)
    }

    /// Asks for a better dispatch order of the remaining work, while something runs.
    fn ask_for_advice(&mut self) {
        self.ask_at = None;
        let outlook = self.executive.outlook(self.clock.now());
        if let Some(advisor) = &self.advisor
            && advisor::is_worth_asking(&outlook)
        {
            self.lookout.looks(outlook.tasks.len());
            advisor.ask(outlook);
        }
    }

    /// The usual duration of a state in seconds of the robot's time, if its file states a number.
    fn usually_s(&self, instance: InstanceId) -> Option<f64> {
        let state = self.program.state(*self.states.get(&instance)?);
        let seconds = state.annotations.duration_s.as_ref()?.evaluate(&NothingKnown).ok()?.as_number()?;
        (seconds.is_finite() && seconds > 0.0).then_some(seconds)
    }

    /// The status of the run.
    fn status(&self) -> RunStatus {
        let (now, standing) = (self.clock.now(), self.performer.standing());
        RunStatus {
            run: self.performer.run().to_owned(),
            task: self.program.name.clone(),
            mode: self.mode,
            log: std::path::absolute(self.log.path()).unwrap_or_else(|_| self.log.path().to_owned()),
            at_s: now.seconds(),
            share: standing.share,
            due_in_s: standing.due_in_ms(SystemTime::now()).map(|ms| ms as f64 / 1e3),
            paused: self.progress.is_paused(),
            ended: self.progress.retired(),
            under_way: self.progress.under_way(now, |instance| self.usually_s(instance)),
            awaits: self.progress.awaiting().map(|(_, awaiting)| awaiting).collect(),
            waits: self.executive.explain().into_iter().take(RunStatus::MOST_WAITS).collect(),
            breakpoints: self.executive.breakpoints().to_vec(),
        }
    }

    /// The event for a message, and the answer to its sender.
    ///
    /// # Errors
    /// The message is not acceptable for this run in its present state.
    fn event_of(&self, message: Message) -> Result<(Event, String), String> {
        let run = message.run();
        let (id, task) = (self.performer.run(), self.program.name.as_str());
        if ![id, task, ANY_RUN].contains(&run) {
            return Err(format!("no run `{run}` is under way here, but {id} of the task {task}"));
        }
        match message {
            Message::Signal { signal, value, .. } => self.signalled(signal, value),
            Message::Answer { state, choice, .. } => self.answered(state.as_deref(), choice),
            Message::Breakpoint { state, set, .. } => self.breakpoints(state.as_deref(), set),
        }
    }

    fn signalled(&self, signal: String, value: Value) -> Result<(Event, String), String> {
        let waits = self.program.states.iter().filter_map(|state| match state.wait() {
            Some(Wait::Signal(name)) => Some(name),
            _ => None,
        });
        let known: Vec<&str> = waits.collect();
        if !known.contains(&signal.as_str()) {
            let help = suggestion(&signal, known.into_iter(), "", "it waits for no signal at all");
            return Err(format!("no state of {} waits for a signal `{signal}`: {help}", self.program.name));
        }
        if self.executive.signals_kept(&signal) >= MOST_SIGNALS_KEPT {
            return Err(format!(
                "{MOST_SIGNALS_KEPT} signals `{signal}` are kept already for states that have yet to wait for them"
            ));
        }
        let first = self.executive.first_waiting_for(&signal);
        let waiting = self.progress.awaiting().find(|(instance, _)| Some(*instance) == first);
        let said = match waiting {
            Some((_, awaiting)) => format!("{} has waited for it and goes on", awaiting.path),
            None => format!("it is kept for the next state that waits for `{signal}`"),
        };
        Ok((Event::Signalled { signal, value }, said))
    }

    /// Sets a breakpoint, or removes one or all.
    fn breakpoints(&self, state: Option<&str>, set: bool) -> Result<(Event, String), String> {
        let mut states = self.executive.breakpoints().to_vec();
        match state.map(without_visits) {
            None if set => return Err("say before which state: `ratn control break STATE`".to_owned()),
            None => states.clear(),
            Some(path) if set => {
                if !states.contains(&path) {
                    states.push(path);
                }
                states = breakpoints(&self.program, &states)?;
            }
            Some(path) => {
                if !states.contains(&path) {
                    let there = if states.is_empty() {
                        "there is none".to_owned()
                    } else {
                        format!("there is {}", states.join(", "))
                    };
                    return Err(format!("there is no breakpoint at `{path}`: {there}"));
                }
                states.retain(|other| *other != path);
            }
        }
        let said = match states.as_slice() {
            [] => "no breakpoints are set any more".to_owned(),
            all => format!("the run pauses before {}", all.join(", ")),
        };
        Ok((Event::BreakpointsSet { states }, said))
    }

    fn answered(&self, state: Option<&str>, choice: String) -> Result<(Event, String), String> {
        let questions = self.progress.awaiting().filter_map(|(id, awaiting)| match awaiting.awaited {
            Awaited::Answer { question, choices, .. } => Some((id, awaiting.path, question, choices)),
            _ => None,
        });
        let open: Vec<_> = questions.collect();
        let listed =
            || open.iter().map(|(_, path, question, _)| format!("{path} ({question})")).collect::<Vec<_>>().join(", ");
        let is_meant = |path: &str| state.is_none_or(|state| state == path || state == without_visits(path));
        let meant: Vec<_> = open.iter().filter(|(_, path, ..)| is_meant(path)).collect();
        let (instance, path, _, choices) = match meant.as_slice() {
            [one] => one,
            _ if open.is_empty() => return Err("no state asks anything now".to_owned()),
            [] => return Err(format!("{} asks nothing now; these do: {}", state.unwrap_or_default(), listed())),
            _ => return Err(format!("several states ask: say which by `--state`: {}", listed())),
        };
        if !choices.contains(&choice) {
            return Err(format!("`{choice}` is no answer to {path}: there is {}", choices.join(", ")));
        }
        let said = format!("{path} is answered: {choice}");
        Ok((Event::Answered { instance: *instance, choice }, said))
    }

    /// Makes a checkpoint, from which the run can be resumed. Between two events, all logged commands have been performed.
    fn make_checkpoint(&mut self) {
        if let Some(checkpointer) = &mut self.checkpointer {
            let confirmed = self.performer.confirmed();
            checkpointer.make(&self.log, &self.executive, &self.states, &self.progress, confirmed);
        }
    }

    /// The next timed work, and its time.
    fn next_due(&mut self) -> (Due, Instant) {
        let timer = self.timers.first().copied();
        if self.wake_at.map(|(of, _)| of) != timer {
            self.wake_at = timer.map(|of| (of, Instant::now() + self.clock.until(of)));
        }
        let others = [
            self.wake_at.map(|(_, at)| (Due::Timer, at)),
            self.ask_at.filter(|_| self.advisor.is_some()).map(|at| (Due::Advice, at)),
            self.checkpointer
                .as_mut()
                .and_then(|checkpointer| checkpointer.due(&self.log))
                .map(|at| (Due::Checkpoint, at)),
        ];
        let look = (Due::Look, self.look_at);
        others.into_iter().flatten().chain([look]).min_by_key(|(_, at)| *at).unwrap_or(look)
    }

    /// The next event for the executive.
    async fn next(&mut self, interrupt: &Interrupt, asked: &mut EndRequests) -> anyhow::Result<Event> {
        loop {
            if self.at_once < most_at_once()
                && let Ok(answer) = self.answers.try_recv()
            {
                self.at_once += 1;
                match self.performer.accept(answer, self.executive.root()) {
                    Some(event) => return Ok(event),
                    None => continue,
                }
            }
            self.hand_over()?;
            let (due, at) = self.next_due();
            self.alarm.set(at);
            let advised = async {
                match &mut self.advisor {
                    Some(advisor) => advisor.told().await,
                    None => std::future::pending().await,
                }
            };
            let told = async {
                match &mut self.control {
                    Some(control) => control.asked().await,
                    None => std::future::pending().await,
                }
            };
            let answer = tokio::select! {
                answer = self.answers.recv() => answer.context("nothing can answer any more")?,
                () = self.alarm.rings() => match due {
                    Due::Timer => {
                        self.wake_at = None;
                        return Ok(Event::Woken);
                    }
                    Due::Advice => {
                        self.ask_for_advice();
                        continue;
                    }
                    Due::Checkpoint => {
                        self.make_checkpoint();
                        continue;
                    }
                    Due::Look => {
                        self.look_at = Instant::now() + LOOK;
                        if let Some(instance) = self.performer.waits()
                            && let Some(path) = self.progress.waits(instance)
                        {
                            self.performer.say_why(self.clock.now(), instance, path);
                        }
                        continue;
                    }
                },
                asked = told => match asked {
                    Asked::Told(event) => return Ok(*event),
                    Asked::Status(say) => {
                        // The receiver may have been dropped.
                        let _ = say.send(self.status());
                        continue;
                    }
                    // Its sender was told that the result is unknown.
                    Asked::Message(_, say) if say.is_closed() => continue,
                    Asked::Message(message, say) => match self.event_of(message) {
                        Ok((event, said)) => {
                            self.confirm.push((say, said));
                            return Ok(event);
                        }
                        Err(why) => {
                            let _ = say.send(Err(why));
                            continue;
                        }
                    },
                },
                event = advised => return Ok(event),
                reason = self.syncer.failed() => {
                    bail!("{} cannot be made safe on its disk: {reason}", self.log.path().display())
                }
                // The first request ends the run in order (clean-up included), the second at once.
                () = interrupt.asked_times(asked.by_the_user + 1), if asked.by_the_user < 2 => {
                    asked.by_the_user += 1;
                    return Ok(Event::AbortRequested { reason: "the user asked for it".into(), at_once: false });
                }
                () = self.performer.lost(), if !asked.for_lost_leases => {
                    asked.for_lost_leases = true;
                    let reason = "the session with the resource manager, and every lease, is lost".into();
                    return Ok(Event::AbortRequested { reason, at_once: true });
                }
            };
            if let Some(event) = self.performer.accept(answer, self.executive.root()) {
                return Ok(event);
            }
        }
    }
}

/// Timed work of a run.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Due {
    /// The executive is woken.
    Timer,
    /// The advisor is asked for advice.
    Advice,
    /// A checkpoint is made.
    Checkpoint,
    /// Waiting instances are reported.
    Look,
}

/// The requests to end the run so far.
#[derive(Debug, Default)]
struct EndRequests {
    /// Number of requests by the user.
    by_the_user: u32,
    for_lost_leases: bool,
}

impl Ended {
    /// The end of the run, if this command ends it.
    pub(crate) fn of(command: Command, now: Timestamp) -> Option<Ended> {
        match command {
            Command::End { outcome, outputs, reason } => {
                Some(Ended { outcome, outputs, reason, makespan_s: now.seconds() })
            }
            _ => None,
        }
    }
}

/// Starts the advisor if there are several orders to choose from. A run can do without it.
fn advisor_of(mode: Mode, seed: u64) -> Option<Advisor> {
    match mode {
        Mode::Hsm => None,
        Mode::Cdtn => Advisor::start(seed).inspect_err(|error| tracing::warn!(%error, "nobody looks ahead")).ok(),
    }
}

/// The natures of a program's states, by path, and the kinds of resources that move the robot.
fn natures(program: &Program, catalogue: &Catalogue) -> Natures {
    let is_action = |state: &&State| matches!(state.kind, StateKind::Action { .. });
    let actions = |is_meant: fn(&Nature) -> bool| {
        let meant = program.states.iter().filter(is_action).filter(|state| is_meant(&state.annotations.nature));
        meant.map(|state| state.path.clone()).collect()
    };
    // A module moves also where a catalogue leaves `actuates` out; who only senses with one is among `senses`.
    let moves = |offer: &ResourceOffer| offer.actuates || offer.class == ResourceClass::Module;
    Natures {
        computes: actions(|nature| *nature == Nature::Computes),
        senses: actions(|nature| matches!(nature, Nature::Senses(_))),
        actuating: catalogue.resources.iter().filter(|one| moves(one.1)).map(|one| one.0.clone()).collect(),
        changes_at_exit: changes_at_exit(program),
    }
}

/// The composite states that declare effects.
pub(crate) fn changes_at_exit(program: &Program) -> Vec<String> {
    let composites = program.states.iter().filter(|state| !matches!(state.kind, StateKind::Action { .. }));
    let changing = composites.filter(|state| state.annotations.effects.values().any(|effects| !effects.is_empty()));
    changing.map(|state| state.path.clone()).collect()
}

/// The PIAs with imprecise exceptions: younger PIAs may run beside them although they may still fail.
fn imprecise(program: &Program) -> Vec<String> {
    let is_pia = |state: &&State| {
        matches!(state.kind, StateKind::Action { .. }) && state.annotations.nature == Nature::Irreversible
    };
    let lets = |state: &&State| state.annotations.exceptions.unwrap_or(program.exceptions) == Exceptions::Imprecise;
    program.states.iter().filter(is_pia).filter(lets).map(|state| state.path.clone()).collect()
}

fn unix_ms() -> u64 {
    SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |since| u64::try_from(since.as_millis()).unwrap_or(u64::MAX))
}

#[cfg(test)]
mod tests;
