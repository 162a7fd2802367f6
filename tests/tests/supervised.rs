//! A daemon under a service manager: what it tells it, and what SIGHUP changes.

mod support;

use anyhow::{Context, ensure};
use nix::sys::signal::Signal;
use std::os::unix::net::UnixDatagram;
use std::path::PathBuf;
use std::time::Duration;
use support::{Place, Started, texts, wait_for};

const PATIENCE: Duration = Duration::from_secs(60);

const ROLES: [&str; 4] = ["resource-manager", "world-pool", "process-manager", "cell"];

/// A daemon and the service manager that it believes in.
struct Supervised {
    place: Place,
    process: Started,
    socket: UnixDatagram,
    config: PathBuf,
}

impl Supervised {
    fn start(role: &str, config_text: &str) -> anyhow::Result<Supervised> {
        let place = Place::new()?;
        let (notify, config) = (place.path().join("notify.sock"), place.path().join("ratn.toml"));
        let socket = UnixDatagram::bind(&notify)?;
        socket.set_read_timeout(Some(PATIENCE))?;
        std::fs::write(&config, config_text)?;
        let arguments = [role, "--config", config.to_str().context("a path")?];
        let notify = notify.to_str().context("a path")?.to_owned();
        let environment = [("NOTIFY_SOCKET", notify.as_str()), ("WATCHDOG_USEC", "200000")];
        let process = place.start_with("daemon", &arguments, &environment)?;
        let this = Supervised { place, process, socket, config };
        this.hear("READY=1").with_context(|| this.process.said())?;
        Ok(this)
    }

    /// The next message with this in it; what comes before it.
    fn hear(&self, wanted: &str) -> anyhow::Result<Vec<String>> {
        let mut before = Vec::new();
        loop {
            let mut buffer = [0; 4096];
            let length = self.socket.recv(&mut buffer).with_context(|| format!("no {wanted}, but {before:?}"))?;
            let message = String::from_utf8_lossy(&buffer[..length]).into_owned();
            before.push(message);
            if before.last().is_some_and(|message| message.lines().any(|line| line.starts_with(wanted))) {
                return Ok(before);
            }
        }
    }

    fn reload(&self, config_text: &str) -> anyhow::Result<()> {
        std::fs::write(&self.config, config_text)?;
        self.process.signal(Signal::SIGHUP)?;
        let reloading = self.hear("RELOADING=1")?;
        ensure!(reloading.last().is_some_and(|last| last.contains("MONOTONIC_USEC=")), "{reloading:?}");
        self.hear("READY=1")?;
        Ok(())
    }

    fn create(&self, id: &str) -> anyhow::Result<(Option<i32>, String)> {
        let output = self.place.ratn(&["resource", "create", "Fixture", "--id", id]).output()?;
        Ok((output.status.code(), texts(&output).1))
    }
}

#[test]
fn a_service_manager_hears_that_a_daemon_serves_lives_reloads_and_stops() -> anyhow::Result<()> {
    for role in ROLES {
        // Without workers: the process manager has nobody to wait for.
        let mut daemon = Supervised::start(role, "[process-manager]\ntemplate = []\n")?;
        daemon.hear("WATCHDOG=1")?;
        daemon.hear("WATCHDOG=1")?;
        daemon.reload("[process-manager]\ntemplate = []\n[service.log]\nfilter = 'info'\n")?;
        daemon.process.signal(Signal::SIGTERM)?;
        let last = daemon.hear("STOPPING=1")?;
        ensure!(!last.iter().any(|message| message.contains("READY")), "{role}: {last:?}");
        let (code, _, said) = daemon.process.finish()?;
        ensure!(code == Some(0) && said.contains("read again and taken over"), "{role}: {code:?} {said}");
    }
    Ok(())
}

