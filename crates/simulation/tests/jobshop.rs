//! Scheduling quality on instances that nobody here has made: classic job shops as tasks, in CDTN mode.

use ratn_model::program::SUCCESS;
use ratn_simulation::activities::{DEFAULT_ORDERS, Execution};
use ratn_simulation::jobshop::{JobShop, best_known};

macro_rules! instances {
    ($($name:literal),*) => {
        [$(($name, include_str!(concat!("../../../tests/jobshop/", $name, ".txt")))),*]
    };
}

const INSTANCES: [(&str, &str); 23] = instances!(
    "ft06", "ft10", "ft20", "la01", "la02", "la03", "la04", "la05", "la06", "la07", "la08", "la09", "la10", "la11",
    "la12", "la13", "la14", "la15", "la16", "la17", "la18", "la19", "la20"
);

/// The ratio of makespan to best known, of every instance.
fn ratios(orders: usize) -> Vec<f64> {
    INSTANCES
        .iter()
        .map(|(name, text)| {
            let shop = JobShop::parse(text).unwrap_or_else(|error| unreachable!("{name}: {error}"));
            let run = shop
                .activities()
                .execute(Execution { orders, ..Execution::default() })
                .unwrap_or_else(|error| unreachable!("{name}: {error}"));
            assert_eq!(run.outcome, SUCCESS, "{name}: {}", run.reason);
            let best = best_known(name).unwrap_or_else(|| unreachable!("{name} is not known"));
            assert!(run.end_s >= best, "{name}: {} is better than the best possible {best}", run.end_s);
            run.end_s / best
        })
        .collect()
}

/// Enough, and fifteen times as fast as the default.
const ORDERS: usize = DEFAULT_ORDERS / 15;

fn mean(ratios: &[f64]) -> f64 {
    ratios.iter().sum::<f64>() / ratios.len() as f64
}

#[test]
fn job_shops_come_within_a_twentieth_of_the_best_known_and_no_instance_gets_worse() {
    let plain = ratios(0);
    let ahead = ratios(ORDERS);
    assert!((mean(&plain) - 1.11).abs() < 0.01, "plain dispatch: {:.4}", mean(&plain));
    assert!(mean(&ahead) <= 1.05, "with a look ahead: {:.4}", mean(&ahead));
    for ((name, _), (plain, ahead)) in INSTANCES.iter().zip(plain.iter().zip(&ahead)) {
        assert!(ahead <= plain, "{name}: {ahead:.4} after {plain:.4}");
    }
}
