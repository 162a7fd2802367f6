//! Applies the lines of a log to a [`Timeline`].

use super::instance::{Activity, Cause, Ending, Instance, Job, Stage};
use super::{Changed, Commit, Span, Timeline};
use ratn_event_log::without_visits;
use ratn_executive::protocol::{Command, Event, Goal, LogEntry, LogLine, Mode, Note, Origin};
use ratn_model::id::InstanceId;
use ratn_model::program::SUCCESS;
use ratn_model::resource::LeasedResource;
use ratn_model::value::Value;
use std::collections::{BTreeMap, BTreeSet, VecDeque};

/// Kinds whose holder detects, for logs that do not say which actions sense.
const LOOKING: [&str; 2] = ["Camera", "Detector"];

/// What the log says at its start about the task's actions, by paths without visits.
#[derive(Debug, Clone, Default)]
pub(super) struct Hints {
    /// PIAs whose exceptions are imprecise.
    imprecise: BTreeSet<String>,
    computes: BTreeSet<String>,
    senses: BTreeSet<String>,
    /// Kinds that move the robot; empty if the log does not say.
    actuating: BTreeSet<String>,
}

impl Hints {
    fn of(origin: &Origin) -> Hints {
        let all = |paths: &[String]| paths.iter().cloned().collect();
        Hints {
            imprecise: all(&origin.imprecise),
            computes: all(&origin.natures.computes),
            senses: all(&origin.natures.senses),
            actuating: all(&origin.natures.actuating),
        }
    }

    /// Whether the action is a PIA according to the log: it neither only computes nor only senses.
    pub(super) fn is_pia(&self, path: &str) -> bool {
        let is_said = !(self.computes.is_empty() && self.senses.is_empty() && self.actuating.is_empty());
        let state = without_visits(path);
        is_said && !self.computes.contains(&state) && !self.senses.contains(&state)
    }

    /// The activity of a goal: as the task declares it, else by the resources in its lease.
    fn activity(&self, path: &str, goal: &Goal) -> Activity {
        let state = without_visits(path);
        let holds = |is_meant: &dyn Fn(&LeasedResource) -> bool| {
            goal.lease.iter().flat_map(|lease| &lease.resources).any(is_meant)
        };
        let moves = |one: &LeasedResource| self.actuating.iter().any(|kind| one.is_a(kind));
        if goal.projection.is_some() || self.computes.contains(&state) {
            Activity::Planning
        } else if self.senses.contains(&state) || holds(&|one| LOOKING.contains(&one.kind.as_str())) {
            Activity::Detection
        } else if self.actuating.is_empty() || holds(&moves) {
            Activity::Motion
        } else {
            Activity::Other
        }
    }
}

/// The instances that have left the window, the oldest first.
#[derive(Debug, Clone)]
pub(super) struct Left {
    order: VecDeque<InstanceId>,
    keep: usize,
}

impl Left {
    pub(super) fn keeping(keep: usize) -> Left {
        Left { order: VecDeque::new(), keep }
    }

    fn add(&mut self, id: InstanceId) {
        if self.keep < usize::MAX {
            self.order.push_back(id);
        }
    }

    fn surplus(&mut self) -> Option<InstanceId> {
        (self.order.len() > self.keep).then(|| self.order.pop_front()).flatten()
    }
}

impl Timeline {
    /// Applies the next line; returns what it has changed.
    pub fn apply(&mut self, line: &LogLine) -> Changed {
        let at = line.at.seconds();
        if matches!(line.entry, LogEntry::Event(Event::Resumed { .. })) {
            self.absences.push(Span { from_s: self.end_s, to_s: at });
        }
        self.end_s = self.end_s.max(at);
        let mut changed = Changed::default();
        match &line.entry {
            LogEntry::Event(event) => self.event(at, event, &mut changed),
            LogEntry::Command(command) => self.command(at, command, &mut changed),
        }
        while let Some(id) = self.left.surplus() {
            changed.left.extend(self.give_away(id));
        }
        changed
    }

