//! Two resource managers on one etcd, under many clients that know both: whatever becomes of the leader, nothing that was acknowledged is
//! lost, nothing is granted twice, and grants go on soon.
//!
//! `RATN_FAILOVERS` says how many (7, one of each kind), `RATN_SEED` which and when; `scripts/soak-failover` does a thousand. Without etcd
//! it says that it is skipped.

#[path = "../../crates/storage/tests/common/cluster.rs"]
#[allow(dead_code, clippy::unwrap_used, reason = "shared by tests, each of which uses some of it")]
mod cluster;
mod support;

use anyhow::{Context, bail, ensure};
use cluster::{Cluster, Proxy};
use nix::sys::signal::Signal;
use ratn_worker::client::wait_until_serving;
use ratn_worker::endpoint::Endpoint;
use ratn_worker::tls::ClientTls;
use std::time::{Duration, Instant};
use support::crashes::{AGAIN, PATIENCE, Random, number};
use support::tool_clients::{CLIENTS, Crowd, told};
use support::{Place, Started};

/// What a leader that was got past ends with: `ratn_worker::vitals::EXIT_CODE_DEPOSED`.
const DEPOSED: i32 = 75;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Fault {
    Kill,
    Terminate,
    /// For longer than its place is kept.
    Suspend,
    CutFromEtcd,
    /// What it asks of etcd arrives, the answers do not.
    LoseAnswersOfEtcd,
    CutFromClients,
    KillMemberOfEtcd,
}

const FAULTS: [Fault; 7] = [
    Fault::Kill,
    Fault::Terminate,
    Fault::Suspend,
    Fault::CutFromEtcd,
    Fault::LoseAnswersOfEtcd,
    Fault::CutFromClients,
    Fault::KillMemberOfEtcd,
];

struct Manager {
    name: String,
    config: String,
    process: Option<Started>,
    /// Between it and each member of etcd.
    to_etcd: Vec<Proxy>,
    /// Between clients and it.
    from_clients: Proxy,
    itself: Endpoint,
}

struct Pair {
    place: Place,
    cluster: Cluster,
    managers: Vec<Manager>,
}

impl Pair {
    fn start() -> anyhow::Result<Pair> {
        let place = Place::new()?;
        let cluster = Cluster::start(3, &[]);
        let mut managers = Vec::new();
        for number in 0..2 {
            let name = format!("manager-{number}");
            let port = std::net::TcpListener::bind("127.0.0.1:0")?.local_addr()?.port();
            let itself = format!("http://127.0.0.1:{port}");
            let to_etcd: Vec<Proxy> = cluster.endpoints().iter().map(|member| Proxy::to(member)).collect();
            let members: Vec<String> = to_etcd.iter().map(|proxy| format!("{:?}", proxy.address)).collect();
            let config = place.path().join(format!("{name}.toml"));
            let text = format!(
                "[service.access]\nanonymous = [\"operator\"]\n[resource-manager]\nlisten = {itself:?}\n[resource-manager.storage]\nengine = \"etcd\"\n\
                 endpoints = [{}]\nprefix = \"/ratn/test\"\n",
                members.join(", ")
            );
            std::fs::write(&config, text)?;
            let config = config.to_str().context("a path")?.to_owned();
            let from_clients = Proxy::to(&itself);
            managers.push(Manager { name, config, process: None, to_etcd, from_clients, itself: itself.parse()? });
        }
        let mut pair = Pair { place, cluster, managers };
        pair.run(0)?;
        pair.run(1)?;
        Ok(pair)
    }

    fn run(&mut self, number: usize) -> anyhow::Result<()> {
        let Manager { name, config, .. } = &self.managers[number];
        let runtime = self.place.path().join(format!("{name}.run"));
        let environment = [("RATN_RUNTIME_DIR", runtime.to_str().context("a path")?), ("RATN_LOG", "info")];
        let started = self.place.start_with(name, &["resource-manager", "--config", config], &environment)?;
        self.managers[number].process = Some(started);
        Ok(())
    }

    /// As clients are told it.
    fn endpoint(&self) -> anyhow::Result<Endpoint> {
        let addresses: Vec<&str> = self.managers.iter().map(|manager| manager.from_clients.address.as_str()).collect();
        Ok(addresses.join(",").parse()?)
    }

    async fn leader(&mut self) -> anyhow::Result<usize> {
        let begin = Instant::now();
        while begin.elapsed() < PATIENCE {
            self.revive(0)?;
            self.revive(1)?;
            for (number, manager) in self.managers.iter().enumerate() {
                if wait_until_serving(&manager.itself, &ClientTls::none(), Duration::from_millis(300)).await.is_ok() {
                    return Ok(number);
                }
            }
        }
        bail!("nobody leads: {}", self.said())
    }

    fn signal(&mut self, number: usize, signal: Signal) -> anyhow::Result<()> {
        self.managers[number].process.as_mut().context("it runs")?.signal(signal)
    }

    /// Waits until its process has ended, and starts it again as a service manager does.
    async fn await_end(&mut self, number: usize, code: Option<i32>) -> anyhow::Result<()> {
        let begin = Instant::now();
        let mut process = self.managers[number].process.take().context("it runs")?;
        let status = loop {
            if let Some(status) = process.child.try_wait()? {
                break status;
            }
            ensure!(begin.elapsed() < PATIENCE, "{number} does not end: {}", process.said());
            tokio::time::sleep(AGAIN).await;
        };
        ensure!(code.is_none_or(|code| status.code() == Some(code)), "it ended with {status}: {}", process.said());
        self.run(number)
    }

