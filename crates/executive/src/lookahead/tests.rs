#![allow(clippy::unwrap_used, reason = "a test may panic")]

use super::dice::Dice;
use super::{Problem, ProblemError, Search, Task};
use ratn_model::id::InstanceId;
use ratn_model::resource::Quantity;

fn task(id: u64, duration_s: f64, kind: &str, after: &[usize]) -> Task {
    Task {
        instance: InstanceId(id),
        duration_s,
        is_running: false,
        demands: vec![(kind.to_owned(), Quantity::ONE)],
        after: after.to_vec(),
        is_speculative: false,
        held_for: Vec::new(),
        urgency_s: 0.0,
        probability: 1.0,
    }
}

fn problem(tasks: Vec<Task>, capacity: &[(&str, u32)]) -> Problem {
    Problem { tasks, capacity: capacity.iter().map(|(kind, units)| ((*kind).to_owned(), (*units).into())).collect() }
}

/// A random problem: chains and joins, several units, running and speculative tasks.
fn random(seed: u64) -> Problem {
    let mut dice = Dice(seed);
    let size = 2 + dice.below(40);
    let kinds = ["a", "b", "c"];
    let tasks = (0..size)
        .map(|place| {
            let kind = kinds[dice.below(3)];
            let after: Vec<usize> =
                (0..dice.below(3)).filter(|_| place > 1).map(|_| dice.below(place.max(1))).collect();
            let is_speculative = place > size / 2 && dice.below(3) == 0;
            Task {
                is_running: place < 2 && dice.below(2) == 0,
                demands: (0..dice.below(3))
                    .map(|at| (kinds[(at + place) % 3].to_owned(), Quantity::whole(1 + dice.below(2) as u32)))
                    .collect(),
                is_speculative,
                urgency_s: dice.share() * 20.0,
                probability: if is_speculative { 0.25 + 0.5 * dice.share() } else { 1.0 },
                ..task(place as u64, dice.below(9) as f64, kind, &after)
            }
        })
        .collect();
    problem(tasks, &[("a", 1), ("b", 2), ("c", 3)])
}

#[test]
fn a_task_that_others_are_long_in_waiting_for_goes_first() {
    // The machine could do the second task first; nothing waits for the end of that one.
    let mut first = task(1, 2.0, "m", &[]);
    first.urgency_s = 1.0;
    let mut second = task(2, 3.0, "m", &[]);
    second.urgency_s = 9.0;
    let mut search =
        Search::new(&problem(vec![first, second, task(3, 8.0, "n", &[0])], &[("m", 1), ("n", 1)]), 1).unwrap();
    let advice = search.best();
    assert_eq!((advice.plain_s, advice.end_s), (13.0, 10.0));
    let urgency = |id: u64| advice.urgency_s.iter().find(|(i, _)| *i == InstanceId(id)).map(|(_, s)| *s).unwrap();
    assert!(urgency(1) > urgency(2), "{advice:?}");
    assert!(search.is_over(), "nothing is shorter than the path through the first and the third");
}

#[test]
fn what_is_advised_reproduces_the_end_and_is_never_worse_than_what_was() {
    for seed in 0..200 {
        let mut problem = random(seed);
        let mut search = Search::new(&problem, seed).unwrap();
        search.step(300);
        let advice = search.best();
        assert!(advice.end_s <= advice.plain_s, "seed {seed}: {} after {}", advice.end_s, advice.plain_s);
        for (instance, seconds) in &advice.urgency_s {
            problem.tasks[instance.0 as usize].urgency_s = *seconds;
        }
        for held in &advice.held {
            let places = held.until_begun.iter().map(|instance| instance.0 as usize);
            problem.tasks[held.instance.0 as usize].held_for = places.collect();
        }
        let again = Search::new(&problem, 0).unwrap().best().plain_s;
        assert!((again - advice.end_s).abs() < 1e-9, "seed {seed}: advised {}, came to {again}", advice.end_s);
    }
}

