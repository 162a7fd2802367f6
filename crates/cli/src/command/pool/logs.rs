//! `ratn logs`: the output of a worker on any host; for a template the output of all its workers, each line with its worker's id.
//!
//! Where no process manager answers, the files of this host are read: the logs of workers, and of the roles that `ratn up` started.

use super::LogsArguments;
use super::hosts::{self, Host};
use crate::failure::Failure;
use crate::system::directory_of;
use anyhow::Context;
use ratn_daemon::process_manager::log_file::{LogReader, log_file};
use ratn_proto::types::HostPools;
use ratn_worker::client::{CallError, ProcessClient};
use ratn_worker::runtime_directory::RuntimeDirectory;
use ratn_worker::tls::ClientTls;
use std::collections::BTreeSet;
use std::io::{self, Write};
use std::path::PathBuf;
use std::time::Duration;
use tokio::sync::mpsc;
use tokio::task::JoinSet;

/// Interval at which a followed log is read, and a template is checked for new workers.
const LOOK_INTERVAL: Duration = Duration::from_millis(200);
/// Capacity for pieces of several logs that wait to be written.
const PIECES: usize = 64;
/// A longer line is written in parts.
const MAX_LINE_BYTES: usize = 65_536;

/// Prints the log of a worker, or of all workers of a template.
pub(super) async fn print(arguments: &LogsArguments, tls: &ClientTls) -> Result<(), Failure> {
    let name = arguments.name.as_str();
    let found = match hosts::find(&arguments.host, tls).await {
        Ok(found) => hosts::ask_all(found).await,
        Err(refused) => return local(arguments)?.ok_or(refused),
    };
    let chosen = |host: &str| arguments.host.host.as_deref().is_none_or(|wanted| wanted == host);
    let problems: Vec<String> = found.iter().filter_map(hosts::Answered::problem).collect();
    let answered = found.into_iter().filter_map(|one| Some((one.host, one.pools.ok()?)));
    let answered: Vec<(Host, HostPools)> = answered.filter(|(_, pools)| chosen(&pools.host)).collect();
    let has = |pools: &HostPools| pools.pools.iter().any(|pool| pool.template == name);
    if answered.iter().any(|(_, pools)| has(pools)) {
        let clients = answered.into_iter().filter(|(_, pools)| has(pools)).map(|(host, _)| host.client).collect();
        return of_template(clients, name, arguments.follow).await;
    }
    for (host, pools) in &answered {
        if name.ends_with(&format!("@{}", pools.host)) {
            match host.client.log(name, arguments.follow).await {
                Err(error) if error.code() == Some(tonic::Code::NotFound) => {}
                pieces => return of_worker(pieces?).await,
            }
        }
    }
    let silent: String = problems.iter().map(|problem| format!("; {problem}")).collect();
    local(arguments)?.ok_or_else(|| {
        let message = format!(
            "ratn: there is no log of a worker or template `{name}`: `ratn ps` lists those that run; the logs of the last that ended \
             are kept{silent}"
        );
        Failure::Refused(message)
    })
}

async fn of_worker(mut pieces: ratn_worker::client::LogPieces) -> Result<(), Failure> {
    while let Some(chunk) = pieces.next().await? {
        if !written(&chunk)? {
            break;
        }
    }
    Ok(())
}

/// Prints the logs of existing workers, and with `follow` those of later ones.
async fn of_template(clients: Vec<ProcessClient>, template: &str, follow: bool) -> Result<(), Failure> {
    let (lines, mut received) = mpsc::channel(PIECES);
    let mut reading = JoinSet::new();
    for client in clients {
        reading.spawn(read_template(client, template.to_owned(), follow, lines.clone()));
    }
    drop(lines);
    while let Some(line) = received.recv().await {
        if !written(&line)? {
            return Ok(());
        }
    }
    while let Some(read) = reading.join_next().await {
        read.context("a log was not read to its end")??;
    }
    Ok(())
}

