//! Two runs on one system leave a world that some interleaving of their sequential programs leaves.
//!
//! The programs are random and small; every interleaving of the beginnings and ends of their steps is made by an evaluator that shares nothing
//! with the executive but the values of facts. Workers crash. Two motions are under way at once where they are of different resources.
//!
//! `RATN_PROGRAMS=20000 RATN_FIRST=1000 cargo test -p ratn-simulation --test several` tries other pairs.

mod support;

use ratn_executive::protocol::{Event, Goal, Mode};
use ratn_model::value::Value;
use ratn_simulation::dice::Dice;
use ratn_simulation::run::{Answer, Oracle, Performance};
use ratn_simulation::several::{Shared, Together, run};
use ratn_world::world::World;
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::Duration;
use support::{MODES, NoFiles, Providers, fact, load, setup};

const FACTS: u64 = 3;

/// What a motion makes of the world.
#[derive(Debug, Clone, PartialEq)]
enum Effect {
    Set(u64, i64),
    Increase(u64, i64),
    /// The first becomes twice the second, plus one.
    Double(u64, u64),
    /// The first becomes what was computed last.
    Computed(u64),
}

/// A motion, of the arm or of the head.
#[derive(Debug, Clone, PartialEq)]
struct Motion {
    of: &'static str,
    effect: Effect,
}

/// One step of a program.
#[derive(Debug, Clone, PartialEq)]
enum Step {
    /// Requires that a fact is greater than a number, where it says so; else it aborts, and the program goes on. So it does where who moves
    /// crashes, if that is said.
    Move(Option<(u64, i64)>, Motion, bool),
    /// Computes the fact plus ten. The first who computes it crashes, where that is said.
    Think(u64, bool),
    /// One motion or another one, by whether a fact is greater than a number.
    Choose((u64, i64), Motion, Motion),
}

fn motion(dice: &mut Dice, has_computed: bool) -> Motion {
    let of = if dice.below(3) == 0 { "head" } else { "arm" };
    let (p, n) = (dice.below(FACTS), i64::try_from(dice.below(5)).unwrap_or_default());
    let effect = match dice.below(if has_computed { 5 } else { 3 }) {
        0 => Effect::Set(p, n),
        1 => Effect::Increase(p, n + 1),
        2 => Effect::Double(p, dice.below(FACTS)),
        _ => Effect::Computed(p),
    };
    Motion { of, effect }
}

fn program(dice: &mut Dice) -> Vec<Step> {
    let mut has_computed = false;
    let condition = |dice: &mut Dice| (dice.below(FACTS), i64::try_from(dice.below(6)).unwrap_or_default());
    let crashes = |dice: &mut Dice| dice.below(4) == 0;
    let count = 2 + dice.below(3);
    (0..count)
        .map(|_| match dice.below(4) {
            0 => {
                has_computed = true;
                Step::Think(dice.below(FACTS), crashes(dice))
            }
            1 => Step::Choose(condition(dice), motion(dice, has_computed), motion(dice, has_computed)),
            2 => Step::Move(Some(condition(dice)), motion(dice, has_computed), crashes(dice)),
            _ => Step::Move(None, motion(dice, has_computed), crashes(dice)),
        })
        .collect()
}

