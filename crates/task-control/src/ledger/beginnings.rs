//! The beginnings of what a run commits: up to which revision it knew the changes by others then, and whether it has lost its leases since. A pure
//! fold, over the log (in the ledger), and over the commands of a resumed run.
//!
//! ```text
//! an action           counts from when it was granted what it holds, or its last goal was given
//! a routine           from when it began: what it holds it holds to its end
//! another composite   from when the first of its parts began; where what that held is lost, from when the first one began since, as soon as
//!                     that is real: one that is only expected changes nothing
//! anything else       from now: it holds nothing
//! ```
//!
//! Only composite states that change the world at their exit are followed. The log names no instances of them, except for routines: they are
//! identified by their paths, as in their commits. A routine inside of a routine is part of it, and counts as any other composite state.

use ratn_event_log::without_visits;
use ratn_executive::protocol::{Command, Event, Note};
use ratn_model::id::{InstanceId, LeaseId, Revision};
use ratn_model::program::WORLD_MODEL;
use ratn_model::resource::{Lease, Quantity};
use ratn_proto::types::{Holding, Resource};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// Maximum number of composite states that are followed. Beyond it, of those with nothing under way, the one that began first is forgotten. A state
/// that is left by an outcome without declared effects stays until then, and so does one that was only expected.
const MOST_ENTERED: usize = 1024;

/// The beginning of an action, a routine or another composite state.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Began {
    /// The root revision that the run had heard of then.
    pub(crate) knows: Revision,
    /// The revision up to which it held its leases, if the run has lost them since; if it has not, nobody else changes what it changes.
    pub(crate) held_until: Option<Revision>,
}

impl Began {
    /// The revision after which others' changes count, if they do. The run knew the changes that it had heard of; and changes made while it held its
    /// leases were not made with its resources.
    pub(crate) fn others_count(&self) -> Option<Revision> {
        self.held_until.map(|held| held.max(self.knows))
    }

    /// Whether it began after a loss that affects the other one.
    fn is_since(&self, other: &Began) -> bool {
        other.held_until.is_some_and(|lost| self.held_until.is_none_or(|own| own > lost))
    }
}

/// A composite state that has begun and has not been left.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct Entered {
    began: Began,
    /// Its instance, if it is a routine.
    routine: Option<InstanceId>,
    /// Its parts that have begun and not ended, with their beginnings.
    parts: BTreeMap<InstanceId, Began>,
    /// Whether the result of a part is real. Until one is, the state may only be expected.
    is_real: bool,
}

impl Entered {
    /// Whether everything that had begun in it was discarded. Then it was only expected, unless its commit follows: its first part was cut short then.
    fn is_discarded(&self) -> bool {
        self.parts.is_empty() && !self.is_real && self.routine.is_none()
    }

    /// The result of a part is real.
    fn part_is_real(&mut self, part: Began) {
        let is_earlier = || part.held_until == self.began.held_until && part.knows < self.began.knows;
        if self.routine.is_none() && (part.is_since(&self.began) || is_earlier()) {
            self.began = part;
        }
        self.is_real = true;
    }

    /// Whether the routine itself, or a part, is under way.
    fn is_open(&self) -> bool {
        !self.parts.is_empty() || self.routine.is_some()
    }
}

/// The followed composite states around an instance.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct Inside {
    /// Their paths, innermost first.
    states: Vec<String>,
    /// Whether the first of them is the instance's own state: a routine.
    is_routine: bool,
}

/// What guards the facts that a goal changes: the lease under which it was given, and the resources of that, room for a projection left out.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct Guard {
    pub(crate) lease: LeaseId,
    pub(crate) resources: Vec<String>,
}

impl Guard {
    fn of(lease: &Lease) -> Guard {
        let guards = lease.resources.iter().filter(|resource| resource.kind != WORLD_MODEL);
        Guard { lease: lease.id, resources: guards.map(|resource| resource.id.clone()).collect() }
    }

    /// Whether others than this session have a resource of the guard now, and have got it since.
    pub(crate) fn is_taken(&self, resource: &Resource, session: &str) -> bool {
        let since = |holding: &Holding| holding.session != session && holding.lease > self.lease;
        let is_used_up = resource.free == Quantity::default();
        is_used_up && self.resources.contains(&resource.id) && resource.holdings.iter().any(since)
    }
}

