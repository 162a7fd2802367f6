//! `ratn ps`, `logs`, `pool`, `restart` and `drain`: the worker processes of all hosts, for people and scripts.

mod hosts;
mod logs;
mod show;

use super::{blocking_on, leader};
use crate::failure::Failure;
use crate::output;
use crate::repainting;
use crate::system::{System, public_directory};
use anyhow::Context;
use clap::{Args, Subcommand};
use hosts::Answered;
use ratn_daemon::resource_manager;
use ratn_proto::types::{HostPools, Scale};
use ratn_worker::endpoint::Endpoint;
use ratn_worker::tls::ClientTls;
use serde_json::json;
use std::path::PathBuf;

/// Which process managers, and how their answers are shown.
#[derive(Debug, Clone, Args)]
pub(crate) struct HostArguments {
    /// Where endpoint files are; $RATN_RUNTIME_DIR, $XDG_RUNTIME_DIR/ratn or /tmp/ratn-UID unless given
    #[arg(long, value_name = "DIR", global = true)]
    runtime_dir: Option<PathBuf>,
    /// Where the resource manager is, which knows every host, instead: `unix:/path`, `https://host:port`
    #[arg(long, value_name = "ADDRESS", global = true)]
    resource_manager: Option<Endpoint>,
    /// Ask this process manager alone: `unix:/path`, `https://host:port`
    #[arg(long, value_name = "ADDRESS", global = true, conflicts_with = "resource_manager")]
    manager: Option<Endpoint>,
    /// Only this host
    #[arg(long, value_name = "NAME", global = true)]
    host: Option<String>,
    /// Print one JSON document on standard output
    #[arg(long, global = true)]
    json: bool,
}

#[derive(Debug, Clone, Args)]
pub(crate) struct PsArguments {
    /// Show them again whenever something changes, until Ctrl-C
    #[arg(long)]
    watch: bool,
    #[command(flatten)]
    host: HostArguments,
}

#[derive(Debug, Clone, Args)]
pub(crate) struct LogsArguments {
    /// A worker's id, as `ps` shows it: `path-planner-1@compute`; or a template: then every line names its worker
    name: String,
    /// Follow the output: of a worker until it ends, of a template also of workers that start later
    #[arg(short, long)]
    follow: bool,
    #[command(flatten)]
    host: HostArguments,
}

#[derive(Debug, Clone, Args)]
pub(crate) struct PoolArguments {
    #[command(subcommand)]
    command: PoolCommand,
    #[command(flatten)]
    host: HostArguments,
}

#[derive(Debug, Clone, Subcommand)]
enum PoolCommand {
    /// Start more workers of a template and keep them; also where the template has failed
    Start {
        /// The template's name
        template: String,
        /// How many more
        #[arg(default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..))]
        count: u32,
    },
    /// End workers, each when no lease holds it; a template keeps at least its minimum
    Stop {
        /// Their ids
        #[arg(required = true)]
        workers: Vec<String>,
    },
    /// Change how many workers a template has, until its process manager ends; within what its config allows
    Scale {
        /// The template's name
        template: String,
        #[command(flatten)]
        size: SizeArguments,
    },
}

#[derive(Debug, Clone, Args)]
#[group(required = true, multiple = true)]
struct SizeArguments {
    /// At least so many are kept; what was started on request beyond it is not
    #[arg(long, value_name = "N")]
    min: Option<u32>,
    /// At most so many are started
    #[arg(long, value_name = "N")]
    max: Option<u32>,
    /// So many more than are held are kept ready
    #[arg(long, value_name = "N")]
    spares: Option<u32>,
}

#[derive(Debug, Clone, Args)]
pub(crate) struct RestartArguments {
    /// A template, on every host that has it, or a worker's id
    name: String,
    #[command(flatten)]
    host: HostArguments,
}

#[derive(Debug, Clone, Args)]
pub(crate) struct DrainArguments {
    /// The host's name
    name: String,
    /// Let it take work again
    #[arg(long)]
    undo: bool,
    #[command(flatten)]
    host: HostArguments,
}

