//! The processes that are measured. Each ends with its value.

use nix::sys::resource::{UsageWho, getrusage};
use nix::sys::time::{TimeVal, TimeValLike};
use std::io::{BufRead, BufReader};
use std::net::TcpListener;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
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
    pub(crate) fn of(child: Child) -> Process {
        Process(child)
    }

    pub(crate) fn id(&self) -> u32 {
        self.0.id()
    }

    /// The processes that it has started.
    pub(crate) fn children(&self) -> Vec<u32> {
        let of_thread = |thread: u32| {
            let children = std::fs::read_to_string(format!("/proc/{}/task/{thread}/children", self.id()));
            children.unwrap_or_default().split_whitespace().map(|pid| pid.parse().unwrap()).collect::<Vec<u32>>()
        };
        threads(self.id()).into_iter().flat_map(of_thread).collect()
    }

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
pub(crate) async fn daemon(name: &str, directory: &Path, durability: &str) -> (Process, String) {
    role(name, directory, &["--listen", "127.0.0.1:0", "--durability", durability]).await
}

/// The `ratn` that is measured: another build where `RATN_UNDER_TEST` names it.
pub(crate) fn ratn() -> PathBuf {
    std::env::var_os("RATN_UNDER_TEST").map_or_else(|| env!("CARGO_BIN_EXE_ratn-under-test").into(), PathBuf::from)
}

/// A role of a system, and where it is.
pub(crate) async fn role(name: &str, directory: &Path, arguments: &[&str]) -> (Process, String) {
    let child = Command::new(ratn())
        .arg(name)
        .args(arguments)
        .arg("--runtime-dir")
        .arg(directory)
        .env("RATN_LOG", "warn")
        .spawn()
        .unwrap();
    let process = Process(child);
    let file = directory.join(format!("{name}.endpoint"));
    let said = || {
        let endpoint = std::fs::read_to_string(&file).ok()?.trim().to_owned();
        (!endpoint.is_empty()).then_some(endpoint)
    };
    (process, until(name, said).await)
}

/// Asks until there is an answer.
pub(crate) async fn until<T>(what: &str, mut ask: impl FnMut() -> Option<T>) -> T {
    let began = Instant::now();
    loop {
        if let Some(answer) = ask() {
            return answer;
        }
        assert!(began.elapsed() < PATIENCE, "waited in vain for {what}");
        tokio::time::sleep(Duration::from_millis(2)).await;
    }
}

fn threads(pid: u32) -> Vec<u32> {
    let entries = std::fs::read_dir(format!("/proc/{pid}/task")).into_iter().flatten().flatten();
    entries.filter_map(|entry| entry.file_name().to_str()?.parse().ok()).collect()
}

/// User and system microseconds of a process so far.
pub(crate) fn cpu_us(pid: u32) -> f64 {
    let of_thread = |thread: u32| {
        let stat = std::fs::read_to_string(format!("/proc/{pid}/task/{thread}/schedstat")).unwrap_or_default();
        stat.split_whitespace().next().map_or(0.0, |ns| ns.parse::<f64>().unwrap() / 1e3)
    };
    threads(pid).into_iter().map(of_thread).sum()
}

/// How often the threads of a process have waited for something.
pub(crate) fn switches(pid: u32) -> f64 {
    let of_thread = |thread: u32| {
        let status = std::fs::read_to_string(format!("/proc/{pid}/task/{thread}/status")).unwrap_or_default();
        let line = status.lines().find_map(|line| line.strip_prefix("voluntary_ctxt_switches:"));
        line.map_or(0.0, |count| count.trim().parse().unwrap())
    };
    threads(pid).into_iter().map(of_thread).sum()
}

/// Waits for a process: how it ended, its user and system microseconds, and how often it waited.
pub(crate) fn waited_for(mut child: Child) -> (ExitStatus, (f64, f64)) {
    let used = || {
        let usage = getrusage(UsageWho::RUSAGE_CHILDREN).unwrap();
        let us = |time: TimeVal| time.num_microseconds() as f64;
        (us(usage.user_time()) + us(usage.system_time()), usage.voluntary_context_switches() as f64)
    };
    let before = used();
    let status = child.wait().unwrap();
    let after = used();
    (status, (after.0 - before.0, after.1 - before.1))
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
