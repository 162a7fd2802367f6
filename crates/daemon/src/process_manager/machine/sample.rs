//! One measurement of the machine.

use nix::sys::statvfs::statvfs;
use std::fs;
use std::path::{Path, PathBuf};
use sysinfo::{MemoryRefreshKind, System};

/// Directory in which the kernel lists batteries.
const POWER_SUPPLIES: &str = "/sys/class/power_supply";

/// Capacities of the machine, and what is free now.
#[derive(Debug, Clone, PartialEq)]
pub struct Sample {
    /// Number of processors.
    pub cores: u32,
    /// Load average of the last minute, per processor.
    pub load_per_core: f64,
    /// Processors that were idle since the last measurement.
    pub idle_cores: f64,
    /// Memory in bytes.
    pub memory_bytes: u64,
    /// Memory that is available to programs.
    pub free_memory_bytes: u64,
    /// Size of the disk with the runtime directory.
    pub disk_bytes: u64,
    /// Disk space that is available to this user.
    pub free_disk_bytes: u64,
    /// Charge of the battery, 0 to 1, where there is one and it is wanted.
    pub battery: Option<f64>,
}

/// Keeps the last measurement, from which idle time is computed.
#[derive(Debug)]
pub(super) struct Sampler {
    /// `None` where the system does not provide it.
    system: Option<System>,
    disk: PathBuf,
    battery: bool,
    /// Time of all processors, in ticks: idle, and total.
    ticks: (u64, u64),
}

impl Sampler {
    pub(super) fn new(disk: PathBuf, battery: bool) -> Sampler {
        Sampler { system: System::new().ok(), disk, battery, ticks: ticks().unwrap_or_default() }
    }

    pub(super) fn look(&mut self) -> Sample {
        let cores = std::thread::available_parallelism().map_or(1, usize::from);
        let (mut memory_bytes, mut free_memory_bytes) = (0, 0);
        if let Some(system) = &mut self.system {
            system.refresh_memory_specifics(MemoryRefreshKind::nothing().with_ram());
            (memory_bytes, free_memory_bytes) = (system.total_memory(), system.available_memory());
        }
        let load = System::load_average().map_or(0.0, |load| load.one);
        let disk = statvfs(&self.disk).ok();
        let bytes = |blocks: u64| disk.map_or(0, |disk| blocks.saturating_mul(disk.fragment_size()));
        let (idle, all) = ticks().unwrap_or_default();
        let (idle_for, in_all) = (idle.saturating_sub(self.ticks.0), all.saturating_sub(self.ticks.1));
        let share = if in_all == 0 { 1.0 } else { idle_for as f64 / in_all as f64 };
        self.ticks = (idle, all);
        Sample {
            cores: u32::try_from(cores).unwrap_or(u32::MAX),
            load_per_core: load / cores as f64,
            idle_cores: share.clamp(0.0, 1.0) * cores as f64,
            memory_bytes,
            free_memory_bytes,
            disk_bytes: disk.map_or(0, |disk| bytes(disk.blocks())),
            free_disk_bytes: disk.map_or(0, |disk| bytes(disk.blocks_available())),
            battery: self.battery.then(|| battery(Path::new(POWER_SUPPLIES))).flatten(),
        }
    }
}

/// The first line of `proc_stat(5)`: idle time (fourth and fifth number: idle, and waiting for a disk) and total
/// time (sum of the first eight).
fn ticks() -> Option<(u64, u64)> {
    let text = fs::read_to_string("/proc/stat").ok()?;
    let numbers: Vec<u64> =
        text.lines().next()?.split_whitespace().skip(1).take(8).filter_map(|number| number.parse().ok()).collect();
    Some((numbers.get(3)? + numbers.get(4)?, numbers.iter().sum()))
}

/// The charge of the emptiest battery.
fn battery(supplies: &Path) -> Option<f64> {
    let supplies = fs::read_dir(supplies).ok()?.flatten();
    let word = |path: &Path, name: &str| fs::read_to_string(path.join(name)).ok().map(|text| text.trim().to_owned());
    let charge = |path: PathBuf| {
        (word(&path, "type")? == "Battery" && word(&path, "scope").is_none_or(|scope| scope != "Device"))
            .then_some(())?;
        word(&path, "capacity")?.parse::<f64>().ok()
    };
    let charges = supplies.filter_map(|supply| charge(supply.path()));
    charges.map(|percent| (percent / 100.0).clamp(0.0, 1.0)).min_by(f64::total_cmp)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;

    #[test]
    fn a_look_finds_this_machine() {
        let sample = Sampler::new(std::env::temp_dir(), true).look();
        assert!(sample.cores >= 1 && (0.0..=f64::from(sample.cores)).contains(&sample.idle_cores), "{sample:?}");
        assert!(sample.memory_bytes > 0 && sample.free_memory_bytes <= sample.memory_bytes, "{sample:?}");
        assert!(sample.disk_bytes > 0 && sample.free_disk_bytes <= sample.disk_bytes, "{sample:?}");
    }

    #[test]
    fn the_emptiest_battery_counts_and_what_is_none_does_not() {
        let directory = tempfile::tempdir().unwrap();
        let supply = |name: &str, files: &[(&str, &str)]| {
            let path = directory.path().join(name);
            fs::create_dir(&path).unwrap();
            files.iter().for_each(|(file, text)| fs::write(path.join(file), format!("{text}\n")).unwrap());
        };
        assert_eq!(battery(directory.path()), None);
        supply("AC", &[("type", "Mains"), ("online", "1")]);
        supply("mouse", &[("type", "Battery"), ("scope", "Device"), ("capacity", "3")]);
        assert_eq!(battery(directory.path()), None);
        supply("BAT0", &[("type", "Battery"), ("capacity", "87")]);
        supply("BAT1", &[("type", "Battery"), ("capacity", "19")]);
        assert_eq!(battery(directory.path()), Some(0.19));
    }
}
