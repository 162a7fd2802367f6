//! The command line.

use crate::command::doctor::DoctorArguments;
use crate::command::pool::{DrainArguments, HostArguments, LogsArguments, PoolArguments, RestartArguments};
use crate::command::resource::ResourceArguments;
use crate::command::world::WorldArguments;
use crate::task_control::control::Word;
use clap::{Args, Parser, Subcommand, ValueEnum};
use ratn_cell::config::Setting;
use ratn_cell::core::faults::Fault;
use ratn_daemon::config::Durability;
use ratn_worker::endpoint::Endpoint;
use std::net::SocketAddr;
use std::path::PathBuf;

/// Runs robot tasks, written as sequential state machines, as fast as their real dependencies allow.
#[derive(Debug, Parser)]
#[command(name = "ratn", version, arg_required_else_help = true)]
pub(crate) struct Arguments {
    #[command(subcommand)]
    pub(crate) command: Command,
}

#[derive(Debug, Subcommand)]
pub(crate) enum Command {
    /// Fetch boxes, or set a table, in the simulated cell (HSM, CDTN with one planner, CDTN with several; each with and without a
    /// budget) and compare
    Demo(DemoArguments),
    /// Start a whole system on this machine and keep it running in the foreground
    Up(UpArguments),
    /// Run a task on a running system, or on one started for it
    Run(RunArguments),
    /// Pause a run that is under way, let it go on, let it do one step, or end it
    Control(ControlArguments),
    /// Show the worker processes of all hosts
    Ps(HostArguments),
    /// Print what a worker writes, on whichever host it is
    Logs(LogsArguments),
    /// Start and end workers of a host's pools, and change how many there are
    Pool(PoolArguments),
    /// Replace workers, each once its successor is ready
    Restart(RestartArguments),
    /// Let a host take no new work: each of its workers ends once nobody holds it
    Drain(DrainArguments),
    /// Emergency stop: whatever moves stops, and nothing begins until it is cleared
    Stop(StopArguments),
    /// Pause whatever moves, and whatever would begin to
    Hold(HoldArguments),
    /// End a hold: motions go on where they paused
    GoOn(GoOnArguments),
    /// Say what is missing on this machine or in this config, and what to do about it
    Doctor(DoctorArguments),
    /// Lay a new table in the simulated cell of a running system, and forget every fact
    Reset(ResetArguments),
    /// Check a task file without starting anything
    Check(CheckArguments),
    /// Say where the time of a run went, from its event log
    Report(ReportArguments),
    /// Replay the paper's tables in virtual time
    Tables(TablesArguments),
    /// Run a scheduling problem of the literature in virtual time, as a task, and compare with the best known schedule
    Simulate(SimulateArguments),
    /// Solve a file of motion planning problems for a robot, and say how fast and how well
    Plan(PlanArguments),
    /// Look at the resources of a running system and change them
    Resource(ResourceArguments),
    /// Look at the world model of a running system, back in time too, and load facts into it
    World(WorldArguments),
    /// Copy what a daemon keeps on the disk, put a copy back, or look at it
    State(StateArguments),
    /// Make the authority of a system and certificates for its hosts
    Certs(CertsArguments),
    /// Own the resources: who has what, and who waits (host compute)
    ResourceManager(KeptRoleArguments),
    /// Hold the root world model and its projections (host compute)
    WorldPool(KeptRoleArguments),
    /// Spawn and watch this host's worker processes
    ProcessManager(RoleArguments),
    /// Be the simulated cell: robot, table, boxes, sensors, controllers (host sim)
    Cell(CellArguments),
    /// Be a worker process; the process manager starts these
    Worker(WorkerArguments),
}

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
    /// End when standard input ends: whoever started this is gone
    #[arg(long)]
    pub(crate) exit_with_parent: bool,
}

