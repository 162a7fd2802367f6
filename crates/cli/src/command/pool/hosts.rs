//! Finds the process managers of all hosts, and asks them.
//!
//! Each offers its host to the resource manager, with the process manager's address as its endpoint: whoever finds the resource
//! manager finds every host. Without one, the process manager of this host is found by its endpoint file.

use super::HostArguments;
use crate::failure::Failure;
use crate::system::public_directory;
use ratn_daemon::{process_manager, resource_manager};
use ratn_proto::types::HostPools;
use ratn_worker::client::{CallError, Channels, ProcessClient, ResourceClient};
use ratn_worker::endpoint::Endpoint;
use ratn_worker::runtime_directory::RuntimeDirectory;
use ratn_worker::tls::ClientTls;
use std::time::Duration;

/// Timeout of an answer.
const PATIENCE: Duration = Duration::from_secs(3);

/// A process manager.
pub(super) struct Host {
    /// The host's name; empty where only its address is known.
    pub(super) name: String,
    pub(super) endpoint: Endpoint,
    pub(super) client: ProcessClient,
}

/// A host with its answer.
pub(super) struct Answered {
    pub(super) host: Host,
    pub(super) pools: Result<HostPools, String>,
}

/// All process managers that can be found, sorted by host name.
pub(super) async fn find(arguments: &HostArguments, tls: &ClientTls) -> Result<Vec<Host>, Failure> {
    let channels = Channels::new(tls);
    let host = |name: &str, endpoint: Endpoint| -> Result<Host, Failure> {
        Ok(Host { name: name.to_owned(), client: ProcessClient::new(&channels, &endpoint)?, endpoint })
    };
    if let Some(manager) = &arguments.manager {
        return Ok(vec![host("", manager.clone())?]);
    }
    let directory = RuntimeDirectory::at(public_directory(arguments.runtime_dir.as_deref())?);
    let own = directory.find(process_manager::ROLE);
    let known = match resource_manager(arguments) {
        Some(endpoint) => registered(&channels, &endpoint).await.map_err(|error| {
            let help = match &own {
                Ok(own) => format!("; `--manager {own}` asks the process manager of this host alone"),
                Err(_) => String::new(),
            };
            Failure::Refused(format!("ratn: which hosts there are is not known: {error}{help}"))
        })?,
        None => Vec::new(),
    };
    let mut hosts = known.into_iter().map(|(name, at)| host(&name, at)).collect::<Result<Vec<_>, _>>()?;
    match own {
        // The process manager of this host may not have reached the resource manager.
        Ok(own) if hosts.iter().all(|host| host.endpoint != own) => hosts.push(host("", own)?),
        Err(error) if hosts.is_empty() => return Err(Failure::Refused(format!("ratn: {error}"))),
        _ => {}
    }
    Ok(hosts)
}

/// The address of the resource manager that knows the hosts.
pub(super) fn resource_manager(arguments: &HostArguments) -> Option<Endpoint> {
    if arguments.manager.is_some() {
        return None;
    }
    let directory = RuntimeDirectory::at(public_directory(arguments.runtime_dir.as_deref()).ok()?);
    arguments.resource_manager.clone().or_else(|| directory.find(resource_manager::ROLE).ok())
}

async fn registered(channels: &Channels, manager: &Endpoint) -> Result<Vec<(String, Endpoint)>, CallError> {
    let hosts = ResourceClient::new(channels, manager, "")?.list(&[process_manager::HOST_KIND]).await?;
    let endpoint = |text: &str| text.parse::<Endpoint>().ok();
    Ok(hosts.iter().filter_map(|host| Some((host.host.clone(), endpoint(host.endpoint())?))).collect())
}

/// Asks all of them at the same time.
pub(super) async fn ask_all(hosts: Vec<Host>) -> Vec<Answered> {
    let asked = hosts.into_iter().map(async |host| {
        let pools = match tokio::time::timeout(PATIENCE, host.client.pools()).await {
            Ok(answer) => answer.map_err(|error| error.to_string()),
            Err(_) => Err(format!("no answer from {} within {} s", host.endpoint, PATIENCE.as_secs())),
        };
        Answered { host, pools }
    });
    let mut answered = futures::future::join_all(asked).await;
    answered.sort_by(|a, b| a.name().cmp(b.name()));
    answered
}

/// The host for which `wanted` holds; refused where there is none or several. `--host` chooses.
pub(super) async fn the_one(
    arguments: &HostArguments,
    tls: &ClientTls,
    what: &str,
    wanted: impl Fn(&HostPools) -> bool,
) -> Result<Host, Failure> {
    let answered = ask_all(find(arguments, tls).await?).await;
    let silent: Vec<String> = answered.iter().filter_map(Answered::problem).collect();
    let names: Vec<String> = answered.iter().map(|one| one.name().to_owned()).collect();
    let fits = |one: &Answered| {
        let chosen = arguments.host.as_deref().is_none_or(|host| host == one.name());
        chosen && one.pools.as_ref().is_ok_and(&wanted)
    };
    let mut found: Vec<Answered> = answered.into_iter().filter(fits).collect();
    let refuse = |message: String| Err(Failure::Refused(format!("ratn: {message}")));
    match (found.pop(), found.pop()) {
        (Some(one), None) => Ok(one.host),
        (Some(a), Some(b)) => refuse(format!("{what} is on {} and on {}: say --host", b.name(), a.name())),
        (None, _) => {
            let asked = if names.is_empty() { "no host".to_owned() } else { names.join(", ") };
            let silent = silent.iter().map(|problem| format!("; {problem}")).collect::<String>();
            refuse(format!("there is no {what} (asked: {asked}); `ratn ps` shows what there is{silent}"))
        }
    }
}

impl Answered {
    /// The host's own name for itself, else the resource manager's; without both it is empty, and the address is shown
    /// elsewhere.
    pub(super) fn name(&self) -> &str {
        self.pools.as_ref().map_or(&self.host.name, |pools| &pools.host)
    }

    /// Why there is no answer.
    pub(super) fn problem(&self) -> Option<String> {
        let error = self.pools.as_ref().err()?;
        let name = if self.host.name.is_empty() { "this host" } else { &self.host.name };
        Some(format!("{name}: {error}"))
    }
}
