//! A panic in any part of a process that it is of no use without ends the process with an exit code of its own, and the process that is
//! started next serves again. The panics are asked for at the places of `ratn_panic_point`.

mod support;

use anyhow::{Context, ensure};
use nix::sys::signal::Signal;
use ratn_worker::vitals::{EXIT_CODE_FENCED, EXIT_CODE_PANICKED};
use std::path::{Path, PathBuf};
use support::{Place, Started, repository, texts, wait_for};

/// A process that is started again and again in one place.
struct Daemon<'a> {
    place: &'a Place,
    role: &'static str,
    arguments: Vec<String>,
    /// The process writes its endpoint to this file once it serves.
    endpoint: PathBuf,
    process: Started,
}

/// The folder of files that ask for panics of a role.
fn points(place: &Place, role: &str) -> PathBuf {
    place.path().join("panic-points").join(role)
}

fn start(place: &Place, role: &str, arguments: &[String], endpoint: &Path) -> anyhow::Result<Started> {
    let _ = std::fs::remove_file(endpoint);
    std::fs::create_dir_all(points(place, role))?;
    let folder = points(place, role).display().to_string();
    let arguments: Vec<&str> = arguments.iter().map(String::as_str).collect();
    let process = place.start_with(role, &arguments, &[(ratn_panic_point::VARIABLE, &folder)])?;
    wait_for("the endpoint", || Ok(endpoint.exists().then_some(()))).context(process.said())?;
    Ok(process)
}

impl Daemon<'_> {
    fn start<'a>(place: &'a Place, role: &'static str, config: &str) -> anyhow::Result<Daemon<'a>> {
        let file = place.path().join(format!("{role}.toml"));
        std::fs::write(&file, config)?;
        let arguments = vec![role.to_owned(), "--config".to_owned(), file.display().to_string()];
        Daemon::of(place, role, arguments, place.path().join(format!("run/{role}.endpoint")))
    }

    fn of<'a>(
        place: &'a Place,
        role: &'static str,
        arguments: Vec<String>,
        endpoint: PathBuf,
    ) -> anyhow::Result<Daemon<'a>> {
        let process = start(place, role, &arguments, &endpoint)?;
        Ok(Daemon { place, role, arguments, endpoint, process })
    }

    /// Panics at a place, which `reach` makes the process come to, and serves again when it is started again.
    fn panics_at(&mut self, point: &str, reach: impl FnOnce(&Place) -> anyhow::Result<()>) -> anyhow::Result<()> {
        let asked = points(self.place, self.role).join(point);
        std::fs::write(&asked, "")?;
        reach(self.place)?;
        let (code, _, said) = self.process.finish().context(format!("{} does not panic at {point}", self.role))?;
        ensure!(code == Some(i32::from(EXIT_CODE_PANICKED)), "{} at {point}: {code:?} {said}", self.role);
        ensure!(said.contains(&format!("a test asked for a panic at `{point}`")), "{point}: {said}");
        ensure!(said.contains("has ended by a defect"), "{point}: {said}");
        ensure!(!asked.exists());
        self.process = start(self.place, self.role, &self.arguments, &self.endpoint)?;
        Ok(())
    }

    fn stops(mut self) -> anyhow::Result<()> {
        self.process.signal(Signal::SIGTERM)?;
        let (code, _, said) = self.process.finish()?;
        ensure!(code == Some(0), "{}: {code:?} {said}", self.role);
        Ok(())
    }
}

#[allow(clippy::unnecessary_wraps, reason = "one of several ways to reach a place")]
fn by_itself(_: &Place) -> anyhow::Result<()> {
    Ok(())
}

fn ratn(place: &Place, arguments: &[&str]) -> anyhow::Result<String> {
    Ok(texts(&place.ratn(arguments).output()?).0)
}

/// A resource that stays in the log with 3,000 bytes.
fn create(place: &Place, id: &str) -> anyhow::Result<String> {
    let note = format!("note={}", "n".repeat(3_000));
    ratn(place, &["resource", "create", "Fixture", "--id", id, "--attribute", &note])
}

#[test]
#[cfg_attr(not(debug_assertions), ignore = "a release has no places to panic at")]
fn a_panic_of_the_resource_manager_or_of_its_log_ends_it() -> anyhow::Result<()> {
    let place = Place::new()?;
    let mut manager = Daemon::start(&place, "resource-manager", "[resource-manager.storage]\ncompact_bytes = 65536\n")?;
    manager.panics_at("durable-actor", by_itself)?;
    manager.panics_at("may-speak", by_itself)?;
    manager.panics_at("log-syncer", |place| create(place, "a").map(drop))?;
    manager.panics_at("log-compaction", |place| (0..40).try_for_each(|i| create(place, &format!("b{i}")).map(drop)))?;
    manager.stops()
}

#[test]
#[cfg_attr(not(debug_assertions), ignore = "a release has no places to panic at")]
fn a_panic_of_the_world_pool_or_of_its_link_ends_it() -> anyhow::Result<()> {
    let place = Place::new()?;
    let manager = Daemon::start(&place, "resource-manager", "")?;
    let mut pool = Daemon::start(&place, "world-pool", "")?;
    pool.panics_at("durable-actor", by_itself)?;
    pool.panics_at("may-speak", by_itself)?;
    pool.panics_at("link", by_itself)?;
    pool.panics_at("session", by_itself)?;
    pool.stops()?;
    manager.stops()
}