/// What the cell takes beside what every daemon takes.
#[derive(Debug, Clone, Args)]
pub(crate) struct CellArguments {
    #[command(flatten)]
    pub(crate) role: RoleArguments,
    #[command(flatten)]
    pub(crate) faults: FaultArguments,
    /// What the cell is furnished for: boxes on a table, or tableware on a rack; as its config says unless given
    #[arg(long, value_name = "SCENE", value_parser = scene)]
    pub(crate) scene: Option<Setting>,
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

/// What shall go wrong.
#[derive(Debug, Clone, Default, Args)]
pub(crate) struct FaultArguments {
    /// Something that goes wrong in the cell: KIND:N at the n-th occasion, KIND@SECONDS at a time of the robot, KIND~PROBABILITY by
    /// chance; kinds are grasp_slips, object_moved, sensor_dropout, controller_abort and localisation_lost; can be given several times
    #[arg(long, value_name = "FAULT")]
    pub(crate) fault: Vec<Fault>,
}

#[derive(Debug, Clone, Args)]
pub(crate) struct CertsArguments {
    /// Where they are: `ca.pem` and `ca.key` of the authority, `HOST.pem` and `HOST.key` of every host
    pub(crate) directory: PathBuf,
    /// A host by the name that others reach it by; `HOST=NAME,ADDRESS` where they reach it otherwise, too
    #[arg(value_name = "HOST[=NAME,...]")]
    pub(crate) hosts: Vec<String>,
    /// How long a host's certificate holds
    #[arg(long, value_name = "DAYS", default_value_t = 825, value_parser = clap::value_parser!(u16).range(1..=3650))]
    pub(crate) days: u16,
    /// Make new ones also for hosts that have one
    #[arg(long)]
    pub(crate) renew: bool,
    /// One JSON document on standard output
    #[arg(long)]
    pub(crate) json: bool,
}

#[derive(Debug, Clone, Args)]
pub(crate) struct StateArguments {
    #[command(subcommand)]
    pub(crate) command: StateCommand,
    /// One JSON document on standard output
    #[arg(long, global = true)]
    pub(crate) json: bool,
}

#[derive(Debug, Clone, Subcommand)]
pub(crate) enum StateCommand {
    /// Copy a state, also while its daemon runs; holds at least what was acknowledged when it began
    Backup {
        /// The folder that the daemon keeps it in, as `…/state/resource-manager` or `…/state/world-pool`
        state: PathBuf,
        /// Where the copy goes: a folder that is empty or not there yet
        target: PathBuf,
    },
    /// Make a state of a copy; end the daemon first whose state it takes the place of
    Restore {
        /// What `backup` made
        backup: PathBuf,
        /// A folder that is empty or not there yet: nothing is overwritten
        target: PathBuf,
    },
    /// Say what is in a state or a copy, and whether it is whole
    Show {
        /// The folder
        state: PathBuf,
    },
}

/// How tasks are executed, on the command line.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum ModeArgument {
    /// One state after the other, as written
    Hsm,
    /// As parallel as its dependencies allow
    Cdtn,
}

