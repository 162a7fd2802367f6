//! Arguments about tasks: checking, running, controlling, reporting and simulating them; and about planning problems.

use super::values::{Due, at_least_one, chart, due, padding, positive, run_share, setting, share, speed};
use clap::{Args, Subcommand, ValueEnum};
use ratn_task_control::checkpoint::EVERY_EVENTS;
use std::net::SocketAddr;
use std::path::PathBuf;

/// How tasks are executed, on the command line.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum ModeArgument {
    /// One state after the other, as written
    Hsm,
    /// As parallel as its dependencies allow
    Cdtn,
}

#[derive(Debug, Clone, Args)]
pub(crate) struct CheckArguments {
    /// The task file
    #[arg(value_name = "TASK")]
    pub(crate) task: PathBuf,
    /// The system to check it against; without it the built-in default
    #[arg(long, value_name = "FILE")]
    pub(crate) config: Option<PathBuf>,
    /// A catalogue that extends the config's, and overrides it where both say something; may be repeated
    #[arg(long, value_name = "FILE")]
    pub(crate) catalogue: Vec<PathBuf>,
    /// Check against the system that runs there, too: what its workers say of themselves extends the catalogue, or is compared with it. Without
    /// this, --config and --robot that of $RATN_RUNTIME_DIR, where one runs
    #[arg(long, value_name = "DIR")]
    pub(crate) runtime_dir: Option<PathBuf>,
    /// The robot: the name of a built-in one (aimm, panda, ur5, twin), or the path of a robot.toml; the config's unless given. The robot of a
    /// system that runs is its own
    #[arg(long, value_name = "ROBOT", conflicts_with = "runtime_dir")]
    pub(crate) robot: Option<String>,
    /// Only check: leave out the simulation that says what keeps the task sequential
    #[arg(long)]
    pub(crate) no_simulation: bool,
    /// Say what is in force for each state that performs an action, and whether the state or the action's catalogue says so
    #[arg(long, conflicts_with_all = ["no_simulation", "learn"])]
    pub(crate) annotations: bool,
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
pub(crate) struct RunArguments {
    /// The task file; with --resume it may be left out, because the log names it
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
    /// Pause before this state, or a motion inside of it, begins: its path, `for_box/grasp`; may be repeated
    #[arg(long = "break", value_name = "STATE", conflicts_with = "resume")]
    pub(crate) breakpoints: Vec<String>,
    /// Begin at this state of the task's own list, or inside of one (`cups/pick`), in the world as it is: the task's `world` is not written
    #[arg(long, value_name = "STATE", conflicts_with = "resume")]
    pub(crate) from: Option<String>,
    /// Let no other run be under way on the system beside this one
    #[arg(long)]
    pub(crate) alone: bool,
    /// What comes first of what several runs on the system need
    #[arg(long, value_enum, value_name = "HOW", default_value = "normal")]
    pub(crate) urgency: UrgencyArgument,
    /// How much the run is to have of what several runs need, beside the shares of the others, from 0.01 to 100 [default: 1, or that of the run
    /// that is resumed]
    #[arg(long, value_name = "N", value_parser = run_share)]
    pub(crate) share: Option<f64>,
    /// When the run is to have ended: a time from its start (90s, 15m, 2h), or an instant (2026-11-28T17:15:00Z). Of what several runs need
    /// at about the same time, the run that is due first comes first
    #[arg(long, value_name = "TIME", value_parser = due)]
    pub(crate) due: Option<Due>,
    /// Give a parameter of the task a value, `boxes=3`; may be repeated
    #[arg(long = "set", value_name = "NAME=VALUE", value_parser = setting)]
    pub(crate) set: Vec<(String, String)>,
    /// Write the event log here
    #[arg(long, value_name = "FILE")]
    pub(crate) log: Option<PathBuf>,
    /// Write a Gantt chart; `.svg` or `.html`
    #[arg(long, value_name = "FILE", value_parser = chart)]
    pub(crate) gantt: Option<PathBuf>,
    /// Every random choice is derived from this number
    #[arg(long, value_name = "N", default_value_t = 1)]
    pub(crate) seed: u64,
    /// The system's config, TOML; without it the built-in default
    #[arg(long, value_name = "FILE")]
    pub(crate) config: Option<PathBuf>,
    /// The robot: the name of a built-in one (aimm, panda, ur5, twin), or the path of a robot.toml; the config's unless given
    #[arg(long, value_name = "ROBOT")]
    pub(crate) robot: Option<String>,
    /// Where a running system's endpoint files are; without it, a system is started where none runs
    #[arg(long, value_name = "DIR")]
    pub(crate) runtime_dir: Option<PathBuf>,
    /// Robot's seconds per second; a running system's own or the config's unless given
    #[arg(long, value_name = "X", value_parser = speed)]
    pub(crate) speed: Option<f64>,
    /// Write a checkpoint beside the event log after so many events, for a quick `--resume`; 0: none
    #[arg(long, value_name = "EVENTS", default_value_t = EVERY_EVENTS)]
    pub(crate) checkpoint_every: u64,
    /// Say nothing but the result, or why there is none
    #[arg(short, long)]
    pub(crate) quiet: bool,
    /// Print JSON on standard output: one document at the end, with `--json=lines` the event log as it grows before it, all of it a line each
    #[arg(long, value_enum, value_name = "HOW", num_args = 0..=1, require_equals = true, default_missing_value = "document")]
    pub(crate) json: Option<JsonArgument>,
}

/// How urgent a run is beside others, on the command line.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum UrgencyArgument {
    /// It has what others leave
    Low,
    /// As most are
    Normal,
    /// Others wait for it
    High,
}

