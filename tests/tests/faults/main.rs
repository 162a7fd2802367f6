//! Random clients of real daemons, under faults from a seed: every history is that of one pool that does one thing at a time, and a
//! provider moves for one holder at a time.
//!
//! `RATN_ROUNDS` says how many rounds (12), `RATN_SEED` from which seed on; `scripts/soak-faults` plays a thousand. Two rounds are played
//! at the same time. What goes wrong is in `round.rs`, how it is made to go wrong in `line.rs`, `manager.rs` and `shim.c`; what the
//! clients do in `clients.rs`; what must hold in `model.rs` and `exclusion.rs`.
#![allow(clippy::unwrap_used, clippy::expect_used, reason = "a test may panic")]

mod asking;
mod clients;
mod exclusion;
mod history;
mod line;
mod manager;
mod model;
mod oracle;
mod provider;
mod round;
mod search;
#[path = "../support/mod.rs"]
mod support;

use anyhow::ensure;
use manager::Shim;
use round::{Outcome, play};
use std::collections::BTreeMap;
use std::time::{Duration, Instant};
use support::crashes::number;
use tokio::task::JoinSet;

/// Rounds of every test run.
const ROUNDS: u64 = 12;
/// Rounds at the same time.
const AT_ONCE: usize = 2;

/// The role of a provider's process; as a test it does nothing.
#[test]
fn a_provider() -> anyhow::Result<()> {
    provider::serve()
}

#[derive(Default)]
struct Sum {
    rounds: u64,
    calls: usize,
    states: usize,
    undecided: u64,
    steps: usize,
    holders: usize,
    latest: Duration,
    counts: BTreeMap<String, usize>,
}

impl Sum {
    fn add(&mut self, outcome: Outcome) {
        self.rounds += 1;
        self.calls += outcome.calls;
        self.states = self.states.max(outcome.states.unwrap_or_default());
        self.undecided += u64::from(outcome.states.is_none());
        self.steps += outcome.measured.steps;
        self.holders += outcome.measured.holders;
        self.latest = self.latest.max(outcome.measured.latest);
        outcome.counts.into_iter().for_each(|(what, count)| *self.counts.entry(what).or_default() += count);
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 3)]
async fn histories_under_faults_are_those_of_one_pool_and_a_provider_moves_for_one_holder_at_a_time()
-> anyhow::Result<()> {
    let (rounds, seed) = (number("RATN_ROUNDS", ROUNDS), number("RATN_SEED", 1));
    println!("{rounds} rounds from RATN_SEED={seed}");
    let directory = tempfile::tempdir()?;
    let shim = Shim::build(directory.path());
    let begin = Instant::now();
    let (mut playing, mut sum) = (JoinSet::new(), Sum::default());
    for seed in seed..seed + rounds {
        if playing.len() == AT_ONCE {
            sum.add(playing.join_next().await.expect("one is played")??);
        }
        let shim = shim.clone();
        playing.spawn(async move {
            let begin = Instant::now();
            let played = play(seed, shim).await;
            println!("round {seed}: {} ms", begin.elapsed().as_millis());
            played
        });
    }
    while let Some(played) = playing.join_next().await {
        sum.add(played??);
    }
    println!(
        "{} rounds in {:.0} s, {} of them undecided: {} calls, at most {} states for a history; {} steps of the tool for {} holders, at the latest {} ms \
         after the next one was granted it",
        sum.rounds,
        begin.elapsed().as_secs_f64(),
        sum.undecided,
        sum.calls,
        sum.states,
        sum.steps,
        sum.holders,
        sum.latest.as_millis()
    );
    println!("{:#?}", sum.counts);
    ensure!(sum.undecided * 10 <= sum.rounds, "{} of {} rounds are undecided", sum.undecided, sum.rounds);
    Ok(())
}