#[derive(Debug, Clone, Args)]
pub(crate) struct WorkerArguments {
    /// What it does
    #[arg(value_enum)]
    pub(crate) worker: WorkerKind,
    /// Its resource's id, `path-planner-1@compute`, by which leases are checked; without it no lease is asked for
    #[arg(long, value_name = "ID", default_value = "")]
    pub(crate) id: String,
    /// Its resource's kind
    #[arg(long, value_name = "KIND", default_value = "")]
    pub(crate) kind: String,
    /// The host that it is on
    #[arg(long, value_name = "NAME", default_value = "")]
    pub(crate) host: String,
    /// Where to listen: `127.0.0.1:0`, `unix:/path`
    #[arg(long, value_name = "ADDRESS", default_value = "127.0.0.1:0")]
    pub(crate) listen: Endpoint,
    /// Write where it serves to this file once it is ready
    #[arg(long, value_name = "FILE")]
    pub(crate) endpoint_file: Option<PathBuf>,
    /// Offer the resource to this resource manager by itself; not for workers of a process manager
    #[arg(long, value_name = "ADDRESS")]
    pub(crate) resource_manager: Option<Endpoint>,
    /// End when standard input ends: whoever started this is gone
    #[arg(long)]
    pub(crate) exit_with_parent: bool,
    /// Serve addresses beyond loopback also without TLS: the network itself is trusted
    #[arg(long)]
    pub(crate) insecure: bool,
    /// Robot's seconds per second
    #[arg(long, value_name = "X", default_value_t = 1.0, value_parser = speed)]
    pub(crate) speed: f64,
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

#[derive(Debug, Clone, Args)]
pub(crate) struct CheckArguments {
    /// The task file
    #[arg(value_name = "TASK")]
    pub(crate) task: PathBuf,
    /// The system to check it against; without it the built-in default
    #[arg(long, value_name = "FILE")]
    pub(crate) config: Option<PathBuf>,
    /// Only check: leave out the simulation that says what keeps the task sequential
    #[arg(long)]
    pub(crate) no_simulation: bool,
    /// Give a parameter of the task a value for the simulation, `boxes=3`; may be repeated
    #[arg(long = "set", value_name = "NAME=VALUE", value_parser = setting)]
    pub(crate) set: Vec<(String, String)>,
    /// How many elements a list has that an action answers, in the simulation
    #[arg(long, value_name = "N", default_value_t = 3, value_parser = clap::value_parser!(u16).range(0..=100))]
    pub(crate) elements: u16,
    /// Take durations from event logs of earlier runs of the task, or folders of them
    #[arg(long, value_name = "LOG", num_args = 1..)]
    pub(crate) learn: Vec<PathBuf>,
    /// Print one JSON document on standard output
    #[arg(long)]
    pub(crate) json: bool,
}

#[derive(Debug, Clone, Args)]
pub(crate) struct ReportArguments {
    /// The event log
    #[arg(value_name = "LOG")]
    pub(crate) log: PathBuf,
    /// Print one JSON document
    #[arg(long)]
    pub(crate) json: bool,
    /// Write a Gantt chart; `.svg` or `.html`
    #[arg(long, value_name = "FILE", value_parser = chart)]
    pub(crate) gantt: Option<PathBuf>,
}

#[derive(Debug, Clone, Args)]
pub(crate) struct TablesArguments {
    /// Print one JSON array
    #[arg(long)]
    pub(crate) json: bool,
    /// Write a Gantt chart of every run into this folder
    #[arg(long, value_name = "DIR")]
    pub(crate) gantt: Option<PathBuf>,
}

#[derive(Debug, Clone, Args)]
pub(crate) struct PlanArguments {
    /// The robot, with collision shapes or spheres
    #[arg(long, value_name = "URDF")]
    pub(crate) robot: PathBuf,
    /// Where the packages are that the robot's meshes are named by (`package://NAME/...`)
    #[arg(long, value_name = "DIR")]
    pub(crate) packages: Vec<PathBuf>,
    /// Which links may touch; without it neighbours, and links that touch in the middle of all limits
    #[arg(long, value_name = "FILE")]
    pub(crate) srdf: Option<PathBuf>,
    /// Problems in JSON: `joints`, and per class `objects`, `start` and `goal`
    #[arg(long, value_name = "FILE")]
    pub(crate) problems: PathBuf,
    /// What the samples are derived from
    #[arg(long, value_name = "N", default_value_t = 0)]
    pub(crate) seed: u64,
    /// Samples per problem before it is given up
    #[arg(long, value_name = "N", default_value_t = 100_000)]
    pub(crate) iterations: usize,
    /// Solve each problem this often and take the least times
    #[arg(long, value_name = "N", default_value_t = 15)]
    pub(crate) repeat: usize,
    /// How much larger the robot's shapes are taken
    #[arg(long, value_name = "MM", default_value_t = 0.0, value_parser = padding)]
    pub(crate) padding_mm: f64,
    /// Print one JSON array, with every problem
    #[arg(long)]
    pub(crate) json: bool,
    /// In JSON, also print the paths
    #[arg(long, requires = "json")]
    pub(crate) paths: bool,
}

#[derive(Debug, Clone, Args)]
pub(crate) struct SimulateArguments {
    /// A job shop: a line with the numbers of jobs and machines, then per job a line of pairs of machine and duration
    #[arg(long, value_name = "FILE")]
    pub(crate) jobshop: PathBuf,
    /// The best makespan known; of well-known instances it is known
    #[arg(long, value_name = "N", value_parser = makespan)]
    pub(crate) best: Option<f64>,
    /// Orders to look at whenever much of what is to be done has changed; 0 for plain dispatch
    #[arg(long, value_name = "N", default_value_t = ratn_simulation::jobshop::DEFAULT_ORDERS)]
    pub(crate) orders: usize,
    /// What every random choice is derived from
    #[arg(long, value_name = "N", default_value_t = 1)]
    pub(crate) seed: u64,
    /// Print one JSON document on standard output
    #[arg(long)]
    pub(crate) json: bool,
}

#[derive(Debug, Clone, Args)]
pub(crate) struct RunArguments {
    /// The task file; with --resume the one that the log names unless given
    #[arg(value_name = "TASK", required_unless_present = "resume")]
    pub(crate) task: Option<PathBuf>,
    /// Go on with the run of this event log, whose task control was killed, on the system that it was on
    #[arg(long, value_name = "LOG", conflicts_with_all = ["mode", "set", "seed", "log", "learn", "speed"])]
    pub(crate) resume: Option<PathBuf>,
    /// Learn durations and the shares of outcomes from event logs of earlier runs of the task, or folders of them
    #[arg(long, value_name = "LOG", num_args = 1..)]
    pub(crate) learn: Vec<PathBuf>,
    /// How it is executed
    #[arg(long, value_enum, default_value = "cdtn")]
    pub(crate) mode: ModeArgument,
    /// Give a parameter of the task a value, `boxes=3`; may be repeated
    #[arg(long = "set", value_name = "NAME=VALUE", value_parser = setting)]
    pub(crate) set: Vec<(String, String)>,
    /// Write the event log here
    #[arg(long, value_name = "FILE")]
    pub(crate) log: Option<PathBuf>,
    /// Write a Gantt chart; `.svg` or `.html`
    #[arg(long, value_name = "FILE", value_parser = chart)]
    pub(crate) gantt: Option<PathBuf>,
    /// What every random choice is derived from
    #[arg(long, value_name = "N", default_value_t = 1)]
    pub(crate) seed: u64,
    /// The system's config, TOML; without it the built-in default
    #[arg(long, value_name = "FILE")]
    pub(crate) config: Option<PathBuf>,
    /// Where a running system's endpoint files are; without it, a system is started where none runs
    #[arg(long, value_name = "DIR")]
    pub(crate) runtime_dir: Option<PathBuf>,
    /// Robot's seconds per second; a running system's own or the config's unless given
    #[arg(long, value_name = "X", value_parser = speed)]
    pub(crate) speed: Option<f64>,
    /// Print one JSON document on standard output
    #[arg(long)]
    pub(crate) json: bool,
}

#[derive(Debug, Clone, Args)]
pub(crate) struct ControlArguments {
    /// What the run shall do
    #[arg(value_enum)]
    pub(crate) word: Word,
    /// Where the endpoint files of the run's system are
    #[arg(long, value_name = "DIR")]
    pub(crate) runtime_dir: Option<PathBuf>,
}

/// Which drivers of what moves are asked.
#[derive(Debug, Clone, Args)]
pub(crate) struct SafetyArguments {
    /// A driver that no resource manager tells of; may be given again
    #[arg(long, value_name = "ENDPOINT")]
    pub(crate) endpoint: Vec<Endpoint>,
    /// Where the endpoint files of the system are
    #[arg(long, value_name = "DIR")]
    pub(crate) runtime_dir: Option<PathBuf>,
}

#[derive(Debug, Clone, Args)]
pub(crate) struct StopArguments {
    /// Why, for whoever reads the outcome of what was stopped
    #[arg(long, value_name = "TEXT", conflicts_with_all = ["clear", "show"])]
    pub(crate) reason: Option<String>,
    /// End the emergency stop: goals are performed again, what was stopped does not go on
    #[arg(long, conflicts_with = "show")]
    pub(crate) clear: bool,
    /// Change nothing, say what is in force
    #[arg(long)]
    pub(crate) show: bool,
    #[command(flatten)]
    pub(crate) drivers: SafetyArguments,
}

#[derive(Debug, Clone, Args)]
pub(crate) struct HoldArguments {
    /// Why, for whoever asks
    #[arg(long, value_name = "TEXT")]
    pub(crate) reason: Option<String>,
    #[command(flatten)]
    pub(crate) drivers: SafetyArguments,
}

#[derive(Debug, Clone, Args)]
pub(crate) struct GoOnArguments {
    #[command(flatten)]
    pub(crate) drivers: SafetyArguments,
}

#[derive(Debug, Clone, Args)]
pub(crate) struct ResetArguments {
    /// Boxes on the new table; as many as on the old one unless given
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=9))]
    pub(crate) boxes: Option<u32>,
    /// Bowls on the new rack; as many as on the old one unless given
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(0..=3))]
    pub(crate) bowls: Option<u32>,
    /// Forks on the new rack; as many as on the old one unless given
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(0..=3))]
    pub(crate) forks: Option<u32>,
    /// Cups on the new rack; as many as on the old one unless given
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(0..=3))]
    pub(crate) cups: Option<u32>,
    /// Plates on the new table; as many as on the old one unless given
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(0..=3))]
    pub(crate) plates: Option<u32>,
    /// The same seed makes the same scene; that of the old one unless given
    #[arg(long, value_name = "N")]
    pub(crate) seed: Option<u64>,
    /// Where the endpoint files of the system are
    #[arg(long, value_name = "DIR")]
    pub(crate) runtime_dir: Option<PathBuf>,
}

