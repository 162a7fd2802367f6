//! Same task, same world: random programs in both modes end alike, and in CDTN mode every irreversible action starts in the
//! order, and with the inputs, of HSM mode.
//!
//! `RATN_PROGRAMS` is how many programs (2,000), `RATN_FIRST` the seed to begin with (0), `RATN_FEATURES` is `basic`, `all` (what
//! was made first, and what it is unless given), `everything`, `weak` or `imprecise`. A seed that fails is printed with the smallest program found that still does, and with the events
//! of that one's runs where `RATN_LOG` is set.

#![allow(clippy::unwrap_used, clippy::print_stderr, reason = "a test may panic and print its seed")]

use ratn_executive::protocol::Mode;
use ratn_model::program::Program;
use ratn_trials::{
    Conditions, Features, Shrunk, Verdict, execute, listing, program, shrink_by, trial, trial_from_outside,
    trial_interrupted,
};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

/// What came of many programs.
#[derive(Debug, Default)]
struct Sum {
    programs: u64,
    left_out: u64,
    slower: u64,
    acts: usize,
    hsm_s: f64,
    cdtn_s: f64,
    failed: Vec<u64>,
}

fn number(name: &str, otherwise: u64) -> u64 {
    std::env::var(name).ok().map_or(otherwise, |n| n.parse().unwrap_or_else(|_| panic!("{name}: no number: {n}")))
}

/// The events of the runs in both modes, for `RATN_LOG=1`.
fn print_logs(left: Shrunk) {
    const MAX_EVENTS: usize = 100_000;
    let program = Arc::new(left.program);
    for mode in [Mode::Hsm, Mode::Cdtn] {
        eprintln!("{mode:?}");
        match execute(&program, &left.conditions, mode, MAX_EVENTS) {
            Ok(run) => run.log.iter().for_each(|line| eprintln!("{line:?}")),
            Err(problem) => eprintln!("{problem}"),
        }
    }
}

/// How a program is tried.
type Trial = fn(&Arc<Program>, &Conditions) -> Verdict;

/// Programs of the seeds from `first` on, on all processors. A few failures end it.
fn try_programs(first: u64, count: u64, features: &Features) -> Sum {
    try_by(trial, first, count, features)
}

/// The same for any trial.
fn try_by(trial: Trial, first: u64, count: u64, features: &Features) -> Sum {
    const MAX_FAILURES: usize = 3;
    let next = AtomicU64::new(0);
    let failures = AtomicU64::new(0);
    let processors = std::thread::available_parallelism().map_or(1, usize::from);
    let worker = || {
        let mut sum = Sum::default();
        loop {
            let number = next.fetch_add(1, Ordering::Relaxed);
            if number >= count || failures.load(Ordering::Relaxed) >= MAX_FAILURES as u64 {
                return sum;
            }
            if number > 0 && number.is_multiple_of(10_000) {
                eprintln!("{number} programs; to go on from here: RATN_FIRST={}", first + number);
            }
            let seed = first + number;
            let (made, conditions) = (Arc::new(program(seed, features)), Conditions::of(seed, features));
            sum.programs += 1;
            match trial(&made, &conditions) {
                Verdict::Same { hsm_s, cdtn_s, acts } => {
                    // Preemptive concurrencies take hours, so that what ends first is certain.
                    let is_long = hsm_s.max(cdtn_s) > 5_000.0;
                    sum.hsm_s += if is_long { 0.0 } else { hsm_s };
                    sum.cdtn_s += if is_long { 0.0 } else { cdtn_s };
                    sum.acts += acts;
                    sum.slower += u64::from(cdtn_s > hsm_s + 1e-6);
                }
                Verdict::LeftOut => sum.left_out += 1,
                Verdict::Differs(problem) => {
                    failures.fetch_add(1, Ordering::Relaxed);
                    sum.failed.push(seed);
                    let left = shrink_by(trial, Arc::unwrap_or_clone(made), conditions, problem.clone());
                    eprintln!(
                        "seed {seed}: {problem}\nshrunk to: {}\n{:?}\n{}",
                        left.problem,
                        left.conditions,
                        listing(&left.program)
                    );
                    if std::env::var_os("RATN_LOG").is_some() {
                        print_logs(left);
                    }
                }
            }
        }
    };
    let sums: Vec<Sum> = std::thread::scope(|scope| {
        let threads: Vec<_> = (0..processors).map(|_| scope.spawn(worker)).collect();
        threads.into_iter().map(|thread| thread.join().unwrap()).collect()
    });
    sums.into_iter().fold(Sum::default(), |a, b| Sum {
        programs: a.programs + b.programs,
        left_out: a.left_out + b.left_out,
        slower: a.slower + b.slower,
        acts: a.acts + b.acts,
        hsm_s: a.hsm_s + b.hsm_s,
        cdtn_s: a.cdtn_s + b.cdtn_s,
        failed: a.failed.into_iter().chain(b.failed).collect(),
    })
}