/// Everything that has begun and has not ended.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct Beginnings {
    /// Paths (without visits) of the composite states that change the world when they are left.
    composites: Vec<String>,
    instances: BTreeMap<InstanceId, Began>,
    /// Of those that have given a goal.
    #[serde(default)]
    guards: BTreeMap<InstanceId, Guard>,
    /// By path.
    entered: BTreeMap<String, Entered>,
    /// The instances in followed states.
    inside: BTreeMap<InstanceId, Inside>,
}

impl Beginnings {
    /// Follows an event of a run that has heard of this revision.
    pub(crate) fn event(&mut self, event: &Event, knows: Revision) {
        match event {
            Event::Started { origin, .. } => self.composites.clone_from(&origin.natures.changes_at_exit),
            Event::Granted { instance, .. } => self.begins(*instance, knows),
            Event::SessionLost { held_until } => self.lose(*held_until),
            _ => {}
        }
    }

    /// Follows a command of a run that has heard of this revision. The beginning of a commit, [`Beginnings::of`], has to be read before.
    pub(crate) fn command(&mut self, command: &Command, knows: Revision) {
        match command {
            Command::Start { instance, goal, .. } => {
                self.begins(*instance, knows);
                self.guards.extend(goal.lease.iter().map(|lease| (*instance, Guard::of(lease))));
            }
            Command::Commit { writer, .. } => drop(self.entered.remove(writer)),
            Command::Note(Note::Expanded { instance, path, .. }) => {
                let inside = self.inside_of(path);
                if !inside.states.is_empty() {
                    self.inside.insert(*instance, inside);
                }
            }
            Command::Note(Note::Running { instance, .. }) => self.routine_begins(*instance, knows),
            Command::Note(Note::Retired { instance }) => self.ends(*instance, true),
            Command::Note(Note::Squashed { instance } | Note::Merged { instance }) => self.ends(*instance, false),
            _ => {}
        }
    }

    /// The beginning of what a commit is based on; `None` if no beginning is known.
    pub(crate) fn of(&self, instance: InstanceId, writer: &str) -> Option<Began> {
        let composite = self.entered.get(writer).map(|entered| entered.began);
        composite.or_else(|| self.instances.get(&instance).copied())
    }

    /// What guards what an instance changes.
    pub(crate) fn guard(&self, instance: InstanceId) -> Option<&Guard> {
        self.guards.get(&instance)
    }

    /// The earliest revision after which others' changes count for anything under way that has lost its leases.
    pub(crate) fn others_count(&self) -> Option<Revision> {
        let composites = self.entered.values().map(|entered| &entered.began);
        self.instances.values().chain(composites).filter_map(Began::others_count).min()
    }

    /// Whether nothing is under way.
    #[cfg(test)]
    pub(crate) fn is_empty(&self) -> bool {
        self.instances.is_empty() && self.guards.is_empty() && self.entered.is_empty() && self.inside.is_empty()
    }

    /// The instance works from now on with what the run holds.
    fn begins(&mut self, instance: InstanceId, knows: Revision) {
        let began = Began { knows, held_until: None };
        self.instances.insert(instance, began);
        self.enters(instance, 0, began);
    }

    /// An instance begins a routine: the routine is based on what the run knows now, whatever its parts begin with.
    fn routine_begins(&mut self, instance: InstanceId, knows: Revision) {
        let Some(inside) = self.inside.get(&instance).filter(|inside| inside.is_routine) else { return };
        let began = Began { knows, held_until: None };
        let routine = Entered { began, routine: Some(instance), parts: BTreeMap::new(), is_real: false };
        self.entered.insert(inside.states[0].clone(), routine);
        self.enters(instance, 1, began);
    }

    /// An instance begins, and so do the states around it, without the `from` innermost ones.
    fn enters(&mut self, instance: InstanceId, from: usize, began: Began) {
        let Some(inside) = self.inside.get(&instance) else { return };
        for path in inside.states.iter().skip(from) {
            let new = || Entered { began, routine: None, parts: BTreeMap::new(), is_real: false };
            let entered = self.entered.entry(path.clone()).or_insert_with(new);
            if entered.is_discarded() {
                entered.began = began;
            }
            entered.parts.insert(instance, began);
        }
        while self.entered.len() > MOST_ENTERED {
            let order = |entered: &Entered| (entered.is_open(), !entered.is_discarded(), entered.began.knows);
            let Some((first, _)) = self.entered.iter().min_by_key(|(_, entered)| order(entered)) else { return };
            let first = first.clone();
            self.entered.remove(&first);
        }
    }

