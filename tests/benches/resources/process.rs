//! The processes that are measured. Each ends with its value.

use std::io::{BufRead, BufReader};
use std::net::TcpListener;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};
use tonic::transport::{Channel, Endpoint};

/// Nothing takes longer to come up.
const PATIENCE: Duration = Duration::from_secs(10);

pub(crate) struct Process(Child);

impl Drop for Process {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

impl Process {
    /// What it has in memory.
    pub(crate) fn resident_bytes(&self) -> f64 {
        let status = std::fs::read_to_string(format!("/proc/{}/status", self.0.id())).unwrap();
        let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:")).unwrap();
        line.trim().trim_end_matches(" kB").parse::<f64>().unwrap() * 1_024.0
    }
}

/// This program again, as the echo.
pub(crate) fn echo() -> (Process, String) {
    let mut child =
        Command::new(std::env::current_exe().unwrap()).arg("--echo").stdout(Stdio::piped()).spawn().unwrap();
    let mut line = String::new();
    BufReader::new(child.stdout.take().unwrap()).read_line(&mut line).unwrap();
    (Process(child), line.trim().to_owned())
}

/// A resource manager with a directory of its own.
pub(crate) async fn manager(directory: &Path, durability: &str) -> (Process, String) {
    daemon("resource-manager", directory, durability).await
}

/// A daemon that keeps a state, with a directory of its own.
pub(crate) async fn daemon(role: &str, directory: &Path, durability: &str) -> (Process, String) {
    let child = Command::new(env!("CARGO_BIN_EXE_ratn-under-test"))
        .args([role, "--listen", "127.0.0.1:0", "--durability", durability, "--runtime-dir"])
        .arg(directory)
        .env("RATN_LOG", "warn")
        .spawn()
        .unwrap();
    let process = Process(child);
    let file = directory.join(format!("{role}.endpoint"));
    let began = Instant::now();
    while began.elapsed() < PATIENCE {
        if let Ok(endpoint) = std::fs::read_to_string(&file)
            && !endpoint.trim().is_empty()
        {
            return (process, endpoint.trim().to_owned());
        }
        tokio::time::sleep(Duration::from_millis(5)).await;
    }
    panic!("the {role} did not come up");
}

/// Something installed that listens on a port of the loopback; nothing where it is not installed.
pub(crate) async fn installed(program: &str, arguments: impl Fn(u16) -> Vec<String>) -> Option<(Process, u16)> {
    let free = || TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
    let port = free();
    let child = Command::new(program)
        .args(arguments(port))
        .stdin(Stdio::null())
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .spawn()
        .ok()?;
    let process = Process(child);
    let began = Instant::now();
    while began.elapsed() < PATIENCE {
        if tokio::net::TcpStream::connect(("127.0.0.1", port)).await.is_ok() {
            return Some((process, port));
        }
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
    eprintln!("{program} is installed and did not come up");
    None
}

pub(crate) async fn connect(endpoint: &str) -> Channel {
    Endpoint::from_shared(endpoint.to_owned()).unwrap().tcp_nodelay(true).connect().await.unwrap()
}