#[test]
fn parts_of_a_unit_are_planned_as_units_are() {
    for seed in 0..100 {
        let whole = random(seed);
        let mut parts = whole.clone();
        let demands = parts.tasks.iter_mut().flat_map(|task| task.demands.iter_mut().map(|(_, amount)| amount));
        for amount in parts.capacity.values_mut().chain(demands) {
            *amount = Quantity::from_thousandths(amount.thousandths() / 8);
        }
        let [whole, parts] = [whole, parts].map(|problem| {
            let mut search = Search::new(&problem, seed).unwrap();
            search.step(100);
            search.best()
        });
        assert_eq!(whole, parts, "seed {seed}");
    }
}

#[test]
fn a_search_improves_where_the_longest_path_misleads() {
    let better = (0..200).filter(|seed| {
        let mut problem = random(*seed);
        problem.tasks.iter_mut().for_each(|task| task.urgency_s = 0.0);
        let mut search = Search::new(&problem, *seed).unwrap();
        let before_s = search.best().end_s;
        search.step(500);
        search.best().end_s < before_s
    });
    assert!(better.count() > 10);
}

#[test]
fn the_same_seed_finds_the_same() {
    let found = || {
        let mut search = Search::new(&random(7), 3).unwrap();
        search.step(200);
        search.best()
    };
    assert_eq!(found(), found());
}

#[test]
fn problems_that_cannot_be_simulated_are_refused() {
    let refused = |tasks: Vec<Task>| Search::new(&problem(tasks, &[("m", 1)]), 1).map(|_| ()).unwrap_err();
    assert!(matches!(refused(vec![task(1, 1.0, "m", &[1]), task(2, 1.0, "m", &[0])]), ProblemError::Circular { .. }));
    assert!(matches!(refused(vec![task(1, 1.0, "m", &[5])]), ProblemError::Unknown { after: 5, tasks: 1, .. }));
    assert!(matches!(refused(vec![task(1, f64::NAN, "m", &[])]), ProblemError::Number { .. }));
}

#[test]
fn nothing_to_do_is_over_at_once() {
    let mut search = Search::new(&Problem::default(), 1).unwrap();
    assert!(search.is_over() && !search.step(10));
    assert_eq!(search.best().urgency_s, Vec::new());
}

/// The shortest schedule, found by trying all lists: each task as early as the tasks before it allow. Shares no code with the
/// search; whole seconds only.
fn shortest_s(problem: &Problem) -> usize {
    const HORIZON: usize = 100;
    struct Trial<'a> {
        problem: &'a Problem,
        ends: Vec<Option<usize>>,
        used: Vec<std::collections::BTreeMap<String, u64>>,
        best: usize,
    }
    fn extend(trial: &mut Trial<'_>) {
        let problem = trial.problem;
        let end = trial.ends.iter().flatten().copied().max().unwrap_or(0);
        if end >= trial.best {
            return;
        }
        if trial.ends.iter().all(Option::is_some) {
            trial.best = end;
            return;
        }
        for (place, task) in problem.tasks.iter().enumerate() {
            let ready: Option<usize> =
                task.after.iter().map(|after| trial.ends[*after]).try_fold(0, |ready, end| Some(ready.max(end?)));
            let (None, Some(ready)) = (trial.ends[place], ready) else { continue };
            let duration = task.duration_s as usize;
            let fits = |used: &std::collections::BTreeMap<String, u64>| {
                let left = |kind: &String| problem.capacity[kind].thousandths() - used.get(kind).copied().unwrap_or(0);
                task.demands.iter().all(|(kind, units)| units.thousandths() <= left(kind))
            };
            let begins = (ready..).find(|from| trial.used[*from..from + duration].iter().all(fits)).unwrap();
            let before = trial.used.clone();
            for used in &mut trial.used[begins..begins + duration] {
                task.demands
                    .iter()
                    .for_each(|(kind, units)| *used.entry(kind.clone()).or_default() += units.thousandths());
            }
            trial.ends[place] = Some(begins + duration);
            extend(trial);
            trial.ends[place] = None;
            trial.used = before;
        }
    }
    let (ends, used) = (vec![None; problem.tasks.len()], vec![Default::default(); HORIZON]);
    let mut trial = Trial { problem, ends, used, best: HORIZON };
    extend(&mut trial);
    trial.best
}

