//! The running system: which roles answer, which clocks are off, which hosts are drained, which pools have failed; where nothing
//! runs, whether the ports are free.

use super::Findings;
use super::tls::listens;
use crate::system::config::SystemConfig;
use ratn_daemon::config::{Engine, StorageConfig};
use ratn_daemon::process_manager::HOST_KIND;
use ratn_daemon::{resource_manager, world_pool};
use ratn_proto::types::{HostPools, Resource};
use ratn_storage::etcd::Holder;
use ratn_worker::client::{Channels, Health, NOT_SERVING, ProcessClient, ResourceClient};
use ratn_worker::endpoint::Endpoint;
use ratn_worker::runtime_directory::{FindError, RuntimeDirectory};
use ratn_worker::tls::ClientTls;
use std::collections::BTreeMap;
use std::io::ErrorKind;
use std::net::TcpListener;
use std::path::Path;
use std::time::Duration;
use time::OffsetDateTime;

/// Timeout of an answer.
const PATIENCE: Duration = Duration::from_secs(2);
/// Clocks that are further apart than this make charts and logs of several hosts hard to read …
const SLIGHT_OFFSET_MS: i64 = 20;
/// … and certificates and deadlines doubtful.
const LARGE_OFFSET_MS: i64 = 5_000;

/// Roles that can have standbys.
const ROLES: [&str; 2] = [resource_manager::ROLE, world_pool::ROLE];

pub(super) async fn check(findings: &mut Findings, config: &SystemConfig, tls: &ClientTls, directory: &Path) {
    let directory = RuntimeDirectory::at(directory);
    let mut manager = None;
    let kept = [(ROLES[0], &config.resource_manager.storage), (ROLES[1], &config.world_pool.storage)];
    let mut leaders = BTreeMap::new();
    for (role, storage) in kept.into_iter().filter(|(_, storage)| storage.engine == Engine::Etcd) {
        leaders.insert(role, leader(findings, role, storage.clone()).await);
    }
    for (role, listen) in listens(config) {
        let leads = leaders.get(role);
        match directory.find(role) {
            // A leader that was killed has left its endpoint file.
            Ok(endpoint)
                if leads.is_some_and(|leads| leads.as_ref().is_some_and(|leads| *leads != endpoint.to_string()))
                    && stands_by(findings, role, tls, &endpoint).await => {}
            Ok(endpoint) => {
                let answers = role_answers(findings, role, tls, &endpoint).await;
                if answers && role == resource_manager::ROLE {
                    manager = Some(endpoint);
                }
            }
            // A standby publishes no endpoint.
            Err(FindError::NotPublished { .. }) if leads.is_some() && stands_by(findings, role, tls, &listen).await => {
            }
            Err(FindError::NotPublished { .. }) => free_port(findings, role, &listen),
            Err(error) => findings.problem(role, error.to_string(), "remove the file, and start the role again"),
        }
    }
    let elsewhere = [config.process_manager.resource_manager.clone(), config.cell.resource_manager.clone()];
    if let Some(manager) = manager.or_else(|| elsewhere.into_iter().flatten().next()) {
        hosts(findings, &Channels::new(tls), &manager).await;
    }
}

/// The address of the leader where several stand by for one another.
async fn leader(findings: &mut Findings, role: &'static str, storage: StorageConfig) -> Option<String> {
    let place = storage.prefix.clone();
    let about = format!("{role}, leader");
    match tokio::task::spawn_blocking(move || storage.leader(role)).await {
        Ok(Ok(Some(Holder { address, about: what }))) => {
            findings.ok(about, format!("{address} ({what}), by {place} in etcd"));
            return Some(address);
        }
        Ok(Ok(None)) => {
            findings.problem(about, format!("nobody leads, by {place} in etcd"), format!("start `ratn {role}`"))
        }
        Ok(Err(error)) => {
            findings.problem(about, format!("{error:#}"), "see whether etcd is well: `etcdctl endpoint health`")
        }
        Err(error) => findings.problem(about, error.to_string(), "please report it"),
    }
    None
}

/// Whether a standby answers there; reports it.
async fn stands_by(findings: &mut Findings, role: &str, tls: &ClientTls, listen: &Endpoint) -> bool {
    let stands_by = Health::of(listen.clone(), tls).is_serving(PATIENCE).await == Ok(false);
    if stands_by {
        findings.ok(role, format!("stands by at {listen}"));
    }
    stands_by
}

async fn role_answers(findings: &mut Findings, role: &str, tls: &ClientTls, endpoint: &Endpoint) -> bool {
    match Health::of(endpoint.clone(), tls).serving(PATIENCE).await {
        Ok(()) => {
            findings.ok(role, format!("serves at {endpoint}"));
            true
        }
        Err(error) => {
            // The last status that it reported.
            let (found, help) = if error.to_string().contains(NOT_SERVING) {
                let help = "a standby is so, too; else its log says why; where its disk is full or failed, see to that and start it again";
                (
                    format!("answers at {endpoint}, and says that it cannot do what it is for (NOT_SERVING)"),
                    help.to_owned(),
                )
            } else {
                let help = format!(
                    "it was killed, hangs, or cannot be reached from here: start it again (`ratn {role}`), and look at its log"
                );
                (format!("is published at {endpoint} and does not answer: {error}"), help)
            };
            findings.problem(role, found, help);
            false
        }
    }
}

