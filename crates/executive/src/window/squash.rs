//! What is discarded: the arms that are not taken, and everything behind an outcome that was not computed ahead.

use super::cursor::{Cursor, Todo};
use super::instance::{Line, Role, Status};
use super::{Window, give_back};
use crate::context::Context;
use crate::protocol::{Command, Note};
use ratn_model::id::InstanceId;
use smallvec::smallvec;
use std::collections::BTreeSet;

impl Window {
    /// A decision is made: the other arms are discarded.
    pub(super) fn take_arm(&mut self, context: &mut Context<'_>, id: InstanceId, taken: usize) {
        let Some(instance) = self.instances.get_mut(id) else { return };
        if instance.arms.len() <= taken {
            return;
        }
        let mut arms = std::mem::take(&mut instance.arms);
        let kept = arms.swap_remove(taken);
        let (kept_segment, kept_arm) = (kept.segment, kept.clone());
        instance.arms = smallvec![kept];
        let lost: Vec<InstanceId> = arms.iter().filter_map(|arm| arm.next).collect();
        let lost_segments: BTreeSet<u64> = arms.iter().map(|arm| arm.segment).collect();
        self.discard(context, lost, lost_segments, BTreeSet::new());
        for cursor in &mut self.cursors {
            if let Some((tail, arm)) = &mut cursor.tail
                && *tail == id
            {
                debug_assert_eq!(cursor.segment, kept_arm.segment, "only the arm taken is left");
                *arm = 0;
            }
        }
        // What was speculative on the way to this decision is not any more.
        if let Some(branch) = self.branches.remove(&kept_segment) {
            for member in branch.members {
                self.became_certain(context, member);
            }
        }
    }

    /// Everything behind an instance is discarded.
    pub(super) fn squash_behind(&mut self, context: &mut Context<'_>, id: InstanceId) {
        let Some(instance) = self.instances.get_mut(id) else { return };
        let arms = std::mem::take(&mut instance.arms);
        let (own, line, position, detached) = (instance.segment, instance.line, instance.position, instance.detached);
        let segments = arms.iter().map(|arm| arm.segment).filter(|segment| *segment != own).collect();
        let mut next: Vec<InstanceId> = arms.iter().filter_map(|arm| arm.next).collect();
        let mut regions = BTreeSet::new();
        self.cursors.retain(|cursor| cursor.tail.is_none_or(|(tail, _)| tail != id) && cursor.todo != Todo::Await(id));
        if detached {
            // Its line went on without it: what has not retired is behind it.
            regions = self.stop_line(line, &mut next);
            let beside = self.detached.iter().filter_map(|id| self.instances.get(*id));
            let behind = beside
                .filter(|other| regions.contains(&other.line) || (other.line == line && other.position > position));
            next.extend(behind.map(|other| other.id));
            self.cursors.retain(|cursor| cursor.line != line);
        }
        self.discard(context, next, segments, regions);
    }

    /// Adds to `heads` what a line has come to, also in the regions that it waits for, and waits for them no more: their lines.
    fn stop_line(&mut self, line: Line, heads: &mut Vec<InstanceId>) -> BTreeSet<Line> {
        let mut regions = BTreeSet::new();
        let mut open = vec![line];
        while let Some(line) = open.pop() {
            if let Some(thread) = self.threads.get_mut(&line) {
                heads.extend(thread.head);
                thread.open_regions = 0;
            }
            let instances = &self.instances;
            for (_, fork) in self.forks.extract_if(.., |id, fork| fork.line == line && instances.get(*id).is_none()) {
                heads.extend(fork.join);
                regions.extend(&fork.regions);
                open.extend(fork.regions);
            }
        }
        regions
    }

