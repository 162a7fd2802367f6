//! The progress of a run for people: one line per node that starts or ends.

use crate::control::Awaiting;
use ratn_executive::protocol::{Awaited, Command, Event, Note};
use ratn_model::id::InstanceId;
use ratn_model::program::{SUCCESS, WORLD_MODEL};
use ratn_model::time::Timestamp;
use ratn_model::value::Value;
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, VecDeque};

/// Maximum number of facts shown per change from outside.
const MOST_FACTS: usize = 5;
/// Maximum number of instances that have left the window whose paths are kept, so that memory does not grow with the run.
const MOST_GONE: usize = 1024;

/// Follows events and commands, and formats them for people.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct Progress {
    /// The paths of the instances in the window, and of the last ones that have left it.
    paths: BTreeMap<InstanceId, String>,
    /// The instances that have left the window, oldest first.
    gone: VecDeque<InstanceId>,
    started: BTreeMap<InstanceId, Timestamp>,
    /// What states wait for, and the latest end of each wait.
    awaiting: BTreeMap<InstanceId, (Awaited, Option<Timestamp>)>,
    /// The number of states that have retired.
    retired: u64,
    /// Whether the run is paused: no PIA may begin.
    paused: bool,
    /// The last progress message of each goal under way. Lost if task control is killed.
    #[serde(skip)]
    messages: BTreeMap<InstanceId, String>,
    #[serde(skip)]
    quiet: bool,
}

/// A state under way.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct UnderWay {
    /// The path of the state with visits.
    pub path: String,
    /// Time since it began, in seconds of the robot's time.
    pub for_s: f64,
    /// Its usual duration in seconds, if its `duration` states one.
    #[serde(default)]
    pub usually_s: Option<f64>,
    /// Its last progress message; empty if there is none.
    #[serde(default)]
    pub message: String,
}

impl UnderWay {
    /// `for 1.5 s of about 4.0 s: planned 2 of 5`.
    pub fn text(&self) -> String {
        let usually = self.usually_s.map_or_else(String::new, |usually| format!(" of about {usually:.1} s"));
        let message = if self.message.is_empty() { String::new() } else { format!(": {}", self.message) };
        format!("for {:.1} s{usually}{message}", self.for_s)
    }
}

impl Progress {
    /// Formats lines, or none if `quiet`.
    pub(crate) fn new(quiet: bool) -> Progress {
        Progress { quiet, ..Progress::default() }
    }

