//! etcd for tests: members as processes of their own, in a directory that vanishes, and a proxy that loses answers.
//!
//! Tests of other packages include this file. Without `etcd` on the machine tests of it say that they are skipped; with `RATN_NEEDS_ETCD=1` they fail.

use std::io::{Read, Write};
use std::net::{Shutdown, TcpListener, TcpStream};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex};
use std::thread;
use std::time::{Duration, Instant};
use tempfile::TempDir;

/// A cluster.
pub(crate) struct Cluster {
    pub(crate) members: Vec<Member>,
    arguments: Vec<String>,
    _directory: TempDir,
}

pub(crate) struct Member {
    pub(crate) client: String,
    arguments: Vec<String>,
    process: Option<Child>,
}

/// Whether there is an etcd; says so where there is none.
pub(crate) fn is_there() -> bool {
    let there =
        Command::new("etcd").arg("--version").stdout(Stdio::null()).status().is_ok_and(|status| status.success());
    assert!(there || std::env::var_os("RATN_NEEDS_ETCD").is_none(), "etcd is needed and not there");
    if !there {
        eprintln!("skipped: no etcd on this machine (scripts/check-etcd installs it)");
    }
    there
}

fn free_port() -> u16 {
    TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port()
}

/// A port is free when it is picked, and may be another process's when etcd listens: so often new ones are picked.
const STARTS: usize = 5;
/// A cluster that is not healthy by then will not be.
const HEALTHY_WITHIN: Duration = Duration::from_secs(60);

/// The ports of a member, for clients and for other members.
pub(crate) type Ports = (u16, u16);

impl Cluster {
    pub(crate) fn start(count: usize, arguments: &[&str]) -> Cluster {
        Cluster::start_at(count, arguments, || (free_port(), free_port()))
    }

    /// At ports that are picked anew, for all members, as long as one of them ends at once.
    pub(crate) fn start_at(count: usize, arguments: &[&str], mut pick: impl FnMut() -> Ports) -> Cluster {
        for _ in 0..STARTS {
            let ports: Vec<Ports> = (0..count).map(|_| pick()).collect();
            let mut cluster = Cluster::at(&ports, arguments);
            for index in 0..count {
                cluster.run(index);
            }
            if cluster.has_begun() {
                return cluster;
            }
        }
        panic!("in each of {STARTS} starts, at other ports each time, a member of etcd has ended at once");
    }

    /// Not yet running.
    fn at(ports: &[Ports], arguments: &[&str]) -> Cluster {
        let directory = tempfile::tempdir_in("/dev/shm").or_else(|_| tempfile::tempdir()).unwrap();
        let initial: Vec<String> =
            ports.iter().enumerate().map(|(i, (_, peer))| format!("m{i}=http://127.0.0.1:{peer}")).collect();
        let members = ports.iter().enumerate().map(|(i, (client, peer))| {
            let (client, peer) = (format!("http://127.0.0.1:{client}"), format!("http://127.0.0.1:{peer}"));
            let data = directory.path().join(format!("m{i}")).display().to_string();
            let name = format!("m{i}");
            let arguments: Vec<String> = [
                "--name",
                &name,
                "--data-dir",
                &data,
                "--listen-client-urls",
                &client,
                "--advertise-client-urls",
                &client,
                "--listen-peer-urls",
                &peer,
                "--initial-advertise-peer-urls",
                &peer,
                "--initial-cluster",
                &initial.join(","),
                "--heartbeat-interval",
                "50",
                "--election-timeout",
                "500",
                "--logger",
                "zap",
                "--log-level",
                "error",
            ]
            .map(str::to_owned)
            .into();
            Member { client, arguments, process: None }
        });
        let members = members.collect();
        let arguments = arguments.iter().map(|&argument| argument.to_owned()).collect();
        Cluster { members, arguments, _directory: directory }
    }

