//! Seeds keep their meaning: whatever the generator learns to make, the old features make the programs they always made.

use ratn_trials::{Dice, Features, listing, program};

/// What a program without guards had no words for when the fingerprints were taken.
const NO_GUARDS: &str = ", again: None, finally: None";

/// The same of one without motions that are watched.
const NOT_WATCHED: &str = "holds: [], ";

/// The same of one whose concurrencies do not count successes.
const NOT_COUNTED: &str = "successes: None, ";

/// The same of one without results that get better.
const NOT_ANYTIME: &str = "anytime: false, ";

/// The same of one without a hierarchy of kinds.
const NO_KINDS: &str = "kinds: {}, ";

/// The same of one whose conditions and loops have no outputs.
const NO_OUTPUTS: &str = ", outputs: []";

/// The text without [`NO_OUTPUTS`] behind the last list of a condition or a loop.
fn without_outputs(text: &str) -> String {
    let mut next = String::new();
    let mut rest = text;
    let list =
        |text: &str| ["body: [", "otherwise: ["].iter().filter_map(|key| Some(text.find(key)? + key.len())).min();
    while let Some(begin) = list(rest) {
        let end = rest[begin..].find(']').map_or(rest.len(), |end| begin + end + 1);
        next.push_str(&rest[..end]);
        rest = rest[end..].strip_prefix(NO_OUTPUTS).unwrap_or(&rest[end..]);
    }
    next + rest
}

/// FNV-1a over what the programs of the first seeds look like.
fn fingerprint(features: &Features) -> u64 {
    let mut sum = Dice(0);
    for seed in 0..300 {
        let program = format!("{:?}", program(seed, features))
            .replace(NO_GUARDS, "")
            .replace(NOT_WATCHED, "")
            .replace(NOT_COUNTED, "")
            .replace(NOT_ANYTIME, "")
            .replace(NO_KINDS, "");
        for byte in without_outputs(&program).bytes() {
            sum.0 = (sum.0 ^ u64::from(byte)).wrapping_mul(0x0000_0100_0000_01b3);
        }
    }
    sum.0
}

#[test]
fn the_old_features_make_the_programs_they_always_made() {
    let all = [Features::BASIC, Features::ALL, Features::WEAK].map(|features| fingerprint(&features));
    assert_eq!(
        all,
        [13_219_096_853_391_528_144, 11_476_605_008_387_410_266, 1_278_242_996_555_017_609],
        "a seed that was written down somewhere means another program now"
    );
}

#[test]
fn everything_is_made() {
    let made: Vec<String> = (0..3_000).map(|seed| listing(&program(seed, &Features::EVERYTHING))).collect();
    let expected = [
        "with an ontology",
        "$k0 = ",
        "exists (",
        "p20() + ",
        "p21(?, ?)",
        ", box)",
        "p24(0).a",
        "for each in list: for other in",
        "increase p0(0) by -",
        "by x * 0.5",
        "if(exists p30(0), p30(0) <",
        "tool where level",
        "tool where has cuts",
        "block 0.5 power",
        "consume 0.125 battery",
        "| duration ",
        "| attempts 1",
        "stopped",
        "variables g",
        "range(1000)",
        "  c99 (",
    ];
    for text in expected {
        let with = made.iter().filter(|listing| listing.contains(text)).count();
        assert!(with > 0, "no program has `{text}`");
    }
}

#[test]
fn waits_of_every_kind_are_made() {
    let made: Vec<String> = (0..400).map(|seed| listing(&program(seed, &Features::WAITS))).collect();
    let expected = [
        "seconds(seconds: ",
        "until(until: ",
        "condition(for: ",
        "for: not exists ",
        " and p",
        "signal(signal: signal_",
        "ask(question: ",
        "default: ",
        "timeout 60 s",
        "timeout → ",
        ": value",
        ": answer",
    ];
    for text in expected {
        let with = made.iter().filter(|listing| listing.contains(text)).count();
        assert!(with > 0, "no program has `{text}`");
    }
}

#[test]
fn what_is_watched_and_what_is_found_is_made() {
    let made: Vec<String> = (0..300).map(|seed| listing(&program(seed, &Features::WATCHED))).collect();
    for (expected, least) in [("while not p", 20), ("while exists p", 20), ("len(find(?", 60)] {
        let found = made.iter().filter(|listing| listing.contains(expected)).count();
        assert!(found >= least, "`{expected}` is in {found} of 300 programs");
    }
    let has_watch = |seed: &u64| program(*seed, &Features::WATCHED).states.iter().any(|state| state.is_watch());
    let hierarchies = (0..300).filter(has_watch).count();
    assert!(hierarchies >= 20, "a hierarchy is watched in {hierarchies} of 300 programs");
}

#[test]
fn outputs_of_everything_that_contains_states_are_made() {
    let made: Vec<String> = (0..300).map(|seed| listing(&program(seed, &Features::OUTPUTS))).collect();
    let lines = |kind: &str, said: &str| {
        let has = |line: &str| line.contains(kind) && line.contains(said);
        made.iter().filter(|listing| listing.lines().any(has)).count()
    };
    let expected = [
        (": if ", "→ x: either(", 40),
        (": for ", "→ x: ", 40),
        (": for ", "all: $all of ", 20),
        (" while", "→ x: ", 20),
        (": barrier", "→ x: either(", 20),
        (": preemptive", "→ x: either(", 5),
        ("(s", "of_x_", 60),
        ("! [", "= either(", 10),
        ("outputs ", "of_all_", 10),
    ];
    for (kind, said, least) in expected {
        let found = lines(kind, said);
        assert!(found >= least, "`{kind}` with `{said}` is in {found} of 300 programs");
    }
}

#[test]
fn states_of_loops_that_read_what_they_gave_before_are_made() {
    let made = (0..300).map(|seed| format!("{:?}", program(seed, &Features::OUTPUTS)));
    let with = made.filter(|program| program.contains("of_the_last_")).count();
    assert!(with >= 20, "{with} of 300 do");
}