    /// Follows one step of a run that is being resumed, without formatting it again.
    pub(crate) fn catch_up<'a>(
        &mut self,
        at: Timestamp,
        event: &Event,
        commands: impl Iterator<Item = &'a Command> + Clone,
    ) {
        if let Event::Finished { instance, .. } | Event::Improved { instance, .. } = event {
            self.ends(*instance);
        }
        self.hear(event);
        self.await_things(commands.clone());
        for command in commands.clone() {
            match command {
                Command::Note(Note::Expanded { instance, path, .. }) => {
                    self.paths.insert(*instance, path.clone());
                }
                Command::Note(Note::Invalidated { instance, .. }) => drop(self.ends(*instance)),
                Command::Start { instance, .. } => drop(self.started.insert(*instance, at)),
                _ => {}
            }
        }
        self.forget(commands);
    }

    /// Records which waits of states begin and end.
    fn await_things<'a>(&mut self, commands: impl Iterator<Item = &'a Command>) {
        for command in commands {
            match command {
                Command::Note(Note::Awaiting { instance, awaited, until }) => {
                    self.awaiting.insert(*instance, (awaited.clone(), *until));
                }
                Command::Note(Note::Finished { instance, .. } | Note::Squashed { instance }) => {
                    self.awaiting.remove(instance);
                }
                Command::Note(Note::Stopped { .. }) => self.paused = true,
                _ => {}
            }
        }
    }

    /// The instances that wait for something themselves, with what they wait for.
    pub(crate) fn awaiting(&self) -> impl Iterator<Item = (InstanceId, Awaiting)> + '_ {
        self.awaiting.iter().map(|(id, (awaited, until))| {
            let until_s = until.map(Timestamp::seconds);
            (*id, Awaiting { path: self.path(*id), awaited: awaited.clone(), until_s })
        })
    }

    /// Records that an instance is no longer under way; returns when it began.
    fn ends(&mut self, instance: InstanceId) -> Option<Timestamp> {
        self.messages.remove(&instance);
        self.started.remove(&instance)
    }

    /// Records pauses, and progress messages of goals.
    fn hear(&mut self, event: &Event) {
        match event {
            Event::Progressed { instance, message, .. } if self.started.contains_key(instance) => {
                self.messages.insert(*instance, message.clone());
            }
            Event::PauseRequested | Event::StepRequested => self.paused = true,
            Event::ResumeRequested => self.paused = false,
            _ => {}
        }
    }

    /// Whether the user has paused the run.
    pub(crate) fn is_paused(&self) -> bool {
        self.paused
    }

    /// The number of states that have retired.
    pub(crate) fn retired(&self) -> u64 {
        self.retired
    }

    /// The states under way, in the order in which they began, without those that [wait](Progress::awaiting); `usually_s` gives the usual duration
    /// of an instance.
    pub(crate) fn under_way(&self, now: Timestamp, usually_s: impl Fn(InstanceId) -> Option<f64>) -> Vec<UnderWay> {
        let works = self.started.iter().filter(|(id, _)| !self.awaiting.contains_key(id));
        let mut all: Vec<(Timestamp, InstanceId)> = works.map(|(id, at)| (*at, *id)).collect();
        all.sort_unstable();
        let one = |(at, id): (Timestamp, InstanceId)| UnderWay {
            path: self.path(id),
            for_s: now.since(at).as_secs_f64(),
            usually_s: usually_s(id),
            message: self.messages.get(&id).cloned().unwrap_or_default(),
        };
        all.into_iter().map(one).collect()
    }

    /// The paths of the known instances.
    pub(crate) fn paths(&self) -> &BTreeMap<InstanceId, String> {
        &self.paths
    }

    /// Forgets instances that have left the window, except their paths: a failed commit of one may still be reported.
    fn forget<'a>(&mut self, commands: impl Iterator<Item = &'a Command>) {
        for command in commands {
            if let Command::Note(Note::Retired { instance } | Note::Squashed { instance } | Note::Merged { instance }) =
                command
            {
                self.ends(*instance);
                self.retired += u64::from(matches!(command, Command::Note(Note::Retired { .. })));
                self.gone.push_back(*instance);
                if self.gone.len() > MOST_GONE
                    && let Some(oldest) = self.gone.pop_front()
                {
                    self.paths.remove(&oldest);
                }
            }
        }
    }

    /// The lines for one step. `acts` says which instances act on the environment: those are cut short, where others are discarded without a trace.
    pub(crate) fn follow(
        &mut self,
        at: Timestamp,
        event: &Event,
        commands: &[Command],
        acts: impl Fn(InstanceId) -> bool,
    ) -> Vec<String> {
        let mut lines = Vec::new();
        if self.quiet {
            self.catch_up(at, event, commands.iter());
            return lines;
        }
        self.hear(event);
        let waited: Vec<InstanceId> = self.awaiting.keys().copied().collect();
        self.await_things(commands.iter());
        match event {
            // Of several results only the first is shown.
            Event::Improved { instance, .. } => {
                let path = self.path(*instance);
                if let Some(began) = self.ends(*instance) {
                    let took_s = at.since(began).as_secs_f64();
                    say(&mut lines, at, &format!("done   {path}  {took_s:.1} s, and goes on for a better one"));
                }
            }
            // An earlier result was shown.
            Event::Finished { instance, .. } if !self.started.contains_key(instance) => {}
            Event::Finished { instance, outcome, reason, .. } => {
                let path = self.path(*instance);
                let took = self.ends(*instance).map_or(0.0, |s| at.since(s).as_secs_f64());
                if outcome == SUCCESS {
                    say(&mut lines, at, &format!("done   {path}  {took:.1} s"));
                } else {
                    say(&mut lines, at, &format!("{outcome} {path}  {took:.1} s: {reason}"));
                }
            }
            Event::Crashed { instance, reason, .. } => {
                let path = self.path(*instance);
                say(&mut lines, at, &format!("crash  {path}: {reason}"));
            }
            Event::Refused { instance, reason } => {
                say(&mut lines, at, &format!("refuse {}: {reason}", self.path(*instance)))
            }
            Event::RetirementFailed { instance, reason, .. } => {
                say(&mut lines, at, &format!("failed to make {} real: {reason}", self.path(*instance)));
            }
            Event::AbortRequested { reason, .. } => say(&mut lines, at, &format!("abort: {reason}")),
            Event::WorldChanged { facts, .. } => {
                for (fact, value) in facts.iter().take(MOST_FACTS) {
                    match value {
                        Some(value) => say(&mut lines, at, &format!("world  {fact} = {value}, from outside")),
                        None => say(&mut lines, at, &format!("world  {fact} is gone, from outside")),
                    }
                }
                if facts.len() > MOST_FACTS {
                    say(&mut lines, at, &format!("world  and {} more facts", facts.len() - MOST_FACTS));
                }
            }
            Event::Resumed { .. } => say(&mut lines, at, "task control goes on"),
            Event::SessionLost { .. } => {
                say(&mut lines, at, "the session of the run has ended, and what it held is gone")
            }
            Event::Signalled { signal, value: Value::Null } => say(&mut lines, at, &format!("signal {signal}")),
            Event::Signalled { signal, value } => say(&mut lines, at, &format!("signal {signal} = {value}")),
            Event::Answered { instance, choice } => {
                say(&mut lines, at, &format!("answer {}: {choice}", self.path(*instance)));
            }
            Event::PauseRequested => say(&mut lines, at, "pause"),
            Event::ResumeRequested => say(&mut lines, at, "resume"),
            Event::StepRequested => say(&mut lines, at, "step"),
            Event::BreakpointsSet { states } if states.is_empty() => say(&mut lines, at, "no breakpoints"),
            Event::BreakpointsSet { states } => say(&mut lines, at, &format!("breakpoints: {}", states.join(", "))),
            Event::Started { .. }
            | Event::Granted { .. }
            | Event::Projected { .. }
            | Event::Progressed { .. }
            | Event::Delayed { .. }
            | Event::Given { .. }
            | Event::Recorded { .. }
            | Event::Woken
            | Event::WantedByOthers { .. }
            | Event::Advised { .. } => {}
        }
        for command in commands {
            match command {
                Command::Note(Note::Expanded { instance, path, .. }) => {
                    self.paths.insert(*instance, path.clone());
                }
                Command::Note(Note::Awaiting { instance, awaited, until }) => {
                    self.started.insert(*instance, at);
                    let until = until.map_or_else(String::new, |until| format!(", until {:.1} s", until.seconds()));
                    let path = self.path(*instance);
                    say(&mut lines, at, &format!("wait   {path}  for {awaited}{until}"));
                    if let Awaited::Answer { choices, .. } = awaited
                        && let Some(choice) = choices.first()
                    {
                        say(&mut lines, at, &format!("ask    answer with `ratn answer - {choice} --state {path}`"));
                    }
                }
                Command::Note(Note::Stopped { instance }) => {
                    let path = self.path(*instance);
                    say(
                        &mut lines,
                        at,
                        &format!("stop   {path}  at its breakpoint; go on with `ratn control resume` or `step`"),
                    );
                }
                Command::Note(Note::Finished { instance, outcome }) if waited.contains(instance) => {
                    let took = self.started.remove(instance).map_or(0.0, |s| at.since(s).as_secs_f64());
                    let how = if **outcome == *SUCCESS { "waited" } else { outcome };
                    say(&mut lines, at, &format!("{how} {}  {took:.1} s", self.path(*instance)));
                }
                // Ended without its provider: a violated `requires`, or a timeout.
                Command::Note(Note::Finished { instance, outcome })
                    if **outcome != *SUCCESS && !told(event, *instance) =>
                {
                    let path = self.path(*instance);
                    let took = self.ends(*instance).map_or(0.0, |s| at.since(s).as_secs_f64());
                    say(&mut lines, at, &format!("{outcome} {path}  {took:.1} s, not by its provider"));
                }
                Command::Note(Note::Decided { path, decision, .. }) => {
                    say(&mut lines, at, &format!("decide {path}: {decision}"))
                }
                Command::Note(Note::Invalidated { instance, reason }) => {
                    self.ends(*instance);
                    say(&mut lines, at, &format!("again  {}: {reason}", self.path(*instance)));
                }
                Command::Note(Note::Reused { instance }) => {
                    say(&mut lines, at, &format!("reuse  {}", self.path(*instance)))
                }
                Command::Note(Note::Squashed { instance }) if self.ends(*instance).is_some() => {
                    let what = if acts(*instance) { "cut   " } else { "squash" };
                    say(&mut lines, at, &format!("{what} {}", self.path(*instance)));
                }
                Command::Start { instance, attempt, goal } => {
                    self.started.insert(*instance, at);
                    let with: Vec<&str> = goal
                        .lease
                        .iter()
                        .flat_map(|lease| &lease.resources)
                        .filter(|r| r.kind != WORLD_MODEL)
                        .map(|r| r.id.as_str())
                        .collect();
                    let again = if *attempt > 1 { format!(", attempt {attempt}") } else { String::new() };
                    say(&mut lines, at, &format!("start  {}  ({}{again})", self.path(*instance), with.join(", ")));
                }
                _ => {}
            }
        }
        self.forget(commands.iter());
        lines
    }

    /// The path of an instance that waits for resources; `None` if quiet.
    pub(crate) fn waits(&self, instance: InstanceId) -> Option<String> {
        (!self.quiet).then(|| self.path(instance))
    }

    fn path(&self, instance: InstanceId) -> String {
        self.paths.get(&instance).cloned().unwrap_or_else(|| instance.to_string())
    }
}

