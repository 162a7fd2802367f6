//! Regions: threads of control that begin at a fork and end at a join. Each is a line of its own, with its own horizon, order
//! and heads.

use super::Window;
use super::cursor::{Cursor, Todo};
use super::environment::{Binding, Environment, Frame, Link, Producer};
use super::instance::{Arm, Ended, Line, Role, Status};
use crate::context::Context;
use crate::plan::Predicate;
use ratn_model::id::{InstanceId, StateId};
use ratn_model::program::{ABORTED, PREEMPTED, SUCCESS, State, StateKind};
use ratn_model::value::Value;
use smallvec::smallvec;
use std::collections::BTreeMap;
use std::sync::Arc;

/// A line: the task's, or a region's.
#[derive(Debug, Default)]
pub(crate) struct Thread {
    /// The oldest instance that has not retired.
    pub(crate) head: Option<InstanceId>,
    /// Its position, or that of the next.
    pub(crate) floor: u64,
    /// Regions of the fork that retired last, that have not ended: the line waits for them.
    pub(crate) open_regions: usize,
    /// Its fork has retired.
    pub(crate) is_active: bool,
    /// The fork it began at.
    pub(crate) fork: Option<InstanceId>,
}

/// Where a path of a region ends, and what is seen from there.
#[derive(Debug, Clone)]
pub(crate) struct RegionExit {
    pub(crate) end: InstanceId,
    environment: Environment,
    producer: Arc<Producer>,
    /// Why the path left otherwise than by success.
    because: Option<Arc<str>>,
}

/// A fork whose join has not retired.
#[derive(Debug)]
pub(crate) struct Fork {
    /// The concurrency and its visit.
    pub(crate) state: StateId,
    pub(crate) visit: u32,
    /// Where the fork stands.
    pub(crate) line: Line,
    pub(crate) regions: Vec<Line>,
    /// Per region, its ends: one per path.
    pub(crate) ends: Vec<Vec<RegionExit>>,
    pub(crate) join: Option<InstanceId>,
    /// What goes on behind the join.
    pub(crate) waiting: Cursor,
}

impl Window {
    /// A concurrency is entered: every region begins.
    #[expect(clippy::too_many_arguments, reason = "all of it is one visit")]
    pub(super) fn fork(
        &mut self,
        context: &mut Context<'_>,
        index: usize,
        state: &State,
        visit: u32,
        path: &Arc<str>,
        variables: usize,
        regions: &[StateId],
    ) {
        let fork = self.append(context, index, state, Role::Fork, visit, None, 0);
        let template = self.cursors[index].clone();
        let mut lines = Vec::new();
        for (number, region) in regions.iter().enumerate() {
            self.next_line += 1;
            let line = self.next_line;
            lines.push(line);
            self.threads.insert(line, Thread { fork: Some(fork), ..Thread::default() });
            if let Some(instance) = self.instances.get_mut(fork) {
                instance.arms.push(Arm { outcomes: 0, outcome: 0, next: None, segment: template.segment });
            }
            let frame = Frame {
                below: template.environment.frames.clone(),
                owner: state.id,
                visit,
                path: path.clone(),
                visits: Vec::new(),
                iteration: None,
                variables,
                fork: Some(fork),
            };
            self.next_order += 1;
            let mut cursor = Cursor { line, position: 0, order: self.next_order, ..template.clone() };
            cursor.environment.frames = Some(Arc::new(frame));
            cursor.tail = Some((fork, number));
            cursor.todo = Todo::Enter(*region);
            self.cursors.push(cursor);
        }
        let waiting = Cursor { todo: Todo::Await(fork), tail: None, ..template };
        self.cursors[index] = waiting.clone();
        let ends = vec![Vec::new(); lines.len()];
        let record = Fork { state: state.id, visit, line: waiting.line, regions: lines, ends, join: None, waiting };
        self.forks.insert(fork, record);
    }

    /// A path of a region has come to its end.
    pub(super) fn end_region(
        &mut self,
        context: &mut Context<'_>,
        index: usize,
        fork: InstanceId,
        region: StateId,
        outcome: &str,
    ) {
        let state = context.program.state(region);
        let plan = self.plan.clone();
        let number = plan.state(region).outcome(outcome).unwrap_or(0);
        let end = self.append(context, index, state, Role::RegionEnd, 1, None, number);
        let line = self.cursors[index].line;
        self.cursors[index].todo = Todo::Done;
        let Cursor { environment, because, .. } = self.cursors[index].clone();
        let because = because.filter(|_| outcome != SUCCESS);
        let Some(instance) = self.instances.get_mut(end) else { return };
        let outputs = [("outcome".to_owned(), Value::String(outcome.to_owned()))];
        instance.status = Status::Finished;
        instance.ended = Some(Box::new(Ended::with(outcome, outputs.into_iter().collect())));
        let Some(producer) = instance.producer.clone() else { return };
        if let Some(fork) = self.forks.get_mut(&fork)
            && let Some(region) = fork.regions.iter().position(|other| *other == line)
        {
            fork.ends[region].push(RegionExit { end, environment, producer, because });
        }
    }