#[test]
#[cfg_attr(not(debug_assertions), ignore = "a release has no places to panic at")]
fn a_panic_of_the_process_manager_or_of_a_thread_that_tracks_workers_ends_it() -> anyhow::Result<()> {
    let place = Place::new()?;
    let manager = Daemon::start(&place, "resource-manager", "")?;
    let marked = place.path().join("a-worker").display().to_string();
    let config = format!(
        "[process-manager]\n[[process-manager.template]]\nname = 'shell'\nkind = 'Shell'\nprogram = '/bin/sh'\n\
         args = ['-c', 'echo I am here; exec cat', '{marked}']\n\
         readiness = {{ kind = 'line', contains = 'I am here' }}\nmax = 8\n"
    );
    let mut pools = Daemon::start(&place, "process-manager", &config)?;
    let is_ready =
        |place: &Place| wait_for("a worker", || Ok(ratn(place, &["ps"])?.contains("Shell  ready").then_some(())));
    let kill_a_worker = |place: &Place| {
        is_ready(place)?;
        let shown: serde_json::Value = serde_json::from_str(&ratn(place, &["ps", "--json"])?)?;
        let pid = shown["hosts"][0]["pools"][0]["workers"][0]["pid"].as_i64().context("a worker")?;
        ensure!(pid > 1, "{shown}");
        Ok(nix::sys::signal::kill(nix::unistd::Pid::from_raw(i32::try_from(pid)?), Signal::SIGKILL)?)
    };
    pools.panics_at("process-manager-actor", by_itself)?;
    pools.panics_at("link", by_itself)?;
    pools.panics_at("session", by_itself)?;
    pools.panics_at("reaper", by_itself)?;
    // The first worker is there: the next one is started on request.
    is_ready(&place)?;
    pools.panics_at("spawner", |place| ratn(place, &["pool", "start", "shell"]).map(drop))?;
    pools.panics_at("worker-watch", kill_a_worker)?;
    pools.panics_at("end-of-worker", kill_a_worker)?;
    is_ready(&place)?;
    pools.stops()?;
    manager.stops()
}

#[test]
#[cfg_attr(not(debug_assertions), ignore = "a release has no places to panic at")]
fn a_panic_of_the_cell_or_of_its_link_ends_it() -> anyhow::Result<()> {
    let place = Place::new()?;
    let manager = Daemon::start(&place, "resource-manager", "")?;
    let mut cell = Daemon::start(&place, "cell", "")?;
    cell.panics_at("cell-core", by_itself)?;
    cell.panics_at("link", by_itself)?;
    cell.panics_at("session", by_itself)?;
    cell.stops()?;
    manager.stops()
}

#[test]
#[cfg_attr(not(debug_assertions), ignore = "a release has no places to panic at")]
fn a_worker_whose_sdk_panics_ends_and_its_process_manager_starts_another_one() -> anyhow::Result<()> {
    let place = Place::new()?;
    let manager = Daemon::start(&place, "resource-manager", "")?;
    // One of two servers leads, as far as the worker knows.
    let socket = |name: &str| format!("unix:{}", place.path().join("run").join(name).display());
    let at = format!("{},{}", socket("resource-manager.sock"), socket("nobody.sock"));
    let endpoint = place.path().join("alone.endpoint");
    let file = endpoint.display().to_string();
    let arguments = ["worker", "path-planner", "--id", "alone", "--kind", "PathPlanner", "--endpoint-file", &file];
    let arguments = arguments.into_iter().chain(["--resource-manager", &at]).map(str::to_owned).collect();
    let mut alone = Daemon::of(&place, "worker", arguments, endpoint)?;
    alone.panics_at("session", by_itself)?;
    alone.panics_at("leader-watch", by_itself)?;
    alone.stops()?;

    let config = format!(
        "[process-manager]\nhost = 'here'\n[[process-manager.template]]\nname = 'planner'\nkind = 'PathPlanner'\n\
         args = ['worker', 'path-planner', '--id', '{{id}}', '--kind', '{{kind}}', '--endpoint-file', '{{endpoint_file}}', \
         '--exit-with-parent']\nenv = {{ {} = '{}' }}\n",
        ratn_panic_point::VARIABLE,
        points(&place, "worker").display()
    );
    let pools = Daemon::start(&place, "process-manager", &config)?;
    let is_ready = |id: &str| {
        wait_for(id, || Ok(ratn(&place, &["ps"])?.contains(&format!("{id}  PathPlanner  ready")).then_some(())))
    };
    is_ready("planner-1@here")?;
    std::fs::write(points(&place, "worker").join("lease-watch"), "")?;
    is_ready("planner-2@here")?;
    let shown = ratn(&place, &["ps"])?;
    ensure!(shown.contains("planner@here: 1 crashed, the last one: planner-1@here: exited with status 70"), "{shown}");
    pools.stops()?;
    manager.stops()
}

/// systemd starts a daemon again that has panicked, and leaves one alone whose state another process has.
#[test]
fn every_unit_comes_back_after_a_panic_and_not_when_another_process_has_its_state() -> anyhow::Result<()> {
    for role in ["resource-manager", "world-pool", "process-manager", "cell"] {
        let unit = std::fs::read_to_string(repository(&format!("deploy/systemd/ratn-{role}.service")))?;
        let value = |key: &str| unit.lines().find_map(|line| line.strip_prefix(key)?.strip_prefix('='));
        ensure!(value("Restart") == Some("on-failure"), "{role}");
        ensure!(value("RestartPreventExitStatus") == Some(&EXIT_CODE_FENCED.to_string()), "{role}");
        ensure!(value("SuccessExitStatus").is_none(), "{role}");
    }
    Ok(())
}
