//! The window: the instances that are expanded and have not retired, executed out of order.
//!
//! It consists of owners, each with private state and a few methods. An operation on several owners has a file of its own here and
//! uses only those methods.
//!
//! | owner | of what |
//! |---|---|
//! | [`graph`] | the instances: their order, lines, branches, the heads of lines |
//! | [`growth`] | cursors, where the window grows |
//! | [`memory`] | the world at each place of the program, its readers, settled results |
//! | [`waits`] | which instance waits for which other instance, the queue, timers |
//! | [`dispatch`] | running instances, priorities, which speculative holder gives way |
//! | [`results`] | the result cache |
//! | [`improving`] | results that are still being improved |
//!
//! | what happens | |
//! |---|---|
//! | `ready`, `begin` | a node may begin, asks for its resources, gets its projection, runs |
//! | `place` | a computing or sensing node that runs ahead comes to its place in the sequential program |
//! | `waiting` | a state waits, without a provider |
//! | `due` | a wait, a limit or a pause before the next try is over |
//! | `finish` | a goal ends, a worker dies, a node is tried again |
//! | `harvest` | an anytime result is improved until it is used or its resources are wanted |
//! | `decide` | conditions, lists of loops, deciders, ends of composite states |
//! | `retire` | results become real, in program order per line |
//! | `revise` | results are made again whose inputs came out otherwise |
//! | `outside` | the world changes from outside |
//! | `beside` | a region changes facts that regions beside it look at |
//! | `discard` | paths that are not taken are removed |
//!
//! Lines retire in program order, so the root world is always the world after a prefix of the program: a failure is precise, and a
//! projection is the root plus the effects of the older instances on the path. A result has three stages: *finished* feeds data
//! flows and projections; *settled* can no longer change and decides conditions and loops; *retired* is real.

mod begin;
mod beside;
mod checkpoint;
mod decide;
mod discard;
mod dispatch;
mod due;
mod finish;
mod graph;
mod growth;
mod harvest;
mod improving;
mod memory;
mod outside;
mod place;
mod ready;
mod results;
mod retire;
mod revise;
mod waiting;
mod waits;

use crate::binding::Outputs;
use crate::context::Context;
use crate::hold::Hold;
use crate::lookahead;
use crate::plan::Plan;
use crate::protocol::{Command, Event, Learned};
use crate::way_out::WayOut;
use beside::Crossing;
pub(crate) use checkpoint::Beside;
use dispatch::Dispatch;
use graph::Graph;
use graph::instance::{Instance, Role, Status};
use growth::Growth;
use improving::Improving;
use memory::{Memory, Sight, View};
use ratn_model::fact::{Change, FactKey};
use ratn_model::id::InstanceId;
use ratn_model::program::{ABORTED, PREEMPTED, Program};
use ratn_model::resource::Quantity;
use ratn_model::tolerance::Tolerance;
use ratn_model::value::Value;
use results::Results;
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, BTreeSet};
use waits::{Timer, Wait, Waits};

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct End {
    pub(crate) outcome: String,
    pub(crate) outputs: Outputs,
    pub(crate) reason: String,
    /// The way out (`finally`) that is executed before the end.
    pub(crate) way_out: WayOut,
}

impl End {
    /// Without outputs.
    pub(crate) fn new(outcome: &str, reason: String) -> End {
        End { outcome: outcome.to_owned(), outputs: Outputs::new(), reason, way_out: WayOut::default() }
    }
}

/// The state of CDTN mode.
#[derive(Serialize, Deserialize)]
pub(crate) struct Window {
    graph: Graph,
    growth: Growth,
    memory: Memory,
    waits: Waits,
    dispatch: Dispatch,
    results: Results,
    improving: Improving,
    tolerance: Tolerance,
    hold: Hold,
    end: Option<End>,
    is_ending: bool,
    /// Whether the root has changed or a signal has come since waits under way were last checked.
    #[serde(skip)]
    may_end_waits: bool,
    /// Instances that have assigned other values since the event came.
    #[serde(skip)]
    assigned_again: BTreeSet<InstanceId>,
    /// Computing and sensing nodes that have come to their places since the event came.
    #[serde(skip)]
    just_come: BTreeSet<InstanceId>,
    /// Shared facts that regions have changed and of which the regions beside them were not told yet.
    #[serde(skip)]
    crossings: Vec<Crossing>,
    /// Number of this event's commands that `follow_root` has handled.
    #[serde(skip)]
    followed: usize,
}