/// The program as a task file.
fn task(name: &str, steps: &[Step]) -> String {
    let mut computed = String::new();
    let mut text = format!("task: {name}\nstates:\n");
    let says = |effect: &Effect, computed: &str| match effect {
        Effect::Set(p, n) => format!("p{p}() = {n}"),
        Effect::Increase(p, n) => format!("increase p{p}() by {n}"),
        Effect::Double(p, q) => format!("p{p}() = p{q}() * 2 + 1"),
        Effect::Computed(p) => format!("p{p}() = {computed}.x"),
    };
    let moves = |name: &str, requires: &str, Motion { of, effect }: &Motion, computed: &str, ends: &str| {
        let (action, kind) = if *of == "arm" { ("arm/move", "Arm") } else { ("head/turn", "Head") };
        let effect = says(effect, computed);
        format!(
            "- {name}: {{ action: {action}, pia: true, reads: [], {requires}effects: ['{effect}'], resources: [{{ block: {kind} }}], duration: 2{ends} }}\n"
        )
    };
    for (number, step) in steps.iter().enumerate() {
        let next = if number + 1 < steps.len() { format!("s{}", number + 1) } else { "success".to_owned() };
        let ends = format!(", transitions: {{ success: {next}, aborted: {next} }}");
        match step {
            Step::Move(requires, motion, _) => {
                let requires = requires.map_or(String::new(), |(p, n)| format!("requires: ['p{p}() > {n}'], "));
                text += &format!("  {}", moves(&format!("s{number}"), &requires, motion, &computed, &ends));
            }
            Step::Think(p, _) => {
                text += &format!(
                    "  - s{number}: {{ action: brain/think, computes: true, reads: ['p{p}()'], in: {{ a: p{p}() }}, resources: [{{ block: Brain }}], duration: 1, transitions: {{ success: {next} }} }}\n"
                );
                computed = format!("s{number}");
            }
            Step::Choose((p, n), then, otherwise) => {
                text += &format!("  - s{number}:\n      condition: p{p}() > {n}\n      then:\n        ");
                text += &moves("yes", "", then, &computed, "");
                text += "      else:\n        ";
                text += &moves("no", "", otherwise, &computed, "");
                text += &format!("      transitions: {{ success: {next} }}\n");
            }
        }
    }
    text
}

type Facts = BTreeMap<u64, i64>;

/// Where one program is: its next step, which motion it has chosen, the one under way, and what it has computed last.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
struct Place {
    step: usize,
    chosen: Option<bool>,
    moving: Option<&'static str>,
    computed: i64,
}

fn apply(facts: &mut Facts, effect: &Effect, computed: i64) {
    let value = |facts: &Facts, p: &u64| facts[p];
    match effect {
        Effect::Set(p, n) => drop(facts.insert(*p, *n)),
        Effect::Increase(p, n) => drop(facts.insert(*p, value(facts, p) + n)),
        Effect::Double(p, q) => drop(facts.insert(*p, value(facts, q) * 2 + 1)),
        Effect::Computed(p) => drop(facts.insert(*p, computed)),
    }
}

/// What may come next of a program while the other one moves this: nothing at its end, or where that is in the way.
fn next(steps: &[Step], place: &Place, facts: &Facts, other: Option<&'static str>) -> Option<(Place, Facts)> {
    let (mut place, mut facts) = (place.clone(), facts.clone());
    let (requires, motion, crashes) = match steps.get(place.step)? {
        Step::Think(p, _) => {
            place.computed = facts[p] + 10;
            place.step += 1;
            return Some((place, facts));
        }
        Step::Choose((p, n), ..) if place.chosen.is_none() => {
            place.chosen = Some(facts[p] > *n);
            return Some((place, facts));
        }
        Step::Move(requires, motion, crashes) => (*requires, motion, *crashes),
        Step::Choose(_, then, otherwise) => (None, if place.chosen == Some(true) { then } else { otherwise }, false),
    };
    let is_met = requires.is_none_or(|(p, n)| facts[&p] > n);
    match place.moving {
        None if is_met && other == Some(motion.of) => return None,
        None if is_met => {
            place.moving = Some(motion.of);
            return Some((place, facts));
        }
        None => {}
        Some(_) if crashes => {}
        Some(_) => apply(&mut facts, &motion.effect, place.computed),
    }
    (place.moving, place.chosen) = (None, None);
    place.step += 1;
    Some((place, facts))
}