/// Whether the line of an event already covers this instance.
fn told(event: &Event, instance: InstanceId) -> bool {
    match event {
        Event::Finished { instance: of, .. } | Event::Refused { instance: of, .. } => *of == instance,
        _ => false,
    }
}

fn say(lines: &mut Vec<String>, at: Timestamp, what: &str) {
    lines.push(format!("{:>8.1} s  {what}", at.seconds()));
}

#[cfg(test)]
mod tests {
    use super::*;
    use ratn_model::id::StateId;

    #[test]
    fn what_a_worker_has_said_is_shown_while_its_state_is_under_way() {
        let instance = InstanceId(1);
        let expanded = Note::Expanded { instance, state: StateId(1), path: "plan[1]".to_owned(), speculative: false };
        let said = |message: &str| Event::Progressed { instance, attempt: 1, message: message.to_owned() };
        let mut progress = Progress::new(true);
        progress.follow(Timestamp(0), &said("too early"), &[Command::Note(expanded)], |_| false);
        progress.started.insert(instance, Timestamp(0));
        progress.follow(Timestamp(0), &said("1 of 2"), &[], |_| false);
        progress.follow(Timestamp(0), &said("2 of 2"), &[], |_| false);
        let text = |progress: &Progress| -> Vec<String> {
            progress.under_way(Timestamp::from_seconds(1.5), |_| Some(3.0)).iter().map(UnderWay::text).collect()
        };
        assert_eq!(text(&progress), ["for 1.5 s of about 3.0 s: 2 of 2"]);
        progress.follow(Timestamp(0), &Event::Woken, &[Command::Note(Note::Retired { instance })], |_| false);
        assert_eq!(text(&progress), [""; 0]);
        progress.started.insert(instance, Timestamp(0));
        assert_eq!(text(&progress), ["for 1.5 s of about 3.0 s"], "what it said before is not said of it again");
    }

