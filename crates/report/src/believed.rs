//! The world as a run believes it, from its log, and the scene that follows from it: the shapes of objects in their places, and where the
//! base stands.

use ratn_executive::protocol::{Command, Event, LogEntry, LogLine};
use ratn_world::scene::Scene;
use ratn_world::world::World;

/// The root world of a run.
#[derive(Debug, Default)]
pub struct Believed {
    world: World,
}

impl Believed {
    /// Whether a line says something of the root world.
    pub fn follow(&mut self, line: &LogLine) -> bool {
        match &line.entry {
            LogEntry::Event(Event::Started { world, .. }) => {
                self.world.overwrite(world.iter().map(|(fact, value)| (fact.clone(), Some(value.clone()))));
                !world.is_empty()
            }
            LogEntry::Event(Event::WorldChanged { facts, .. }) => {
                self.world.overwrite(facts.iter().cloned());
                true
            }
            // The run has made the same changes. What does not fit here is left out, and what is known is shown.
            LogEntry::Command(Command::Commit { changes, .. }) => self.world.apply(changes).is_ok(),
            _ => false,
        }
    }

    /// The scene; none where a fact has a form from which none can be made.
    pub fn scene(&self) -> Option<Scene> {
        Scene::of(&self.world).ok()
    }
}