#[test]
fn a_reload_takes_over_bounds_roles_and_the_log_filter_and_names_what_it_does_not() -> anyhow::Result<()> {
    let manager = Supervised::start(
        "resource-manager",
        "[service.log]\nfilter = 'warn'\n[resource-manager.limits]\nresources = 1\n",
    )?;
    ensure!(manager.create("f1")?.0 == Some(0));
    let (code, refused) = manager.create("f2")?;
    ensure!(
        code == Some(1) && refused.contains("resources of all callers: the limit of 1 is reached (limits.resources)"),
        "{code:?} {refused}"
    );

    // Taken over; and what is not is named, with no word about the sections of others.
    manager.reload(
        "[service]\ndrain_ms = 700\n[service.log]\nfilter = 'info'\n[resource-manager]\nlisten = 'unix:/elsewhere'\n\
         [resource-manager.limits]\nresources = 2\n[cell]\nboxes = 2\n",
    )?;
    ensure!(manager.create("f2")?.0 == Some(0));
    let said = manager.process.said();
    ensure!(said.contains("need_a_restart=\"resource-manager.listen, service.drain_ms\""), "{said}");

    // Where spans go is known at the start of a process: each key of it is named, and no key for the collector is told.
    manager.reload(
        "[service.otlp]\nendpoint = 'http://127.0.0.1:4318'\nheaders = { x-api-key = 'hidden' }\n[service.log]\nfilter = 'info'\n\
         [resource-manager.limits]\nresources = 2\n",
    )?;
    let named = "need_a_restart=\"service.otlp.endpoint, service.otlp.headers.x-api-key\"";
    let said =
        wait_for("the keys of the collector", || Ok(Some(manager.process.said()).filter(|said| said.contains(named))))?;
    ensure!(!said.contains("hidden"), "{said}");

    // A bad one changes nothing, and says where it is bad.
    manager.reload("[resource-manager.limits]\nresources = 3\nresource = 7\n")?;
    wait_for("the complaint", || Ok(manager.process.said().contains("the config stays as it was").then_some(())))?;
    let said = manager.process.said();
    ensure!(said.contains("line 3") && said.contains("resource"), "{said}");
    ensure!(manager.create("f3")?.0 == Some(1));

    // Who may do what, from the next call on: this user is no longer an operator.
    let uid = nix::unistd::geteuid();
    manager.reload(&format!("[[service.access.user]]\nuid = {uid}\nroles = ['viewer']\n"))?;
    let (code, refused) = manager.create("f3")?;
    ensure!(code == Some(1) && refused.contains("may not"), "{code:?} {refused}");
    Ok(())
}

#[test]
fn certificates_are_read_again_at_a_reload_and_a_bad_one_changes_nothing() -> anyhow::Result<()> {
    let place = Place::new()?;
    let (used, first, second) = (place.path().join("used"), place.path().join("first"), place.path().join("second"));
    std::fs::create_dir(&used)?;
    for made in [&first, &second] {
        // Each with an authority of its own.
        let made = made.to_str().context("a path")?;
        ensure!(place.ratn(&["certs", made, "localhost"]).output()?.status.success());
    }
    let put = |made: &PathBuf| -> anyhow::Result<()> {
        for name in ["ca.pem", "localhost.pem", "localhost.key"] {
            std::fs::copy(made.join(name), used.join(name))?;
        }
        Ok(())
    };
    put(&first)?;
    let file = |name: &str| used.join(name).display().to_string();
    let config = format!(
        "[service.tls]\ncert = '{}'\nkey = '{}'\nclient_ca = '{}'\n[resource-manager]\nlisten = 'localhost:0'\n",
        file("localhost.pem"),
        file("localhost.key"),
        file("ca.pem")
    );
    let manager = Supervised::start("resource-manager", &config)?;
    let is_served = |made: &PathBuf| -> anyhow::Result<bool> {
        let mut list = manager.place.ratn(&["resource", "list"]);
        list.env("RATN_TLS_CA", made.join("ca.pem"));
        list.env("RATN_TLS_CERT", made.join("localhost.pem")).env("RATN_TLS_KEY", made.join("localhost.key"));
        Ok(list.output()?.status.success())
    };
    ensure!(is_served(&first)? && !is_served(&second)?, "{}", manager.process.said());

    std::fs::write(used.join("localhost.pem"), "no certificate")?;
    manager.reload(&config)?;
    wait_for("the complaint", || Ok(manager.process.said().contains("the config stays as it was").then_some(())))?;
    let said = manager.process.said();
    ensure!(said.contains(&format!("cannot read the TLS file {}", file("localhost.pem"))), "{said}");
    ensure!(is_served(&first)? && !is_served(&second)?, "{said}");

    put(&second)?;
    manager.reload(&config)?;
    ensure!(is_served(&second)? && !is_served(&first)?, "{}", manager.process.said());
    Ok(())
}