/// Shows the workers of all hosts, once or repeatedly; fails where a host does not answer.
pub(super) fn ps(arguments: &PsArguments, tls: &ClientTls) -> Result<(), Failure> {
    let PsArguments { host, watch } = arguments;
    asking(async {
        let mut problems = Vec::new();
        let look = async || {
            let (text, said) = workers(host, tls).await?;
            problems = said;
            Ok::<String, Failure>(text)
        };
        repainting::repeat(*watch, host.json, look).await?;
        if problems.is_empty() { Ok(()) } else { Err(anyhow::anyhow!(problems.join("\nratn: ")).into()) }
    })
}

/// The workers of all hosts as text or JSON, and the hosts that do not answer.
async fn workers(arguments: &HostArguments, tls: &ClientTls) -> Result<(String, Vec<String>), Failure> {
    let managers = match hosts::resource_manager(arguments) {
        Some(endpoint) => leader::ask(&endpoint, tls).await,
        None => Vec::new(),
    };
    let found = hosts::find(arguments, tls).await.inspect_err(|_| {
        if !managers.is_empty() {
            output::progress(leader::line(resource_manager::ROLE, &managers));
        }
    });
    let mut answered = hosts::ask_all(found?).await;
    answered.retain(|one| arguments.host.as_deref().is_none_or(|host| host == one.name()));
    if let Some(host) = arguments.host.as_deref().filter(|_| answered.is_empty()) {
        return Err(Failure::Refused(format!("ratn: there is no host `{host}`; `ratn ps` shows all")));
    }
    let pools: Vec<&HostPools> = answered.iter().filter_map(|one| one.pools.as_ref().ok()).collect();
    let mismatches = mismatches(arguments, tls).await;
    let problems: Vec<String> = answered.iter().filter_map(Answered::problem).collect();
    if arguments.json {
        let mut document = show::in_json(&answered);
        document["mismatches"] = json!(mismatches);
        if !managers.is_empty() {
            document["resource_managers"] = leader::in_json(&managers);
        }
        return Ok((document.to_string(), problems));
    }
    let managers = (!managers.is_empty()).then(|| leader::line(resource_manager::ROLE, &managers));
    let lines = std::iter::once(show::table(&pools)).chain(mismatches).chain(managers);
    Ok((lines.collect::<Vec<_>>().join("\n"), problems))
}

/// The workers of all hosts, and the resource usage of each host, for display together with other things.
pub(super) async fn overview(runtime_dir: Option<PathBuf>, tls: &ClientTls) -> Result<String, Failure> {
    let arguments = HostArguments { runtime_dir, resource_manager: None, manager: None, host: None, json: false };
    let answered = hosts::ask_all(hosts::find(&arguments, tls).await?).await;
    let pools: Vec<&HostPools> = answered.iter().filter_map(|one| one.pools.as_ref().ok()).collect();
    let silent = answered.iter().filter_map(Answered::problem);
    Ok([show::hosts(&pools), show::table(&pools)].into_iter().chain(silent).collect::<Vec<_>>().join("\n"))
}

/// Differences between workers' descriptions and the catalogue of the system in the runtime directory; empty where none is
/// known.
async fn mismatches(arguments: &HostArguments, tls: &ClientTls) -> Vec<String> {
    let elsewhere = arguments.manager.is_some() || arguments.resource_manager.is_some();
    let Some(directory) = public_directory(arguments.runtime_dir.as_deref()).ok().filter(|_| !elsewhere) else {
        return Vec::new();
    };
    match Box::pin(System::find(&directory, None, tls)).await {
        Ok(Some(system)) => system.mismatches,
        Ok(None) | Err(_) => Vec::new(),
    }
}

/// Warns before more workers are started whose description differs from the catalogue, as far as the template's ready workers
/// show.
async fn warn_of_mismatches(arguments: &HostArguments, tls: &ClientTls, template: &str) {
    let is_of_it = |what: &&String| what.strip_prefix(template).is_some_and(|rest| rest.starts_with('-'));
    let mismatches = mismatches(arguments, tls).await;
    mismatches.iter().filter(is_of_it).for_each(|what| output::progress(format_args!("warning: {what}")));
}

/// Prints the output of workers.
pub(super) fn logs(arguments: &LogsArguments, tls: &ClientTls) -> Result<(), Failure> {
    asking(logs::print(arguments, tls))
}

