//! Arguments about a whole system: the objects in its cell, injected faults, its speed.

use super::values::{scene, speed};
use clap::{Args, ValueEnum};
use ratn_cell::config::Setting;
use ratn_cell::core::faults::Fault;
use std::path::PathBuf;

#[derive(Debug, Clone, Args)]
pub(crate) struct UpArguments {
    /// The system's config, TOML; without it the built-in default
    #[arg(long, value_name = "FILE")]
    pub(crate) config: Option<PathBuf>,
    /// Where the endpoint files go
    #[arg(long, value_name = "DIR")]
    pub(crate) runtime_dir: Option<PathBuf>,
    /// Show it and its runs as pages in a browser on this machine, as `ratn dashboard` does
    #[arg(long)]
    pub(crate) dashboard: bool,
    /// End when standard input ends, because the process that started this one is gone
    #[arg(long)]
    pub(crate) exit_with_parent: bool,
    #[command(flatten)]
    pub(crate) system: SystemArguments,
}

/// What differs from a system's config.
#[derive(Debug, Clone, Default, Args)]
pub(crate) struct SystemArguments {
    /// The robot: the name of a built-in one (aimm, panda, ur5, twin), or the path of a robot.toml; the config's unless given
    #[arg(long, value_name = "ROBOT")]
    pub(crate) robot: Option<String>,
    /// What the cell is furnished for: boxes on a table, or tableware on a rack
    #[arg(long, value_name = "SCENE", value_parser = scene)]
    pub(crate) scene: Option<Setting>,
    #[command(flatten)]
    pub(crate) goods: GoodsArguments,
    /// Path planner processes
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=32))]
    pub(crate) planners: Option<u32>,
    /// Robot's seconds per second
    #[arg(long, value_name = "X", value_parser = speed)]
    pub(crate) speed: Option<f64>,
    /// What the boxes' places and the sensors' noise are derived from
    #[arg(long, value_name = "N")]
    pub(crate) seed: Option<u64>,
    #[command(flatten)]
    pub(crate) faults: FaultArguments,
}

/// What a scene has that can be moved; as many as before, or as the config says, unless given.
#[derive(Debug, Clone, Copy, Default, Args)]
pub(crate) struct GoodsArguments {
    /// Boxes on the cell's table
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=9))]
    pub(crate) boxes: Option<u32>,
    /// Bowls on the cell's rack
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(0..=3))]
    pub(crate) bowls: Option<u32>,
    /// Forks on the cell's rack
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(0..=3))]
    pub(crate) forks: Option<u32>,
    /// Cups on the cell's rack
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(0..=3))]
    pub(crate) cups: Option<u32>,
    /// Plates on the cell's table
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(0..=3))]
    pub(crate) plates: Option<u32>,
}

/// What shall go wrong.
#[derive(Debug, Clone, Default, Args)]
pub(crate) struct FaultArguments {
    /// Something that goes wrong in the cell: KIND:N at the n-th occasion, KIND@SECONDS at a time of the robot, KIND~PROBABILITY by
    /// chance; kinds are grasp_slips, object_moved, sensor_dropout, controller_abort and localisation_lost; can be given several times
    #[arg(long, value_name = "FAULT")]
    pub(crate) fault: Vec<Fault>,
}

#[derive(Debug, Clone, Args)]
pub(crate) struct ResetArguments {
    #[command(flatten)]
    pub(crate) goods: GoodsArguments,
    /// The same seed makes the same scene; that of the old one unless given
    #[arg(long, value_name = "N")]
    pub(crate) seed: Option<u64>,
    /// Where the endpoint files of the system are
    #[arg(long, value_name = "DIR")]
    pub(crate) runtime_dir: Option<PathBuf>,
}

/// What planners may do with their time.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum Budget {
    /// The time that the task gives them: as long as the paper's planners took
    Task,
    /// What they need for a path, no more
    None,
    /// Nothing but the last row, of the task whose motions and looks overlap
    Overlapped,
    /// One row for each
    Both,
}

#[derive(Debug, Clone, Args)]
pub(crate) struct DemoArguments {
    /// The robot: the name of a built-in one (aimm, panda, ur5, twin), or the path of a robot.toml with a workplace; the config's unless given
    #[arg(long, value_name = "ROBOT")]
    pub(crate) robot: Option<String>,
    /// With 2, two arms at one table fetch boxes, a task each: one after the other, and both at once
    #[arg(long, value_name = "1..2", default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..=2))]
    pub(crate) robots: u32,
    /// Which of the paper's experiments: boxes are fetched onto the base, or a table is set with tableware from a rack
    #[arg(long, value_name = "SCENARIO", default_value = "boxes", value_parser = scene)]
    pub(crate) scenario: Setting,
    /// Boxes to fetch
    #[arg(long, value_name = "1..9", default_value_t = 3, value_parser = clap::value_parser!(u32).range(1..=9))]
    pub(crate) boxes: u32,
    /// Bowls to set
    #[arg(long, value_name = "0..3", default_value_t = 2, value_parser = clap::value_parser!(u32).range(0..=3))]
    pub(crate) bowls: u32,
    /// Forks to set
    #[arg(long, value_name = "0..3", default_value_t = 2, value_parser = clap::value_parser!(u32).range(0..=3))]
    pub(crate) forks: u32,
    /// Cups to set
    #[arg(long, value_name = "0..3", default_value_t = 0, value_parser = clap::value_parser!(u32).range(0..=3))]
    pub(crate) cups: u32,
    /// Plates that lie on the table, between which the rest is set
    #[arg(long, value_name = "0..3", default_value_t = 0, value_parser = clap::value_parser!(u32).range(0..=3))]
    pub(crate) plates: u32,
    /// Path planner processes of the last run
    #[arg(long, value_name = "N", default_value_t = 2, value_parser = clap::value_parser!(u32).range(1..=32))]
    pub(crate) planners: u32,
    /// Robot's seconds per second
    #[arg(long, value_name = "X", default_value_t = 8.0, value_parser = speed)]
    pub(crate) speed: f64,
    /// What planners may do with their time
    #[arg(long, value_enum, default_value = "both")]
    pub(crate) budget: Budget,
    /// What everything random is derived from
    #[arg(long, value_name = "N", default_value_t = 1)]
    pub(crate) seed: u64,
    #[command(flatten)]
    pub(crate) faults: FaultArguments,
    /// Print one JSON document on standard output
    #[arg(long)]
    pub(crate) json: bool,
    /// Where event logs and charts go; a new folder under the system's temporary one unless given
    #[arg(long, value_name = "DIR")]
    pub(crate) out: Option<PathBuf>,
    /// The system's config, TOML; without it the built-in default
    #[arg(long, value_name = "FILE")]
    pub(crate) config: Option<PathBuf>,
}