    /// Ends the timeline here, at the end of the log or of the part that is looked at: what is under way lasts until now.
    pub fn close(&mut self) -> Changed {
        self.goes_on(self.end_s);
        for id in &self.at_work {
            let jobs = self.instances.get_mut(id).map(|one| &mut one.jobs);
            for job in jobs.into_iter().flatten().filter(|job| job.ending == Ending::Open) {
                job.to_s = self.end_s;
            }
        }
        let mut changed = Changed::default();
        if self.left.keep < usize::MAX {
            changed.released = self.resources.close(self.end_s);
            let all: Vec<InstanceId> = self.instances.keys().copied().collect();
            changed.left = all.into_iter().filter_map(|id| self.give_away(id)).collect();
        }
        changed
    }

    fn give_away(&mut self, id: InstanceId) -> Option<Instance> {
        let instance = self.instances.remove(&id)?;
        self.open.remove(&id);
        self.at_work.remove(&id);
        self.speculation.add(&instance);
        if self.results.get(&instance.path).is_some_and(|(of, _)| *of == id) {
            self.results.remove(&instance.path);
        }
        Some(instance)
    }

    fn event(&mut self, at: f64, event: &Event, changed: &mut Changed) {
        let of = instance_of(event);
        changed.instance = of;
        // An instance that has left may still get better results: that is not news about it.
        if let Some(id) = of.filter(|id| !self.is_only_improved(*id, event)) {
            // This may be the first line about the instance.
            self.known(id, at);
        }
        let path = |run: &Timeline, id: InstanceId| {
            run.instances.get(&id).map_or_else(|| id.to_string().into(), |one| one.path.clone())
        };
        self.cause = match event {
            Event::Started { .. } => Cause::Start,
            Event::Finished { instance, .. }
            | Event::Improved { instance, .. }
            | Event::Crashed { instance, .. }
            | Event::RetirementFailed { instance, .. } => Cause::Result(*instance, path(self, *instance)),
            Event::Granted { instance, .. } | Event::Refused { instance, .. } => {
                Cause::Answer(*instance, path(self, *instance))
            }
            Event::Projected { instance, .. } => Cause::Projected(*instance, path(self, *instance)),
            Event::WorldChanged { .. } => Cause::World,
            Event::Woken => Cause::Time,
            Event::Advised { .. } => Cause::Advice,
            Event::WantedByOthers { .. } => Cause::AnotherRun,
            Event::Resumed { .. } => Cause::Resumed,
            Event::PauseRequested
            | Event::ResumeRequested
            | Event::StepRequested
            | Event::BreakpointsSet { .. }
            | Event::Answered { .. }
            | Event::AbortRequested { .. } => Cause::Operator,
            Event::Signalled { signal, .. } => Cause::Signal(signal.as_str().into()),
            // These events change nothing.
            Event::Progressed { .. }
            | Event::Delayed { .. }
            | Event::Given { .. }
            | Event::Recorded { .. }
            | Event::SessionLost { .. } => return,
        };
        match event {
            Event::Started { task, mode, parameters, seed, capacity, breakpoints, origin, .. } => {
                self.hints = Hints::of(origin);
                self.task.clone_from(task);
                self.run.clone_from(&origin.run);
                self.file.clone_from(&origin.file);
                self.robot.clone_from(&origin.robot);
                self.began_unix_ms = origin.began_unix_ms;
                self.mode = *mode;
                self.parameters.clone_from(parameters);
                self.seed = *seed;
                self.breakpoints = breakpoints.to_vec();
                self.resources.begin(capacity);
            }
            Event::Granted { instance, lease } => {
                let holder = path(self, *instance);
                let (wait, over) = self.resources.grants(*instance, &holder, at, lease);
                changed.released.extend(over);
                changed.granted.extend_from_slice(self.resources.held_under(lease.id));
                self.known(*instance, at).waits.extend(wait);
                self.enter(*instance, Stage::Preparing, at);
            }
            Event::Refused { instance, .. } => {
                self.resources.withdraws(*instance);
                self.enter(*instance, Stage::Waiting, at);
            }
            Event::Finished { instance, attempt, .. } | Event::Crashed { instance, attempt, .. }
                if self.improvements.is_over(*instance, *attempt) => {}
            Event::Finished { instance, attempt, outcome, outputs, reason, .. } => {
                self.end(*instance, *attempt, at, Ending::Outcome(outcome.clone(), reason.clone()), outputs);
            }
            Event::Improved { instance, attempt, outputs, cost_s } => {
                if !self.improvements.has(*instance, *attempt) {
                    self.end(*instance, *attempt, at, Ending::Outcome(SUCCESS.to_owned(), String::new()), outputs);
                }
                self.improvements.given(*instance, *attempt, *cost_s);
            }
            Event::Crashed { instance, attempt, reason, .. } => {
                self.end(*instance, *attempt, at, Ending::Crashed(reason.clone()), &BTreeMap::new());
            }
            Event::PauseRequested => _ = self.paused.get_or_insert(at),
            Event::StepRequested => {
                self.paused.get_or_insert(at);
                self.steps += 1;
                self.stopped_at = None;
            }
            Event::ResumeRequested => self.goes_on(at),
            Event::BreakpointsSet { states } => self.breakpoints.clone_from(states),
            Event::Projected { .. }
            | Event::Progressed { .. }
            | Event::Delayed { .. }
            | Event::Given { .. }
            | Event::Recorded { .. }
            | Event::SessionLost { .. }
            | Event::WorldChanged { .. }
            | Event::RetirementFailed { .. }
            | Event::AbortRequested { .. }
            | Event::Signalled { .. }
            | Event::Answered { .. }
            | Event::Resumed { .. }
            | Event::Woken
            | Event::WantedByOthers { .. }
            | Event::Advised { .. } => {}
        }
    }

