//! A look ahead changes when things happen, never what happens; and it makes the paper's tasks no longer.

#![allow(clippy::unwrap_used, reason = "a test may panic")]

use ratn_executive::protocol::{Event, LogEntry, Mode};
use ratn_model::catalogue::{Catalogue, ResourceOffer};
use ratn_model::resource::ResourceClass;
use ratn_model::tolerance::Tolerance;
use ratn_simulation::run::{Run, Setup, run, run_looking_ahead};
use ratn_simulation::tables::{FETCH_BOXES, SET_TABLE};
use ratn_simulation::timed::TimedProviders;
use ratn_trials::{Features, HashOracle, RESOURCES, program};
use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

/// Orders per look; few, for a test.
const ORDERS: usize = 60;
const SEEDS: u64 = 300;

fn is_advised(run: &Run) -> bool {
    run.log.iter().any(|line| matches!(line.entry, LogEntry::Event(Event::Advised { .. })))
}

#[test]
fn random_programs_come_to_the_same_with_and_without() {
    let mut advised = 0;
    for seed in 0..SEEDS {
        let program = Arc::new(program(seed, &Features::BASIC));
        let setup = |mode| Setup {
            program: program.clone(),
            mode,
            parameters: BTreeMap::new(),
            seed,
            resources: RESOURCES
                .iter()
                .map(|(kind, class, units)| ((*kind).to_owned(), ResourceOffer::new(*class, *units)))
                .collect(),
            world: Vec::new(),
            tolerance: Tolerance::EXACT,
            latency: if seed.is_multiple_of(2) { Duration::ZERO } else { Duration::from_millis(1500) },
        };
        let oracle = || HashOracle {
            program: &program,
            seed,
            failures_percent: 3,
            crashes_percent: 5,
            deviations_percent: 0,
            stops: false,
        };
        let hsm = run(setup(Mode::Hsm), &mut oracle()).unwrap();
        let ahead = run_looking_ahead(setup(Mode::Cdtn), &mut oracle(), ORDERS);
        let ahead = ahead.unwrap_or_else(|error| unreachable!("seed {seed}: {error}"));
        let facts =
            |run: &Run| -> Vec<String> { run.world.iter().map(|(k, f)| format!("{k} = {}", f.value)).collect() };
        assert_eq!((&hsm.outcome, &hsm.outputs), (&ahead.outcome, &ahead.outputs), "seed {seed}");
        assert_eq!((facts(&hsm), &hsm.units), (facts(&ahead), &ahead.units), "seed {seed}");
        advised += u64::from(is_advised(&ahead));
    }
    assert!(advised >= 3, "only {advised} of {SEEDS} runs were advised");
}

#[test]
fn the_papers_tasks_take_no_longer() {
    let catalogue = Catalogue::standard();
    let tasks = [
        (FETCH_BOXES, vec![("boxes", "3")], 3),
        (FETCH_BOXES, vec![("boxes", "9")], 9),
        (SET_TABLE, vec![("bowls", "3"), ("forks", "3")], 0),
    ];
    for (text, parameters, boxes) in tasks {
        for planners in [1, 2] {
            let program = ratn_model::load::load(text, "task.yaml", &catalogue).unwrap().program;
            let set: Vec<(String, String)> =
                parameters.iter().map(|(name, value)| ((*name).to_owned(), (*value).to_owned())).collect();
            let setup = || Setup {
                program: Arc::new(program.clone()),
                mode: Mode::Cdtn,
                parameters: program.bind_parameters(&set).unwrap(),
                seed: 1,
                resources: catalogue
                    .resources
                    .iter()
                    .map(|(kind, offer)| match (kind.as_str(), offer.class) {
                        ("PathPlanner", class) => (kind.clone(), ResourceOffer::new(class, planners)),
                        (_, ResourceClass::World) => (kind.clone(), offer.clone()),
                        (_, class) => (kind.clone(), ResourceOffer::new(class, 1)),
                    })
                    .collect(),
                world: Vec::new(),
                tolerance: Tolerance::EXACT,
                latency: Duration::ZERO,
            };
            let plain = run(setup(), &mut TimedProviders { boxes }).unwrap();
            let ahead = run_looking_ahead(setup(), &mut TimedProviders { boxes }, ORDERS).unwrap();
            assert_eq!((plain.outcome.as_str(), ahead.outcome.as_str()), ("success", "success"));
            assert!(ahead.end_s <= plain.end_s + 1e-6, "{set:?}, {planners}: {} after {}", ahead.end_s, plain.end_s);
        }
    }
}
