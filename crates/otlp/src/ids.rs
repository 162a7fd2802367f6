//! The ids of a run's trace and of its spans. They follow from the run: the export of its log, the run itself and the daemons that it
//! calls come to the same, and no message has to say them.

/// The run's own span; those of instances are behind it.
pub const ROOT: u64 = 1;

/// Jobs and waits have ids of their own, behind their instance's: of one instance there are at most so many.
pub const PARTS: u64 = 1 << 16;

/// The trace of a run.
pub fn trace(run: &str, task: &str, seed: u64, began_unix_ms: u64) -> u128 {
    let named = format!("{run} {task} {seed}");
    (u128::from(number_of(&named)) << 64) | u128::from(began_unix_ms)
}

/// The span of an instance of a run. Number 0 stands for no instance: what the run does itself is of its own span.
pub fn instance(instance: u64) -> u64 {
    if instance == 0 { ROOT } else { (instance + 1).wrapping_mul(PARTS) }
}

/// A number that is always the same for a name (FNV-1a), never 0.
pub fn number_of(name: &str) -> u64 {
    let hash = name
        .bytes()
        .fold(0xcbf2_9ce4_8422_2325_u64, |hash, byte| (hash ^ u64::from(byte)).wrapping_mul(0x0100_0000_01b3));
    hash.max(1)
}