    fn command(&mut self, at: f64, command: &Command, changed: &mut Changed) {
        match command {
            Command::Note(note) => self.note(at, note, changed),
            Command::Acquire { instance, requirements, priority } => {
                changed.instance = Some(*instance);
                self.resources.asks(*instance, at, requirements, *priority);
                self.enter(*instance, Stage::Asking, at);
            }
            Command::Withdraw { instance } => {
                changed.instance = Some(*instance);
                self.resources.withdraws(*instance);
                if self.known(*instance, at).stage == Stage::Asking {
                    self.enter(*instance, Stage::Waiting, at);
                }
            }
            Command::Project { instance, writers, .. } => {
                changed.instance = Some(*instance);
                self.known(*instance, at).writers.clone_from(writers);
                self.enter(*instance, Stage::Preparing, at);
            }
            Command::Start { instance, attempt, goal } => {
                changed.instance = Some(*instance);
                self.starts(*instance, at, *attempt, goal);
            }
            Command::Cancel { instance, attempt } if self.improvements.is_over(*instance, *attempt) => {}
            Command::Cancel { instance, attempt } => {
                changed.instance = Some(*instance);
                self.end(*instance, *attempt, at, Ending::Cancelled, &BTreeMap::new());
            }
            Command::Release { instance, lease, .. } => {
                changed.instance = Some(*instance);
                changed.released.extend(lease.iter().flat_map(|lease| self.resources.releases(*lease, at)));
            }
            Command::Commit { instance, writer, changes, revision, .. } => {
                changed.instance = Some(*instance);
                let (revision, writer) = (*revision, writer.clone());
                self.commits.push_back(Commit { at_s: at, revision, writer, changes: changes.len() });
                if self.commits.len() > self.left.keep {
                    self.commits.pop_front();
                }
            }
            Command::End { outcome, outputs, reason } => {
                self.outcome = Some(outcome.clone());
                self.outputs.clone_from(outputs);
                self.reason.clone_from(reason);
                self.ended_by = self.cause.clone();
            }
            Command::Operate { .. } | Command::Wake { .. } => {}
        }
    }