#[derive(Debug, Clone, Args)]
pub(crate) struct UpArguments {
    /// The system's config, TOML; without it the built-in default
    #[arg(long, value_name = "FILE")]
    pub(crate) config: Option<PathBuf>,
    /// Where the endpoint files go
    #[arg(long, value_name = "DIR")]
    pub(crate) runtime_dir: Option<PathBuf>,
    #[command(flatten)]
    pub(crate) system: SystemArguments,
}

/// What differs from a system's config.
#[derive(Debug, Clone, Default, Args)]
pub(crate) struct SystemArguments {
    /// What the cell is furnished for: boxes on a table, or tableware on a rack
    #[arg(long, value_name = "SCENE", value_parser = scene)]
    pub(crate) scene: Option<Setting>,
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

/// What planners may do with their time.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum Budget {
    /// The time that the task gives them: as long as the paper's planners took
    Task,
    /// What they need for a path, no more
    None,
    /// One row for each
    Both,
}

#[derive(Debug, Clone, Args)]
pub(crate) struct DemoArguments {
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

const SLOWEST: f64 = 0.01;
const FASTEST: f64 = 1000.0;

/// X,Y,Z in metres.
fn place(text: &str) -> Result<[f64; 3], String> {
    let number = |part: &str| part.trim().parse().ok().filter(|x: &f64| x.is_finite());
    let numbers: Option<Vec<f64>> = text.split(',').map(number).collect();
    numbers.and_then(|numbers| numbers.try_into().ok()).ok_or_else(|| "expected X,Y,Z in metres".to_owned())
}

fn scene(text: &str) -> Result<Setting, String> {
    Setting::named(text).ok_or_else(|| format!("expected {}", Setting::ALL.map(Setting::name).join(" or ")))
}

fn speed(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(x) if (SLOWEST..=FASTEST).contains(&x) => Ok(x),
        _ => Err(format!("expected a number from {SLOWEST} to {FASTEST}")),
    }
}

/// A length that something is grown by.
fn padding(text: &str) -> Result<f64, String> {
    let value: f64 = text.parse().map_err(|_| "not a number".to_owned())?;
    if (0.0..1e3).contains(&value) { Ok(value) } else { Err("expected 0 to 1000 mm".to_owned()) }
}

fn makespan(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(makespan) if makespan > 0.0 && makespan.is_finite() => Ok(makespan),
        _ => Err("expected a number greater than 0".to_owned()),
    }
}

fn chart(text: &str) -> Result<PathBuf, String> {
    let path = PathBuf::from(text);
    let known = path.extension().is_some_and(|end| ["svg", "html"].iter().any(|known| end.eq_ignore_ascii_case(known)));
    if known { Ok(path) } else { Err("expected a file name that ends with .svg or .html".to_owned()) }
}

fn setting(text: &str) -> Result<(String, String), String> {
    let pair = text.split_once('=').map(|(name, value)| (name.to_owned(), value.to_owned()));
    pair.ok_or_else(|| "expected NAME=VALUE".to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_command_line_is_well_formed() {
        use clap::CommandFactory;
        Arguments::command().debug_assert();
    }
}
