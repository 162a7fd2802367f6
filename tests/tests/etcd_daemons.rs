//! A resource manager whose state is in etcd: a panic in a thread of its log, or of a standby, ends it, and it ends when it is told to while
//! etcd is away. Without etcd the tests say that they are skipped.

#[path = "../../crates/storage/tests/common/cluster.rs"]
#[allow(dead_code, clippy::unwrap_used, reason = "shared by tests, each of which uses some of it")]
mod cluster;
mod support;

use anyhow::{Context, ensure};
use cluster::{Cluster, Proxy};
use nix::sys::signal::Signal;
use ratn_worker::vitals::{EXIT_CODE_DEPOSED, EXIT_CODE_PANICKED};
use std::os::unix::net::UnixDatagram;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};
use support::{Place, Started, wait_for};

/// Pings for the watchdog that a process sends at the least while it closes its state for a second.
const PINGS: usize = 4;

/// The one that serves `ratn` in this place, or another one.
struct Manager<'a> {
    place: &'a Place,
    name: &'a str,
    process: Started,
}

fn runtime(place: &Place, name: &str) -> PathBuf {
    place.path().join(if name == "leader" { "run" } else { name })
}

fn points(place: &Place, name: &str) -> PathBuf {
    place.path().join(format!("{name}-points"))
}

impl Manager<'_> {
    /// On this member of etcd; `environment` is added to its own.
    fn start<'a>(
        place: &'a Place,
        name: &'a str,
        etcd: &str,
        environment: &[(&str, &str)],
    ) -> anyhow::Result<Manager<'a>> {
        std::fs::create_dir_all(points(place, name))?;
        let config = place.path().join(format!("{name}.toml"));
        let text = format!(
            "[service]\ndrain_ms = 1\n[resource-manager.storage]\nengine = \"etcd\"\nendpoints = [{etcd:?}]\nprefix = \"/ratn/test\"\n\
             compact_bytes = 65536\n"
        );
        std::fs::write(&config, text)?;
        let (runtime, points) = (runtime(place, name).display().to_string(), points(place, name).display().to_string());
        let own = [("RATN_RUNTIME_DIR", runtime.as_str()), (ratn_panic_point::VARIABLE, points.as_str())];
        let arguments = ["resource-manager", "--config", config.to_str().context("a path")?];
        let process = place.start_with(name, &arguments, &[&own, environment].concat())?;
        Ok(Manager { place, name, process })
    }

    fn serves(&self) -> anyhow::Result<()> {
        let endpoint = runtime(self.place, self.name).join("resource-manager.endpoint");
        wait_for("the endpoint", || Ok(endpoint.exists().then_some(()))).with_context(|| self.process.said())
    }

    fn panicked_at(mut self, point: &str) -> anyhow::Result<()> {
        let (code, _, said) = self.process.finish().with_context(|| format!("no panic at {point}"))?;
        ensure!(code == Some(i32::from(EXIT_CODE_PANICKED)), "{point}: {code:?} {said}");
        ensure!(said.contains(&format!("a test asked for a panic at `{point}`")), "{point}: {said}");
        let _ = std::fs::remove_file(runtime(self.place, self.name).join("resource-manager.endpoint"));
        Ok(())
    }
}

#[test]
#[cfg_attr(not(debug_assertions), ignore = "a release has no places to panic at")]
fn a_panic_in_a_thread_of_the_log_in_etcd_or_of_a_standby_ends_the_process() -> anyhow::Result<()> {
    if !cluster::is_there() {
        return Ok(());
    }
    let (place, cluster) = (Place::new()?, Cluster::start(1, &[]));
    let etcd = cluster.endpoints().remove(0);
    let ask = |name: &str, point: &str| std::fs::write(points(&place, name).join(point), "");
    let create = |id: &str| -> anyhow::Result<()> {
        let note = format!("note={}", "n".repeat(3_000));
        // It may be that nobody answers any more.
        place.ratn(&["resource", "create", "Fixture", "--id", id, "--attribute", &note]).output()?;
        Ok(())
    };
    for (point, changes) in [("etcd-client", 0), ("etcd-renewer", 0), ("etcd-writer", 1), ("etcd-compaction", 40)] {
        let leader = Manager::start(&place, "leader", &etcd, &[])?;
        leader.serves()?;
        ask("leader", point)?;
        (0..changes).try_for_each(|number| create(&format!("{point}-{number}")))?;
        leader.panicked_at(point)?;
    }
    std::fs::create_dir_all(points(&place, "opening"))?;
    ask("opening", "open-state")?;
    Manager::start(&place, "opening", &etcd, &[])?.panicked_at("open-state")?;
    let leader = Manager::start(&place, "leader", &etcd, &[])?;
    leader.serves()?;
    std::fs::create_dir_all(points(&place, "standby"))?;
    ask("standby", "standby")?;
    Manager::start(&place, "standby", &etcd, &[])?.panicked_at("standby")
}