/// How a run is told in JSON, on the command line.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum JsonArgument {
    /// One document at the end
    Document,
    /// Every line of the event log as it is written, then the document in one line
    Lines,
}

/// What a run can be told, on the command line.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum WordArgument {
    /// No further PIA begins; states that run go on
    Pause,
    /// PIAs may begin again
    Resume,
    /// One PIA begins, then the run pauses again
    Step,
    /// The run ends: motions stop and hold, everything is given back
    Abort,
    /// The run pauses before STATE, or a motion inside of it, begins; `resume` and `step` let it go on
    Break,
    /// The breakpoint at STATE is taken away; without a STATE all are
    Clear,
}

#[derive(Debug, Clone, Args)]
pub(crate) struct ControlArguments {
    /// What to tell the run
    #[arg(value_enum)]
    pub(crate) word: WordArgument,
    /// For `break` and `clear`: the path of a state, `for_box/grasp`, as `ratn check TASK --annotations` and `ratn status` name it
    #[arg(value_name = "STATE")]
    pub(crate) state: Option<String>,
    /// The run: its id, the name of its task, or `-` for the one that is under way
    #[arg(long, value_name = "RUN", default_value = "-")]
    pub(crate) run: String,
    /// Where the endpoint files of the run's system are
    #[arg(long, value_name = "DIR")]
    pub(crate) runtime_dir: Option<PathBuf>,
}

#[derive(Debug, Clone, Args)]
pub(crate) struct SignalArguments {
    /// The run: its id, the name of its task, or `-` for the one that is under way
    #[arg(value_name = "RUN")]
    pub(crate) run: String,
    /// The signal's name, as a state of the task waits for it
    #[arg(value_name = "NAME")]
    pub(crate) signal: String,
    /// What is sent with it, written as in a task file: 3, true, left, "pose(0, 0, 1)"
    #[arg(value_name = "VALUE", allow_hyphen_values = true)]
    pub(crate) value: Option<String>,
    /// Where the endpoint files of the run's system are
    #[arg(long, value_name = "DIR")]
    pub(crate) runtime_dir: Option<PathBuf>,
}

#[derive(Debug, Clone, Args)]
pub(crate) struct AnswerArguments {
    /// The run: its id, the name of its task, or `-` for the one that is under way
    #[arg(value_name = "RUN")]
    pub(crate) run: String,
    /// One of the question's choices
    #[arg(value_name = "CHOICE")]
    pub(crate) choice: String,
    /// The path of the state that asks; needed where several do
    #[arg(long, value_name = "PATH")]
    pub(crate) state: Option<String>,
    /// Where the endpoint files of the run's system are
    #[arg(long, value_name = "DIR")]
    pub(crate) runtime_dir: Option<PathBuf>,
}

