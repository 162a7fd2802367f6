//! Arguments of the daemons and the bundled workers.

use super::systems::FaultArguments;
use super::values::{place, scene, speed};
use clap::{Args, ValueEnum};
use ratn_cell::config::Setting;
use ratn_daemon::config::Durability;
use ratn_worker::endpoint::Endpoint;
use std::net::SocketAddr;
use std::path::PathBuf;

/// What every daemon takes.
#[derive(Debug, Clone, Args)]
pub(crate) struct RoleArguments {
    /// The system's config, TOML; without it the built-in default
    #[arg(long, value_name = "FILE")]
    pub(crate) config: Option<PathBuf>,
    /// Read the config, say whether it is good, and end
    #[arg(long)]
    pub(crate) check_config: bool,
    /// Where endpoint files are; $RATN_RUNTIME_DIR, $XDG_RUNTIME_DIR/ratn or /tmp/ratn-UID unless given
    #[arg(long, value_name = "DIR")]
    pub(crate) runtime_dir: Option<PathBuf>,
    /// Where to listen: `local` (a Unix socket beside the endpoint file), `127.0.0.1:0`, `unix:/path`; the config's unless given
    #[arg(long, value_name = "ADDRESS")]
    pub(crate) listen: Option<Endpoint>,
    /// Serve addresses beyond loopback also without TLS: the network itself is trusted
    #[arg(long)]
    pub(crate) insecure: bool,
    /// Show metrics for Prometheus at this address, `127.0.0.1:9464`; the config's unless given
    #[arg(long, value_name = "ADDRESS")]
    pub(crate) metrics: Option<SocketAddr>,
    /// End when standard input ends, because the process that started this one is gone
    #[arg(long)]
    pub(crate) exit_with_parent: bool,
}

/// What the cell takes beside what every daemon takes.
#[derive(Debug, Clone, Args)]
pub(crate) struct CellArguments {
    #[command(flatten)]
    pub(crate) role: RoleArguments,
    /// The robot: the name of a built-in one (aimm, panda, ur5, twin), or the path of a robot.toml; the config's unless given
    #[arg(long, value_name = "ROBOT")]
    pub(crate) robot: Option<String>,
    #[command(flatten)]
    pub(crate) faults: FaultArguments,
    /// What the cell is furnished for: boxes on a table, or tableware on a rack; as its config says unless given
    #[arg(long, value_name = "SCENE", value_parser = scene)]
    pub(crate) scene: Option<Setting>,
    /// Where an emergency stop is kept, in a folder `cell`; the config's, $RATN_STATE_DIR, $STATE_DIRECTORY or `state` in the runtime
    /// directory unless given
    #[arg(long, value_name = "DIR")]
    pub(crate) state_dir: Option<PathBuf>,
    /// Write down in a new file what happens, line by line
    #[arg(long, value_name = "FILE")]
    pub(crate) record: Option<PathBuf>,
    /// Go through a recording again, say whether the same comes of it, and end
    #[arg(long, value_name = "FILE", conflicts_with = "record")]
    pub(crate) replay: Option<PathBuf>,
    /// Write a picture of the configured cell as it begins to this file, PNG, and end
    #[arg(long, value_name = "FILE", conflicts_with_all = ["record", "replay"])]
    pub(crate) picture: Option<PathBuf>,
    /// From where the picture is taken: X,Y,Z in metres; by the robot's own camera unless given
    #[arg(long, value_name = "PLACE", requires = "picture", allow_hyphen_values = true, value_parser = place)]
    pub(crate) from: Option<[f64; 3]>,
    /// Towards where: X,Y,Z in metres
    #[arg(long, value_name = "PLACE", default_value = "0.8,0,0.7", allow_hyphen_values = true, value_parser = place)]
    pub(crate) towards: [f64; 3],
}

/// What a daemon that keeps a state takes beside that.
#[derive(Debug, Clone, Args)]
pub(crate) struct KeptRoleArguments {
    #[command(flatten)]
    pub(crate) role: RoleArguments,
    /// When an answer may leave: `none` at once, `group` when it is on the disk, `each` likewise with a sync for every change; the
    /// config's unless given
    #[arg(long, value_name = "WHEN")]
    pub(crate) durability: Option<Durability>,
    /// Where its state is kept, in a folder of its name; the config's, $RATN_STATE_DIR, $STATE_DIRECTORY or `state` in the runtime
    /// directory unless given
    #[arg(long, value_name = "DIR")]
    pub(crate) state_dir: Option<PathBuf>,
}

#[derive(Debug, Clone, Args)]
pub(crate) struct WorkerArguments {
    /// What it does
    #[arg(value_enum)]
    pub(crate) worker: WorkerKind,
    /// Its resource's id, `path-planner-1@compute`; goals need a lease of it, which the resource manager of --resource-manager or
    /// $RATN_RESOURCE_MANAGER confirms
    #[arg(long, value_name = "ID", value_parser = clap::builder::NonEmptyStringValueParser::new())]
    pub(crate) id: String,
    /// Its resource's kind
    #[arg(long, value_name = "KIND", default_value = "")]
    pub(crate) kind: String,
    /// The system's config, of whose `[service.access]` callers have their roles; $RATN_ACCESS unless given
    #[arg(long, value_name = "FILE")]
    pub(crate) config: Option<PathBuf>,
    /// The host that it is on
    #[arg(long, value_name = "NAME", default_value = "")]
    pub(crate) host: String,
    /// Where to listen: `127.0.0.1:0`, `unix:/path`; unless given, at a socket that its process manager has named, or on loopback
    #[arg(long, value_name = "ADDRESS")]
    pub(crate) listen: Option<Endpoint>,
    /// Write where it serves to this file once it is ready
    #[arg(long, value_name = "FILE")]
    pub(crate) endpoint_file: Option<PathBuf>,
    /// Offer the resource to this resource manager by itself; not for workers of a process manager
    #[arg(long, value_name = "ADDRESS")]
    pub(crate) resource_manager: Option<Endpoint>,
    /// End when standard input ends, because the process that started this one is gone
    #[arg(long)]
    pub(crate) exit_with_parent: bool,
    /// Serve addresses beyond loopback also without TLS: the network itself is trusted
    #[arg(long)]
    pub(crate) insecure: bool,
    /// Robot's seconds per second
    #[arg(long, value_name = "X", default_value_t = 1.0, value_parser = speed)]
    pub(crate) speed: f64,
    /// The robot: the name of a built-in one (aimm, panda, ur5, twin), or the path of a robot.toml
    #[arg(long, value_name = "ROBOT", default_value = "aimm")]
    pub(crate) robot: String,
    /// Of a detector: keep what it sees and finds as PNG files in this folder
    #[arg(long, value_name = "DIR")]
    pub(crate) pictures: Option<PathBuf>,
}

/// The bundled workers.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum WorkerKind {
    /// Plans motions of the arm
    PathPlanner,
    /// Finds boxes in depth images
    Detector,
}