/// The worlds that all interleavings leave; the second program may be told to end anywhere, where that is so.
fn interleaved(programs: &[Vec<Step>; 2], facts: Facts, is_cut: bool) -> BTreeSet<Facts> {
    let begin = Place { step: 0, chosen: None, moving: None, computed: 0 };
    let mut open = vec![([begin.clone(), begin], facts)];
    let (mut seen, mut ends) = (BTreeSet::new(), BTreeSet::new());
    while let Some((places, facts)) = open.pop() {
        if !seen.insert((places.clone(), facts.clone())) {
            continue;
        }
        // A motion that is cut short changes nothing, and does not keep its resource.
        let second = Place { moving: None, step: programs[1].len(), ..places[1].clone() };
        if is_cut && places[1] != second {
            open.push(([places[0].clone(), second], facts.clone()));
        }
        let mut is_end = true;
        for which in 0..2 {
            let other = places[1 - which].moving;
            if let Some((place, after)) = next(&programs[which], &places[which], &facts, other) {
                let mut places = places.clone();
                places[which] = place;
                open.push((places, after));
                is_end = false;
            }
        }
        if is_end {
            ends.insert(facts);
        }
    }
    ends
}

/// They do what the steps say.
struct Workers<'a>(&'a [Vec<Step>; 2]);

impl Oracle for Workers<'_> {
    fn perform(&mut self, path: &str, attempt: u32, goal: &Goal, _: &World) -> Performance {
        let (run, state) = path.split_once(":s").expect("a path: the run, and its state");
        let number: usize = state.split('/').next().and_then(|number| number.parse().ok()).expect("a number");
        let crashes = match &self.0[run.parse::<usize>().expect("a run")][number] {
            Step::Move(_, _, crashes) => *crashes,
            Step::Think(_, crashes) => *crashes && attempt == 1,
            Step::Choose(..) => false,
        };
        let x = match goal.inputs.get("a") {
            Some(Value::Int(a)) => Value::Int(a + 10),
            other => other.cloned().unwrap_or(Value::Null),
        };
        let answer = match crashes {
            true => Answer::Crashed,
            false => Answer::Finished {
                outcome: "success".to_owned(),
                outputs: BTreeMap::from([("x".to_owned(), x)]),
                measured: Vec::new(),
            },
        };
        Performance { duration_s: goal.expected_s.unwrap_or(1.0), answer }
    }
}

/// How many different worlds the pairs of these seeds could have left, and how many pairs could have left more than one.
fn try_pairs(seeds: std::ops::Range<u64>) -> (usize, usize) {
    let (mut worlds, mut open) = (0, 0);
    for seed in seeds {
        let dice = &mut Dice(seed);
        let programs = [program(dice), program(dice)];
        let modes: [Mode; 2] = [MODES[dice.below(2) as usize], MODES[dice.below(2) as usize]];
        let tasks = [task("one", &programs[0]), task("two", &programs[1])];
        let begin: Facts = (0..FACTS).map(|p| (p, i64::try_from(p).unwrap_or_default() + 1)).collect();
        let loaded = |text: &str| load(text, "task.yaml", &NoFiles);
        let shared = Shared {
            resources: setup(loaded(&tasks[0]), Mode::Hsm).resources,
            world: begin.iter().map(|(p, n)| (fact(&format!("p{p}()")), Value::Int(*n))).collect(),
            latency: Duration::from_millis(900),
            seed,
        };
        let mut seconds = |most: u64| dice.below(most * 1000) as f64 / 1000.0;
        let (begins_s, pause_s, abort_s) = (seconds(3), seconds(9), seconds(12));
        let resume_s = pause_s + seconds(6);
        let pauses = vec![(pause_s, Event::PauseRequested), (resume_s, Event::ResumeRequested)];
        let (pauses, is_cut) = (if dice.below(2) == 0 { pauses } else { Vec::new() }, dice.below(4) == 0);
        let abort = (abort_s, Event::AbortRequested { reason: "it is enough".to_owned(), at_once: false });
        let runs = [
            Together { program: Arc::new(loaded(&tasks[0])), mode: modes[0], begins_s: 0.0, told: pauses },
            Together {
                program: Arc::new(loaded(&tasks[1])),
                mode: modes[1],
                begins_s,
                told: Vec::from_iter(is_cut.then_some(abort)),
            },
        ];
        let mut workers = Workers(&programs);
        let about = || format!("seed {seed}, {modes:?}\n{}\n{}", tasks[0], tasks[1]);
        let ended = run(&shared, &runs, &mut workers).unwrap_or_else(|error| panic!("{error}\n{}", about()));
        let is_well = |(number, (outcome, _)): (usize, &(String, String))| {
            outcome == "success" || number == 1 && is_cut && outcome == "preempted"
        };
        assert!(ended.outcomes.iter().enumerate().all(is_well), "{:?}\n{}", ended.outcomes, about());
        let number = |p: u64| match ended.world.get(&fact(&format!("p{p}()"))) {
            Some(Value::Int(n)) => *n,
            other => panic!("p{p} is {other:?}\n{}", about()),
        };
        let left: Facts = (0..FACTS).map(|p| (p, number(p))).collect();
        let possible = interleaved(&programs, begin, is_cut);
        assert!(possible.contains(&left), "{left:?} is none of {possible:?}\n{}", about());
        worlds += possible.len();
        open += usize::from(possible.len() > 1);
    }
    (worlds, open)
}