    fn note(&mut self, at: f64, note: &Note, changed: &mut Changed) {
        let id = match note {
            Note::Expanded { instance, .. }
            | Note::Decided { instance, .. }
            | Note::Running { instance, .. }
            | Note::Stopped { instance }
            | Note::Awaiting { instance, .. }
            | Note::Finished { instance, .. }
            | Note::Retired { instance }
            | Note::Merged { instance }
            | Note::Invalidated { instance, .. }
            | Note::Preempted { instance, .. }
            | Note::Reused { instance }
            | Note::Squashed { instance } => *instance,
        };
        changed.instance = Some(id);
        match note {
            Note::Expanded { path, speculative, .. } => {
                let instance = self.known(id, at);
                instance.path = path.as_str().into();
                instance.speculative = *speculative;
            }
            // A loop decides, but is no instance of its own.
            Note::Decided { decision, .. } => {
                if let Some(instance) = self.instances.get_mut(&id) {
                    instance.decision = Some(decision.clone());
                }
            }
            Note::Running { .. } => {}
            Note::Stopped { .. } => {
                self.paused.get_or_insert(at);
                self.stopped_at = Some(id);
            }
            Note::Awaiting { awaited, .. } => {
                let cause = self.cause.clone();
                self.known(id, at).begins_to_await(at, awaited.to_string(), &cause);
            }
            Note::Finished { outcome, .. } => {
                let instance = self.known(id, at);
                let has_awaited = instance.awaits.take().is_some();
                (instance.finished, instance.outcome) = (true, Some(outcome.clone()));
                self.enter(id, Stage::Finished, at);
                self.open.remove(&id);
                // Whatever ended the wait: what goes on now has waited for it.
                if has_awaited {
                    self.cause = Cause::Result(id, self.known(id, at).path.clone());
                }
            }
            Note::Retired { .. } => {
                self.improvements.is_real(id);
                self.count.retired += usize::from(!self.known(id, at).has_left());
                self.known(id, at).retired = true;
                self.leaves(id, Stage::Retired, at);
            }
            Note::Merged { .. } => {
                self.known(id, at);
                self.left.add(id);
            }
            Note::Squashed { .. } => {
                self.improvements.is_gone(id);
                self.count.squashed += usize::from(!self.known(id, at).has_left());
                self.known(id, at).squashed = true;
                self.resources.withdraws(id);
                self.leaves(id, Stage::Squashed, at);
            }
            Note::Reused { .. } => self.reuses(id, at),
            Note::Invalidated { reason, .. } => {
                self.improvements.is_gone(id);
                let instance = self.known(id, at);
                instance.invalidations.push(reason.clone());
                (instance.finished, instance.outcome) = (false, None);
                if let Some(job) = instance.jobs.last_mut() {
                    job.invalidated = Some(reason.clone());
                }
                self.enter(id, Stage::Waiting, at);
                self.open.insert(id);
            }
            Note::Preempted { .. } => self.enter(id, Stage::Waiting, at),
        }
    }

    fn starts(&mut self, id: InstanceId, at: f64, attempt: u32, goal: &Goal) {
        let path = self.known(id, at).path.clone();
        let activity = self.hints.activity(&path, goal);
        // In the sequential mode an older instance that is open is of another region.
        let ahead_of_time = self.mode == Mode::Cdtn && self.open.range(..id).next().is_some();
        if matches!(activity, Activity::Motion | Activity::Other) {
            self.begins_beside(id, &path);
        }
        let instance = self.known(id, at);
        instance.jobs.push(Job::begun(at, attempt, goal, activity, ahead_of_time));
        instance.open_jobs += 1;
        self.enter(id, Stage::Running, at);
        self.at_work.insert(id);
    }

    /// Records which older PIAs with imprecise exceptions still run when a PIA begins.
    fn begins_beside(&mut self, id: InstanceId, path: &str) {
        if self.hints.imprecise.is_empty() {
            return;
        }
        let older = self.at_work.range(..id).filter_map(|other| self.instances.get(other));
        let imprecise = older.filter(|other| self.hints.imprecise.contains(&without_visits(&other.path)));
        let pairs: Vec<_> = imprecise.map(|older| (older.path.to_string(), path.to_owned())).collect();
        self.beside.extend(pairs);
    }