impl Window {
    /// A window at the beginning of the program.
    pub(crate) fn new(
        program: &Program,
        plan: &Plan,
        parameters: &BTreeMap<String, Value>,
        capacity: BTreeMap<String, Quantity>,
        learned: Learned,
        tolerance: Tolerance,
    ) -> Window {
        Window {
            graph: Graph::new(),
            growth: Growth::new(program, plan, parameters, learned.outcomes),
            memory: Memory::default(),
            waits: Waits::default(),
            dispatch: Dispatch::new(capacity, learned.durations_s),
            results: Results::default(),
            improving: Improving::default(),
            tolerance,
            hold: Hold::default(),
            end: None,
            is_ending: false,
            may_end_waits: false,
            assigned_again: BTreeSet::new(),
            just_come: BTreeSet::new(),
            crossings: Vec::new(),
            followed: 0,
        }
    }

    /// Begins the run.
    pub(crate) fn start(&mut self, context: &mut Context<'_>) -> Option<End> {
        self.go_on(context)
    }

    /// What comes before everything that is due: an answer, because the operator was told that it has arrived, and what the root and the signals
    /// already contain. Returns the end of the run if the answer ended it.
    pub(crate) fn before(&mut self, context: &mut Context<'_>, event: &Event) -> Option<End> {
        self.followed = 0;
        self.assigned_again.clear();
        self.just_come.clear();
        match event {
            Event::Answered { instance, choice } => {
                self.answer(context, *instance, choice);
                return self.go_on(context);
            }
            Event::WorldChanged { facts, .. } => {
                self.may_end_waits = true;
                self.world_changed(context, facts.iter().map(|(fact, _)| fact));
            }
            Event::Signalled { .. } => self.may_end_waits = true,
            _ => {}
        }
        None
    }

    /// The run has reached its deadline; returns its end.
    pub(crate) fn end_early(&mut self, context: &mut Context<'_>, reason: String) -> Option<End> {
        self.cut_short(context, ABORTED, reason);
        self.end.take()
    }

    /// Handles an event; returns the end of the run if it ended.
    pub(crate) fn handle(&mut self, context: &mut Context<'_>, event: Event) -> Option<End> {
        match event {
            Event::Granted { .. } | Event::Refused { .. } | Event::Projected { .. } => self.answered(context, event),
            Event::Finished { .. } | Event::Crashed { .. } => self.attempt_ended(context, event),
            event @ (Event::Delayed { .. } | Event::Given { .. }) => self.given(context, event),
            Event::Improved { instance, attempt, outputs, .. } => self.improved(context, instance, attempt, outputs),
            Event::RetirementFailed { reason, .. } => {
                self.stop(context, ABORTED, format!("what had happened could not be recorded: {reason}"));
            }
            Event::AbortRequested { reason, at_once: true } => self.stop(context, PREEMPTED, reason),
            Event::AbortRequested { reason, at_once: false } => self.cut_short(context, PREEMPTED, reason),
            Event::PauseRequested => self.hold.pause(),
            Event::ResumeRequested => {
                self.hold.resume();
                self.look_at_those_held();
            }
            Event::StepRequested => {
                self.hold.step();
                self.look_at_those_held();
            }
            Event::BreakpointsSet { states } => {
                self.hold.break_at(context.program, states);
                self.look_at_those_held();
            }
            Event::Advised { urgency_s, held } => {
                Dispatch::advise(&mut self.graph, &urgency_s);
                self.hold_back(context, &held);
                self.ask_again(context);
            }
            Event::WantedByOthers { holders } => self.give_way_to_others(context, &holders),
            Event::Answered { .. }
            | Event::WorldChanged { .. }
            | Event::Signalled { .. }
            | Event::Woken
            | Event::Started { .. }
            | Event::Progressed { .. }
            | Event::Recorded { .. }
            | Event::SessionLost { .. }
            | Event::Resumed { .. } => {}
        }
        let end = self.go_on(context);
        self.harvest_what_is_removed(context);
        end
    }

