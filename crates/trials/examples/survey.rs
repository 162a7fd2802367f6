//! Tries programs and says of each that fails, in a line, how; stops at none. `survey FEATURES TRIAL FIRST COUNT [shrink]`; features as
//! in `scripts/soak`, the trial is `plain`, `outside` or `interrupted`. Says last of how many the reference has no verdict, and why.

#![allow(clippy::print_stdout, reason = "it is what it is for")]

use ratn_trials::{
    Conditions, Features, Verdict, listing, no_verdict, program, shrink_by, trial, trial_from_outside,
    trial_interrupted,
};
use std::collections::BTreeMap;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex};

fn main() {
    let arguments: Vec<String> = std::env::args().collect();
    let word = |n: usize| arguments.get(n).map_or("", String::as_str);
    let number = |n: usize| word(n).parse::<u64>().unwrap_or(0);
    let features = match word(1) {
        "basic" => Features::BASIC,
        "everything" => Features::EVERYTHING,
        "weak" => Features::WEAK,
        "imprecise" => Features::IMPRECISE,
        "guards" => Features::GUARDS,
        "guards-short" => Features { long: false, ..Features::GUARDS },
        "guards-weak" => Features { guards: true, ..Features::WEAK },
        "short" => Features { long: false, ..Features::EVERYTHING },
        "alone" => Features { regions: false, preemptive: false, ..Features::ALL },
        _ => Features::ALL,
    };
    let by = match word(2) {
        "outside" => trial_from_outside,
        "interrupted" => trial_interrupted,
        _ => trial,
    };
    let (first, count, shrinks) = (number(3), number(4), word(5) == "shrink");
    let next = AtomicU64::new(0);
    let reasons: Mutex<BTreeMap<&str, u64>> = Mutex::default();
    let sums = Mutex::new((0, 0, 0));
    let worker = || {
        loop {
            let seed = first + next.fetch_add(1, Ordering::Relaxed);
            if seed >= first + count {
                return;
            }
            let (made, conditions) = (Arc::new(program(seed, &features)), Conditions::of(seed, &features));
            if let Some(why) = no_verdict(&made, &conditions) {
                *reasons.lock().unwrap_or_else(|e| e.into_inner()).entry(why).or_default() += 1;
            }
            let verdict = std::panic::catch_unwind(|| by(&made, &conditions))
                .unwrap_or_else(|_| Verdict::Differs("it panics".to_owned()));
            let mut sums = sums.lock().unwrap_or_else(|e| e.into_inner());
            sums.0 += 1;
            if sums.0 % 1_000 == 0 {
                println!("{} {}: {sums:?} programs, left out, failed", word(1), word(2));
            }
            match verdict {
                Verdict::Same { .. } => {}
                Verdict::LeftOut => sums.1 += 1,
                Verdict::Differs(problem) => {
                    sums.2 += 1;
                    drop(sums);
                    let line: String = problem.replace('\n', " ").chars().take(260).collect();
                    println!("FAIL {} {} {seed}: {line}", word(1), word(2));
                    if shrinks {
                        let left = shrink_by(by, Arc::unwrap_or_clone(made), conditions, problem);
                        println!("shrunk: {}\n{:?}\n{}", left.problem, left.conditions, listing(&left.program));
                    }
                }
            }
        }
    };
    std::thread::scope(|scope| {
        for _ in 0..std::thread::available_parallelism().map_or(1, usize::from) {
            scope.spawn(worker);
        }
    });
    println!(
        "{sums:?} programs, left out, failed; without a verdict: {reasons:?}",
        sums = sums.into_inner(),
        reasons = reasons.into_inner()
    );
}
