//! The world of a run from its log: the facts of the root with their writers, the latest changes, and how projections differ from the root.
//! Pure: it takes lines.
//!
//! It is not the state of the world pool: changes from outside are in the log only when the run has heard of them.

use crate::wire;
use ratn_executive::protocol::{Command, Event, LogEntry, LogLine};
use ratn_model::fact::{Change, FactKey};
use ratn_model::id::{InstanceId, Revision};
use ratn_model::value::Value;
use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;

/// Maximum number of changes kept.
const MOST_HISTORY: usize = 2_000;
/// Maximum number of facts, changes and projected changes sent at once.
const MOST_TOLD: usize = 1_000;
/// Maximum length of a value; a longer one is truncated.
const MOST_CHARACTERS: usize = 240;
/// The writers of facts that existed when the run began, and of changes from outside.
const AT_THE_START: &str = "before the run";
const OUTSIDE: &str = "somebody else";

/// The facts and their writers.
#[derive(Debug, Default)]
pub(crate) struct World {
    revision: Revision,
    facts: BTreeMap<FactKey, Known>,
    history: VecDeque<wire::Written>,
    projections: BTreeMap<InstanceId, Projection>,
}

#[derive(Debug)]
struct Known {
    value: Value,
    writer: Arc<str>,
    at_s: f64,
    revision: Revision,
}

#[derive(Debug)]
struct Projection {
    base: Revision,
    changes: Vec<Change>,
    writers: Vec<Arc<str>>,
}

/// A writer, and when its changes become real.
struct Writing {
    writer: Arc<str>,
    at_s: f64,
    revision: Revision,
}

impl World {
    /// Applies the next line.
    pub(crate) fn apply(&mut self, line: &LogLine) {
        let at_s = line.at.seconds();
        match &line.entry {
            LogEntry::Event(Event::Started { world, revision, .. }) => {
                self.revision = *revision;
                let known = |value: &Value| Known {
                    value: value.clone(),
                    writer: AT_THE_START.into(),
                    at_s,
                    revision: *revision,
                };
                self.facts = world.iter().map(|(key, value)| (key.clone(), known(value))).collect();
            }
            LogEntry::Event(Event::WorldChanged { revision, facts }) => {
                let writing = Writing { writer: OUTSIDE.into(), at_s, revision: *revision };
                self.revision = *revision;
                for (key, value) in facts {
                    self.write(key, value.clone(), &writing);
                }
            }
            LogEntry::Command(Command::Commit { writer, changes, revision, .. }) => {
                let writing = Writing { writer: writer.as_str().into(), at_s, revision: *revision };
                self.revision = *revision;
                for change in changes {
                    self.change(change, &writing);
                }
            }
            LogEntry::Command(Command::Project { instance, base, changes, writers, .. }) => {
                let projection = Projection { base: *base, changes: changes.clone(), writers: writers.clone() };
                self.projections.insert(*instance, projection);
            }
            LogEntry::Command(Command::Release { instance, projection: Some(_), .. }) => {
                self.projections.remove(instance);
            }
            _ => {}
        }
    }

    /// The world in the pages' notation: the facts whose key, value or writer contains `filter`.
    pub(crate) fn told(&self, filter: &str, path: impl Fn(InstanceId) -> String) -> wire::World {
        let filter = filter.to_lowercase();
        let all = self.facts.iter().map(|(key, known)| wire::Fact {
            key: key.to_string(),
            value: shown(&known.value),
            writer: known.writer.to_string(),
            at_s: known.at_s,
            revision: known.revision.0,
        });
        let fits = |text: &str| text.to_lowercase().contains(&filter);
        let mut facts: Vec<wire::Fact> = all
            .filter(|fact| filter.is_empty() || fits(&fact.key) || fits(&fact.value) || fits(&fact.writer))
            .collect();
        let fitting = facts.len();
        facts.truncate(MOST_TOLD);
        let history = self.history.iter().rev();
        let history = history.filter(|one| filter.is_empty() || fits(&one.key) || fits(&one.writer));
        let projections = self.projections.iter().map(|(id, projection)| self.projection(*id, path(*id), projection));
        wire::World {
            revision: self.revision.0,
            facts,
            fitting,
            all: self.facts.len(),
            history: history.take(MOST_TOLD).cloned().collect(),
            projections: projections.take(MOST_TOLD).collect(),
            ..wire::World::default()
        }
    }

    fn projection(&self, id: InstanceId, path: String, projection: &Projection) -> wire::Projection {
        let changes = projection.changes.iter().enumerate().take(MOST_TOLD).map(|(index, change)| {
            let (key, root, becomes) = match change {
                Change::Set { fact, value } => (fact.to_string(), self.facts.get(fact), shown(value)),
                Change::Increase { fact, by } => (fact.to_string(), self.facts.get(fact), format!("{by:+}")),
                Change::Delete { pattern } => {
                    let key = pattern.to_string();
                    let one = self.facts.iter().find(|(key, _)| pattern.matches(key)).map(|(_, known)| known);
                    (key, one, "gone".to_owned())
                }
            };
            wire::Projected {
                key,
                root: root.map(|known| shown(&known.value)),
                change: becomes,
                writer: projection.writers.get(index).map(|writer| writer.to_string()).unwrap_or_default(),
            }
        });
        wire::Projection { instance: id.0, path, base: projection.base.0, changes: changes.collect() }
    }

