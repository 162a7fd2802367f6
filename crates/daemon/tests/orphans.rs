//! Nothing that a worker started outlives its process manager, or its successor's start: with real processes, in cgroups where this machine
//! has some that may be divided, and without.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

mod support;

use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use std::process::{Child, Command};
use std::time::{Duration, Instant};
use support::{DEADLINE, TestSystem, own_cgroup};

/// How often a process manager is killed while it starts workers.
const ROUNDS: u64 = 25;
/// What must become true is looked for so often.
const LOOK: Duration = Duration::from_millis(2);

/// A process manager in a process of its own, ended with the test.
struct Manager(Child);

impl Manager {
    fn start(system: &TestSystem, how: &[&str]) -> Manager {
        let mut command = Command::new(env!("CARGO_BIN_EXE_ratn-test-worker"));
        Manager(command.arg("manage").arg(system.directory.path()).args(how).spawn().unwrap())
    }

    fn kill(&mut self) {
        self.0.kill().unwrap();
        self.0.wait().unwrap();
    }

    /// As its unit does it.
    fn stop(&mut self) {
        kill(Pid::from_raw(i32::try_from(self.0.id()).unwrap()), Signal::SIGTERM).unwrap();
        until("the process manager to end", || self.0.try_wait().unwrap().map(|status| assert!(status.success())));
    }
}

impl Drop for Manager {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// Processes that name a number on their command line, whatever has become of their environment, group and session; ended with the test.
struct Marked(String);

impl Marked {
    fn new() -> Marked {
        let mut bytes = [0; 4];
        std::fs::File::open("/dev/urandom")
            .and_then(|mut file| std::io::Read::read_exact(&mut file, &mut bytes))
            .unwrap();
        Marked(format!("9{:09}", u32::from_le_bytes(bytes) % 1_000_000_000))
    }

    fn pids(&self) -> Vec<i32> {
        let pids = std::fs::read_dir("/proc").unwrap().flatten();
        let pids = pids.filter_map(|entry| entry.file_name().to_str()?.parse().ok());
        pids.filter(|pid| self.is_of(*pid)).collect()
    }

    fn is_of(&self, pid: i32) -> bool {
        let line = std::fs::read(format!("/proc/{pid}/cmdline")).unwrap_or_default();
        let says = String::from_utf8_lossy(&line).contains(&self.0);
        // The process manager itself has it on its command line, too.
        says && !String::from_utf8_lossy(&line).contains("ratn-test-worker")
    }
}

impl Drop for Marked {
    fn drop(&mut self) {
        for pid in self.pids() {
            let _ = kill(Pid::from_raw(pid), Signal::SIGKILL);
        }
    }
}

fn until<T>(what: &str, mut look: impl FnMut() -> Option<T>) -> T {
    let begin = Instant::now();
    loop {
        if let Some(found) = look() {
            return found;
        }
        assert!(begin.elapsed() < DEADLINE, "waited in vain for {what}");
        std::thread::sleep(LOOK);
    }
}

/// Whether a group of cgroup v2 can be made where this process is.
fn divisible_cgroup() -> bool {
    let Some(own) = own_cgroup() else { return false };
    let probe = own.join(format!("ratn-probe-{}", std::process::id()));
    let made = std::fs::create_dir(&probe).is_ok() && probe.join("cgroup.kill").exists();
    let _ = std::fs::remove_dir(&probe);
    made
}

/// The ways that can be tried here.
fn ways() -> Vec<&'static str> {
    if divisible_cgroup() {
        return vec!["cgroup", "environment"];
    }
    eprintln!("skipped: no cgroup v2 that may be divided here; only the way without is tried");
    vec!["environment"]
}

#[test]
fn no_worker_outlives_a_process_manager_that_is_killed_while_it_starts_them() {
    for way in ways() {
        let (system, marked) = (TestSystem::new(), Marked::new());
        let mut random = 0x9e37_79b9_7f4a_7c15_u64;
        let mut started = 0;
        for round in 0..ROUNDS {
            let mut manager = Manager::start(&system, &["many", way, &marked.0]);
            until("the first worker", || (!marked.pids().is_empty()).then_some(()));
            random = random.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            std::thread::sleep(Duration::from_micros((random >> 33) % 12_000));
            manager.kill();
            started += marked.pids().len();
            let endpoint = system.directory.endpoint_file(ratn_daemon::process_manager::ROLE);
            let _ = std::fs::remove_file(&endpoint);
            let mut successor = Manager::start(&system, &["none", way]);
            until("the successor", || endpoint.exists().then_some(()));
            let left = marked.pids();
            assert!(left.is_empty(), "{way}, round {round}: {} processes that nobody knows", left.len());
            successor.stop();
        }
        assert!(started as u64 > ROUNDS, "{way}: {started} processes were there when it was killed");
    }
}

#[test]
fn what_a_worker_put_into_a_session_of_its_own_ends_at_a_clean_stop() {
    for way in ways() {
        for how in ["session", "clean-session"] {
            let (system, marked) = (TestSystem::new(), Marked::new());
            let mut manager = Manager::start(&system, &[how, way, &marked.0]);
            // The worker, and what it has sent away.
            until("both processes", || (marked.pids().len() >= 2).then_some(()));
            manager.stop();
            let left = marked.pids();
            assert!(left.is_empty(), "{way}, {how}: {left:?} is left");
        }
    }
}

#[test]
fn what_a_worker_put_into_a_session_of_its_own_ends_with_that_worker() {
    for way in ways() {
        let (system, marked) = (TestSystem::new(), Marked::new());
        let _manager = Manager::start(&system, &["session", way, &marked.0]);
        let before = until("both processes", || Some(marked.pids()).filter(|pids| pids.len() >= 2));
        let leader = |pid: &i32| {
            std::fs::read_to_string(format!("/proc/{pid}/stat")).is_ok_and(|stat| group(&stat) == Some(*pid))
        };
        let worker = before.iter().copied().filter(leader).min().unwrap();
        kill(Pid::from_raw(worker), Signal::SIGKILL).unwrap();
        until("all of the first worker to end", || before.iter().all(|pid| !marked.is_of(*pid)).then_some(()));
    }
}

/// The group of processes, of `/proc/PID/stat`.
fn group(stat: &str) -> Option<i32> {
    stat.rsplit_once(')')?.1.split_whitespace().nth(2)?.parse().ok()
}
