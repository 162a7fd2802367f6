//! Seeds keep their meaning: whatever the generator learns to make, the old features make the programs they always made.

use ratn_trials::{Dice, Features, program};

/// FNV-1a over what the programs of the first seeds look like.
fn fingerprint(features: &Features) -> u64 {
    let mut sum = Dice(0);
    for seed in 0..300 {
        for byte in format!("{:?}", program(seed, features)).bytes() {
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
        [10_389_196_769_696_335_920, 1_180_402_043_409_272_414, 7_919_185_597_585_669_513],
        "a seed that was written down somewhere means another program now"
    );
}
