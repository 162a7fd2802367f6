//! Ending what is under way: all of it when the run ends, a region when another one was first.

use super::{Interpreter, Phase, Todo};
use crate::binding::Outputs;
use crate::context::Context;
use crate::protocol::{Command, Note};
use ratn_model::id::StateId;
use ratn_model::program::PREEMPTED;

impl Interpreter {
    /// Ends everything under way. What a motion says of being cut short is true; what composite states do at their ends is left undone.
    pub(crate) fn abort(&mut self, context: &mut Context<'_>) {
        let all: Vec<u64> = self.threads.keys().copied().collect();
        for thread in all {
            // The run ends anyway.
            let _ = self.cancel(context, thread);
            self.set(thread, Todo::Done { outcome: PREEMPTED.to_owned(), reason: String::new() });
        }
        self.give_up_routines(context);
    }

    /// Another region was first: what this one has under way is cancelled and ends `preempted`, then the composite states in which it is, the
    /// innermost first.
    ///
    /// # Errors
    /// Why an effect that they declare for that could not be made.
    pub(super) fn preempt(&mut self, context: &mut Context<'_>, id: u64) -> Result<(), String> {
        let mut result = self.cancel(context, id);
        let Some(thread) = self.threads.get_mut(&id) else { return result };
        let todo = std::mem::replace(&mut thread.todo, Todo::Busy);
        if let Todo::Join { state, path, regions } = todo {
            for region in &regions {
                result = result.and(self.preempt(context, *region));
            }
            self.merge_variables(id, &regions);
            for region in &regions {
                self.threads.remove(region);
            }
            result = result.and(self.leave_preempted(context, id, state, &path));
        }
        // The outermost frame is that of the concurrency itself.
        while let Some(thread) = self.threads.get_mut(&id).filter(|thread| thread.frames.len() > 1)
            && let Some(frame) = thread.frames.pop()
        {
            result = result.and(self.leave_preempted(context, id, frame.owner, &frame.path));
            if let Some(thread) = self.threads.get_mut(&id) {
                thread.variables.truncate(frame.variables);
            }
        }
        result
    }

    fn leave_preempted(
        &mut self,
        context: &mut Context<'_>,
        thread: u64,
        state: StateId,
        path: &str,
    ) -> Result<(), String> {
        let state = context.program.state(state);
        let changed = self.change(context, thread, state, path, PREEMPTED, &Outputs::new());
        changed.map_err(|problem| format!("{path}: {problem}"))
    }

    /// Ends the action that a thread has under way. What that did to the world is said as for any end.
    fn cancel(&mut self, context: &mut Context<'_>, id: u64) -> Result<(), String> {
        let Some(current) = self.threads.get_mut(&id).and_then(|thread| thread.current.take()) else { return Ok(()) };
        let has_begun = current.phase == Phase::Running && !context.program.state(current.state).is_pause();
        let mut result = Ok(());
        match current.phase {
            Phase::Held | Phase::Stalled | Phase::Backoff(_) => {}
            Phase::Running if !has_begun => {}
            Phase::Acquiring => context.commands.push(Command::Withdraw { instance: current.instance }),
            Phase::Projecting | Phase::Running => {
                context.commands.push(Command::Cancel { instance: current.instance, attempt: current.attempt });
                if has_begun {
                    result = self.leave_preempted(context, id, current.state, &current.path);
                }
            }
        }
        self.give_back(context, &current);
        context.note(Note::Squashed { instance: current.instance });
        result
    }
}
