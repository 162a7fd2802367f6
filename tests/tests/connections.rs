//! The connections of a daemon: operators have their share, silent clients and handshakes shut nobody out, idle connections are closed.

mod support;

use anyhow::{Context, ensure};
use ratn_worker::client::{Channels, ResourceClient};
use ratn_worker::endpoint::Endpoint;
use ratn_worker::runtime_directory::RuntimeDirectory;
use ratn_worker::tls::ClientTls;
use std::io::Read;
use std::net::TcpStream;
use std::process::{Command, Output};
use std::time::{Duration, Instant};
use support::{Place, Started, texts, wait_for};
use tokio::sync::mpsc;

/// The certificates that callers show.
const CALLERS: [&str; 4] = ["ann", "bob", "cleo", "root"];

/// A manager with TLS and little room: 8 connections, of which 2 are operators', and 3 of one caller.
struct Manager {
    place: Place,
    running: Started,
    port: u16,
}

impl Manager {
    fn start() -> anyhow::Result<Manager> {
        let place = Place::new()?;
        let tls = place.path().join("tls");
        let made = place.ratn(&["certs", tls.to_str().context("a path")?, "localhost"]).args(CALLERS).output()?;
        ensure!(made.status.success(), "{}", texts(&made).1);
        let roles = |name: &str| if name == "root" { "operator" } else { "task" };
        let access = CALLERS
            .map(|name| format!("[[service.access.certificate]]\nhost = '{name}'\nroles = ['{}']\n", roles(name)));
        let config = format!(
            "[resource-manager]\nlisten = 'localhost:0'\n[service.tls]\ncert = '{0}/localhost.pem'\nkey = '{0}/localhost.key'\n\
             client_ca = '{0}/ca.pem'\n[service.quotas]\nconnections = 8\nconnections_for_operators = 2\nconnections_in_use = 3\n\
             first_call_ms = 1500\n{1}",
            tls.display(),
            access.concat()
        );
        let file = place.path().join("ratn.toml");
        std::fs::write(&file, config)?;
        let running = place.start_as("manager", &["resource-manager", "--config", file.to_str().context("a path")?])?;
        let directory = RuntimeDirectory::at(place.path().join("run"));
        let endpoint =
            wait_for("the manager", || Ok(directory.find("resource-manager").ok())).with_context(|| running.said())?;
        let Endpoint::Tls { port, .. } = endpoint else { anyhow::bail!("{endpoint} has no TLS") };
        Ok(Manager { place, running, port })
    }

    fn show(&self, caller: &str, command: &mut Command) {
        let tls = self.place.path().join("tls");
        command.env("RATN_TLS_CA", tls.join("ca.pem"));
        command.env("RATN_TLS_CERT", tls.join(format!("{caller}.pem")));
        command.env("RATN_TLS_KEY", tls.join(format!("{caller}.key")));
    }

    fn list(&self, caller: &str) -> anyhow::Result<Output> {
        let mut command = self.place.ratn(&["resource", "list"]);
        self.show(caller, &mut command);
        Ok(command.output()?)
    }

    fn is_served(&self, caller: &str) -> anyhow::Result<()> {
        let output = self.list(caller)?;
        ensure!(output.status.success(), "{caller}: {}\n{}", texts(&output).1, self.running.said());
        Ok(())
    }

    fn is_refused(&self, caller: &str, why: &str) -> anyhow::Result<()> {
        let output = self.list(caller)?;
        let (_, said) = texts(&output);
        ensure!(!output.status.success() && said.contains(why), "{caller}: {:?}, {said}", output.status);
        Ok(())
    }

    /// A client that keeps a connection in use: it waits for what is not there yet.
    fn wait_as(&self, caller: &str, name: &str) -> anyhow::Result<Started> {
        let tls = self.place.path().join("tls");
        let file = |end: &str| tls.join(end).display().to_string();
        let (ca, cert, key) = (file("ca.pem"), file(&format!("{caller}.pem")), file(&format!("{caller}.key")));
        let environment =
            [("RATN_TLS_CA", &*ca), ("RATN_TLS_CERT", &*cert), ("RATN_TLS_KEY", &*key), ("RATN_LOG", "warn")];
        let waits = ["resource", "block", "Fixture", "--wait", "120"];
        let started = self.place.start_with(&format!("{caller}{name}"), &waits, &environment)?;
        Ok(started)
    }

    fn waiters(&self) -> anyhow::Result<usize> {
        let mut command = self.place.ratn(&["resource", "sessions"]);
        self.show("root", &mut command);
        let (out, err) = texts(&command.output()?);
        ensure!(err.is_empty(), "{err}");
        Ok(out.lines().filter(|line| line.contains("(certificate)")).count())
    }
}