    #[test]
    fn a_motion_that_is_cut_short_is_told_from_what_is_discarded() {
        let (moves, plans) = (InstanceId(1), InstanceId(2));
        let mut progress = Progress::new(false);
        for (id, path) in [(moves, "move[1]"), (plans, "plan[1]")] {
            progress.paths.insert(id, path.to_owned());
            progress.started.insert(id, Timestamp(0));
        }
        let squashed = [moves, plans].map(|instance| Command::Note(Note::Squashed { instance }));
        let lines = progress.follow(Timestamp(0), &Event::Woken, &squashed, |id| id == moves);
        assert_eq!(lines, ["     0.0 s  cut    move[1]", "     0.0 s  squash plan[1]"]);
    }

    #[test]
    fn a_state_that_waits_by_itself_is_not_among_those_under_way() {
        let instance = InstanceId(1);
        let awaited = Awaited::Signal { signal: "lid_closed".to_owned() };
        let awaiting = [Command::Note(Note::Awaiting { instance, awaited, until: None })];
        let mut progress = Progress::new(false);
        progress.follow(Timestamp(0), &Event::Woken, &awaiting, |_| false);
        assert_eq!((progress.awaiting().count(), progress.under_way(Timestamp(0), |_| None)), (1, Vec::new()));
    }
}