#[test]
#[cfg_attr(not(debug_assertions), ignore = "a release has no places to hang at")]
fn a_leader_whose_core_hangs_is_got_past_and_ends_without_a_watchdog() -> anyhow::Result<()> {
    if !cluster::is_there() {
        return Ok(());
    }
    let (place, cluster) = (Place::new()?, Cluster::start(1, &[]));
    let etcd = cluster.endpoints().remove(0);
    let mut leader = Manager::start(&place, "leader", &etcd, &[])?;
    leader.serves()?;
    let standby = Manager::start(&place, "standby", &etcd, &[])?;
    let stands_by = || Ok(standby.process.said().contains("standing by").then_some(()));
    wait_for("the standby", stands_by).with_context(|| standby.process.said())?;
    // In one step: a file that says nothing yet asks for a panic.
    let point = points(&place, "leader").join("durable-actor");
    std::fs::write(point.with_extension("new"), ratn_panic_point::HANG)?;
    std::fs::rename(point.with_extension("new"), point)?;
    standby.serves()?;
    let (code, _, said) = leader.process.finish()?;
    ensure!(code == Some(i32::from(EXIT_CODE_DEPOSED)), "{code:?} {said}");
    ensure!(said.contains("it does not keep its place"), "{said}");
    Ok(())
}

/// What a process says to its service manager.
struct Notified(Arc<Mutex<Vec<String>>>);

impl Notified {
    fn at(path: &Path) -> anyhow::Result<Notified> {
        let socket = UnixDatagram::bind(path)?;
        let heard = Arc::new(Mutex::new(Vec::new()));
        let hears = heard.clone();
        std::thread::spawn(move || {
            let mut buffer = [0; 4096];
            while let Ok(length) = socket.recv(&mut buffer) {
                let message = String::from_utf8_lossy(&buffer[..length]).into_owned();
                hears.lock().unwrap_or_else(PoisonError::into_inner).push(message);
            }
        });
        Ok(Notified(heard))
    }

    fn all(&self) -> Vec<String> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    fn hear(&self, wanted: &str) -> anyhow::Result<()> {
        wait_for(wanted, || Ok(self.all().iter().any(|message| message.contains(wanted)).then_some(())))
    }
}

#[test]
fn a_leader_and_a_standby_end_when_they_are_told_to_while_etcd_is_away_and_the_watchdog_hears_the_leader_meanwhile()
-> anyhow::Result<()> {
    if !cluster::is_there() {
        return Ok(());
    }
    let (place, cluster) = (Place::new()?, Cluster::start(1, &[]));
    let etcd = cluster.endpoints().remove(0);
    let mut proxies = Vec::new();
    let mut managers = Vec::new();
    for name in ["leader", "standby"] {
        let proxy = Proxy::to(&etcd);
        let notify = place.path().join(format!("{name}.notify"));
        let notified = Notified::at(&notify)?;
        let notify = notify.display().to_string();
        let environment = [("NOTIFY_SOCKET", notify.as_str()), ("WATCHDOG_USEC", "20000")];
        let manager = Manager::start(&place, name, &proxy.address, &environment)?;
        let status = if name == "leader" { "STATUS=serving" } else { "STATUS=standing by" };
        notified.hear(status).with_context(|| manager.process.said())?;
        proxies.push(proxy);
        managers.push((manager, notified));
    }
    proxies.iter().for_each(|proxy| proxy.lose_all(true));
    let (leader, _) = &managers[0];
    let silent = || Ok(leader.process.said().contains("nothing is said until it can").then_some(()));
    wait_for("the leader's silence", silent).with_context(|| leader.process.said())?;
    // It waits for etcd, with the daemon.
    let mut creating = place.ratn(&["resource", "create", "Fixture", "--id", "late"]).spawn()?;
    for (manager, _) in &managers {
        manager.process.signal(Signal::SIGTERM)?;
    }
    for (manager, notified) in &mut managers {
        let (code, _, said) = manager.process.finish()?;
        // By itself, or at its deadline; in any case no signal was needed.
        ensure!(matches!(code, Some(0 | 3 | 75)), "{}: {code:?} {said}", manager.name);
        let heard = notified.all();
        let stopping = heard.iter().position(|message| message.contains("STOPPING=1"));
        let pings = heard[stopping.unwrap_or(heard.len())..].iter().filter(|message| message.contains("WATCHDOG=1"));
        let pings = pings.count();
        ensure!(manager.name != "leader" || pings >= PINGS, "{pings} pings while it ended: {heard:?} {said}");
    }
    creating.kill()?;
    creating.wait()?;
    Ok(())
}