    /// Starts it again where it was got past, and has ended for that.
    fn revive(&mut self, number: usize) -> anyhow::Result<()> {
        let process = self.managers[number].process.as_mut().context("it was started")?;
        let Some(status) = process.child.try_wait()? else { return Ok(()) };
        ensure!(status.code() == Some(DEPOSED), "it ended with {status}: {}", process.said());
        self.run(number)
    }

    fn said(&self) -> String {
        let said = self.managers.iter().map(|manager| manager.process.as_ref().map(Started::said).unwrap_or_default());
        said.collect::<Vec<_>>().join("\n--\n")
    }

    /// Does it to the leader, waits until somebody leads, and mends it.
    async fn suffer(&mut self, fault: Fault, random: &mut Random) -> anyhow::Result<()> {
        let leader = self.leader().await?;
        match fault {
            Fault::Kill => {
                self.signal(leader, Signal::SIGKILL)?;
                self.await_other(leader).await?;
                self.await_end(leader, None).await
            }
            Fault::Terminate => {
                self.signal(leader, Signal::SIGTERM)?;
                self.await_other(leader).await?;
                self.await_end(leader, Some(0)).await
            }
            Fault::Suspend => {
                self.signal(leader, Signal::SIGSTOP)?;
                self.await_other(leader).await?;
                tokio::time::sleep(Duration::from_millis(random.below(1_000))).await;
                self.signal(leader, Signal::SIGCONT)?;
                self.await_end(leader, Some(DEPOSED)).await
            }
            Fault::CutFromEtcd => {
                self.managers[leader].to_etcd.iter().for_each(|proxy| proxy.lose_all(true));
                self.await_other(leader).await?;
                self.managers[leader].to_etcd.iter().for_each(|proxy| proxy.lose_all(false));
                self.await_end(leader, Some(DEPOSED)).await
            }
            Fault::LoseAnswersOfEtcd => {
                // It says nothing as long as nothing is confirmed, and keeps its place no longer than that: then the other one leads.
                self.managers[leader].to_etcd.iter().for_each(|proxy| proxy.lose_answers(true));
                tokio::time::sleep(Duration::from_millis(200 + random.below(1_500))).await;
                self.managers[leader].to_etcd.iter().for_each(|proxy| proxy.lose_answers(false));
                self.leader().await.map(drop)
            }
            Fault::CutFromClients => {
                self.managers[leader].from_clients.lose_all(true);
                tokio::time::sleep(Duration::from_millis(200 + random.below(1_500))).await;
                self.managers[leader].from_clients.lose_all(false);
                Ok(())
            }
            Fault::KillMemberOfEtcd => {
                let member = random.below(3) as usize;
                self.cluster.kill(member);
                tokio::time::sleep(Duration::from_millis(random.below(1_500))).await;
                self.cluster.run(member);
                self.cluster.await_health();
                self.leader().await.map(drop)
            }
        }
    }

    async fn await_other(&mut self, than: usize) -> anyhow::Result<()> {
        let (begin, other) = (Instant::now(), 1 - than);
        loop {
            self.revive(other)?;
            match wait_until_serving(&self.managers[other].itself, &ClientTls::none(), Duration::from_millis(300)).await
            {
                Err(error) if begin.elapsed() >= PATIENCE => return Err(error).with_context(|| self.said()),
                Err(_) => {}
                Ok(()) => return Ok(()),
            }
        }
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn whatever_becomes_of_the_leader_nothing_acknowledged_is_lost_and_nothing_is_granted_twice() -> anyhow::Result<()>
{
    if !cluster::is_there() {
        return Ok(());
    }
    let (failovers, seed) = (number("RATN_FAILOVERS", FAULTS.len() as u64), number("RATN_SEED", 1));
    println!("{failovers} failovers, RATN_SEED={seed}");
    let mut random = Random(seed | 1);
    let mut pair = Pair::start()?;
    pair.leader().await?;
    let mut crowd = Crowd::begin(&pair.endpoint()?, seed).await?;
    crowd.await_grants(CLIENTS).await?;
    let mut gaps: Vec<(Fault, Duration)> = Vec::new();
    for failover in 0..failovers {
        let fault = match failovers == FAULTS.len() as u64 {
            true => FAULTS[failover as usize],
            false => FAULTS[random.below(FAULTS.len() as u64) as usize],
        };
        tokio::time::sleep(Duration::from_millis(random.below(300))).await;
        told(&crowd.shared, |told| told.longest_gap = Duration::ZERO);
        let context = |pair: &Pair| format!("failover {failover}, {fault:?}: {}", pair.said());
        pair.suffer(fault, &mut random).await.with_context(|| context(&pair))?;
        crowd.await_grants(CLIENTS).await.with_context(|| context(&pair))?;
        crowd.verify().await.with_context(|| context(&pair))?;
        let gap = told(&crowd.shared, |told| told.longest_gap);
        // One by one: of a soak that is stopped nothing is lost.
        println!("failover {failover}: {fault:?}, {} ms without a grant", gap.as_millis());
        gaps.push((fault, gap));
    }
    let shared = crowd.end().await?;
    let grants = told(&shared, |told| told.grants);
    println!("{grants} grants");
    for fault in FAULTS {
        let mut of_fault: Vec<u128> = gaps.iter().filter(|gap| gap.0 == fault).map(|gap| gap.1.as_millis()).collect();
        of_fault.sort_unstable();
        if let (Some(median), Some(most)) = (of_fault.get(of_fault.len() / 2), of_fault.last()) {
            println!("{fault:?}: {} times; without a grant for {median} ms (median), {most} ms (most)", of_fault.len());
        }
    }
    Ok(())
}
