//! What a node costs beside its work: a chain of nodes that do nothing, each of which blocks a worker and is performed by it, through
//! `ratn run` and the real daemons.
//!
//! A node waits for its lease and for its goal. It takes over the lease of the node before it while nobody else waits for that
//! (`performer/handover.rs`), and asks for one otherwise. The goal goes over the one stream to the worker, which performs it when its own watch of
//! the resource manager confirms the lease.
//!
//! Resource manager, world pool, process manager, worker and task control are processes of their own on Unix sockets, as `ratn up` has
//! them; a node gets its input from the one before it, so no two can run at once. What is measured is in the event log: from the
//! end of one node to the end of the next. An echo takes turns with the runs.
//!
//! | key | what |
//! |---|---|
//! | `echo_…`, `stream_echo_…` | a question and its answer over a bare tonic, as a call of its own and over one stream |
//! | `hop_…` | one node of a chain of 1,000 that only compute; `hop_echoes`: how many bare calls that is |
//! | `world_hop_…` | of a chain in which each also reads what the one before it has changed: with a projection and a commit |
//! | `…_cpu_us_ROLE`, `…_switches_ROLE` | user and system time of a process, and how often its threads waited, for each node |
//! | `durable_…` | the same with every acknowledgement on the disk (`--durability group`); `plain_sync_…` what that takes alone |

use crate::echo;
use crate::line::block;
use crate::process::{self, Process, connect};
use crate::times::{Times, plain_sync};
use ratn_worker::action::{Action, ActionResult, GoalContext, GoalOutcome};
use ratn_worker::worker::{Worker, WorkerOptions};
use serde_json::{Value, json};
use std::fmt::Write;
use std::path::Path;
use std::process::{Command, Stdio};
use std::time::Instant;

pub(crate) const NODES: usize = 1_000;
const TURNS: usize = 5;
const CALLS: usize = 500;
const KIND: &str = "Noop";
/// The action that does not end by itself.
pub(crate) const WAIT: &str = "wait";
/// The roles that take part, in the order in which they are started.
const ROLES: [&str; 3] = ["resource-manager", "world-pool", "process-manager"];

pub(crate) async fn measure() {
    let directory = tempfile::tempdir().unwrap();
    let mut report = serde_json::Map::new();
    let mut note = |key: String, value: f64| drop(report.insert(key, json!(value)));
    let (_echo, at) = process::echo();
    let channel = connect(&at).await;
    let mut bare = echo::Client::new(channel.clone());
    let mut line = echo::Line::open(channel).await;
    let [mut echoed, mut streamed, mut synced] = <[Times; 3]>::default();
    for (durability, prefix) in [("none", ""), ("group", "durable_")] {
        let system = System::start(&directory.path().join(durability), durability).await;
        let [mut plain, mut world] = [Chain::new(&system, "hop", false), Chain::new(&system, "world_hop", true)];
        for turn in 0..TURNS {
            for call in 0..CALLS {
                let began = Instant::now();
                bare.unary(block("bench", KIND, call)).await;
                echoed.add(began);
                let began = Instant::now();
                line.ask(block("bench", KIND, call)).await;
                streamed.add(began);
            }
            plain_sync(directory.path(), CALLS, &mut synced);
            plain.run(&system, turn);
            world.run(&system, turn);
        }
        for chain in [plain, world] {
            let key = format!("{prefix}{}", chain.name);
            chain.report(&key, echoed.at(0.5), &mut note);
        }
    }
    note("echo_p50_us".to_owned(), echoed.at(0.5));
    note("stream_echo_p50_us".to_owned(), streamed.at(0.5));
    note("plain_sync_p50_us".to_owned(), synced.at(0.5));
    println!("{}", serde_json::to_string_pretty(&report).unwrap());
}

/// The daemons, and the worker that the process manager starts.
pub(crate) struct System {
    pub(crate) directory: std::path::PathBuf,
    daemons: Vec<Process>,
}

