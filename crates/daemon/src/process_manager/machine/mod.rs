//! This machine as resources of the class system (the paper's Section V-B): its processors, memory, disk, load and battery, created when the
//! process manager starts and kept up to date, so that a task can require them; and whether there is room for more workers.
//!
//! ```text
//!   sample.rs (sysinfo, statvfs, /sys) ──Sample──▶ DeadbandFilter (what was published, and what has changed enough) ──▶ offered resources
//!                                         └────▶ the pools: is there room for one more worker?
//! ```

mod sample;

pub use sample::Sample;

use super::config::Labels;
use super::offered;
use crate::config::{ConfigError, rule};
use crate::link::Wanted;
use ratn_proto::types::Resource;
use ratn_worker::runtime_directory::RuntimeDirectory;
use sample::Sampler;
use serde::{Deserialize, Serialize};
use std::time::Duration;
use tokio::sync::{mpsc, watch};

/// The part of this machine that is offered. All keys are optional.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct MachineConfig {
    /// Interval of measurements, in seconds.
    pub interval_s: f64,
    /// Number of processors that are not offered as `Core`: those for the daemons and all other programs.
    pub reserved_cores: u32,
    /// Whether the machine's battery, where there is one, is offered as `Battery`.
    pub battery: bool,
    /// A value is published again when it has changed by this fraction of its maximum.
    pub step: f64,
}

impl Default for MachineConfig {
    fn default() -> Self {
        MachineConfig { interval_s: 2.0, reserved_cores: 0, battery: false, step: 0.05 }
    }
}

impl MachineConfig {
    pub(super) fn check(&self) -> Result<(), ConfigError> {
        let seconds = (0.1..=3_600.0).contains(&self.interval_s);
        rule("machine.interval_s", seconds, "from 0.1 s to an hour")?;
        rule("machine.step", (0.001..=1.0).contains(&self.step), "from 0.001 to 1")
    }
}

/// Publishes a value again only when it differs from the one that was published last by a step or more (a deadband, "send on delta").
#[derive(Debug)]
pub(super) struct DeadbandFilter {
    step: f64,
    sample: Option<Sample>,
}

impl DeadbandFilter {
    pub(super) fn new(step: f64) -> DeadbandFilter {
        DeadbandFilter { step, sample: None }
    }

    /// The sample to publish now, with the old value of everything that has not changed enough; `None` where nothing has.
    pub(super) fn pass(&mut self, now: &Sample) -> Option<Sample> {
        let Some(published) = &self.sample else {
            self.sample = Some(now.clone());
            return self.sample.clone();
        };
        let bytes =
            |was: u64, is: u64, of: u64| if far(was as f64, is as f64, self.step * of as f64) { is } else { was };
        let numbers = |was: f64, is: f64| if far(was, is, self.step) { is } else { was };
        let next = Sample {
            cores: now.cores,
            load_per_core: numbers(published.load_per_core, now.load_per_core),
            idle_cores: numbers(
                published.idle_cores / f64::from(now.cores.max(1)),
                now.idle_cores / f64::from(now.cores.max(1)),
            ) * f64::from(now.cores.max(1)),
            memory_bytes: now.memory_bytes,
            free_memory_bytes: bytes(published.free_memory_bytes, now.free_memory_bytes, now.memory_bytes),
            disk_bytes: now.disk_bytes,
            free_disk_bytes: bytes(published.free_disk_bytes, now.free_disk_bytes, now.disk_bytes),
            battery: match (published.battery, now.battery) {
                (Some(was), Some(is)) => Some(numbers(was, is)),
                (_, is) => is,
            },
        };
        (self.sample.as_ref() != Some(&next)).then(|| {
            self.sample = Some(next.clone());
            next
        })
    }
}

/// Whether two values are at least a step apart. A change to exactly zero always counts, because there may be no room for a whole step above
/// zero.
fn far(was: f64, is: f64, step: f64) -> bool {
    (was - is).abs() >= step || (is == 0.0 && was != 0.0)
}

/// The machine as it is offered.
pub(super) struct Machine {
    pub(super) config: MachineConfig,
    pub(super) labels: Labels,
    /// The host's resource without measurements.
    pub(super) host: Resource,
}

impl Machine {
    /// Keeps the offered resources up to date, and sends every measurement to the pools. Never returns.
    pub(super) async fn watch(
        self,
        directory: RuntimeDirectory,
        wanted: watch::Sender<Wanted>,
        looks: mpsc::Sender<Sample>,
    ) {
        let mut filter = DeadbandFilter::new(self.config.step);
        let mut sampler = Sampler::new(directory.path().to_owned(), self.config.battery);
        loop {
            let looked = tokio::task::spawn_blocking(move || {
                let sample = sampler.look();
                (sampler, sample)
            });
            let Ok((back, sample)) = looked.await else { return };
            sampler = back;
            if let Some(sample) = filter.pass(&sample) {
                let resources = self.resources(&sample);
                wanted.send_modify(|wanted| wanted.extend(resources.into_iter().map(|one| (one.id.clone(), one))));
            }
            if looks.send(sample).await.is_err() {
                return;
            }
            tokio::time::sleep(Duration::from_secs_f64(self.config.interval_s)).await;
        }
    }

    fn resources(&self, sample: &Sample) -> Vec<Resource> {
        let cores = sample.cores.saturating_sub(self.config.reserved_cores);
        let mut resources = vec![offered::host_with(self.host.clone(), sample)];
        resources.extend(offered::cores(&self.host.host, &self.labels, cores));
        resources.extend(sample.battery.map(|level| offered::battery(&self.host.host, level)));
        resources
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;

    fn sample(free_memory_mib: u64, battery: f64) -> Sample {
        Sample {
            cores: 4,
            load_per_core: 0.5,
            idle_cores: 2.0,
            memory_bytes: 1_000 << 20,
            free_memory_bytes: free_memory_mib << 20,
            disk_bytes: 1 << 40,
            free_disk_bytes: 1 << 39,
            battery: Some(battery),
        }
    }

    #[test]
    fn what_goes_to_and_fro_is_told_once_and_a_step_is_told_at_once() {
        let mut filter = DeadbandFilter::new(0.05);
        assert_eq!(filter.pass(&sample(500, 0.8)), Some(sample(500, 0.8)));
        for free in [520, 470, 540, 460] {
            assert_eq!(filter.pass(&sample(free, 0.8)), None, "{free}");
        }
        assert_eq!(filter.pass(&sample(449, 0.8)), Some(sample(449, 0.8)));
        assert_eq!(filter.pass(&sample(495, 0.78)), None, "from 449 on");
        assert_eq!(filter.pass(&sample(495, 0.74)).unwrap(), sample(449, 0.74), "the rest stays as it was published");
    }

    #[test]
    fn nothing_left_is_told_however_small_the_step() {
        let mut filter = DeadbandFilter::new(0.05);
        filter.pass(&sample(20, 0.5));
        assert_eq!(filter.pass(&sample(0, 0.5)), Some(sample(0, 0.5)));
    }
}