    fn end(&mut self, id: InstanceId, attempt: u32, at: f64, ending: Ending, outputs: &BTreeMap<String, Value>) {
        let crashed = !matches!(ending, Ending::Outcome(..));
        let with_result = matches!(ending, Ending::Outcome(..));
        // A live view does not need trajectories.
        let keeps_outputs = self.left.keep == usize::MAX;
        let instance = self.known(id, at);
        let open = |job: &Job| job.ending == Ending::Open && job.attempt == attempt;
        if let Some(index) = instance.jobs.iter().rposition(open) {
            let job = &mut instance.jobs[index];
            (job.to_s, job.ending) = (at, ending);
            if keeps_outputs {
                job.outputs.clone_from(outputs);
            }
            instance.open_jobs -= 1;
            if instance.open_jobs == 0 {
                self.at_work.remove(&id);
            }
            if with_result {
                let path = self.known(id, at).path.clone();
                self.results.insert(path, (id, index));
            }
        }
        // For an attempt with an answer, the executive decides whether the answer is its result.
        if crashed {
            self.enter(id, Stage::Waiting, at);
        }
    }

    /// The instance reuses the result of an equal visit: one of the same path, with a result. Of several, the one that ended last.
    fn reuses(&mut self, id: InstanceId, at: f64) {
        let instance = self.known(id, at);
        instance.reused = true;
        let path = instance.path.clone();
        if let Some((of, index)) = self.results.get(&path)
            && let Some(job) = self.instances.get_mut(of).and_then(|one| one.jobs.get_mut(*index))
        {
            job.used_elsewhere = true;
        }
    }

    fn leaves(&mut self, id: InstanceId, stage: Stage, at: f64) {
        if !self.instances.get(&id).is_some_and(|one| matches!(one.stage, Stage::Retired | Stage::Squashed)) {
            self.left.add(id);
        }
        self.enter(id, stage, at);
        self.open.remove(&id);
    }

    fn goes_on(&mut self, at: f64) {
        self.stopped_at = None;
        if let Some(from_s) = self.paused.take() {
            self.pauses.push(Span { from_s, to_s: at });
        }
    }

    fn enter(&mut self, id: InstanceId, stage: Stage, at: f64) {
        let cause = self.cause.clone();
        self.known(id, at).enter(stage, at, &cause);
    }

    /// Whether an event only reports that the goal of an instance goes on after it has given a result.
    fn is_only_improved(&self, id: InstanceId, event: &Event) -> bool {
        match event {
            Event::Improved { attempt, .. } | Event::Finished { attempt, .. } | Event::Crashed { attempt, .. } => {
                self.improvements.has(id, *attempt)
            }
            _ => false,
        }
    }

    /// The instance of this id, which may be new.
    fn known(&mut self, id: InstanceId, at_s: f64) -> &mut Instance {
        self.instances.entry(id).or_insert_with(|| {
            self.count.expanded += 1;
            self.open.insert(id);
            Instance::new(id, at_s, self.cause.clone())
        })
    }
}

fn instance_of(event: &Event) -> Option<InstanceId> {
    match event {
        Event::Granted { instance, .. }
        | Event::Refused { instance, .. }
        | Event::Projected { instance, .. }
        | Event::Progressed { instance, .. }
        | Event::Delayed { instance, .. }
        | Event::Given { instance, .. }
        | Event::Finished { instance, .. }
        | Event::Improved { instance, .. }
        | Event::Crashed { instance, .. }
        | Event::Answered { instance, .. }
        | Event::RetirementFailed { instance, .. } => Some(*instance),
        Event::Started { .. }
        | Event::Resumed { .. }
        | Event::Recorded { .. }
        | Event::SessionLost { .. }
        | Event::Woken
        | Event::PauseRequested
        | Event::ResumeRequested
        | Event::StepRequested
        | Event::BreakpointsSet { .. }
        | Event::Advised { .. }
        | Event::WantedByOthers { .. }
        | Event::WorldChanged { .. }
        | Event::Signalled { .. }
        | Event::AbortRequested { .. } => None,
    }
}