    fn ends(&mut self, instance: InstanceId, is_real: bool) {
        self.instances.remove(&instance);
        self.guards.remove(&instance);
        let Some(inside) = self.inside.remove(&instance) else { return };
        for path in inside.states {
            let Some(entered) = self.entered.get_mut(&path) else { continue };
            if let Some(part) = entered.parts.remove(&instance).filter(|_| is_real) {
                entered.part_is_real(part);
            }
            if entered.routine == Some(instance) {
                self.entered.remove(&path);
            }
        }
    }

    /// The run has lost what it held. What was lost earlier keeps the revision of its earlier loss.
    fn lose(&mut self, held_until: Revision) {
        let composites =
            self.entered.values_mut().flat_map(|entered| entered.parts.values_mut().chain([&mut entered.began]));
        for began in self.instances.values_mut().chain(composites) {
            began.held_until.get_or_insert(held_until);
        }
    }

    /// The composite states around an instance with this path.
    fn inside_of(&self, path: &str) -> Inside {
        if self.composites.is_empty() {
            return Inside { states: Vec::new(), is_routine: false };
        }
        let is_followed = |path: &&str| {
            let state = without_visits(path);
            self.composites.contains(&state)
        };
        let own = Some(path).filter(is_followed);
        let around = path.rmatch_indices('/').map(|(at, _)| without_iteration(&path[..at]));
        let root = Some("").filter(|root| *root != path);
        let states: Vec<String> =
            own.into_iter().chain(around.chain(root).filter(is_followed)).map(str::to_owned).collect();
        Inside { states, is_routine: own.is_some() }
    }
}

