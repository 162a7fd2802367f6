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

/// What every part of the executive works with.
pub(crate) struct Context<'a> {
    pub(crate) program: &'a Program,
    /// What follows from the program alone.
    pub(crate) plan: &'a Plan,
    /// The mirror of the root world model.
    pub(crate) root: &'a mut World,
    /// The moment of the event.
    pub(crate) now: Timestamp,
    /// The last instance id given.
    pub(crate) last_instance: &'a mut u64,
    /// The run's seed.
    pub(crate) seed: u64,
    /// The signals that no wait has taken.
    pub(crate) signals: &'a mut Signals,
    /// What the shell shall do.
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

    /// Whether the task's ontology allows a world to change so; a task without one allows everything.
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

    /// Makes changes real: in the mirror now, in the world pool by command. `writer` is the path of who makes them.
    pub(crate) fn commit(&mut self, instance: InstanceId, writer: String, made: Made) -> Result<(), String> {
        if made.changes.is_empty() {
            return Ok(());
        }
        self.allows(self.root, &made)?;
        let Made { changes, mut evidence } = made;
        let revision = self.root.apply(&changes).map_err(|e| e.to_string())?;
        // What is measured and then deleted, or was not declared, is not written.
        evidence.retain(|(fact, _)| self.root.fact(fact).is_some_and(|fact| fact.revision == revision));
        self.commands.push(Command::Commit { instance, writer, changes, evidence, revision });
        Ok(())
    }
}

/// What a node has changed, and what measured which of it.
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

/// More visits than this without an action between them, and the task goes in circles. Each thread of control counts its own: one per
/// state that is entered and one per iteration that begins. The count is 0 again when the goal of an action is started, and where a
/// routine begins and ends.
pub(crate) const MAX_IDLE_VISITS: u32 = 100_000;

/// Why a run ends that goes on without an action: `path` is that of the innermost list it is in.
pub(crate) fn in_circles(path: &str) -> String {
    let place = if path.is_empty() { String::new() } else { format!("{path}: ") };
    format!("{place}the task goes in circles without doing anything; does what its loop looks at ever change?")
}