    /// Examines, retires, revises and grows until nothing changes.
    fn go_on(&mut self, context: &mut Context<'_>) -> Option<End> {
        loop {
            while self.end.is_none()
                && let Some(id) = self.waits.next(&mut self.graph)
            {
                self.examine(context, id);
            }
            if self.end.is_some() {
                return self.end.take();
            }
            let changed = self.retire(context)
                | self.tell_of_crossings(context)
                | self.revise(context)
                | self.grow(context)
                | self.give_way(context);
            if self.end.is_some() {
                return self.end.take();
            }
            self.follow_root(context);
            let changed = changed | self.look_at_waits(context);
            if self.end.is_some() {
                return self.end.take();
            }
            if !changed && !self.waits.is_due(&self.graph) {
                return None;
            }
        }
    }

    /// Lets an instance go on, if it can.
    fn examine(&mut self, context: &mut Context<'_>, id: InstanceId) {
        let Some(instance) = self.graph.get(id) else { return };
        let has_ended = instance.ended().is_some();
        match (instance.role(), instance.node().map(|node| &node.status)) {
            (None, Some(Status::Expanded)) => self.begin(context, id),
            // It has its resources.
            (None, Some(Status::Granted(_))) => self.proceed_unless_held_back(context, id),
            (None, Some(Status::Running(_))) => self.take_end(context, id),
            (None, Some(Status::Finished(_))) if instance.is_undecided() => self.decide_by_outcome(context, id),
            (Some(Role::Condition | Role::Test), _) if !has_ended => self.decide(context, id),
            (Some(Role::Loop), _) if !has_ended => self.count(context, id),
            (Some(Role::Join), _) if !has_ended => self.decide_join(context, id),
            (Some(Role::Entry | Role::Exit), _) if !has_ended => self.compute_boundary(context, id),
            (Some(Role::Fork), _) if !has_ended => {
                self.end_instance(id, graph::instance::Ended::success(Outputs::new()));
            }
            (Some(Role::End), _) => self.end_run(context, id),
            _ => {}
        }
    }

    /// Grows up to the horizon; true if anything was appended.
    fn grow(&mut self, context: &mut Context<'_>) -> bool {
        let grew = self.growth.grow(&mut self.graph, context);
        if grew && Dispatch::is_estimate_due(self.graph.len(), self.growth.grown()) {
            self.growth.forget_grown();
            let sight = self.memory.sight(context.program, context.plan, context.root, &self.graph);
            let estimates = self.dispatch.estimates(sight);
            Dispatch::set_estimates(&mut self.graph, estimates);
        }
        grew
    }

    /// The operator's holds have changed: examines heads, and detached PIAs, which may have a further try.
    fn look_at_those_held(&mut self) {
        let heads = self.graph.heads().map(|head| head.id);
        let held: Vec<InstanceId> = heads.chain(self.graph.detached().iter().copied()).collect();
        for id in held {
            self.waits.enqueue(&mut self.graph, id);
        }
    }

    pub(crate) fn break_at(&mut self, program: &Program, breakpoints: Vec<String>) {
        self.hold.break_at(program, breakpoints);
    }

    /// The breakpoints; see [`crate::executive::Executive::breakpoints`].
    pub(crate) fn breakpoints(&self) -> &[String] {
        self.hold.breakpoints()
    }

    /// What every instance that has not begun waits for, as sentences.
    pub(crate) fn waits(&self, program: &Program) -> Vec<String> {
        let is_waiting = |instance: &&Instance| {
            instance.node().is_some_and(|node| matches!(node.status, Status::Expanded | Status::Acquiring { .. }))
        };
        let named = |id: InstanceId| self.path(program, id);
        let waiting = self.graph.iter().filter(is_waiting);
        waiting.map(|instance| instance.waiting.wait().sentence(&named(instance.id), named)).collect()
    }