    /// Forks whose regions have each come to one end that nothing in the region can change: what follows the join is expanded.
    pub(super) fn join_regions(&mut self, context: &mut Context<'_>) {
        let ready: Vec<InstanceId> = self
            .forks
            .iter()
            .filter(|(_, fork)| {
                let single = |ends: &Vec<RegionExit>| match ends.as_slice() {
                    [exit] => self
                        .instances
                        .get(exit.end)
                        .is_none_or(|end| self.is_same_stretch(end.segment, fork.waiting.segment)),
                    _ => false,
                };
                fork.join.is_none() && fork.ends.iter().all(single)
            })
            .map(|(id, _)| *id)
            .collect();
        for id in ready {
            self.join(context, id);
        }
    }

    fn join(&mut self, context: &mut Context<'_>, id: InstanceId) {
        let Some(index) = self.cursors.iter().position(|cursor| cursor.todo == Todo::Await(id)) else { return };
        let Some(fork) = self.forks.get(&id) else { return };
        let ends: Vec<RegionExit> = fork.ends.iter().flatten().cloned().collect();
        let (line, visit) = (fork.line, fork.visit);
        let state = context.program.state(fork.state);
        let StateKind::Concurrency { regions, .. } = &state.kind else { return };
        let states = self.plan.len();
        let before = self.cursors[index].environment.clone();
        let mut merged: BTreeMap<Predicate, Vec<Link>> = BTreeMap::new();
        for (region, RegionExit { environment, producer, .. }) in regions.iter().zip(&ends) {
            for (predicate, link) in environment.writers.iter() {
                if before.writer(predicate) != Some(*link) {
                    merged.entry(predicate).or_default().push(*link);
                }
            }
            let cursor = &mut self.cursors[index];
            for (slot, producer) in environment.producers.iter() {
                let known = before.producers.get(slot).map(|old| old.instance);
                if known != Some(producer.instance) {
                    cursor.environment.producers.set(slot, Some(producer.clone()));
                }
            }
            cursor.environment.producers.set(states + region.0 as usize, Some(producer.clone()));
            let theirs: Vec<_> = environment.variables.iter().take(before.variables.len()).cloned().collect();
            for ((name, binding), (_, old)) in theirs.into_iter().zip(before.variables.iter()) {
                if let Binding::Assigned(new) = &binding
                    && !matches!(old, Binding::Assigned(old) if old.instance == new.instance)
                {
                    cursor.environment.variables.assign(&name, binding);
                }
            }
        }
        let reasons: Vec<&str> = ends.iter().filter_map(|end| end.because.as_deref()).collect();
        if !reasons.is_empty() {
            self.cursors[index].because = Some(reasons.join("; ").into());
        }
        let join = self.append(context, index, state, Role::Join, visit, None, 0);
        for (predicate, links) in &merged {
            let link = match links.as_slice() {
                [only] => *only,
                _ => Link { writer: join, outcome: 0, vague: false },
            };
            self.cursors[index].environment.writers.set(*predicate, Some(link));
        }
        let several = merged.into_iter().filter(|(_, links)| links.len() > 1);
        let links: Vec<_> = several.flat_map(|(p, links)| links.into_iter().map(move |link| (p, link))).collect();
        self.joins.insert(join, links);
        // The decider sees what the regions wrote.
        let environment = self.cursors[index].environment.clone();
        if let Some(instance) = self.instances.get_mut(join) {
            instance.environment = environment;
            let segment = instance.segment;
            instance.arms = smallvec![Arm { outcomes: u64::MAX, outcome: 0, next: None, segment }];
        }
        if let Some(fork) = self.forks.get_mut(&id) {
            fork.join = Some(join);
        }
        let waits = self.threads.get(&line).is_some_and(|thread| thread.open_regions == 0 && thread.head.is_none());
        if waits && self.instances.get(id).is_none() {
            self.set_head(line, Some(join));
        }
        self.cursors[index].todo = Todo::Await(join);
    }

    /// The outcome of a concurrency whose decider says nothing.
    pub(super) fn default_outcome(outcomes: &[String]) -> &'static str {
        if outcomes.iter().all(|outcome| outcome == SUCCESS) {
            SUCCESS
        } else if outcomes.iter().any(|outcome| outcome == ABORTED) {
            ABORTED
        } else {
            PREEMPTED
        }
    }
}