impl System {
    pub(crate) async fn start(directory: &Path, durability: &str) -> System {
        std::fs::create_dir_all(directory).unwrap();
        std::fs::write(directory.join("config.toml"), config()).unwrap();
        let mut system = System { directory: directory.to_owned(), daemons: Vec::new() };
        for role in ROLES {
            let config = directory.join("config.toml");
            let mut arguments = vec!["--config", config.to_str().unwrap()];
            if role != "process-manager" {
                arguments.extend(["--durability", durability]);
            }
            system.daemons.push(process::role(role, directory, &arguments).await.0);
        }
        let worker = directory.join("noop-1@bench.endpoint");
        process::until("the worker", || worker.exists().then_some(())).await;
        system
    }

    /// User and system microseconds so far, and how often their threads have waited.
    fn used(&self) -> Vec<(&'static str, f64, f64)> {
        let worker = self.daemons.last().unwrap().children();
        let own = ROLES.into_iter().zip(&self.daemons).map(|(role, daemon)| (role, daemon.id()));
        own.chain(worker.into_iter().map(|pid| ("worker", pid)))
            .map(|(role, pid)| (role, process::cpu_us(pid), process::switches(pid)))
            .collect()
    }
}

fn config() -> String {
    let program = std::env::current_exe().unwrap();
    format!(
        r#"
[process-manager]
host = "bench"
[[process-manager.template]]
name = "noop"
kind = "{KIND}"
program = {program:?}
args = ["--worker", "{{id}}", "{{runtime_dir}}", "{{endpoint_file}}"]
min = 1
max = 1
[catalogue.resources.{KIND}]
class = "process"
count = 1
[catalogue.resources.WorldModel]
class = "world"
count = 64
[catalogue.providers.noop]
resource = "{KIND}"
[catalogue.providers.noop.actions.do]
inputs = {{ x = "int" }}
outputs = {{ x = "int" }}
"#
    )
}

/// A task, and what its runs have taken.
pub(crate) struct Chain {
    name: &'static str,
    times: Times,
    /// By role: microseconds and switches of all runs.
    used: Vec<(&'static str, f64, f64)>,
    runs: f64,
}

/// What one run has taken.
pub(crate) struct Ran {
    /// By role: microseconds and switches.
    pub(crate) used: Vec<(&'static str, f64, f64)>,
    /// From the end of each node to the end of the next.
    pub(crate) hops_us: Vec<f64>,
}

impl Chain {
    pub(crate) fn new(system: &System, name: &'static str, world: bool) -> Chain {
        let mut task = format!("task: {name}\nworld: [\"done(s0)\"]\nstates:\n");
        (1..=NODES).for_each(|node| writeln!(task, "  - {}", step(node, world)).unwrap());
        Chain::of(system, name, &task)
    }

    /// A chain of so many nodes, so many times, one after the other: a run that lasts.
    pub(crate) fn repeated(system: &System, name: &'static str, nodes: usize, times: usize) -> Chain {
        let mut task = format!("task: {name}\nstates:\n  - for: i in range({times})\n    do:\n");
        (1..=nodes).for_each(|node| writeln!(task, "      - {}", step(node, false)).unwrap());
        Chain::of(system, name, &task)
    }

    fn of(system: &System, name: &'static str, task: &str) -> Chain {
        std::fs::write(system.directory.join(format!("{name}.yaml")), task).unwrap();
        Chain { name, times: Times::default(), used: Vec::new(), runs: 0.0 }
    }

    fn run(&mut self, system: &System, turn: usize) {
        let Ran { used, hops_us } = self.ran(system, turn);
        if self.used.is_empty() {
            self.used = used;
        } else {
            for (sum, (_, us, switches)) in self.used.iter_mut().zip(used) {
                sum.1 += us;
                sum.2 += switches;
            }
        }
        self.runs += 1.0;
        hops_us.into_iter().for_each(|us| self.times.add_us(us));
    }

