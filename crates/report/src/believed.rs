//! The world as believed by a run, from its log, and the scene that follows from it: shapes and poses of objects, and the pose of the base.

use ratn_executive::protocol::{Command, Event, LogEntry, LogLine};
use ratn_world::scene::Scene;
use ratn_world::world::World;

/// The root world of a run.
#[derive(Debug, Default)]
pub struct Believed {
    world: World,
}

impl Believed {
    /// Applies a line; returns whether it changed the root world.
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
            // The run has made the same changes. A change that does not fit is ignored, and the world stays as known.
            LogEntry::Command(Command::Commit { changes, .. }) => self.world.apply(changes).is_ok(),
            _ => false,
        }
    }

    /// The scene; `None` if a fact has a form that yields no scene.
    pub fn scene(&self) -> Option<Scene> {
        Scene::of(&self.world).ok()
    }
}