    /// Waits until all members are healthy. Whether they are: not where one of them has ended.
    fn has_begun(&mut self) -> bool {
        let begin = Instant::now();
        loop {
            let ended =
                |member: &mut Member| member.process.as_mut().is_none_or(|own| own.try_wait().unwrap().is_some());
            if self.members.iter_mut().any(ended) {
                return false;
            }
            // Who answers may be a member of another test, at a port that ours did not get: a member makes its data when it has its ports.
            let is_ours = |member: &Member| Path::new(&member.argument("--data-dir")).join("member").exists();
            if self.members.iter().all(is_ours) && self.is_healthy() {
                return true;
            }
            assert!(begin.elapsed() < HEALTHY_WITHIN, "etcd does not become healthy");
            thread::sleep(Duration::from_millis(50));
        }
    }

    pub(crate) fn run(&mut self, index: usize) {
        let member = &mut self.members[index];
        let mut command = Command::new("etcd");
        command.args(&member.arguments).args(&self.arguments).stdin(Stdio::null());
        member.process = Some(command.stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap());
    }

    pub(crate) fn kill(&mut self, index: usize) {
        if let Some(mut process) = self.members[index].process.take() {
            process.kill().unwrap();
            process.wait().unwrap();
        }
    }

    pub(crate) fn endpoints(&self) -> Vec<String> {
        self.members.iter().map(|member| member.client.clone()).collect()
    }

    /// Puts a snapshot of etcd in place of what the only member has.
    pub(crate) fn restore(&mut self, snapshot: &str) {
        self.kill(0);
        let of = |name: &str| self.members[0].argument(name);
        std::fs::remove_dir_all(of("--data-dir")).unwrap();
        let mut command = Command::new("etcdctl");
        command.env("ETCDCTL_API", "3").args(["snapshot", "restore", snapshot, "--initial-cluster-token", "restored"]);
        for name in ["--name", "--data-dir", "--initial-cluster"] {
            command.args([name, &of(name)]);
        }
        command.args(["--initial-advertise-peer-urls", &of("--initial-advertise-peer-urls")]);
        assert!(command.output().unwrap().status.success());
        self.run(0);
        self.await_health();
    }

    /// `etcdctl` at every member.
    pub(crate) fn ctl(&self, arguments: &[&str]) -> std::process::Output {
        let mut command = Command::new("etcdctl");
        command.env("ETCDCTL_API", "3").arg("--endpoints").arg(self.endpoints().join(",")).args(arguments);
        command.output().unwrap()
    }

    pub(crate) fn await_health(&self) {
        let begin = Instant::now();
        while !self.is_healthy() {
            assert!(begin.elapsed() < HEALTHY_WITHIN, "etcd does not become healthy");
            thread::sleep(Duration::from_millis(50));
        }
    }

    fn is_healthy(&self) -> bool {
        self.ctl(&["endpoint", "health"]).status.success()
    }
}

impl Member {
    /// What it is started with under this name.
    fn argument(&self, name: &str) -> String {
        let at = self.arguments.iter().position(|argument| argument == name).unwrap();
        self.arguments[at + 1].clone()
    }
}

impl Drop for Cluster {
    fn drop(&mut self) {
        for index in 0..self.members.len() {
            self.kill(index);
        }
    }
}

/// Passes bytes on, both ways, until it is told to lose the answers, or everything.
pub(crate) struct Proxy {
    pub(crate) address: String,
    loses: Arc<Loses>,
}

type Happening = Box<dyn FnOnce() + Send>;

#[derive(Default)]
struct Loses {
    answers: AtomicBool,
    /// Connections are refused and broken.
    all: AtomicBool,
    /// What is asked is passed on up to so many milliseconds later.
    delay_ms: AtomicU64,
    /// What happens once, before something is passed on that contains these bytes.
    before: Mutex<Option<(Vec<u8>, Happening)>>,
}

impl Proxy {
    pub(crate) fn to(target: &str) -> Proxy {
        let target = target.strip_prefix("http://").unwrap().to_owned();
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let address = format!("http://{}", listener.local_addr().unwrap());
        let loses = Arc::new(Loses::default());
        let shared = loses.clone();
        thread::spawn(move || {
            for near in listener.incoming().flatten() {
                let far = TcpStream::connect(&target);
                let Ok(far) = far.map_err(drop).and_then(|far| match shared.all.load(Ordering::SeqCst) {
                    true => Err(()),
                    false => Ok(far),
                }) else {
                    let _ = near.shutdown(Shutdown::Both);
                    continue;
                };
                let (near_too, far_too) = (near.try_clone().unwrap(), far.try_clone().unwrap());
                pass(near, far, shared.clone(), false);
                pass(far_too, near_too, shared.clone(), true);
            }
        });
        Proxy { address, loses }
    }