    fn change(&mut self, change: &Change, writing: &Writing) {
        match change {
            Change::Set { fact, value } => self.write(fact, Some(value.clone()), writing),
            Change::Increase { fact, by } => {
                let value = match self.facts.get(fact).map(|known| &known.value) {
                    Some(Value::Int(before)) if by.fract() == 0.0 => Value::Int(before.saturating_add(*by as i64)),
                    Some(Value::Int(before)) => Value::Float(*before as f64 + by),
                    Some(Value::Float(before)) => Value::Float(before + by),
                    _ => Value::Float(*by),
                };
                self.write(fact, Some(value), writing);
            }
            Change::Delete { pattern } => {
                let keys: Vec<FactKey> = self.facts.keys().filter(|key| pattern.matches(key)).cloned().collect();
                for key in keys {
                    self.write(&key, None, writing);
                }
            }
        }
    }

    fn write(&mut self, key: &FactKey, value: Option<Value>, writing: &Writing) {
        let Writing { writer, at_s, revision } = writing;
        let after = value.as_ref().map(shown);
        let before = match value {
            Some(value) => {
                let known = Known { value, writer: writer.clone(), at_s: *at_s, revision: *revision };
                self.facts.insert(key.clone(), known)
            }
            None => self.facts.remove(key),
        };
        if self.history.len() == MOST_HISTORY {
            self.history.pop_front();
        }
        self.history.push_back(wire::Written {
            at_s: *at_s,
            revision: revision.0,
            writer: writer.to_string(),
            key: key.to_string(),
            before: before.map(|known| shown(&known.value)),
            after,
        });
    }
}

/// A value as a text that fits into a table.
fn shown(value: &Value) -> String {
    let text = value.to_string();
    match text.char_indices().nth(MOST_CHARACTERS) {
        Some((end, _)) => format!("{}…", &text[..end]),
        None => text,
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;

    const LOG: &str = r#"
{"at":0,"event":"started","task":"t","digest":"d","mode":"cdtn","parameters":{},"seed":1,"world":[[{"predicate":"count","arguments":[]},{"int":1}],[{"predicate":"at","arguments":["box"]},{"string":"table"}]],"revision":3}
{"at":1000000000,"command":"project","instance":5,"attempt":1,"base":3,"changes":[{"set":{"fact":{"predicate":"at","arguments":["box"]},"value":{"string":"base"}}}],"writers":["move[1]"],"reads":"everything","lease":null}
{"at":2000000000,"command":"commit","instance":1,"writer":"move[1]","changes":[{"set":{"fact":{"predicate":"at","arguments":["box"]},"value":{"string":"base"}}},{"increase":{"fact":{"predicate":"count","arguments":[]},"by":2.0}}],"revision":4}
{"at":3000000000,"event":"world_changed","revision":5,"facts":[[{"predicate":"at","arguments":["box"]},null],[{"predicate":"door","arguments":[]},{"string":"open"}]]}
"#;

    fn after(lines: usize) -> wire::World {
        let mut world = World::default();
        for line in LOG.trim().lines().take(lines) {
            world.apply(&serde_json::from_str(line).unwrap());
        }
        world.told("", |id| format!("instance {}", id.0))
    }

    fn facts(world: &wire::World) -> Vec<String> {
        world.facts.iter().map(|one| format!("{} = {} by {}", one.key, one.value, one.writer)).collect()
    }

    #[test]
    fn every_fact_says_who_wrote_it() {
        assert_eq!(facts(&after(1)), ["at(box) = table by before the run", "count() = 1 by before the run"]);
        assert_eq!(facts(&after(3)), ["at(box) = base by move[1]", "count() = 3 by move[1]"]);
        assert_eq!(facts(&after(4)), ["count() = 3 by move[1]", "door() = open by somebody else"]);
    }

    #[test]
    fn a_projection_stands_against_the_root_and_the_history_is_told_backwards() {
        let world = after(2);
        let projected = &world.projections[0].changes[0];
        let told = (projected.key.as_str(), projected.root.as_deref(), projected.change.as_str());
        assert_eq!(told, ("at(box)", Some("table"), "base"));
        let world = after(4);
        let history: Vec<_> =
            world.history.iter().map(|one| (one.revision, one.key.as_str(), one.after.clone())).collect();
        assert_eq!(history[0], (5, "door()", Some("open".to_owned())));
        assert_eq!(history[1], (5, "at(box)", None));
        assert_eq!((world.revision, world.all, world.fitting), (5, 2, 2));
    }

    #[test]
    fn a_filter_chooses_by_key_value_and_writer() {
        let mut world = World::default();
        LOG.trim().lines().for_each(|line| world.apply(&serde_json::from_str(line).unwrap()));
        assert_eq!(facts(&world.told("MOVE", |_| String::new())), ["count() = 3 by move[1]"]);
        assert_eq!(world.told("nothing", |_| String::new()).fitting, 0);
    }
}
