//! Arguments of the commands that keep a system running: stops, states, certificates.

use clap::{Args, Subcommand};
use ratn_worker::endpoint::Endpoint;
use std::path::PathBuf;

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
    /// Restore a state from a copy; end the daemon of that state first
    Restore {
        /// What `backup` made
        backup: PathBuf,
        /// A folder that is empty or not there yet: nothing is overwritten
        target: PathBuf,
    },
    /// Copy a state to where another config keeps it: from files to etcd, or back. End its daemons first
    Copy {
        /// Whose state: `resource-manager` or `world-pool`
        #[arg(value_parser = ["resource-manager", "world-pool"])]
        role: String,
        /// The config with the storage that it is in
        #[arg(long, value_name = "FILE")]
        from: PathBuf,
        /// The config with the storage that it goes to; nothing is overwritten
        #[arg(long, value_name = "FILE")]
        to: PathBuf,
        /// The state as it is at this moment, for a backup: its daemons may run
        #[arg(long)]
        running: bool,
    },
    /// Say what is in a state or a copy, and whether it is whole
    Show {
        /// The folder
        state: PathBuf,
    },
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
