//! Random numbers that are unique among processes.

use std::fs::File;
use std::io::{self, Read};

/// A number from the system's random number generator.
pub(crate) fn number() -> io::Result<u64> {
    let mut bytes = [0; 8];
    File::open("/dev/urandom")?.read_exact(&mut bytes)?;
    Ok(u64::from_le_bytes(bytes))
}