#[test]
fn two_runs_leave_a_world_that_some_interleaving_of_their_sequential_programs_leaves() {
    let given = |name: &str, usual| std::env::var(name).map_or(usual, |number| number.parse().expect("a number"));
    let (first, count) = (given("RATN_FIRST", 0), given("RATN_PROGRAMS", 600));
    let (worlds, open) = try_pairs(first..first + count);
    assert!(open as u64 > count / 2, "the pairs hardly meet: {open} of them have several ends, {worlds} worlds in all");
}

/// Turns its head for 6 s and computes for both of what may come of it meanwhile, which takes 4 s.
const AHEAD: &str = "task: ahead
states:
  - look: { action: head/turn, pia: true, effects: [], resources: [{ block: Head }], duration: 6 }
  - found:
      condition: look.x = 1
      then:
        - plan_carry: { action: brain/think, computes: true, reads: [], resources: [{ block: Brain }], duration: 4 }
        - carry: { action: arm/move, in: { a: plan_carry.x }, pia: true, effects: [], resources: [{ block: Arm }] }
      else:
        - plan_search: { action: brain/think, computes: true, reads: [], resources: [{ block: Brain }], duration: 4 }
        - search: { action: head/turn, in: { a: plan_search.x }, pia: true, effects: [], resources: [{ block: Head }] }
";

/// Computes what it needs in any case.
const CERTAINLY: &str = "task: certainly
states:
  - plan: { action: brain/think, computes: true, reads: [], resources: [{ block: Brain }], duration: 1 }
";

#[test]
fn what_one_run_computes_in_case_gives_way_to_what_another_needs() {
    let loaded = |text: &str| load(text, "task.yaml", &NoFiles);
    let mut resources = setup(loaded(AHEAD), Mode::Hsm).resources;
    let brain = resources.iter_mut().find(|(kind, _)| kind == "Brain").expect("a brain");
    brain.1.count = ratn_model::resource::Quantity::ONE;
    for latency in [Duration::ZERO, Duration::from_millis(300)] {
        let shared = Shared { resources: resources.clone(), world: Vec::new(), latency, seed: 1 };
        let together = |task: &str, begins_s| {
            let program = Arc::new(loaded(task));
            Together { program, mode: Mode::Cdtn, begins_s, told: Vec::new() }
        };
        let runs = [together(AHEAD, 0.0), together(CERTAINLY, 1.0)];
        let mut given = Vec::new();
        let mut providers = Providers(|path: &str, attempt: u32, _: &Goal, _: &World| {
            given.push((path.to_owned(), attempt));
            ("success", Value::Int(1))
        });
        let ended = run(&shared, &runs, &mut providers).expect("both end");
        assert!(ended.outcomes.iter().all(|(outcome, _)| outcome == "success"), "{:?}", ended.outcomes);
        let thought: Vec<(&str, u32)> = given
            .iter()
            .filter(|(path, _)| path.contains("plan"))
            .map(|(path, attempt)| (path.as_str(), *attempt))
            .collect();
        let carry = "0:found/plan_carry";
        assert!(thought.starts_with(&[(carry, 1), ("1:plan", 1), (carry, 2)]), "{thought:?}");
    }
}