#[derive(Debug, Clone, Args)]
pub(crate) struct StatusArguments {
    /// Show it again whenever it changes, until Ctrl-C
    #[arg(long)]
    pub(crate) watch: bool,
    /// Where the endpoint files of the system are
    #[arg(long, value_name = "DIR")]
    pub(crate) runtime_dir: Option<PathBuf>,
    /// Print JSON on standard output: one document, with --watch one a line
    #[arg(long)]
    pub(crate) json: bool,
}

#[derive(Debug, Clone, Args)]
pub(crate) struct TopArguments {
    /// Show it once
    #[arg(long)]
    pub(crate) once: bool,
    /// Where the endpoint files of the system are
    #[arg(long, value_name = "DIR")]
    pub(crate) runtime_dir: Option<PathBuf>,
}

#[derive(Debug, Clone, Args)]
pub(crate) struct DashboardArguments {
    /// Event logs; the log of a run that is under way in the system joins them, also of one that begins later
    #[arg(value_name = "LOG")]
    pub(crate) logs: Vec<PathBuf>,
    /// Let the pages pause a run, let it step and go on, and end it; without it they only look
    #[arg(long)]
    pub(crate) control: bool,
    /// A task file whose annotations the page "Annotations" shows, checks while they are typed and, after a question, writes
    #[arg(long, value_name = "TASK")]
    pub(crate) edit: Option<PathBuf>,
    /// The robot of the logs: the name of a built-in one (aimm, panda, ur5, twin), or the path of a robot.toml; the system's unless given
    #[arg(long, value_name = "ROBOT")]
    pub(crate) robot: Option<String>,
    /// Where pages are served: an address of this machine alone, with port 0 at one that is free
    #[arg(long, value_name = "ADDRESS:PORT", default_value = "127.0.0.1:0")]
    pub(crate) listen: SocketAddr,
    /// Where the endpoint files of the system are; it need not be up
    #[arg(long, value_name = "DIR")]
    pub(crate) runtime_dir: Option<PathBuf>,
}

#[derive(Debug, Clone, Args)]
pub(crate) struct CompletionsArguments {
    /// The shell
    #[arg(value_enum)]
    pub(crate) shell: clap_complete::Shell,
}

#[derive(Debug, Clone, Args)]
pub(crate) struct ManArguments {
    /// The folder, which is made
    #[arg(value_name = "DIR")]
    pub(crate) directory: PathBuf,
}

#[derive(Debug, Clone, Args)]
pub(crate) struct ReportArguments {
    /// The event log; several are compared
    #[arg(value_name = "LOG", required = true)]
    pub(crate) logs: Vec<PathBuf>,
    /// Print one JSON document
    #[arg(long)]
    pub(crate) json: bool,
    /// Write a Gantt chart; `.svg` or `.html`. Several runs stand below each other on one time axis, HSM first
    #[arg(long, value_name = "FILE", value_parser = chart)]
    pub(crate) gantt: Option<PathBuf>,
    /// What a row of the chart is
    #[arg(long, value_enum, value_name = "WHAT", default_value = "resource")]
    pub(crate) by: RowArgument,
}

/// The rows of a chart, on the command line.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum RowArgument {
    /// A resource
    Resource,
    /// A state
    Node,
}

/// The forms of an export, on the command line.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum FormatArgument {
    /// A trace for ui.perfetto.dev: a track per resource, and what led to what
    Perfetto,
    /// Spans as OTLP/JSON, a request a line
    Otlp,
    /// A recording for Foxglove and Rerun: what happened, the objects as believed, the joints
    Mcap,
    /// A table of the instances
    Csv,
    /// A graph for Graphviz
    Dot,
    /// A graph for Mermaid
    Mermaid,
}

/// What a graph shows, on the command line.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum DrawingArgument {
    /// Every instance, and what it waited for
    Network,
    /// The states, all visits of one together
    Task,
}