/// Up to seven tasks that need units of two resources, or one of two machines.
fn small(seed: u64, machines: bool) -> Problem {
    let mut dice = Dice(seed);
    let size = 3 + dice.below(5);
    let tasks = (0..size).map(|place| {
        let after: Vec<usize> = if place > 0 && dice.below(2) == 0 { vec![dice.below(place)] } else { Vec::new() };
        let kinds = ["a", "b"];
        let one = vec![(kinds[dice.below(2)].to_owned(), Quantity::ONE)];
        let units = |dice: &mut Dice| Quantity::whole(1 + dice.below(3) as u32);
        let several = vec![("a".to_owned(), units(&mut dice)), ("b".to_owned(), units(&mut dice))];
        let demands = if machines { one } else { several };
        Task { demands, ..task(place as u64, 1.0 + dice.below(9) as f64, "a", &after) }
    });
    let units = if machines { 1 } else { 4 };
    problem(tasks.collect(), &[("a", units), ("b", units)])
}

#[test]
fn the_plan_of_a_small_problem_is_the_shortest_there_is() {
    for (seed, machines) in (0..60).flat_map(|seed| [(seed, false), (seed, true)]) {
        let mut problem = small(seed, machines);
        let shortest_s = shortest_s(&problem) as f64;
        let mut search = Search::new(&problem, seed).unwrap();
        search.step(3_000);
        let advice = search.best();
        assert_eq!(advice.end_s, shortest_s, "seed {seed}, machines: {machines}");
        // And a dispatch with this advice leads to that end.
        for (instance, seconds) in &advice.urgency_s {
            problem.tasks[instance.0 as usize].urgency_s = *seconds;
        }
        for held in &advice.held {
            let places = held.until_begun.iter().map(|instance| instance.0 as usize);
            problem.tasks[held.instance.0 as usize].held_for = places.collect();
        }
        assert_eq!(Search::new(&problem, 0).unwrap().best().plain_s, shortest_s, "seed {seed}, machines: {machines}");
    }
}

#[test]
fn a_plan_that_needs_it_holds_somebody_back() {
    // The first task could have the machine at once, but the long chain of the second begins with it a second later.
    let tasks = vec![task(0, 5.0, "m", &[]), task(1, 1.0, "n", &[]), task(2, 1.0, "m", &[1]), task(3, 9.0, "n", &[2])];
    let mut search = Search::new(&problem(tasks, &[("m", 1), ("n", 1)]), 1).unwrap();
    search.step(100);
    let advice = search.best();
    assert_eq!((advice.plain_s, advice.end_s), (15.0, 11.0));
    let held: Vec<_> = advice.held.iter().map(|held| (held.instance, held.until_begun.clone())).collect();
    assert_eq!(held, [(InstanceId(0), vec![InstanceId(2)])]);
}

#[test]
fn those_held_back_for_each_other_are_no_plan() {
    let mut tasks = vec![task(0, 1.0, "m", &[]), task(1, 1.0, "m", &[])];
    (tasks[0].held_for, tasks[1].held_for) = (vec![1], vec![0]);
    let advice = Search::new(&problem(tasks.clone(), &[("m", 1)]), 1).unwrap().best();
    assert!(advice.end_s == 2.0 && advice.plain_s > 1e9 && advice.held.is_empty(), "{advice:?}");
    tasks[1].held_for = vec![7];
    assert!(matches!(Search::new(&problem(tasks, &[("m", 1)]), 1), Err(ProblemError::Unknown { after: 7, .. })));
}

#[test]
fn a_later_search_begins_where_the_one_before_ended() {
    for (seed, machines) in (0..60).flat_map(|seed| [(seed, false), (seed, true)]) {
        let problem = small(seed, machines);
        let mut search = Search::new(&problem, seed).unwrap();
        search.step(600);
        let memory = search.memory();
        let mut later = Search::remembering(&problem, seed, &memory).unwrap();
        // Two lists are the dispatch's own, the third is the best remembered one; each makes three schedules.
        later.step(9);
        assert!(later.best().end_s <= search.best().end_s, "seed {seed}, machines: {machines}");
    }
}