    /// The remaining work as a scheduling problem.
    pub(crate) fn outlook(&self, context: &Context<'_>) -> lookahead::Problem {
        self.dispatch.outlook(self.sight(context), context.now)
    }

    /// The path of an instance, with visits.
    fn path(&self, program: &Program, id: InstanceId) -> String {
        self.graph.get(id).map_or(String::new(), |instance| instance.path(program))
    }

    fn sight<'a>(&'a self, context: &'a Context<'_>) -> Sight<'a> {
        self.memory.sight(context.program, context.plan, context.root, &self.graph)
    }

    /// Calls `look` with the view of an instance, with its own outputs if it has ended. The call is repeated if forecasts at the end
    /// of a deep chain had to be made first.
    fn look<'a, T>(
        &'a self,
        context: &'a Context<'_>,
        id: InstanceId,
        outputs: Option<&'a Outputs>,
        look: impl Fn(&Instance, &View<'a>) -> T,
    ) -> Option<T> {
        let instance = self.graph.get(id)?;
        Some(self.sight(context).with(|sight| look(instance, &sight.view(instance, outputs))))
    }

    fn wait(&mut self, id: InstanceId, wait: Wait) {
        self.waits.wait(&mut self.graph, id, wait);
    }

    fn tolerance_of<'a>(&self, context: &'a Context<'_>) -> impl Fn(&FactKey) -> Tolerance + 'a {
        let base = self.tolerance;
        move |key| context.program.tolerances.of(&key.predicate, base)
    }

    /// Updates what is derived from the root and from the capacities with the commits and operations made since the last call.
    fn follow_root(&mut self, context: &Context<'_>) {
        let mut has_changed = false;
        for command in &context.commands[self.followed.min(context.commands.len())..] {
            match command {
                Command::Commit { changes, .. } => {
                    self.memory.root_changed(context.root, changes.iter().map(Change::pattern));
                    has_changed = true;
                }
                Command::Operate { operations, .. } => self.dispatch.operated(operations),
                _ => {}
            }
        }
        if has_changed {
            self.may_end_waits = true;
            self.waits.environment_changed(&mut self.graph);
        }
        self.followed = context.commands.len();
    }

    /// Sets a timer that is due after so many seconds.
    fn set_timer(&mut self, context: &mut Context<'_>, after_s: f64, timer: Timer) {
        let at = self.waits.set_timer(context.now, after_s, timer);
        context.commands.push(Command::Wake { at });
    }

    /// Checks the window between two events.
    pub(crate) fn check_invariants(&self) -> Result<(), String> {
        if self.is_ending {
            return Ok(());
        }
        if !self.crossings.is_empty() {
            return Err("a region has changed what others look at, and they were not told".to_owned());
        }
        self.graph.check_invariants()?;
        self.growth.check_invariants(&self.graph)?;
        self.waits.check_invariants(&self.graph)?;
        self.dispatch.check_invariants(&self.graph)?;
        self.results.check_invariants(&self.graph)?;
        self.improving.check_invariants(&self.graph)?;
        if !self.memory.is_fresh() {
            return Err("something came out otherwise, and its users were not looked at".to_owned());
        }
        Ok(())
    }

    /// Finds an instance that could go on and was not woken: every instance is examined again.
    pub(crate) fn check_quiescence(&mut self, context: &mut Context<'_>) -> Result<(), String> {
        let all: Vec<InstanceId> = self.graph.iter().map(|instance| instance.id).collect();
        for id in all {
            let waited = self.graph.get(id).map(|instance| instance.waiting.wait());
            if waited == Some(Wait::Backoff) {
                // Its timer may be due at this very moment.
                continue;
            }
            let before = context.commands.len();
            self.waits.enqueue(&mut self.graph, id);
            self.may_end_waits = true;
            let end = self.go_on(context);
            if let Some(command) = context.commands.get(before) {
                let path = self.path(context.program, id);
                return Err(format!("{path} ({waited:?}) could have gone on and was not woken: {command:?}"));
            }
            if end.is_some() {
                return Err("the run could have ended".to_owned());
            }
        }
        Ok(())
    }
}