#[derive(Debug, Clone, Args)]
pub(crate) struct ExportArguments {
    /// The form
    #[arg(value_enum)]
    pub(crate) format: FormatArgument,
    /// The event log; that of a run under way is exported as far as it is written
    #[arg(value_name = "LOG")]
    pub(crate) log: PathBuf,
    /// Where it goes; standard output unless given
    #[arg(short, long, value_name = "FILE")]
    pub(crate) output: Option<PathBuf>,
    /// What a graph shows
    #[arg(long, value_enum, value_name = "WHAT", default_value = "network")]
    pub(crate) of: DrawingArgument,
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
pub(crate) struct SimulateArguments {
    /// A job shop: a line with the numbers of jobs and machines, then per job a line of pairs of machine and duration
    #[arg(long, value_name = "FILE", required_unless_present = "project", conflicts_with = "project")]
    pub(crate) jobshop: Option<PathBuf>,
    /// Projects in PSPLIB's `.sm` format: activities that need units of several resources
    #[arg(long, value_name = "FILE", num_args = 1.., conflicts_with = "best")]
    pub(crate) project: Vec<PathBuf>,
    /// The best makespan known; of well-known job shops it is known
    #[arg(long, value_name = "N", value_parser = positive)]
    pub(crate) best: Option<f64>,
    /// A table of best makespans of projects: lines `file,lower bound,best known`, with or without the bound
    #[arg(long, value_name = "CSV", requires = "project")]
    pub(crate) best_known: Option<PathBuf>,
    /// What activities really take differs from the estimates by up to this share of them (0.3: 30 %); the reference then is a run that
    /// knows what they take
    #[arg(long, value_name = "SHARE", value_parser = share)]
    pub(crate) vary: Option<f64>,
    /// Schedules to look at whenever much of what is to be done has changed; 0 for plain dispatch
    #[arg(long, value_name = "N", default_value_t = ratn_simulation::activities::DEFAULT_ORDERS)]
    pub(crate) orders: usize,
    /// Every random choice is derived from this number
    #[arg(long, value_name = "N", default_value_t = 1)]
    pub(crate) seed: u64,
    /// Print one JSON document on standard output
    #[arg(long)]
    pub(crate) json: bool,
}

#[derive(Debug, Clone, Args)]
pub(crate) struct PlanArguments {
    /// The robot, with collision shapes or spheres
    #[arg(long, value_name = "URDF")]
    pub(crate) robot: PathBuf,
    /// Where the packages are that the robot's meshes are named by (`package://NAME/...`)
    #[arg(long, value_name = "DIR")]
    pub(crate) packages: Vec<PathBuf>,
    /// Which links may touch; without it neighbours that are made to touch, and links that meet in every posture
    #[arg(long, value_name = "FILE")]
    pub(crate) srdf: Option<PathBuf>,
    /// Problems in JSON: `joints`, and per class `objects`, `start` and `goal`; the form is in docs/running.md
    #[arg(long, value_name = "FILE")]
    pub(crate) problems: PathBuf,
    /// What the samples are derived from
    #[arg(long, value_name = "N", default_value_t = 0)]
    pub(crate) seed: u64,
    /// Samples per problem before it is given up
    #[arg(long, value_name = "N", default_value_t = 100_000, value_parser = at_least_one)]
    pub(crate) iterations: usize,
    /// Seconds for a problem, all its repetitions together, before it is given up
    #[arg(long, value_name = "S", default_value_t = 30.0, value_parser = positive)]
    pub(crate) limit_s: f64,
    /// Solve each problem this often and take the least times; one that is not solved is not tried again
    #[arg(long, value_name = "N", default_value_t = 15, value_parser = at_least_one)]
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
pub(crate) struct RobotArguments {
    #[command(subcommand)]
    pub(crate) command: RobotCommand,
}

/// What can be done with a robot.
#[derive(Debug, Clone, Subcommand)]
pub(crate) enum RobotCommand {
    /// Read it with its URDF, SRDF and meshes, and look at its postures and its workplace
    Check {
        /// The name of a built-in one (aimm, panda, ur5, twin), or the path of a robot.toml
        #[arg(value_name = "ROBOT")]
        robot: String,
    },
}
