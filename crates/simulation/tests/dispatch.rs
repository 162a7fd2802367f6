//! Who is served first: with which priorities nodes ask for their resources, what a look-ahead is told of the rest of a window, and
//! what a node that does not go on says it waits for. Nothing of that changes the world that comes of a task, so no comparison of worlds sees it.

#![allow(clippy::unwrap_used, clippy::panic, reason = "a test may panic")]

mod support;

use ratn_executive::executive::Executive;
use ratn_executive::lookahead::Task;
use ratn_executive::protocol::{Command, Event, Learned, Mode, Note};
use ratn_model::id::{FencingToken, InstanceId, LeaseId, Revision};
use ratn_model::resource::{Lease, Quantity};
use ratn_model::time::Timestamp;
use ratn_model::tolerance::Tolerance;
use ratn_model::value::Value;
use std::collections::BTreeMap;
use std::sync::Arc;
use support::{NoFiles, load};

/// An executive whose shell does nothing unless it is told to.
struct Begun {
    executive: Executive,
    /// What has been asked for with which priority, by path: the last time.
    asked: BTreeMap<String, i64>,
    paths: BTreeMap<InstanceId, String>,
    attempts: BTreeMap<InstanceId, u32>,
}

impl Begun {
    fn of(task: &str, durations_s: &[(&str, f64)]) -> Begun {
        let program = Arc::new(load(task, "task.yaml", &NoFiles));
        let durations_s = durations_s.iter().map(|(path, seconds)| ((*path).to_owned(), *seconds)).collect();
        let started = Event::Started {
            task: program.name.clone(),
            digest: program.digest.clone(),
            mode: Mode::Cdtn,
            parameters: program.bind_parameters(&[]).unwrap(),
            seed: 7,
            world: Vec::new(),
            revision: Revision(0),
            capacity: BTreeMap::from([("Brain".to_owned(), Quantity::whole(2))]),
            learned: Learned { durations_s, ..Learned::default() },
            breakpoints: Box::default(),
            origin: Box::default(),
        };
        let (asked, paths, attempts) = Default::default();
        let mut begun = Begun { executive: Executive::new(program, Tolerance::EXACT), asked, paths, attempts };
        begun.handle(0, started);
        begun
    }

    fn handle(&mut self, at_s: u64, event: Event) {
        for command in self.executive.handle(Timestamp::from_seconds(at_s as f64), event) {
            match command {
                Command::Note(Note::Expanded { instance, path, .. }) => drop(self.paths.insert(instance, path)),
                Command::Acquire { instance, priority, .. } => {
                    self.asked.insert(self.paths[&instance].clone(), priority);
                }
                Command::Start { instance, attempt, .. } => drop(self.attempts.insert(instance, attempt)),
                _ => {}
            }
        }
        self.executive.check_invariants().unwrap();
    }

    fn instance(&self, path: &str) -> InstanceId {
        *self.paths.iter().find(|(_, of)| *of == path).unwrap_or_else(|| panic!("no {path} in {:?}", self.paths)).0
    }

    fn grant(&mut self, at_s: u64, path: &str) {
        let instance = self.instance(path);
        let lease =
            Lease { id: LeaseId(instance.0), token: FencingToken(1), resources: Vec::new(), consumed: Vec::new() };
        self.handle(at_s, Event::Granted { instance, lease });
    }

    fn finish(&mut self, at_s: u64, path: &str, x: i64) {
        let instance = self.instance(path);
        let event = Event::Finished {
            instance,
            attempt: self.attempts[&instance],
            outcome: "success".to_owned(),
            outputs: BTreeMap::from([("x".to_owned(), Value::Int(x))]),
            measured: Vec::new(),
            evidence: Vec::new(),
            reason: String::new(),
            at_rest: true,
        };
        self.handle(at_s, event);
    }

    /// Who asks with a larger priority than the next.
    fn ranked(&self) -> Vec<&str> {
        let mut ranked: Vec<(&str, i64)> =
            self.asked.iter().map(|(path, priority)| (path.as_str(), *priority)).collect();
        ranked.sort_by_key(|(_, priority)| std::cmp::Reverse(*priority));
        assert!(ranked.windows(2).all(|two| two[0].1 != two[1].1), "somebody is before whom: {ranked:?}");
        ranked.into_iter().map(|(path, _)| path).collect()
    }

    fn planned(&mut self, at_s: u64, path: &str) -> Task {
        let instance = self.instance(path);
        let problem = self.executive.outlook(Timestamp::from_seconds(at_s as f64));
        problem.tasks.into_iter().find(|task| task.instance == instance).unwrap()
    }
}

/// A state that computes, of the inputs, for so many seconds.
fn think(name: &str, inputs: &str, seconds: &str) -> String {
    format!(
        "  - {name}: {{ action: brain/think, in: {{ {inputs} }}, computes: true, reads: [], duration: {seconds}, resources: [{{ block: Brain }}] }}\n"
    )
}

fn task(states: &[String]) -> String {
    format!("task: dispatch\nstates:\n{}", states.concat())
}

#[test]
fn of_two_that_are_certain_the_one_with_more_behind_it_comes_first() {
    let states =
        [think("short", "", "3"), think("long", "", "1"), think("reader", "a: long.x", "4"), think("alike", "", "3")];
    let begun = Begun::of(&task(&states), &[]);
    assert_eq!(begun.ranked(), ["long", "short", "alike"], "5 s, and two of 3 s in program order");
}

