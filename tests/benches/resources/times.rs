//! Times of calls, and what a disk takes alone.

use std::fs::OpenOptions;
use std::io::Write;
use std::path::Path;
use std::time::Instant;

/// Microseconds of every call.
#[derive(Default)]
pub(crate) struct Times(Vec<f64>);

impl Times {
    pub(crate) fn add(&mut self, began: Instant) {
        self.add_us(began.elapsed().as_secs_f64() * 1e6);
    }

    pub(crate) fn add_us(&mut self, us: f64) {
        self.0.push(us);
    }

    pub(crate) fn count(&self) -> usize {
        self.0.len()
    }

    /// The time that this part of the calls is not above, in tenths of a microsecond.
    pub(crate) fn at(&mut self, part: f64) -> f64 {
        self.0.sort_by(f64::total_cmp);
        let index = ((self.0.len() - 1) as f64 * part) as usize;
        (self.0[index] * 10.0).round() / 10.0
    }
}

/// So many times a record as large as that of an acquire is appended to a file and synced.
pub(crate) fn plain_sync(directory: &Path, count: usize, times: &mut Times) {
    let mut file = OpenOptions::new().create(true).append(true).open(directory.join("plain")).unwrap();
    for _ in 0..count {
        let began = Instant::now();
        file.write_all(&[7; 200]).unwrap();
        file.sync_data().unwrap();
        times.add(began);
    }
}