#[test]
fn two_callers_with_all_the_connections_they_may_have_leave_the_operators_theirs_and_silent_handshakes_are_closed()
-> anyhow::Result<()> {
    let manager = Manager::start()?;
    let mut create = manager.place.ratn(&["resource", "create", "Fixture", "--id", "f1"]);
    manager.show("root", &mut create);
    ensure!(create.output()?.status.success());
    let mut waiting = Vec::new();
    for (caller, name) in [("ann", "1"), ("ann", "2"), ("ann", "3"), ("bob", "1"), ("bob", "2"), ("bob", "3")] {
        waiting.push(manager.wait_as(caller, name)?);
        let there = waiting.len();
        wait_for("its session", || Ok((manager.waiters()? == there).then_some(())))
            .with_context(|| manager.running.said())?;
    }
    manager.is_refused("ann", "connections of ann (certificate): the quota of 3")?;
    manager.is_refused("cleo", "connections of all who are no operators: the quota of 6")?;
    manager.is_served("root")?;
    // Handshakes that do not go on have the operators' places, and lose them.
    let silent = (0..20).map(|_| TcpStream::connect(("localhost", manager.port)));
    let silent: Vec<TcpStream> = silent.collect::<Result<_, _>>()?;
    let began = Instant::now();
    for _ in 0..3 {
        manager.is_served("root")?;
    }
    for mut connection in silent {
        connection.set_read_timeout(Some(Duration::from_secs(30)))?;
        let ended = connection.read_to_end(&mut Vec::new());
        let still_open = ended.is_err_and(|error| error.kind() == std::io::ErrorKind::WouldBlock);
        ensure!(!still_open, "a silent handshake is still open after {:?}", began.elapsed());
    }
    // One of them ends: its place is another's.
    let last = waiting.pop().context("a waiter")?;
    drop(last);
    wait_for("a free place", || Ok(manager.list("cleo")?.status.success().then_some(())))?;
    for client in &mut waiting {
        ensure!(client.child.try_wait()?.is_none(), "who worked goes on: {}", client.said());
    }
    Ok(())
}

/// Passes bytes on between a client and a server, and says when the server has closed a connection.
async fn relay(server: u16) -> anyhow::Result<(Endpoint, mpsc::Receiver<Instant>)> {
    let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await?;
    let endpoint = listener.local_addr()?.to_string().parse()?;
    let (tell, closed) = mpsc::channel(8);
    tokio::spawn(async move {
        while let Ok((client, _)) = listener.accept().await {
            let Ok(there) = tokio::net::TcpStream::connect(("127.0.0.1", server)).await else { return };
            let tell = tell.clone();
            tokio::spawn(async move {
                let ((mut from_client, mut to_client), (mut from_server, mut to_server)) =
                    (client.into_split(), there.into_split());
                let up = tokio::spawn(async move { tokio::io::copy(&mut from_client, &mut to_server).await });
                let _ = tokio::io::copy(&mut from_server, &mut to_client).await;
                let _ = tell.send(Instant::now()).await;
                up.abort();
            });
        }
    });
    Ok((endpoint, closed))
}

#[test]
fn an_idle_connection_is_closed_and_its_client_goes_on_and_one_with_a_watch_stays() -> anyhow::Result<()> {
    const IDLE: Duration = Duration::from_millis(1_000);
    let place = Place::new()?;
    let file = place.path().join("ratn.toml");
    std::fs::write(&file, "[resource-manager]\nlisten = '127.0.0.1:0'\n[service.quotas]\nidle_ms = 1000\n")?;
    let manager = place.start_as("manager", &["resource-manager", "--config", file.to_str().context("a path")?])?;
    let directory = RuntimeDirectory::at(place.path().join("run"));
    let found =
        wait_for("the manager", || Ok(directory.find("resource-manager").ok())).with_context(|| manager.said())?;
    let Endpoint::Tcp { port, .. } = found else { anyhow::bail!("{found} is not TCP") };
    tokio::runtime::Runtime::new()?.block_on(async {
        let ((through, mut closed), (watched_through, mut watched_closed)) = (relay(port).await?, relay(port).await?);
        let client = ResourceClient::new(&Channels::new(&ClientTls::none()), &through, "")?;
        let watching = ResourceClient::new(&Channels::new(&ClientTls::none()), &watched_through, "")?;
        let mut watch = watching.watch(&[]).await?;
        watch.next().await?;
        for _ in 0..2 {
            // A call in the very moment in which its connection ends fails, and is made again.
            let before = loop {
                let before = Instant::now();
                match client.list(&[]).await {
                    Ok(_) => break before,
                    Err(error) => ensure!(error.is_crash(), "{error}"),
                }
            };
            let at = tokio::time::timeout(Duration::from_secs(30), closed.recv()).await?.context("the relay")?;
            let lasted = at.duration_since(before);
            ensure!(lasted >= IDLE, "closed after {lasted:?}");
        }
        while let Err(error) = client.list(&[]).await {
            ensure!(error.is_crash(), "{error}");
        }
        ensure!(watched_closed.try_recv().is_err(), "a connection with a watch is not idle");
        Ok(())
    })
}
