//! Moments at which something happens by itself: a try after its pause, a goal that takes too long, the end of the task's time.

use super::Window;
use super::instance::{Ended, Status};
use crate::context::Context;
use crate::protocol::Command;
use ratn_model::id::InstanceId;
use ratn_model::program::ABORTED;
use ratn_model::time::Timestamp;
use std::time::Duration;

/// What happens.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Timer {
    /// The pause before the next try is over.
    Retry(InstanceId),
    /// The goal of this attempt has had its time.
    Timeout(InstanceId, u32),
    /// The task has had its time.
    Deadline,
}

impl Window {
    /// Something happens so many seconds from now.
    pub(super) fn set_timer(&mut self, context: &mut Context<'_>, after_s: f64, timer: Timer) {
        let after = Duration::try_from_secs_f64(after_s.max(0.0)).unwrap_or(Duration::MAX);
        let at: Timestamp = context.now + after;
        self.timers.insert((at, timer));
        context.commands.push(Command::Wake { at });
    }

    /// What is due happens.
    pub(super) fn fire(&mut self, context: &mut Context<'_>) {
        while let Some((at, timer)) = self.timers.first().copied()
            && at <= context.now
        {
            self.timers.pop_first();
            match timer {
                Timer::Retry(id) => self.enqueue(id),
                Timer::Timeout(id, attempt) => {
                    let Some(instance) = self.instances.get_mut(id) else { continue };
                    if instance.attempt != attempt || instance.status != Status::Running {
                        continue;
                    }
                    let limit = context.program.state(instance.state).annotations.timeout_s.unwrap_or_default();
                    context.commands.push(Command::Cancel { instance: id, attempt });
                    self.goal_ended(context, id, Ended::aborted(format!("it took longer than {limit} s")));
                }
                Timer::Deadline => {
                    let limit = context.program.deadline_s.unwrap_or_default();
                    self.stop(context, ABORTED, format!("the task took longer than its deadline of {limit} s"));
                }
            }
        }
    }
}