/// Checks the address at which a role would listen that does not run.
fn free_port(findings: &mut Findings, role: &str, listen: &Endpoint) {
    let (Endpoint::Tcp { host, port } | Endpoint::Tls { host, port }) = listen else {
        return findings.ok(role, "does not run in this runtime directory");
    };
    match TcpListener::bind((host.as_str(), *port)) {
        Ok(_) => findings.ok(role, format!("does not run here; {listen} is free for it")),
        Err(error) if error.kind() == ErrorKind::AddrNotAvailable => {
            findings.ok(role, format!("is another host's: {host} is no address of this machine"));
        }
        Err(error) if error.kind() == ErrorKind::AddrInUse => findings.problem(
            role,
            format!("does not run here, and {listen} is taken"),
            "`ss -ltnp` says by whom: end that, or give another port to `listen`",
        ),
        Err(error) => findings.problem(
            role,
            format!("{listen} cannot be listened on: {error}"),
            "the name has to resolve on every host: /etc/hosts or DNS",
        ),
    }
}

async fn hosts(findings: &mut Findings, channels: &Channels, manager: &Endpoint) {
    let listed = async { ResourceClient::new(channels, manager, "")?.list(&[HOST_KIND]).await };
    let hosts = match tokio::time::timeout(PATIENCE, listed).await {
        Ok(Ok(hosts)) => hosts,
        Ok(Err(error)) => {
            let help = "is it running, does TLS let you in, has your certificate a role ([service.access])?";
            return findings.problem("resource manager", format!("{manager}: {error}"), help);
        }
        Err(_) => {
            let help = "is the network between the hosts well?";
            return findings.problem("resource manager", format!("{manager} does not answer within 2 s"), help);
        }
    };
    if hosts.is_empty() {
        let help = "start `ratn process-manager` where workers are to run";
        findings.warning("hosts", "no process manager has offered its host", help);
    }
    for host in hosts {
        process_manager(findings, channels, &host).await;
    }
}

async fn process_manager(findings: &mut Findings, channels: &Channels, host: &Resource) {
    let about = format!("host {}", host.host);
    let Ok(endpoint) = host.endpoint().parse::<Endpoint>() else { return };
    let asked = OffsetDateTime::now_utc();
    let answer = async { ProcessClient::new(channels, &endpoint)?.pools().await };
    let pools = match tokio::time::timeout(PATIENCE, answer).await {
        Ok(Ok(pools)) => pools,
        Ok(Err(error)) => {
            let help = "one that listens on `local` is reached on its own host only: give it an address";
            return findings.warning(about, format!("its process manager does not answer: {error}"), help);
        }
        Err(_) => {
            return findings.problem(
                about,
                format!("{endpoint} does not answer within 2 s"),
                "is that host well, and its network?",
            );
        }
    };
    let answered = OffsetDateTime::now_utc();
    clock(findings, &about, asked, answered, pools.clock_us);
    workers(findings, &about, &pools);
}

/// The remote clock was read between question and answer; half of that time is the uncertainty (Cristian 1989).
fn clock(findings: &mut Findings, about: &str, asked: OffsetDateTime, answered: OffsetDateTime, clock_us: u64) {
    let micros = |at: OffsetDateTime| i64::try_from(at.unix_timestamp_nanos() / 1_000).unwrap_or(i64::MAX);
    let middle = (micros(asked) + micros(answered)) / 2;
    let doubt_ms = (micros(answered) - micros(asked)) / 2_000;
    let offset_ms = (i64::try_from(clock_us).unwrap_or(i64::MAX) - middle) / 1_000;
    let (far, about) = ((offset_ms.abs() - doubt_ms).max(0), format!("{about}, clock"));
    let found = format!("{offset_ms:+} ms from this machine's, to {doubt_ms} ms");
    let help = "synchronise the clocks (chrony, systemd-timesyncd)";
    if far > LARGE_OFFSET_MS {
        findings.problem(about, found, help);
    } else if far > SLIGHT_OFFSET_MS {
        findings.warning(about, found, help);
    } else {
        findings.ok(about, found);
    }
}

fn workers(findings: &mut Findings, about: &str, host: &HostPools) {
    if host.draining {
        let help = format!("`ratn drain --undo {}` lets it take work again", host.host);
        findings.warning(about, "is drained: it starts no workers", help);
    }
    for pool in &host.pools {
        let about = format!("{about}, template {}", pool.template);
        if !pool.failure.is_empty() {
            let help = format!("`ratn logs {0}` says more; `ratn pool start {0}` tries again", pool.template);
            findings.problem(about, format!("FAILED: {}", pool.failure), help);
        } else if pool.crashes > 0 {
            let found = format!("{} workers crashed, the last one: {}", pool.crashes, pool.last_exit);
            findings.warning(about, found, format!("`ratn logs {}`", pool.template));
        } else {
            findings.ok(about, format!("{} workers, {} to {}", pool.workers.len(), pool.min, pool.max));
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;
    use crate::command::doctor::Level;

    #[test]
    fn a_clock_is_off_only_by_what_the_answer_s_time_does_not_explain() {
        let asked = OffsetDateTime::UNIX_EPOCH + Duration::from_secs(1_000);
        let level = |took_ms: u64, offset_us: i64| {
            let mut findings = Findings::default();
            let middle = 1_000_000_000 + took_ms * 500;
            let clock_us = u64::try_from(i64::try_from(middle).unwrap() + offset_us).unwrap();
            clock(&mut findings, "host a", asked, asked + Duration::from_millis(took_ms), clock_us);
            findings.0[0].level
        };
        assert_eq!(level(2, 10_000), Level::Ok);
        assert_eq!(level(2, -50_000), Level::Warning);
        assert_eq!(level(200, -50_000), Level::Ok, "the answer took longer than that");
        assert_eq!(level(2, 60_000_000), Level::Problem);
    }
}
