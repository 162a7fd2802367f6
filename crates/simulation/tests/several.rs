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
use ratn_simulation::several::{AllEnded, Death, REFUSED, SESSION_S, Shared, Together, What, run};
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

fn motion(dice: &mut Dice, facts: u64, has_computed: bool) -> Motion {
    let of = if dice.below(3) == 0 { "head" } else { "arm" };
    let (p, n) = (dice.below(facts), i64::try_from(dice.below(5)).unwrap_or_default());
    let effect = match dice.below(if has_computed { 5 } else { 3 }) {
        0 => Effect::Set(p, n),
        1 => Effect::Increase(p, n + 1),
        2 => Effect::Double(p, dice.below(facts)),
        _ => Effect::Computed(p),
    };
    Motion { of, effect }
}

/// Of so many steps and facts.
fn program(dice: &mut Dice, facts: u64, steps: Option<u64>) -> Vec<Step> {
    let mut has_computed = false;
    let condition = |dice: &mut Dice| (dice.below(facts), i64::try_from(dice.below(6)).unwrap_or_default());
    let crashes = |dice: &mut Dice| dice.below(4) == 0;
    let count = steps.unwrap_or_else(|| 2 + dice.below(3));
    (0..count)
        .map(|_| match dice.below(4) {
            0 => {
                has_computed = true;
                Step::Think(dice.below(facts), crashes(dice))
            }
            1 => Step::Choose(condition(dice), motion(dice, facts, has_computed), motion(dice, facts, has_computed)),
            2 => Step::Move(Some(condition(dice)), motion(dice, facts, has_computed), crashes(dice)),
            _ => Step::Move(None, motion(dice, facts, has_computed), crashes(dice)),
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
    /// Its task control has died, or will not.
    has_died: bool,
    /// The resource of what it moves went with its session.
    is_loose: bool,
}

/// The run whose task control dies and loses what it held, and whether it was refused when it was taken up again.
#[derive(Debug, Clone, Copy)]
struct Died {
    run: usize,
    is_refused: bool,
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
    (place.moving, place.chosen, place.is_loose) = (None, None, false);
    place.step += 1;
    Some((place, facts))
}

/// What may become of a program whose task control dies where it moves, or is about to: what moves is cut short and changes nothing, or goes
/// on to its end, which is made when the run is taken up again. Its resource is free meanwhile. A run that is refused then has ended there.
fn after_death(steps: &[Step], place: &Place, is_refused: bool) -> Vec<Place> {
    let is_motion = match steps.get(place.step) {
        Some(Step::Move(..)) => true,
        Some(Step::Choose(..)) => place.chosen.is_some(),
        Some(Step::Think(..)) | None => false,
    };
    if place.has_died || !is_motion {
        return Vec::new();
    }
    let died = Place { moving: None, chosen: None, has_died: true, ..place.clone() };
    if is_refused {
        return Vec::from_iter(place.moving.is_some().then_some(Place { step: steps.len(), ..died }));
    }
    // What follows a choice that fails is nothing.
    let step = if matches!(steps[place.step], Step::Choose(..)) { steps.len() } else { place.step + 1 };
    let goes_on = place.moving.map(|_| Place { has_died: true, is_loose: true, ..place.clone() });
    std::iter::once(Place { step, ..died }).chain(goes_on).collect()
}

/// The worlds that all interleavings leave; the second program may be told to end anywhere, where that is so, and the task control of one may
/// die once.
fn interleaved(programs: &[Vec<Step>; 2], facts: Facts, is_cut: bool, died: Option<Died>) -> BTreeSet<Facts> {
    let begin = |run: usize| {
        let has_died = died.is_none_or(|died| died.run != run);
        Place { step: 0, chosen: None, moving: None, computed: 0, has_died, is_loose: false }
    };
    let mut open = vec![([begin(0), begin(1)], facts)];
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
        if let Some(Died { run, is_refused }) = died {
            for place in after_death(&programs[run], &places[run], is_refused) {
                let mut places = places.clone();
                places[run] = place;
                open.push((places, facts.clone()));
            }
            is_end = !is_refused || places[run].has_died;
        }
        for which in 0..2 {
            let other = places[1 - which].moving.filter(|_| !places[1 - which].is_loose);
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

/// What a pair of large programs did, event by event, beside what it may do. It knows the programs and the facts, and shares nothing with the
/// executive: what is real is what the steps make of the world at the moment at which they are.
struct Judge<'a> {
    programs: &'a [Vec<Step>; 2],
    facts: Facts,
    runs: [Seen; 2],
    /// Who holds a resource.
    held: BTreeMap<String, (usize, ratn_model::id::LeaseId)>,
}

/// How far a run is.
#[derive(Debug, Default)]
struct Seen {
    /// The step that comes next.
    step: usize,
    /// The worlds since the last of its motions that was seen.
    worlds: Vec<Facts>,
    /// What may have been computed last.
    computed: BTreeSet<i64>,
    /// The step that moves, and the choice of which branch it is.
    moving: Option<(usize, Option<bool>)>,
    /// The one that ended and is to be real.
    ended: Option<(usize, Option<bool>)>,
    motions: usize,
}

/// The number of a step in a path, and the branch.
fn place(path: &str) -> (usize, Option<bool>) {
    let (number, branch) =
        path.split_once('/').map_or((path, None), |(number, branch)| (number, Some(branch == "yes")));
    (number.trim_start_matches('s').parse().expect("a number"), branch)
}

impl Judge<'_> {
    fn motion(&self, run: usize, (step, branch): (usize, Option<bool>)) -> Option<(&Motion, bool)> {
        match (&self.programs[run][step], branch) {
            (Step::Move(_, motion, crashes), None) => Some((motion, *crashes)),
            (Step::Choose(_, then, _), Some(true)) => Some((then, false)),
            (Step::Choose(_, _, otherwise), Some(false)) => Some((otherwise, false)),
            _ => None,
        }
    }

    /// A run passes the steps before this without a motion: each is decided in a world that was there, in their order.
    fn pass(&mut self, run: usize, until: usize) -> Result<usize, String> {
        let seen = &mut self.runs[run];
        let mut at = 0;
        for number in seen.step..until {
            let found = match &self.programs[run][number] {
                Step::Think(p, _) => {
                    seen.computed = seen.worlds[at..].iter().map(|facts| facts[p] + 10).collect();
                    Some(0)
                }
                Step::Move(Some((p, n)), ..) => seen.worlds[at..].iter().position(|facts| facts[p] <= *n),
                Step::Move(None, ..) | Step::Choose(..) => None,
            };
            at += found.ok_or_else(|| format!("run {run} did not perform s{number}"))?;
        }
        Ok(at)
    }

    fn see(&mut self, run: usize, what: &What) -> Result<(), String> {
        match what {
            // Judged by the interleavings.
            What::Died | What::TakenUp { .. } => {}
            What::Granted(lease, resources) => {
                // There are worlds for everybody: one resource with many units.
                for resource in resources.iter().filter(|resource| !resource.starts_with("WorldModel")) {
                    if let Some(other) = self.held.insert(resource.clone(), (run, *lease)) {
                        return Err(format!("{resource} is held by {other:?} and run {run}"));
                    }
                }
            }
            What::GaveBack(lease) => self.held.retain(|_, held| held != &(run, *lease)),
            What::Began(path) => {
                let (step, branch) = place(path);
                let Some((motion, _)) = self.motion(run, (step, branch)) else { return Ok(()) };
                let of = motion.of;
                if let Some(lost) = self.runs[run].ended {
                    return Err(format!("what s{} of run {run} did is lost", lost.0));
                }
                for (other, seen) in self.runs.iter().enumerate() {
                    if seen.moving.is_some_and(|moves| {
                        other == run || self.motion(other, moves).is_some_and(|(motion, _)| motion.of == of)
                    }) {
                        return Err(format!("{path} of run {run} begins while run {other} moves"));
                    }
                }
                let is_held =
                    self.held.iter().any(|(id, (holder, _))| *holder == run && id.to_lowercase().starts_with(of));
                if !is_held {
                    return Err(format!("{path} of run {run} moves the {of}, which it does not hold: {:?}", self.held));
                }
                if step < self.runs[run].step {
                    return Err(format!("{path} of run {run} begins again"));
                }
                let at = self.pass(run, step)?;
                let decides = match (&self.programs[run][step], branch) {
                    (Step::Choose((p, n), ..), Some(yes)) => {
                        self.runs[run].worlds[at..].iter().any(|facts| (facts[p] > *n) == yes)
                    }
                    (Step::Move(Some((p, n)), ..), None) => self.facts[p] > *n,
                    _ => true,
                };
                if !decides {
                    return Err(format!(
                        "{path} of run {run} begins, and what it requires does not hold: {:?}",
                        self.facts
                    ));
                }
                let seen = &mut self.runs[run];
                (seen.step, seen.moving, seen.worlds) = (step + 1, Some((step, branch)), vec![self.facts.clone()]);
                seen.motions += 1;
            }
            What::Ended(path) => {
                let moved = self.runs[run].moving.take_if(|moves| *moves == place(path));
                let crashed = moved.and_then(|moved| self.motion(run, moved)).is_some_and(|(_, crashes)| crashes);
                if moved.is_some() {
                    self.runs[run].ended = moved.filter(|_| !crashed);
                }
            }
            What::Cut(path) => {
                let seen = &mut self.runs[run];
                if seen.moving == Some(place(path)) {
                    seen.moving = None;
                }
            }
            What::Committed(path, world) => {
                let moved = self.runs[run].ended.take();
                let Some(motion) =
                    moved.filter(|moved| *moved == place(path)).and_then(|moved| self.motion(run, moved))
                else {
                    return Err(format!("{path} of run {run} commits, and {moved:?} has ended"));
                };
                let real = numbers(world, self.facts.len() as u64);
                let effect = motion.0.effect.clone();
                let computed = if let Effect::Computed(p) = effect { real[&p] } else { 0 };
                if matches!(effect, Effect::Computed(_)) && !self.runs[run].computed.contains(&computed) {
                    return Err(format!("{path} of run {run} writes {computed}: {:?}", self.runs[run].computed));
                }
                apply(&mut self.facts, &effect, computed);
                if matches!(effect, Effect::Computed(_)) {
                    self.runs[run].computed = BTreeSet::from([computed]);
                }
                if self.facts != real {
                    return Err(format!("after {path} of run {run} there is {real:?}, not {:?}", self.facts));
                }
                self.runs.iter_mut().for_each(|seen| seen.worlds.push(self.facts.clone()));
            }
        }
        Ok(())
    }

    fn all(mut self, ended: &AllEnded, is_cut: bool) -> Result<usize, String> {
        for happened in &ended.history {
            self.see(happened.run, &happened.what).map_err(|problem| format!("{:.3} s: {problem}", happened.at_s))?;
        }
        for run in 0..2 {
            if run == 1 && is_cut && ended.outcomes[1].0 == "preempted" {
                continue;
            }
            self.pass(run, self.programs[run].len())?;
            if self.runs[run].moving.or(self.runs[run].ended).is_some() {
                return Err(format!("run {run} has ended and not all that it began"));
            }
        }
        let left = numbers(&ended.world, self.facts.len() as u64);
        if left != self.facts || !self.held.is_empty() {
            return Err(format!("{left:?} is left, and {:?} held", self.held));
        }
        Ok(self.runs.iter().map(|seen| seen.motions).sum())
    }
}

fn numbers(world: &World, facts: u64) -> Facts {
    let number = |p: u64| match world.get(&fact(&format!("p{p}()"))) {
        Some(Value::Int(n)) => *n,
        other => panic!("p{p} is {other:?}"),
    };
    (0..facts).map(|p| (p, number(p))).collect()
}

/// A pair of programs, how it ended, whether the second was told to end, and what there was at first.
struct Pair {
    programs: [Vec<Step>; 2],
    ended: AllEnded,
    is_cut: bool,
    died: Option<Died>,
    begin: Facts,
    about: String,
}

/// A pair of so many facts and steps, within about so many seconds. The task control of one dies, where that is said.
fn pair(seed: u64, facts: u64, steps: Option<u64>, lasts_s: u64, dies: bool) -> Pair {
    let dice = &mut Dice(seed);
    let programs = [program(dice, facts, steps), program(dice, facts, steps)];
    let modes: [Mode; 2] = [MODES[dice.below(2) as usize], MODES[dice.below(2) as usize]];
    let tasks = [task("one", &programs[0]), task("two", &programs[1])];
    let begin: Facts = (0..facts).map(|p| (p, i64::try_from(p).unwrap_or_default() + 1)).collect();
    let loaded = |text: &str| load(text, "task.yaml", &NoFiles);
    let shared = Shared {
        resources: setup(loaded(&tasks[0]), Mode::Hsm).resources,
        world: begin.iter().map(|(p, n)| (fact(&format!("p{p}()")), Value::Int(*n))).collect(),
        latency: Duration::from_millis(900),
        seed,
    };
    let mut seconds = |most: u64| dice.below(most * 1000) as f64 / 1000.0;
    let (begins_s, pause_s, abort_s) = (seconds(lasts_s / 4), seconds(lasts_s * 3 / 4), seconds(lasts_s));
    let resume_s = pause_s + seconds(6);
    let pauses = vec![(pause_s, Event::PauseRequested), (resume_s, Event::ResumeRequested)];
    let (pauses, is_cut) = (if dice.below(2) == 0 { pauses } else { Vec::new() }, dice.below(4) == 0);
    let abort = (abort_s, Event::AbortRequested { reason: "it is enough".to_owned(), at_once: false });
    let (dying, death) = (usize::try_from(dice.below(2)).unwrap_or_default(), death(dice, lasts_s));
    let dies_as = |run: usize| Some(death).filter(|_| dies && run == dying);
    let runs = [
        Together {
            program: Arc::new(loaded(&tasks[0])),
            mode: modes[0],
            begins_s: 0.0,
            told: pauses,
            dies: dies_as(0),
        },
        Together {
            program: Arc::new(loaded(&tasks[1])),
            mode: modes[1],
            begins_s,
            told: Vec::from_iter(is_cut.then_some(abort)),
            dies: dies_as(1),
        },
    ];
    let mut workers = Workers(&programs);
    let deaths = [dies_as(0), dies_as(1)];
    let about = format!("seed {seed}, {modes:?}, {deaths:?}, cut {is_cut}\n{}\n{}", tasks[0], tasks[1]);
    let ended = run(&shared, &runs, &mut workers).unwrap_or_else(|error| panic!("{error}\n{about}"));
    let lost = ended.history.iter().find(|happened| happened.what == What::TakenUp { has_lost: true });
    let died = lost.map(|lost| Died { run: lost.run, is_refused: ended.outcomes[lost.run].0 == REFUSED });
    let is_well = |(number, (outcome, _)): (usize, &(String, String))| {
        outcome == "success"
            || number == 1 && is_cut && outcome == "preempted"
            || died.is_some_and(|died| died.run == number) && (outcome == "aborted" || outcome == REFUSED)
    };
    assert!(ended.outcomes.iter().enumerate().all(is_well), "{:?}\n{about}", ended.outcomes);
    Pair { programs, ended, is_cut, died, begin, about }
}

/// At any moment, before or after what it has decided was written down and done, and for a moment or for longer than its session lives.
fn death(dice: &mut Dice, lasts_s: u64) -> Death {
    let mut some = |most: u64| usize::try_from(dice.below(most)).unwrap_or_default();
    let (written, performed) = (if some(4) == 0 { some(6) } else { usize::MAX }, some(8));
    let mut seconds = |most: f64| dice.below(1000) as f64 / 1000.0 * most;
    let (at_s, away_s) = (seconds(lasts_s as f64), seconds(5.0 * SESSION_S));
    Death { at_s, written, performed, away_s }
}

/// How many different worlds the pairs of these seeds could have left, and how many pairs could have left more than one.
fn try_pairs(seeds: std::ops::Range<u64>) -> (usize, usize) {
    let (mut worlds, mut open) = (0, 0);
    for seed in seeds {
        let Pair { programs, ended, is_cut, begin, about, .. } = pair(seed, FACTS, None, 12, false);
        let left = numbers(&ended.world, FACTS);
        let possible = interleaved(&programs, begin, is_cut, None);
        assert!(possible.contains(&left), "{left:?} is none of {possible:?}\n{about}");
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

/// One of the two dies without a word, and is taken up again from its event log while the other goes on. Where its session lived on, that has
/// left no trace; else one motion of it may have ended `aborted`, or after its resource was free, or the run is refused.
///
/// `RATN_DEATHS=3000 RATN_FIRST=1000 cargo test -p ratn-simulation --test several dies` tries other pairs.
#[test]
fn a_run_that_dies_beside_another_leaves_a_world_that_some_interleaving_leaves() {
    let given = |name: &str, usual| std::env::var(name).map_or(usual, |number| number.parse().expect("a number"));
    let (first, count) = (given("RATN_FIRST", 0), given("RATN_DEATHS", 400));
    let (mut lost, mut kept, mut refused, mut otherwise) = (0, 0, 0, Vec::new());
    for seed in first..first + count {
        let Pair { programs, ended, is_cut, died, begin, about } = pair(seed, FACTS, None, 12, true);
        let left = numbers(&ended.world, FACTS);
        let possible = interleaved(&programs, begin, is_cut, died);
        if !possible.contains(&left) {
            otherwise.push(format!("{left:?} is none of {possible:?}, {:?}\n{about}", ended.outcomes));
        }
        kept += usize::from(ended.history.iter().any(|it| it.what == What::TakenUp { has_lost: false }));
        lost += usize::from(died.is_some());
        refused += usize::from(died.is_some_and(|died| died.is_refused));
    }
    println!("{lost} lost their session, {kept} did not, {refused} were refused");
    assert!(
        otherwise.is_empty(),
        "{} pairs:\n{}",
        otherwise.len(),
        otherwise.iter().take(5).cloned().collect::<String>()
    );
    let is_tried = lost as u64 * 5 > count && kept as u64 * 20 > count && refused * 4 < lost;
    assert!(count < 100 || is_tried, "{lost} lost, {refused} of them refused, {kept} kept");
}

/// Programs that are too large for all interleavings, event by event: see [`Judge`].
///
/// `RATN_LARGE=5000 RATN_FIRST=1000 cargo test -p ratn-simulation --test several large` tries other pairs.
#[test]
fn two_large_runs_do_what_their_programs_say_in_the_worlds_that_they_meet() {
    let given = |name: &str, usual| std::env::var(name).map_or(usual, |number| number.parse().expect("a number"));
    let (first, count) = (given("RATN_FIRST", 0), given("RATN_LARGE", 60));
    let mut motions = 0;
    for seed in first..first + count {
        let Pair { programs, ended, is_cut, begin, about, .. } = pair(seed, 8, Some(30), 60, false);
        let runs = [(); 2].map(|()| Seen { worlds: vec![begin.clone()], ..Seen::default() });
        let judge = Judge { programs: &programs, facts: begin, runs, held: BTreeMap::new() };
        motions += judge.all(&ended, is_cut).unwrap_or_else(|problem| panic!("{problem}\n{about}"));
    }
    assert!(motions as u64 > count * 20, "{motions} motions are few");
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
            Together { program, mode: Mode::Cdtn, begins_s, told: Vec::new(), dies: None }
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
