//! The ids of a run's trace and of its spans. They are derived from the run: the export of its log, the run itself and the daemons that it
//! calls get the same ids, and no message has to carry them.

/// The id of the run's own span; ids of instances are larger.
pub const ROOT: u64 = 1;

/// Ids of jobs and waits follow that of their instance: an instance can have at most this many.
pub const PARTS: u64 = 1 << 16;

/// The trace id of a run.
pub fn trace(run: &str, task: &str, seed: u64, began_unix_ms: u64) -> u128 {
    let named = format!("{run} {task} {seed}");
    (u128::from(number_of(&named)) << 64) | u128::from(began_unix_ms)
}

/// The span id of an instance of a run. Number 0 stands for no instance: work of the run itself belongs to the root span.
pub fn instance(instance: u64) -> u64 {
    if instance == 0 { ROOT } else { (instance + 1).wrapping_mul(PARTS) }
}

/// A hash of a name (FNV-1a), never 0.
pub fn number_of(name: &str) -> u64 {
    let hash = name
        .bytes()
        .fold(0xcbf2_9ce4_8422_2325_u64, |hash, byte| (hash ^ u64::from(byte)).wrapping_mul(0x0100_0000_01b3));
    hash.max(1)
}
