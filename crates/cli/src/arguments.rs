//! The command line: every command, and what each takes.

mod operating;
mod roles;
mod systems;
mod tasks;
mod values;

use crate::command::actions::ActionsArguments;
use crate::command::doctor::DoctorArguments;
use crate::command::new::NewArguments;
use crate::command::pool::{DrainArguments, LogsArguments, PoolArguments, PsArguments, RestartArguments};
use crate::command::resource::ResourceArguments;
use crate::command::world::WorldArguments;
use clap::{Parser, Subcommand};

pub(crate) use operating::{
    CertsArguments, GoOnArguments, HoldArguments, SafetyArguments, StateArguments, StateCommand, StopArguments,
};
pub(crate) use roles::{CellArguments, KeptRoleArguments, RoleArguments, WorkerArguments, WorkerKind};
pub(crate) use systems::{Budget, DemoArguments, GoodsArguments, ResetArguments, SystemArguments, UpArguments};
pub(crate) use tasks::{
    AnswerArguments, CheckArguments, CompletionsArguments, ControlArguments, DashboardArguments, DrawingArgument,
    ExportArguments, FormatArgument, JsonArgument, ManArguments, ModeArgument, PlanArguments, ReportArguments,
    RobotArguments, RobotCommand, RowArgument, RunArguments, SignalArguments, SimulateArguments, StatusArguments,
    TablesArguments, TopArguments, UrgencyArgument, WordArgument,
};

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
    /// Pause a run, let it go on, let it do one step, or end it
    Control(ControlArguments),
    /// Send a run a signal that one of its states waits for, or will
    Signal(SignalArguments),
    /// Answer a question that a state of a run asks
    Answer(AnswerArguments),
    /// Show which states run, which resources are held, and what waits for what
    Status(StatusArguments),
    /// Show the worker processes of all hosts
    Ps(PsArguments),
    /// Watch a whole system: its run, who holds what and who waits for what, workers, hosts with CPU and memory
    Top(TopArguments),
    /// Show runs, live and replayed, and a whole system as pages in a browser on this machine
    Dashboard(DashboardArguments),
    /// Print the output of a worker on any host
    Logs(LogsArguments),
    /// Start and end workers of a host's pools, and change how many there are
    Pool(PoolArguments),
    /// Replace workers, each once its successor is ready
    Restart(RestartArguments),
    /// Let a host take no new work: each of its workers ends when no lease holds it
    Drain(DrainArguments),
    /// Emergency stop: everything that moves stops, and nothing begins until the stop is cleared
    Stop(StopArguments),
    /// Pause everything that moves, and let nothing new move
    Hold(HoldArguments),
    /// End a hold: motions go on where they paused
    GoOn(GoOnArguments),
    /// Say what is missing on this machine or in this config, and what to do about it
    Doctor(DoctorArguments),
    /// Lay a new table in the simulated cell of a running system, and remove every fact
    Reset(ResetArguments),
    /// Check a task file without starting anything
    Check(CheckArguments),
    /// List the actions that tasks can use, with their ports, and where each comes from
    Actions(ActionsArguments),
    /// Begin a worker or a task of your own
    New(NewArguments),
    /// Say where the time of a run went, from its event log
    Report(ReportArguments),
    /// Write an event log in a form that other tools open: Perfetto, OpenTelemetry, Foxglove and Rerun, spreadsheets, graphs
    Export(ExportArguments),
    /// Print a script that lets a shell complete what is typed
    Completions(CompletionsArguments),
    /// Write man pages of every command into a folder
    Man(ManArguments),
    /// Replay the paper's tables in virtual time
    Tables(TablesArguments),
    /// Run a scheduling problem of the literature in virtual time, as a task, and compare with the best known schedule
    Simulate(SimulateArguments),
    /// Solve a file of motion planning problems for a robot, and say how fast and how well
    Plan(PlanArguments),
    /// Say what a description of a robot is good for: what it has, how far it reaches, what collides
    Robot(RobotArguments),
    /// Look at the resources of a running system and change them
    Resource(ResourceArguments),
    /// Look at the world model of a running system, now or at an earlier revision, and load facts into it
    World(WorldArguments),
    /// Back up, restore, copy or show the state that a daemon keeps on the disk
    State(StateArguments),
    /// Make the authority of a system and certificates for its hosts
    Certs(CertsArguments),
    /// Run the resource manager, which grants resources to tasks (host compute)
    ResourceManager(KeptRoleArguments),
    /// Run the world pool, which keeps the world model and its projections (host compute)
    WorldPool(KeptRoleArguments),
    /// Run the process manager, which starts and watches this host's workers
    ProcessManager(RoleArguments),
    /// Run the simulated cell: robot, table, boxes, sensors, controllers (host sim)
    Cell(CellArguments),
    /// Run a bundled worker; the process manager starts these
    Worker(WorkerArguments),
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