    /// Runs it once.
    pub(crate) fn ran(&self, system: &System, turn: usize) -> Ran {
        let at = |name: String| system.directory.join(name);
        let log = at(format!("{}-{turn}.jsonl", self.name));
        let before = system.used();
        let run = Command::new(process::ratn())
            .args(["run", "--config"])
            .arg(at("config.toml".to_owned()))
            .arg("--runtime-dir")
            .arg(&system.directory)
            .arg("--log")
            .arg(&log)
            .arg(at(format!("{}.yaml", self.name)))
            .stdout(Stdio::null())
            .stderr(std::fs::File::create(at("run.err".to_owned())).unwrap())
            .spawn()
            .unwrap();
        let (status, own) = process::waited_for(run);
        assert!(status.success(), "{}", std::fs::read_to_string(at("run.err".to_owned())).unwrap());
        let used = before
            .into_iter()
            .zip(system.used())
            .map(|((role, us, n), (_, more_us, more))| (role, more_us - us, more - n));
        let used = used.chain([("task-control", own.0, own.1)]).collect();
        let (mut last, mut hops_us) = (None, Vec::new());
        for line in std::fs::read_to_string(log).unwrap().lines() {
            let line: Value = serde_json::from_str(line).unwrap();
            if line["event"] == "finished" {
                let at = line["at"].as_u64().unwrap();
                if let Some(last) = last.replace(at) {
                    hops_us.push((at - last) as f64 / 1e3);
                }
            }
        }
        Ran { used, hops_us }
    }

    fn report(mut self, key: &str, echo_us: f64, note: &mut impl FnMut(String, f64)) {
        assert_eq!(self.times.count(), TURNS * (NODES - 1), "every node has ended");
        let p50 = self.times.at(0.5);
        note(format!("{key}_p50_us"), p50);
        note(format!("{key}_p90_us"), self.times.at(0.9));
        note(format!("{key}_echoes"), (p50 / echo_us * 100.0).round() / 100.0);
        for (role, us, switches) in self.used {
            let role = role.replace('-', "_");
            note(format!("{key}_cpu_us_{role}"), (us / self.runs / NODES as f64).round());
            note(format!("{key}_switches_{role}"), (switches / self.runs / NODES as f64 * 10.0).round() / 10.0);
        }
    }
}

/// A node of a chain, which takes its input from the one before it.
fn step(node: usize, world: bool) -> String {
    let before = node - 1;
    let input = if node == 1 { "0".to_owned() } else { format!("s{before}.x") };
    let (reads, effects) = if world {
        (format!("\"done(s{before})\""), format!("effects: [\"done(s{node})\"], "))
    } else {
        Default::default()
    };
    format!(
        "s{node}: {{ action: noop/do, in: {{ x: {input} }}, computes: true, reads: [{reads}], {effects}resources: [{{ block: {KIND} }}] }}"
    )
}

/// The worker: `--worker ID DIRECTORY ENDPOINT_FILE`.
pub(crate) fn work(id: &str, directory: &str, endpoint_file: &str) {
    let options = WorkerOptions {
        id: id.to_owned(),
        kind: KIND.to_owned(),
        listen: format!("unix:{directory}/{id}.sock").parse().unwrap(),
        endpoint_file: Some(endpoint_file.into()),
        exit_with_parent: true,
        ..WorkerOptions::default()
    };
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
    runtime.block_on(Worker::new(options).action(Noop).action(Wait).run()).unwrap();
}

/// `noop/do`: its output is its input.
struct Noop;

#[tonic::async_trait]
impl Action for Noop {
    fn name(&self) -> &str {
        "do"
    }

    async fn execute(&self, goal: GoalContext) -> ActionResult {
        Ok(GoalOutcome { outputs: goal.inputs, ..GoalOutcome::success() })
    }
}

/// Does not end before it is told to.
struct Wait;

#[tonic::async_trait]
impl Action for Wait {
    fn name(&self) -> &str {
        WAIT
    }

    async fn execute(&self, goal: GoalContext) -> ActionResult {
        goal.cancelled.cancelled().await;
        Err(goal.stopped())
    }
}