/// Starts and ends workers, and changes their number.
pub(super) fn run(arguments: &PoolArguments, tls: &ClientTls) -> Result<(), Failure> {
    let host = &arguments.host;
    asking(async {
        match &arguments.command {
            PoolCommand::Start { template, count } => {
                let one = hosts::the_one(host, tls, &format!("template `{template}`"), has(template)).await?;
                ids(host, &one.client.spawn(template, *count).await.context("not started")?)?;
                warn_of_mismatches(host, tls, template).await;
                Ok(())
            }
            PoolCommand::Stop { workers } => {
                for id in workers {
                    let one = hosts::the_one(host, tls, &format!("worker `{id}`"), runs(id)).await?;
                    one.client.stop(id).await.with_context(|| format!("`{id}` is not ended"))?;
                }
                ids(host, workers)
            }
            PoolCommand::Scale { template, size } => {
                let one = hosts::the_one(host, tls, &format!("template `{template}`"), has(template)).await?;
                let scale = Scale { min: size.min, max: size.max, spares: size.spares };
                let pool = one.client.scale(template, scale).await?;
                warn_of_mismatches(host, tls, template).await;
                if host.json {
                    return Ok(output::result(show::pool_json(&pool))?);
                }
                Ok(output::result(format!("{template}: {} to {}, {} spares", pool.min, pool.max, pool.spares))?)
            }
        }
    })
}

/// Replaces workers.
pub(super) fn restart(arguments: &RestartArguments, tls: &ClientTls) -> Result<(), Failure> {
    let (name, host) = (arguments.name.as_str(), &arguments.host);
    asking(async {
        let mut answered = hosts::ask_all(hosts::find(host, tls).await?).await;
        answered.retain(|one| host.host.as_deref().is_none_or(|wanted| wanted == one.name()));
        let with = |one: &&Answered| one.pools.as_ref().is_ok_and(has(name));
        let mut going = Vec::new();
        let on: Vec<&Answered> = answered.iter().filter(with).collect();
        for one in &on {
            let restarted = one.host.client.restart_template(name).await;
            going.extend(restarted.with_context(|| format!("`{name}` on {} is not restarted", one.name()))?);
        }
        if on.is_empty() {
            let one = hosts::the_one(host, tls, &format!("template or worker `{name}`"), runs(name)).await?;
            going = one.client.restart_worker(name).await.with_context(|| format!("`{name}` is not restarted"))?;
        }
        ids(host, &going)
    })
}

/// Drains a host, or ends the drain.
pub(super) fn drain(arguments: &DrainArguments, tls: &ClientTls) -> Result<(), Failure> {
    let (name, host) = (arguments.name.as_str(), &arguments.host);
    asking(async {
        let one = hosts::the_one(host, tls, &format!("host `{name}`"), |pools| pools.host == name).await?;
        let left = one.client.drain(!arguments.undo).await?;
        if host.json {
            return Ok(output::result(json!({ "host": name, "draining": !arguments.undo, "workers": left }))?);
        }
        let text = match (arguments.undo, left.is_empty()) {
            (true, _) => format!("{name} takes work again"),
            (false, true) => format!("{name} is drained; it has no workers"),
            (false, false) => {
                format!("{name} takes no new work; these end once nobody holds them: {}", left.join(", "))
            }
        };
        Ok(output::result(text)?)
    })
}

fn has(template: &str) -> impl Fn(&HostPools) -> bool {
    move |pools| pools.pools.iter().any(|pool| pool.template == template)
}

fn runs(worker: &str) -> impl Fn(&HostPools) -> bool {
    move |pools| pools.pools.iter().flat_map(|pool| &pool.workers).any(|known| known.id == worker)
}

fn ids(arguments: &HostArguments, ids: &[String]) -> Result<(), Failure> {
    if arguments.json {
        output::result(json!(ids))?
    } else if ids.is_empty() {
        output::progress("there is no worker now")
    } else {
        output::result(ids.join("\n"))?
    }
    Ok(())
}

fn asking(ask: impl Future<Output = Result<(), Failure>>) -> Result<(), Failure> {
    blocking_on(tokio::runtime::Builder::new_current_thread(), ask)
}
