//! The command line of `ratn resource`.

use crate::failure::Failure;
use clap::{Args, Subcommand};
use ratn_model::condition::Condition;
use ratn_model::id::LeaseId;
use ratn_model::name::{KIND_RULE, is_kind};
use ratn_model::resource::{Quantity, ResourceClass};
use ratn_model::value::Value;
use ratn_worker::endpoint::Endpoint;
use std::collections::BTreeMap;
use std::path::PathBuf;
use std::time::Duration;

#[derive(Debug, Clone, Args)]
pub(crate) struct ResourceArguments {
    #[command(subcommand)]
    pub(super) command: ResourceCommand,
    /// Where endpoint files are; $RATN_RUNTIME_DIR, $XDG_RUNTIME_DIR/ratn or /tmp/ratn-UID unless given
    #[arg(long, value_name = "DIR", global = true)]
    pub(super) runtime_dir: Option<PathBuf>,
    /// Where the resource manager is, instead: `unix:/path`, `https://host:port`
    #[arg(long, value_name = "ADDRESS", global = true)]
    pub(super) manager: Option<Endpoint>,
    /// Print JSON on standard output: one document, or with `watch` one a line
    #[arg(long, global = true)]
    pub(super) json: bool,
}

#[derive(Debug, Clone, Subcommand)]
pub(super) enum ResourceCommand {
    /// Add a resource; it stays until it is deleted
    Create(CreateArguments),
    /// Use capacity up for as long as this command runs
    Consume(HoldArguments),
    /// Remove resources; their holders lose them
    Delete {
        /// Their ids
        #[arg(value_name = "ID", required_unless_present = "kind", conflicts_with = "kind")]
        ids: Vec<String>,
        /// One of this kind instead
        #[arg(long, value_name = "KIND")]
        kind: Option<String>,
    },
    /// Wait for resources and hold them for as long as this command runs
    Block(HoldArguments),
    /// End a lease of any holder
    Release {
        /// Its number, as `list` shows it, or `lease-17` as messages write it
        #[arg(value_name = "LEASE")]
        lease: LeaseId,
    },
    /// Say whether such resources exist, free or not; exit code 1 when not
    Exists(Selector),
    /// Show the resources and who holds them
    List {
        /// Only of these kinds
        #[arg(value_name = "KIND")]
        kinds: Vec<String>,
        /// Only those that meet this condition, `payload >= 2.5`, `tool in [gripper, welder]`, `has camera`; may be repeated
        #[arg(long = "where", value_name = "CONDITION")]
        conditions: Vec<Condition>,
        /// Show them again whenever something changes, until Ctrl-C
        #[arg(long)]
        watch: bool,
    },
    /// Show everything about one resource
    Get {
        /// Its id
        #[arg(value_name = "ID")]
        id: String,
    },
    /// Show the requests that wait, and what each waits for
    Explain {
        /// The request id of one; the first hundred of the queue unless given
        #[arg(value_name = "REQUEST", default_value = "")]
        request: String,
    },
    /// Show the open sessions, what they hold and provide
    Sessions,
    /// Show the resources, then every change
    Watch {
        /// Only of these kinds
        #[arg(value_name = "KIND")]
        kinds: Vec<String>,
    },
}

#[derive(Debug, Clone, Args)]
pub(super) struct CreateArguments {
    /// Its kind, `Fixture`: letters, digits, `_` and `-`
    #[arg(value_name = "KIND", value_parser = kind)]
    pub(super) kind: String,
    /// Replace the attributes, the capacity and the host of one of this id that is there
    #[arg(long, requires = "id")]
    pub(super) update: bool,
    /// system, process, module, world or task
    #[arg(long, value_name = "CLASS", default_value = "module", value_parser = class)]
    pub(super) class: ResourceClass,
    /// Its id; the resource manager gives one unless given
    #[arg(long, value_name = "ID", default_value = "")]
    pub(super) id: String,
    /// How much of it there is, `3` or, of what is divisible, `2.5`
    #[arg(long, value_name = "N", default_value = "1", value_parser = amount)]
    pub(super) capacity: Quantity,
    /// Parts of a unit of it can be had
    #[arg(long)]
    pub(super) divisible: bool,
    /// What is consumed of it is gone for good, and not back at the end of the task
    #[arg(long)]
    pub(super) non_renewable: bool,
    /// The host that it is on
    #[arg(long, value_name = "NAME", default_value = "")]
    pub(super) host: String,
    /// An attribute, `reach=1.2`; may be repeated
    #[arg(long = "attribute", value_name = "NAME=VALUE", value_parser = attribute)]
    pub(super) attributes: Vec<(String, Value)>,
}