    /// Discards instances, what is behind them, segments with their cursors, and lines.
    fn discard(
        &mut self,
        context: &mut Context<'_>,
        from: Vec<InstanceId>,
        mut segments: BTreeSet<u64>,
        mut lines: BTreeSet<Line>,
    ) {
        let mut open = from;
        let mut squashed: BTreeSet<InstanceId> = BTreeSet::new();
        let mut reopened: Vec<Cursor> = Vec::new();
        loop {
            while let Some(id) = open.pop() {
                let Some(instance) = self.instances.get(id) else { continue };
                if !squashed.insert(id) {
                    continue;
                }
                for arm in &instance.arms {
                    open.extend(arm.next);
                    if arm.segment != instance.segment {
                        segments.insert(arm.segment);
                    }
                }
                match instance.role {
                    Role::Fork => {
                        if let Some(fork) = self.forks.remove(&id) {
                            lines.extend(&fork.regions);
                            open.extend(fork.join);
                        }
                    }
                    Role::RegionEnd => {
                        let line = instance.line;
                        let fork = self.threads.get(&line).and_then(|thread| thread.fork);
                        if let Some(fork) = fork.and_then(|fork| self.forks.get_mut(&fork)) {
                            fork.ends.iter_mut().for_each(|ends| ends.retain(|exit| exit.end != id));
                            if let Some(join) = fork.join.take() {
                                open.push(join);
                                reopened.push(fork.waiting.clone());
                            }
                        }
                    }
                    _ => {}
                }
            }
            // Segments below a lost one are lost, and so is what stands on them.
            let below: Vec<u64> = self
                .branches
                .iter()
                .filter(|(segment, branch)| {
                    !segments.contains(segment)
                        && (segments.contains(&branch.parent) || squashed.contains(&branch.decision))
                })
                .map(|(segment, _)| *segment)
                .collect();
            segments.extend(&below);
            if below.is_empty() {
                break;
            }
        }
        for segment in &segments {
            self.branches.remove(segment);
        }
        self.cursors.retain(|cursor| {
            let gone = |id: InstanceId| squashed.contains(&id);
            !(segments.contains(&cursor.segment)
                || lines.contains(&cursor.line)
                || cursor.tail.is_some_and(|(tail, _)| gone(tail))
                || matches!(cursor.todo, Todo::Await(id) if gone(id)))
        });
        for line in lines {
            self.threads.remove(&line);
        }
        for cursor in reopened {
            if self.threads.contains_key(&cursor.line) {
                self.next_order += 1;
                self.cursors.push(Cursor { order: self.next_order, ..cursor });
            }
        }
        for id in squashed {
            self.squash(context, id);
        }
    }

    fn squash(&mut self, context: &mut Context<'_>, id: InstanceId) {
        let Some(instance) = self.instances.get(id) else { return };
        if instance.is_pia() && !self.is_ending {
            match instance.status {
                // A motion beside a failed one: it ends as it ends, and what it does stands.
                Status::Running => return self.orphan(id),
                Status::Finished if instance.has_acted => return self.retire_orphan(context, id),
                _ => {}
            }
        }
        self.remember(context, id);
        self.stop_instance(context, id);
        self.wake_waiters(id);
        self.detached.remove(&id);
        self.joins.remove(&id);
        self.leave_head(id);
        let Some(instance) = self.instances.remove(id) else { return };
        if instance.role == Role::Node {
            context.note(Note::Squashed { instance: id });
        }
    }

    fn orphan(&mut self, id: InstanceId) {
        let Some(instance) = self.instances.get_mut(id) else { return };
        instance.detached = true;
        instance.arms.clear();
        instance.users.clear();
        self.detached.insert(id);
        self.leave_head(id);
    }

    /// It is not the oldest of its line any more, if it was.
    pub(super) fn leave_head(&mut self, id: InstanceId) {
        let line = self.instances.get(id).map(|instance| instance.line);
        if let Some(thread) = line.and_then(|line| self.threads.get_mut(&line))
            && thread.head == Some(id)
        {
            thread.head = None;
        }
    }

    /// Discards everything that is in the window: the run ends.
    pub(super) fn stop(&mut self, context: &mut Context<'_>, outcome: &str, reason: String) {
        self.is_ending = true;
        let all: Vec<InstanceId> = self.instances.iter().map(|instance| instance.id).collect();
        for id in all.into_iter().rev() {
            self.squash(context, id);
        }
        self.cursors.clear();
        self.end = Some(super::End { outcome: outcome.to_owned(), outputs: Default::default(), reason });
    }

    /// Takes back what was asked for an instance; it holds nothing afterwards.
    pub(super) fn stop_instance(&mut self, context: &mut Context<'_>, id: InstanceId) {
        let Some(instance) = self.instances.get_mut(id) else { return };
        match instance.status {
            Status::Acquiring => context.commands.push(Command::Withdraw { instance: id }),
            Status::Projecting => {
                context.commands.push(Command::Cancel { instance: id, attempt: instance.attempt });
            }
            Status::Running => match instance.routine.take() {
                Some(mut routine) => {
                    routine.abort(context);
                    instance.lease = routine.lease().cloned().map(Box::new);
                }
                None => context.commands.push(Command::Cancel { instance: id, attempt: instance.attempt }),
            },
            Status::Expanded | Status::Granted | Status::Finished => {}
        }
        give_back(context, instance);
        self.is_idle(id);
    }
}
