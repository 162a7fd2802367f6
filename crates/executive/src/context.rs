//! The context of one event: shared by all parts of the executive while it is handled.

use crate::plan::Plan;
use crate::protocol::{Command, Note};
use crate::signals::Signals;
use ratn_model::fact::Change;
use ratn_model::id::InstanceId;
use ratn_model::measurement::Evidence;
use ratn_model::program::Program;
use ratn_model::time::Timestamp;
use ratn_world::world::World;
use serde::{Deserialize, Serialize};

/// The state that every part of the executive works with.
pub(crate) struct Context<'a> {
    pub(crate) program: &'a Program,
    /// The static plan: what follows from the program alone.
    pub(crate) plan: &'a Plan,
    pub(crate) root: &'a mut World,
    pub(crate) now: Timestamp,
    /// The last instance id given.
    pub(crate) last_instance: &'a mut u64,
    /// The run's seed.
    pub(crate) seed: u64,
    /// The signals that no wait has taken.
    pub(crate) signals: &'a mut Signals,
    /// Commands for the shell.
    pub(crate) commands: &'a mut Vec<Command>,
}

impl Context<'_> {
    pub(crate) fn new_instance(&mut self) -> InstanceId {
        *self.last_instance += 1;
        InstanceId(*self.last_instance)
    }

    pub(crate) fn note(&mut self, note: Note) {
        self.commands.push(Command::Note(note));
    }

    /// Checks changes against the task's ontology; without an ontology every change is allowed.
    pub(crate) fn allows(&self, world: &World, made: &Made) -> Result<(), String> {
        let Some(ontology) = &self.program.ontology else { return Ok(()) };
        world.admits(ontology, &made.changes).map_err(|violation| violation.to_string())?;
        for change in &made.changes {
            if let Change::Set { fact, value } = change
                && let Some((_, measured)) = made.evidence.iter().find(|(of, _)| of == fact)
            {
                ontology.check_measurement(fact, value, measured).map_err(|violation| violation.to_string())?;
            }
        }
        Ok(())
    }

    /// Commits changes: at once in the mirror, by a command in the world pool. `writer` is the path of their writer.
    pub(crate) fn commit(&mut self, instance: InstanceId, writer: String, made: Made) -> Result<(), String> {
        if made.changes.is_empty() {
            return Ok(());
        }
        self.allows(self.root, &made)?;
        let Made { changes, mut evidence } = made;
        let revision = self.root.apply(&changes).map_err(|e| e.to_string())?;
        // No evidence for facts that were deleted after they were measured, or that were not declared.
        evidence.retain(|(fact, _)| self.root.fact(fact).is_some_and(|fact| fact.revision == revision));
        self.commands.push(Command::Commit { instance, writer, changes, evidence, revision });
        Ok(())
    }
}

/// The changes made by a node, and their evidence.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct Made {
    pub(crate) changes: Vec<Change>,
    pub(crate) evidence: Evidence,
}

impl From<Vec<Change>> for Made {
    fn from(changes: Vec<Change>) -> Made {
        Made { changes, evidence: Evidence::new() }
    }
}

/// Limit of visits without an action; beyond it the run ends, because the task goes in circles. Each thread of control has its own
/// count: one per state entered and one per iteration begun. The count returns to 0 when the goal of an action starts, and where a
/// routine begins and ends.
pub(crate) const MAX_IDLE_VISITS: u32 = 100_000;

/// Reason with which a run ends that goes in circles; `path` is the path of its innermost list.
pub(crate) fn in_circles(path: &str) -> String {
    let place = if path.is_empty() { String::new() } else { format!("{path}: ") };
    format!("{place}the task goes in circles without doing anything; does what its loop looks at ever change?")
}