/// The path of a state, from the path in its list: for a loop, this removes the number of the iteration.
fn without_iteration(path: &str) -> &str {
    let number = path.strip_suffix(']').and_then(|path| path.rsplit_once('['));
    number.map_or(path, |(state, _)| state)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]

    use super::*;
    use crate::ledger::Ledger;
    use crate::replay;
    use crate::shell::changes_at_exit;
    use ratn_executive::protocol::{LogEntry, LogLine, Mode, Natures, Origin};
    use ratn_model::fact::Change;
    use ratn_model::id::{FencingToken, StateId};

    /// A run that follows these states; what it knows grows with each step.
    struct Bench {
        beginnings: Beginnings,
        knows: u64,
    }

    impl Bench {
        fn new(composites: &[&str]) -> Bench {
            let composites = composites.iter().map(|path| (*path).to_owned()).collect();
            Bench { beginnings: Beginnings { composites, ..Beginnings::default() }, knows: 0 }
        }

        fn command(&mut self, command: Command) {
            self.knows += 1;
            self.beginnings.command(&command, Revision(self.knows));
        }

        fn expanded(&mut self, instance: u64, path: &str) {
            let (instance, state, path) = (InstanceId(instance), StateId(1), path.to_owned());
            self.command(Command::Note(Note::Expanded { instance, state, path, speculative: true }));
        }

        fn granted(&mut self, instance: u64) {
            self.knows += 1;
            let lease = Lease { id: LeaseId(1), token: FencingToken(1), resources: Vec::new(), consumed: Vec::new() };
            self.beginnings.event(&Event::Granted { instance: InstanceId(instance), lease }, Revision(self.knows));
        }

        fn begins(&mut self, instance: u64, path: &str) -> u64 {
            self.expanded(instance, path);
            self.granted(instance);
            self.knows
        }

        fn note(&mut self, note: impl FnOnce(InstanceId) -> Note, instance: u64) {
            self.command(Command::Note(note(InstanceId(instance))));
        }

        fn retired(&mut self, instance: u64) {
            self.note(|instance| Note::Retired { instance }, instance);
        }

        fn squashed(&mut self, instance: u64) {
            self.note(|instance| Note::Squashed { instance }, instance);
        }

        fn running(&mut self, instance: u64) -> u64 {
            self.note(|instance| Note::Running { instance, attempt: 1 }, instance);
            self.knows
        }

        fn loses(&mut self) {
            self.beginnings.event(&Event::SessionLost { held_until: Revision(0) }, Revision(self.knows));
        }

        /// What the commit of a composite state knows, and whether the run has lost its leases since.
        fn of(&self, writer: &str) -> Option<(u64, bool)> {
            let began = self.beginnings.of(InstanceId(0), writer)?;
            Some((began.knows.0, began.held_until.is_some()))
        }

        fn commits(&mut self, writer: &str) {
            let (instance, changes, evidence) = (InstanceId(0), Vec::<Change>::new(), Vec::new());
            let revision = Revision(1);
            self.command(Command::Commit { instance, writer: writer.to_owned(), changes, evidence, revision });
        }
    }

    #[test]
    fn a_composite_state_counts_from_the_beginning_of_its_first_part_until_it_is_left() {
        let mut bench = Bench::new(&["part", "loop", "loop/inner", ""]);
        let first = bench.begins(1, "part#2/move");
        bench.retired(1);
        bench.begins(2, "part#2/again");
        bench.retired(2);
        let second = bench.begins(3, "loop[1]/inner/move");
        bench.begins(4, "loop[12]/inner/move");
        assert_eq!([bench.of("part#2"), bench.of("part")], [Some((first, false)), None]);
        assert_eq!([bench.of("loop"), bench.of("loop[1]/inner")], [Some((second, false)); 2]);
        assert_eq!(bench.of(""), Some((first, false)), "the task itself");
        bench.retired(3);
        bench.retired(4);
        for left in ["part#2", "loop[1]/inner", "loop[12]/inner", "loop", ""] {
            bench.commits(left);
        }
        assert!(bench.beginnings.is_empty());
    }

    #[test]
    fn what_was_only_expected_counts_from_when_it_begins_anew() {
        let mut bench = Bench::new(&["part"]);
        let expected = bench.begins(1, "part/move");
        bench.begins(2, "part/other");
        bench.squashed(1);
        assert_eq!(bench.of("part"), Some((expected, false)), "a part of it goes on");
        bench.squashed(2);
        let anew = bench.begins(3, "part/move");
        bench.begins(4, "part/other");
        assert_eq!(bench.of("part"), Some((anew, false)));
        bench.retired(3);
        bench.squashed(4);
        bench.begins(5, "part/last");
        assert_eq!(bench.of("part"), Some((anew, false)), "it is real");
    }

    #[test]
    fn a_composite_state_whose_first_part_is_cut_short_is_made_of_what_that_began_with() {
        let mut bench = Bench::new(&["part"]);
        let part = bench.begins(1, "part/move");
        bench.loses();
        bench.squashed(1);
        assert_eq!(bench.of("part"), Some((part, true)));
        assert!(bench.beginnings.others_count().is_some());
        bench.commits("part");
        assert!(bench.beginnings.is_empty() && bench.beginnings.others_count().is_none());
    }

    #[test]
    fn of_more_than_are_followed_those_that_are_open_stay_however_many_begin_at_once() {
        let mut bench = Bench::new(&["a", "a/loop", "a/loop/part", "a/loop/part/inner"]);
        bench.begins(1, "a/first");
        let begun = bench.of("a").unwrap();
        for number in 2..2 * MOST_ENTERED as u64 {
            bench.begins(number, &format!("a/loop#{number}[1]/part/inner/move"));
            assert!(bench.beginnings.entered.len() <= MOST_ENTERED);
            bench.retired(number);
        }
        assert_eq!(bench.of("a"), Some(begun));
    }

    #[test]
    fn of_what_is_lost_a_composite_state_counts_anew_when_a_part_begins_since_and_a_routine_does_not() {
        let mut bench = Bench::new(&["part", "routine"]);
        let part = bench.begins(1, "part/move");
        bench.retired(1);
        bench.begins(2, "routine");
        let routine = bench.running(2);
        bench.expanded(3, "routine/move");
        bench.running(3);
        bench.loses();
        assert_eq!([bench.of("part"), bench.of("routine")], [Some((part, true)), Some((routine, true))]);
        let anew = bench.begins(4, "part/again");
        assert_eq!(bench.of("part"), Some((part, true)), "it is only expected");
        bench.retired(4);
        assert_eq!(bench.of("part"), Some((anew, false)));
        // The routine has a new lease, and one of its parts is tried again.
        bench.granted(2);
        bench.running(3);
        assert_eq!([bench.of("part"), bench.of("routine")], [Some((anew, false)), Some((routine, true))]);
        assert_eq!(bench.beginnings.others_count(), Some(Revision(routine)));
        // Its computed results are not valid any more: all of it is done again.
        let anew = bench.running(2);
        assert_eq!(bench.of("routine"), Some((anew, false)));
        bench.retired(2);
        assert_eq!(bench.of("routine"), None, "it is left, whatever it has committed");
    }

    #[test]
    fn of_what_is_lost_a_part_that_is_only_expected_and_is_discarded_does_not_count() {
        let mut bench = Bench::new(&["part"]);
        let part = bench.begins(1, "part/move");
        bench.retired(1);
        bench.loses();
        bench.begins(2, "part/expected");
        bench.squashed(2);
        assert_eq!(bench.of("part"), Some((part, true)), "what others change meanwhile counts");
        // Of the real parts the first to begin counts, whichever ends first.
        bench.begins(3, "part/expected");
        let first = bench.begins(4, "part/again");
        bench.begins(5, "part/more");
        bench.retired(5);
        bench.squashed(3);
        bench.retired(4);
        assert_eq!(bench.of("part"), Some((first, false)));
        // The leases are lost once more while another part is under way.
        bench.begins(6, "part/last");
        bench.loses();
        bench.retired(6);
        assert_eq!(bench.of("part"), Some((first, true)));
    }

    #[test]
    fn composite_states_that_are_never_left_are_not_followed_for_ever() {
        let mut bench = Bench::new(&["loop/part"]);
        let total = 2 * MOST_ENTERED as u64;
        for number in 1..=total {
            bench.begins(number, &format!("loop[{number}]/part/move"));
            bench.retired(number);
        }
        assert_eq!(bench.beginnings.entered.len(), MOST_ENTERED);
        assert!(bench.of(&format!("loop[{total}]/part")).is_some(), "the first ones are forgotten");
    }

    const COMPOSITES: &str = r#"
