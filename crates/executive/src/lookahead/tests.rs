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
        urgency_s: 0.0,
        probability: 1.0,
    }
}

fn problem(tasks: Vec<Task>, capacity: &[(&str, u32)]) -> Problem {
    Problem { tasks, capacity: capacity.iter().map(|(kind, units)| ((*kind).to_owned(), (*units).into())).collect() }
}

/// Anything: chains and joins, several units, running and speculative tasks.
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
    // The machine could do the second first, on whose end nobody waits.
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