#[test]
fn what_was_measured_counts_more_than_what_was_estimated() {
    let states = [think("first", "", "9"), think("second", "", "5")];
    let begun = Begun::of(&task(&states), &[("first", 2.0)]);
    assert_eq!(begun.ranked(), ["second", "first"]);
    let begun = Begun::of(&task(&states), &[("first", f64::INFINITY)]);
    assert_eq!(begun.ranked(), ["first", "second"], "no number: as estimated");
}

#[test]
fn what_an_undecided_condition_may_make_useless_comes_after_all_that_is_certain() {
    let states = [
        think("look", "", "1"),
        "  - bright: { condition: look.x = 1, then: [\n".to_owned(),
        "      { hard: { action: brain/think, computes: true, reads: [], duration: 100, resources: [{ block: Brain }] } } ], else: [\n".to_owned(),
        "      { easy: { action: brain/think, computes: true, reads: [], duration: 10, resources: [{ block: Brain }] } } ] }\n".to_owned(),
        think("after", "", "1"),
    ];
    let mut begun = Begun::of(&task(&states), &[]);
    let ranked = begun.ranked();
    assert_eq!(ranked[0], "look", "{ranked:?}");
    assert!(
        ranked.iter().position(|path| path.ends_with("hard")) < ranked.iter().position(|path| path.ends_with("easy"))
    );
    let planned = begun.executive.outlook(Timestamp::default()).tasks;
    let speculative: Vec<f64> =
        planned.iter().filter(|task| task.is_speculative).map(|task| task.probability).collect();
    assert_eq!(speculative, [0.5, 0.5], "of two ways on that are alike one is planned, and what is behind");
    begun.grant(0, "look");
    begun.finish(1, "look", 1);
    assert!(begun.ranked()[0].ends_with("hard"), "once it is certain it asks again: {:?}", begun.ranked());
}

#[test]
fn a_look_ahead_plans_with_what_is_left_of_everything_and_with_what_waits_for_what() {
    let day_s = 24.0 * 3600.0;
    let states = [think("day", "", "86400"), think("then", "a: day.x", "2"), think("apart", "", "7")];
    let mut begun = Begun::of(&task(&states), &[]);
    let day = begun.planned(0, "day");
    assert_eq!((day.duration_s, day.urgency_s, day.is_running), (day_s, day_s + 2.0, false));
    let then = begun.planned(0, "then");
    assert_eq!((then.duration_s, then.after.as_slice()), (2.0, [0].as_slice()), "of the one before");
    let apart = begun.planned(0, "apart");
    assert_eq!((apart.after.as_slice(), apart.is_speculative, apart.probability), ([].as_slice(), false, 1.0));
    assert_eq!(apart.demands, [("Brain".to_owned(), Quantity::whole(1))]);
    begun.grant(100, "day");
    let day = begun.planned(400, "day");
    assert_eq!((day.duration_s, day.is_running), (day_s - 300.0, true), "since it has its resources");
    begun.finish(500, "day", 1);
    let problem = begun.executive.outlook(Timestamp::from_seconds(500.0));
    assert_eq!(problem.tasks.len(), 2, "what has ended is not planned");
}

#[test]
fn a_look_ahead_plans_regions_behind_what_is_before_them_and_before_what_is_behind_them() {
    let go = |name: &str| {
        format!("{name}: {{ action: arm/move, pia: true, reads: [], effects: [], resources: [{{ block: Arm }}] }}")
    };
    let beside =
        format!("  - both: {{ concurrency: barrier, regions: [ {{ {} }}, {{ {} }} ] }}\n", go("left"), go("right"));
    let states = [format!("  - {}\n", go("before")), beside, format!("  - {}\n", go("behind"))];
    let mut begun = Begun::of(&task(&states), &[]);
    let [before, left, right, behind] =
        ["before", "both/left", "both/right", "behind"].map(|path| begun.planned(0, path));
    let places: Vec<InstanceId> =
        begun.executive.outlook(Timestamp::default()).tasks.iter().map(|task| task.instance).collect();
    let after = |task: &Task| task.after.iter().map(|place| places[*place]).collect::<Vec<InstanceId>>();
    assert_eq!(after(&before), []);
    assert_eq!([after(&left), after(&right)], [vec![before.instance], vec![before.instance]]);
    assert_eq!(after(&behind), [left.instance, right.instance]);
}

#[test]
fn what_a_look_ahead_advises_stays_until_it_advises_otherwise() {
    let states = [think("first", "", "9"), think("second", "", "5")];
    let mut begun = Begun::of(&task(&states), &[]);
    let second = begun.instance("second");
    begun.handle(1, Event::Advised { urgency_s: vec![(second, 10.0)], held: Vec::new() });
    assert_eq!(begun.ranked(), ["second", "first"], "it asks again with what was advised");
    begun.handle(2, Event::Advised { urgency_s: vec![(second, f64::NAN)], held: Vec::new() });
    assert_eq!(begun.ranked(), ["second", "first"]);
    assert_eq!(begun.planned(2, "second").urgency_s, 10.0);
}

#[test]
fn who_waits_says_for_whom() {
    let go = "  - go: { action: arm/move, in: { a: reader.x }, pia: true, reads: [], resources: [{ block: Arm }] }\n"
        .to_owned();
    let states = [think("first", "", "1"), think("reader", "a: first.x", "1"), go];
    let mut begun = Begun::of(&task(&states), &[]);
    let said = begun.executive.explain();
    assert_eq!(said[0], "first waits for the resource manager");
    assert_eq!(said[1], "reader waits for an output of first");
    assert_eq!(said[2], "go waits for every older state to have ended");
    begun.grant(0, "first");
    assert_eq!(begun.executive.explain().len(), 2, "who has begun does not wait");
}