async fn read_template(
    client: ProcessClient,
    template: String,
    follow: bool,
    lines: mpsc::Sender<Vec<u8>>,
) -> Result<(), CallError> {
    let mut known = BTreeSet::new();
    let mut reading: JoinSet<Result<(), CallError>> = JoinSet::new();
    loop {
        let pools = client.pools().await?.pools;
        let workers = pools.into_iter().filter(|pool| pool.template == template).flat_map(|pool| pool.workers);
        // A worker without a process has no log yet.
        for worker in workers.filter(|worker| worker.pid != 0 && known.insert(worker.id.clone())) {
            let (client, lines) = (client.clone(), lines.clone());
            reading.spawn(async move { read_worker(&client, &worker.id, follow, &lines).await });
        }
        if !follow {
            while let Some(Ok(read)) = reading.join_next().await {
                read?;
            }
            return Ok(());
        }
        tokio::select! {
            () = tokio::time::sleep(LOOK_INTERVAL) => {}
            () = lines.closed() => return Ok(()),
        }
    }
}

/// Reads line by line, each with the worker's id.
async fn read_worker(
    client: &ProcessClient,
    id: &str,
    follow: bool,
    lines: &mpsc::Sender<Vec<u8>>,
) -> Result<(), CallError> {
    let mut pieces = client.log(id, follow).await?;
    let mut line = Vec::new();
    loop {
        let chunk = pieces.next().await?;
        let over = chunk.is_none();
        line.extend(chunk.unwrap_or_default());
        let whole = line.iter().rposition(|byte| *byte == b'\n').map_or(0, |at| at + 1);
        let whole = if over || line.len() - whole > MAX_LINE_BYTES { line.len() } else { whole };
        let rest = line.split_off(whole);
        let named = named_lines(id, &line);
        line = rest;
        if (!named.is_empty() && lines.send(named).await.is_err()) || over {
            return Ok(());
        }
    }
}

fn named_lines(id: &str, text: &[u8]) -> Vec<u8> {
    let mut named = Vec::with_capacity(text.len());
    for line in text.split_inclusive(|byte| *byte == b'\n') {
        named.extend_from_slice(id.as_bytes());
        named.extend_from_slice(b": ");
        named.extend_from_slice(line);
        if !line.ends_with(b"\n") {
            named.push(b'\n');
        }
    }
    named
}

/// Prints from the files of this host; `None` where there is no log.
fn local(arguments: &LogsArguments) -> anyhow::Result<Option<()>> {
    let directory = RuntimeDirectory::at(directory_of(arguments.host.runtime_dir.as_deref()));
    let name = arguments.name.as_str();
    if name.is_empty() || name.contains('/') {
        return Ok(None);
    }
    let of_role = directory.path().join(format!("{name}.log"));
    let file = [log_file(&directory, name), of_role].into_iter().find(|file| file.is_file());
    file.map(|file| print_file(file, arguments.follow)).transpose()
}

fn print_file(file: PathBuf, follow: bool) -> anyhow::Result<()> {
    let cannot = || format!("cannot read {}", file.display());
    let mut reader = LogReader::open(&file).with_context(cannot)?;
    loop {
        let more = reader.read().with_context(cannot)?;
        if !written(&more)? || (more.is_empty() && !follow) {
            return Ok(());
        }
        if more.is_empty() {
            std::thread::sleep(LOOK_INTERVAL);
        }
    }
}

/// Writes bytes; returns false once nobody reads them any more.
fn written(bytes: &[u8]) -> anyhow::Result<bool> {
    let mut out = io::stdout().lock();
    match out.write_all(bytes).and_then(|()| out.flush()) {
        Err(error) if error.kind() == io::ErrorKind::BrokenPipe => Ok(false),
        other => other.map(|()| true).context("cannot write the log to standard output"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_line_says_whose_it_is() {
        assert_eq!(named_lines("a-1@here", b"one\ntwo"), b"a-1@here: one\na-1@here: two\n");
        assert_eq!(named_lines("a-1@here", b""), b"");
    }
}