#[test]
fn random_programs_leave_the_same_world_in_both_modes() {
    let features = match std::env::var("RATN_FEATURES").as_deref() {
        Ok("basic") => Features::BASIC,
        Ok("weak") => Features::WEAK,
        Ok("everything") => Features::EVERYTHING,
        Ok("imprecise") => Features::IMPRECISE,
        Ok("all") | Err(_) => Features::ALL,
        Ok(other) => panic!("RATN_FEATURES: basic, all, everything, weak or imprecise, not {other}"),
    };
    let (first, count) = (number("RATN_FIRST", 0), number("RATN_PROGRAMS", 2000));
    let sum = try_programs(first, count, &features);
    assert!(sum.failed.is_empty(), "the programs of these seeds fail: {:?}", sum.failed);
    assert!(sum.left_out * 20 <= sum.programs, "{} of {} programs are too long to compare", sum.left_out, sum.programs);
    assert!(count < 100 || sum.cdtn_s < 0.95 * sum.hsm_s, "the network gains nothing: {sum:?}");
}

/// Tries of a result that was invalidated, facts that a routine's effects look up, outcomes of a routine's parts that may change
/// everything, the index of a loop whose test failed,
/// exits that failed because of what was invalidated later, a motion that ended without the effects that were predicted.
#[test]
fn programs_that_once_failed_leave_the_same_world() {
    const ONCE_FAILED: [u64; 8] =
        [1_030_006, 1_000_548, 1_114_152, 2_003_452, 2_080_624, 2_031_869, 5_297_894, 8_081_564];
    for seed in ONCE_FAILED {
        let sum = try_programs(seed, 1, &Features::ALL);
        assert!(sum.failed.is_empty(), "the program of seed {seed} fails");
    }
}

/// Facts that effects look up and a motion that is still under way beside writes; outputs of such a motion that effects are made of; a
/// motion that fails while the line that passed it waits for regions; one that may try again after a pause; one that has ended, and
/// waits to become real, when the one beside fails; what it may write with an outcome that is not the first;
/// the exit of a state in which it still runs.
#[test]
fn programs_that_once_failed_without_the_assumptions_are_decided_and_final() {
    const ONCE_FAILED: [u64; 9] = [
        1_099_511_633_032,
        1_099_511_633_947,
        50_015_019,
        50_018_935,
        50_024_603,
        60_083_909,
        60_093_968,
        62_089_418,
        62_092_164,
    ];
    for seed in ONCE_FAILED {
        let sum = try_programs(seed, 1, &Features::WEAK);
        assert!(sum.failed.is_empty(), "the program of seed {seed} fails");
    }
}

#[test]
fn without_the_theorem_s_assumptions_what_acts_is_still_decided_and_final() {
    let programs = number("RATN_PROGRAMS", 2000) / 4;
    let sum = try_programs(1 << 40, programs, &Features::WEAK);
    assert!(sum.failed.is_empty(), "the programs of these seeds fail: {:?}", sum.failed);
}

/// What seed the programs of the newer features begin with.
const FURTHER: u64 = 1 << 41;

#[test]
fn random_programs_of_everything_leave_the_same_world_in_both_modes() {
    let count = number("RATN_PROGRAMS", 2000);
    let sum = try_programs(FURTHER, count, &Features::EVERYTHING);
    assert!(sum.failed.is_empty(), "the programs of these seeds fail: {:?}", sum.failed);
    assert!(sum.left_out * 10 <= sum.programs, "{} of {} programs are too long to compare", sum.left_out, sum.programs);
}

/// Nothing looks at the world, imprecise motions fail: the outcomes are HSM mode's all the same.
#[test]
fn where_an_imprecise_motion_s_failure_leads_is_the_same_in_both_modes() {
    let sum = try_programs(FURTHER, number("RATN_PROGRAMS", 2000) / 2, &Features::IMPRECISE);
    assert!(sum.failed.is_empty(), "the programs of these seeds fail: {:?}", sum.failed);
}

#[test]
fn random_programs_that_are_interrupted_do_the_first_of_what_they_would_have_done() {
    let count = number("RATN_PROGRAMS", 2000) / 2;
    for features in [Features::ALL, Features::EVERYTHING] {
        let sum = try_by(trial_interrupted, FURTHER, count, &features);
        assert!(sum.failed.is_empty(), "the programs of these seeds fail: {:?}", sum.failed);
        assert!(sum.left_out * 2 < sum.programs, "most are compared");
    }
}

#[test]
fn random_programs_leave_the_same_world_in_both_modes_although_it_changes_from_outside() {
    let (first, count) = (number("RATN_FIRST", 0), number("RATN_PROGRAMS", 2000) / 2);
    let alone = Features { regions: false, preemptive: false, ..Features::ALL };
    for features in [alone, Features::EVERYTHING] {
        let sum = try_by(trial_from_outside, first, count, &features);
        assert!(sum.failed.is_empty(), "the programs of these seeds fail: {:?}", sum.failed);
        assert!(sum.left_out * 2 < sum.programs, "most are compared");
    }
}