task: composites
parameters: { boxes: { type: int, default: 3 } }
states:
  - turns:
      effects: ["turns(table) = 3"]
      states:
        - loop:
            for: turn in range(1, 4)
            do:
              - part:
                  effects: ["seen(table) = turn"]
                  states:
                    - opens: { action: gripper/release, pia: true, effects: ["open(gripper) = turn"], resources: [{ block: Gripper }] }
              - held:
                  routine: true
                  effects: ["held(table) = turn"]
                  states:
                    - opens: { action: gripper/release, pia: true, effects: [], resources: [{ block: Gripper }] }
"#;

    #[test]
    fn in_both_modes_the_commit_of_a_composite_state_is_of_what_its_parts_began_with() {
        let program = replay::tests::program(COMPOSITES);
        for mode in [Mode::Hsm, Mode::Cdtn] {
            let mut lines = replay::tests::log(&program, mode);
            let LogEntry::Event(Event::Started { origin, .. }) = &mut lines[0].entry else { panic!("no start") };
            let natures = Natures { changes_at_exit: changes_at_exit(&program), ..Natures::default() };
            **origin = Origin { natures, ..(**origin).clone() };
            let mut ledger = Ledger::default();
            for (number, LogLine { at, entry }) in (1..).zip(&lines) {
                match entry {
                    LogEntry::Event(event) => {
                        // Others change something at every step.
                        let revision = Revision(number);
                        ledger.event(*at, &Event::WorldChanged { revision, facts: Vec::new() });
                        ledger.event(*at, event);
                    }
                    LogEntry::Command(command) => ledger.command(command),
                }
            }
            let composites =
                |writer: &str| ["turns", "turns/loop/part", "turns/loop/held"].contains(&&*without_visits(writer));
            let of: Vec<_> = ledger.commits.iter().filter(|decided| composites(&decided.writer)).collect();
            assert_eq!(of.len(), 7, "{mode:?}");
            for decided in of {
                assert!(decided.began.knows < decided.knew, "{mode:?}: {decided:?}");
            }
            assert!(ledger.beginnings.is_empty(), "{mode:?}: {:?}", ledger.beginnings);
        }
    }
}