    /// What is asked arrives, what is answered does not.
    pub(crate) fn lose_answers(&self, lose: bool) {
        self.loses.answers.store(lose, Ordering::SeqCst);
    }

    /// What is asked arrives up to so much later, now sooner and now later, also where nobody waits for its answer any more; what is
    /// answered, at once.
    pub(crate) fn delay(&self, most: Duration) {
        self.loses.delay_ms.store(most.as_millis() as u64, Ordering::SeqCst);
    }

    /// Does something once, before a question is passed on that contains this text.
    pub(crate) fn before(&self, text: &str, what: impl FnOnce() + Send + 'static) {
        *self.loses.before.lock().unwrap() = Some((text.as_bytes().to_vec(), Box::new(what)));
    }

    /// Nothing arrives; connections that were open are broken.
    pub(crate) fn lose_all(&self, lose: bool) {
        self.loses.all.store(lose, Ordering::SeqCst);
    }
}

/// What a client asks over HTTP/2 (RFC 9113, section 4), to leave out that it wants an answer no more: a copy of a request that is late on its
/// way is performed all the same.
#[derive(Default)]
struct Asked {
    preface: usize,
    header: Vec<u8>,
    /// What is still to come of a frame, and whether it is left out.
    payload: usize,
    left_out: bool,
}

impl Asked {
    const PREFACE: usize = 24;
    const HEADER: usize = 9;
    const RST_STREAM: u8 = 3;

    fn pass(&mut self, bytes: Vec<u8>, without_cancels: bool) -> Vec<u8> {
        let (mut rest, mut kept) = (&bytes[..], Vec::with_capacity(bytes.len()));
        while !rest.is_empty() {
            let count = if self.preface < Asked::PREFACE {
                let count = rest.len().min(Asked::PREFACE - self.preface);
                self.preface += count;
                kept.extend_from_slice(&rest[..count]);
                count
            } else if self.payload > 0 {
                let count = rest.len().min(self.payload);
                self.payload -= count;
                if !self.left_out {
                    kept.extend_from_slice(&rest[..count]);
                }
                count
            } else {
                let count = rest.len().min(Asked::HEADER - self.header.len());
                self.header.extend_from_slice(&rest[..count]);
                if self.header.len() == Asked::HEADER {
                    let length = [0, self.header[0], self.header[1], self.header[2]];
                    self.payload = u32::from_be_bytes(length) as usize;
                    self.left_out = without_cancels && self.header[3] == Asked::RST_STREAM;
                    if !self.left_out {
                        kept.extend_from_slice(&self.header);
                    }
                    self.header.clear();
                }
                count
            };
            rest = &rest[count..];
        }
        kept
    }
}

/// A connection that has lost bytes is broken as soon as it would pass some on again.
fn pass(mut from: TcpStream, mut to: TcpStream, loses: Arc<Loses>, answers: bool) {
    thread::spawn(move || {
        let (mut bytes, mut has_lost, mut passed) = ([0; 16_384], false, 1_u64);
        let mut asked = Asked::default();
        while let Ok(count @ 1..) = from.read(&mut bytes) {
            let most = loses.delay_ms.load(Ordering::SeqCst);
            let mut kept = bytes[..count].to_vec();
            if !answers {
                kept = asked.pass(kept, most > 0);
                let mut before = loses.before.lock().unwrap();
                let contains = |text: &[u8]| kept.windows(text.len()).any(|window| window == text);
                if let Some((_, what)) = before.take_if(|(text, _)| contains(text)) {
                    what();
                }
            }
            if most > 0 && !answers {
                passed = (passed * 7_919 + 104_729) % 1_000_003;
                thread::sleep(Duration::from_millis(passed % most));
            }
            if loses.all.load(Ordering::SeqCst) {
                break;
            }
            if answers && loses.answers.load(Ordering::SeqCst) {
                has_lost = true;
                continue;
            }
            if has_lost || to.write_all(&kept).is_err() {
                break;
            }
        }
        let _ = from.shutdown(Shutdown::Both);
        let _ = to.shutdown(Shutdown::Both);
    });
}