/// Which resources.
#[derive(Debug, Clone, Default, Args)]
pub(super) struct Selector {
    /// Their kind
    #[arg(value_name = "KIND")]
    pub(super) kind: String,
    /// How many units; of divisible resources also a part: `0.5`
    #[arg(long, value_name = "N", default_value = "1", value_parser = amount)]
    pub(super) count: Quantity,
    /// Their class
    #[arg(long, value_name = "CLASS", value_parser = class)]
    pub(super) class: Option<ResourceClass>,
    /// An attribute that they have, `reach=1.2`; may be repeated
    #[arg(long = "attribute", value_name = "NAME=VALUE", value_parser = attribute)]
    pub(super) attributes: Vec<(String, Value)>,
    /// A condition that they must meet, `payload >= 2.5`, `tool in [gripper, welder]`, `has camera`; may be repeated
    #[arg(long = "where", value_name = "CONDITION")]
    pub(super) conditions: Vec<Condition>,
}

#[derive(Debug, Clone, Args)]
pub(super) struct HoldArguments {
    #[command(flatten)]
    pub(super) selector: Selector,
    /// Wait at most so long for the resources, in seconds; a manager that restarts meanwhile is asked again
    #[arg(long, value_name = "S", default_value = "600", value_parser = seconds)]
    pub(super) wait: Duration,
    /// Larger goes first
    #[arg(long, value_name = "N", default_value_t = 0, allow_negative_numbers = true)]
    pub(super) priority: i64,
    /// Give them back after so long, in seconds; else at Ctrl-C or at the end of the program
    #[arg(long, value_name = "S", value_parser = seconds)]
    pub(super) ttl: Option<Duration>,
    /// A program to run meanwhile; RATN_LEASE and RATN_TOKEN tell it what it has
    #[arg(value_name = "PROGRAM", last = true)]
    pub(super) program: Vec<String>,
}

fn class(text: &str) -> Result<ResourceClass, String> {
    use ResourceClass::{Module, Process, System, Task, World};
    let known = [System, Process, Module, World, Task].into_iter().find(|class| class.to_string() == text);
    known.ok_or_else(|| "expected system, process, module, world or task".to_owned())
}

fn amount(text: &str) -> Result<Quantity, String> {
    match text.parse::<Quantity>() {
        Ok(Quantity::ZERO) => Err("is 0: expected more than nothing".to_owned()),
        Ok(quantity) => Ok(quantity),
        Err(error) => Err(error.to_string()),
    }
}

fn kind(text: &str) -> Result<String, String> {
    if is_kind(text) { Ok(text.to_owned()) } else { Err(format!("expected {KIND_RULE}")) }
}

/// The attributes; a name that is given twice is refused.
pub(super) fn attributes(given: &[(String, Value)]) -> Result<BTreeMap<String, Value>, Failure> {
    let mut attributes = BTreeMap::new();
    for (name, value) in given {
        if let Some(before) = attributes.insert(name.clone(), value.clone()) {
            let message = format!("ratn: --attribute {name} is given twice, {before} and {value}: leave one out");
            return Err(Failure::Refused(message));
        }
    }
    Ok(attributes)
}

/// Parsed as a number or a truth value where possible, else a text.
fn attribute(text: &str) -> Result<(String, Value), String> {
    let (name, value) = text.split_once('=').ok_or("expected NAME=VALUE")?;
    let value = match value {
        "true" => Value::Bool(true),
        "false" => Value::Bool(false),
        _ => match (value.parse(), value.parse::<f64>()) {
            (Ok(whole), _) => Value::Int(whole),
            (_, Ok(number)) if number.is_finite() => Value::Float(number),
            _ => Value::String(value.to_owned()),
        },
    };
    Ok((name.to_owned(), value))
}

fn seconds(text: &str) -> Result<Duration, String> {
    let seconds = text.parse::<f64>().ok().filter(|s| (0.001..=1e9).contains(s));
    seconds.map(Duration::from_secs_f64).ok_or_else(|| "expected seconds, at least 0.001".to_owned())
}
