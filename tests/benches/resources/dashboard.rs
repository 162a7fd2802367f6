//! What ten open pages of `ratn dashboard` cost a run: a chain of nodes of [`crate::hop`] beside one dashboard, in turns with and without ten
//! clients that ask it as its pages do. Other work on the machine hits both alike, so a run with pages is compared with the runs before and
//! behind it: of each the ratio, and of all ratios the median and the quartiles. A run lasts for some seconds, so that the pages see it: a page
//! asks once in a second which runs there are.
//!
//! | key | what |
//! |---|---|
//! | `without_cpu_us`, `with_cpu_us` | user and system time of the processes of the run, for each node: task control, the daemons and the worker; medians |
//! | `cpu_ratio`, `…_q1`, `…_q3` | that with pages beside that without |
//! | `task_control_cpu_ratio…` | the same of task control alone |
//! | `hop_ratio…` | the same of the time from the end of a node to the end of the next |
//! | `same_cpu_ratio…` | of two runs without pages, the second beside the first: what a ratio is worth here |
//! | `dashboard_cpu_us` | what the dashboard itself takes beside a run with pages, for each node |
//! | `answers` | so many questions of pages about the run were answered during each run with pages; a benchmark without any fails |

use crate::hop::{Chain, Ran, System};
use crate::process::{self, Process};
use crate::times::Times;
use serde_json::{Value, json};
use std::io::{BufRead, BufReader, Read, Write};
use std::net::TcpStream;
use std::process::{Command, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

/// Unless `ROUNDS` says otherwise: so many runs with pages, each between two without.
const ROUNDS: usize = 15;
/// A chain of [`CHAIN`] nodes, so many times.
const TIMES: usize = 400;
const CHAIN: usize = 50;
const NODES: usize = TIMES * CHAIN;
/// As `web/src/main.ts` has it: after an answer about the run, and between two questions about all else.
const PERIOD: Duration = Duration::from_millis(300);
const SLOW: Duration = Duration::from_millis(1_000);
/// Which pages are open: what each asks beside the run, each time that the run was asked or once in [`SLOW`].
const PAGES: [Asks; 10] = [
    Asks::NothingMore, // Run
    Asks::NothingMore,
    Asks::NothingMore,
    Asks::NothingMore, // Network
    Asks::NothingMore,
    Asks::Slowly("system"), // Resources
    Asks::Slowly("system"), // Hosts and pools
    Asks::Slowly("world"),  // World
    Asks::EachTime("cell"), // Cell
    Asks::EachTime("cell"),
];

#[derive(Clone, Copy)]
enum Asks {
    NothingMore,
    Slowly(&'static str),
    EachTime(&'static str),
}

pub(crate) async fn measure() {
    let rounds = std::env::var("ROUNDS").map_or(ROUNDS, |rounds| rounds.parse().unwrap());
    let place = tempfile::tempdir().unwrap();
    let system = System::start(&place.path().join("system"), "none").await;
    let chain = Chain::repeated(&system, "hop", CHAIN, TIMES);
    let dashboard = Dashboard::start(&system);
    let mut number = 0;
    let mut plain = || {
        number += 1;
        chain.ran(&system, number)
    };
    // The first run finds nothing warm.
    plain();
    let [mut without, mut with, mut all, mut own, mut hop, mut same] = <[Times; 6]>::default();
    let (mut dashboard_us, mut answers) = (Times::default(), 0);
    for _ in 0..rounds {
        let first = plain();
        let (open, before) = (dashboard.open(), process::cpu_us(dashboard.process.id()));
        let looked_at = plain();
        dashboard_us.add_us((process::cpu_us(dashboard.process.id()) - before) / NODES as f64);
        let answered = open.close();
        assert!(answered >= PAGES.len(), "the pages have hardly seen the run: {answered} answers");
        answers += answered;
        let second = plain();
        // Beside the mean of the run before it and the one behind it.
        let ratio = |of: fn(&Ran) -> f64| of(&looked_at) / ((of(&first) + of(&second)) / 2.0) * SCALE;
        all.add_us(ratio(cpu_us));
        own.add_us(ratio(task_control_us));
        hop.add_us(ratio(hop_us));
        same.add_us(cpu_us(&second) / cpu_us(&first) * SCALE);
        [&first, &second].into_iter().for_each(|one| without.add_us(cpu_us(one)));
        with.add_us(cpu_us(&looked_at));
    }
    let mut report = serde_json::Map::new();
    let mut note = |key: String, value: f64| drop(report.insert(key, json!(value)));
    note("rounds".to_owned(), rounds as f64);
    note("without_cpu_us".to_owned(), without.at(0.5));
    note("with_cpu_us".to_owned(), with.at(0.5));
    for (key, ratios) in [
        ("cpu_ratio", &mut all),
        ("task_control_cpu_ratio", &mut own),
        ("hop_ratio", &mut hop),
        ("same_cpu_ratio", &mut same),
    ] {
        for (ending, part) in [("", 0.5), ("_q1", 0.25), ("_q3", 0.75)] {
            note(format!("{key}{ending}"), ratios.at(part) / SCALE);
        }
    }
    note("dashboard_cpu_us".to_owned(), dashboard_us.at(0.5));
    note("answers".to_owned(), (answers as f64 / rounds as f64).round());
    println!("{}", serde_json::to_string_pretty(&report).unwrap());
}

/// [`Times`] are in tenths; a ratio has four digits.
const SCALE: f64 = 1_000.0;

/// Of all processes of a run, for each node.
fn cpu_us(ran: &Ran) -> f64 {
    ran.used.iter().map(|(_, us, _)| us).sum::<f64>() / NODES as f64
}

fn task_control_us(ran: &Ran) -> f64 {
    ran.used.iter().filter(|(role, ..)| *role == "task-control").map(|(_, us, _)| us).sum::<f64>() / NODES as f64
}

/// The median.
fn hop_us(ran: &Ran) -> f64 {
    let mut times = Times::default();
    ran.hops_us.iter().for_each(|us| times.add_us(*us));
    times.at(0.5)
}

struct Dashboard {
    process: Process,
    address: String,
    token: String,
}

impl Dashboard {
    fn start(system: &System) -> Dashboard {
        let child = Command::new(process::ratn())
            .args(["dashboard", "--runtime-dir"])
            .arg(&system.directory)
            .stdout(Stdio::piped())
            .stderr(Stdio::null())
            .spawn();
        let mut child = child.unwrap();
        let mut line = String::new();
        BufReader::new(child.stdout.take().unwrap()).read_line(&mut line).unwrap();
        let (address, token) = line.trim().strip_prefix("http://").unwrap().split_once("/#token=").unwrap();
        let (address, token) = (address.to_owned(), token.to_owned());
        Dashboard { process: Process::of(child), address, token }
    }

    /// All pages, from now on.
    fn open(&self) -> Open {
        let (ends, answers) = (Arc::new(AtomicBool::new(false)), Arc::new(AtomicUsize::new(0)));
        let page = |asks| {
            let page = Page::open(&self.address, &self.token);
            let (ends, answers) = (Arc::clone(&ends), Arc::clone(&answers));
            std::thread::spawn(move || page.look(asks, &ends, &answers))
        };
        let pages = PAGES.into_iter().map(page).collect();
        Open { ends, answers, pages }
    }
}

struct Open {
    ends: Arc<AtomicBool>,
    answers: Arc<AtomicUsize>,
    pages: Vec<JoinHandle<()>>,
}

impl Open {
    /// How many questions about the run were answered.
    fn close(self) -> usize {
        self.ends.store(true, Ordering::Relaxed);
        self.pages.into_iter().for_each(|page| page.join().unwrap());
        self.answers.load(Ordering::Relaxed)
    }
}

/// A page, over one connection.
struct Page {
    connection: BufReader<TcpStream>,
    head: String,
    answers: usize,
}

impl Page {
    fn open(address: &str, token: &str) -> Page {
        let connection = BufReader::new(TcpStream::connect(address).unwrap());
        let head = format!("HTTP/1.1\r\nHost: {address}\r\nAuthorization: Bearer {token}\r\n\r\n");
        Page { connection, head, answers: 0 }
    }

    fn get(&mut self, question: &str) -> Value {
        let request = format!("GET /api/{question} {}", self.head);
        self.connection.get_mut().write_all(request.as_bytes()).unwrap();
        let (mut length, mut line) = (0, String::new());
        while line != "\r\n" {
            line.clear();
            assert!(self.connection.read_line(&mut line).unwrap() > 0, "the dashboard has hung up");
            if let Some(said) = line.to_lowercase().strip_prefix("content-length:") {
                length = said.trim().parse().unwrap();
            }
        }
        let mut body = vec![0; length];
        self.connection.read_exact(&mut body).unwrap();
        serde_json::from_slice(&body).unwrap()
    }

    fn look(mut self, asks: Asks, ends: &AtomicBool, answers: &AtomicUsize) {
        let (mut log, mut slow) = (None, None::<Instant>);
        let (mut frame, mut cell) = ((0, 0), (0, 0));
        while !ends.load(Ordering::Relaxed) {
            let due = slow.is_none_or(|slow| slow.elapsed() >= SLOW);
            if due {
                slow = Some(Instant::now());
                let about = self.get("about");
                let logs = about["logs"].as_array().unwrap();
                let live = logs.iter().find(|one| one["live"] == true).or(logs.last());
                log = live.and_then(|one| one["id"].as_u64());
            }
            let mut pause = PERIOD;
            if let Some(log) = log {
                let told = self.get(&format!("run?log={log}&epoch={}&version={}", frame.0, frame.1));
                frame = known(&told);
                self.answers += 1;
                if told["more"] == true {
                    pause = Duration::ZERO;
                }
                match asks {
                    Asks::EachTime(what) => {
                        cell = known(&self.get(&format!("{what}?log={log}&epoch={}&version={}", cell.0, cell.1)));
                    }
                    Asks::Slowly("system") if due => drop(self.get("system")),
                    Asks::Slowly(what) if due => drop(self.get(&format!("{what}?log={log}&epoch={}", frame.0))),
                    Asks::Slowly(_) | Asks::NothingMore => {}
                }
            }
            std::thread::sleep(pause);
        }
        answers.fetch_add(self.answers, Ordering::Relaxed);
    }
}

/// Which fold, and up to which change of it.
fn known(told: &Value) -> (u64, u64) {
    (told["epoch"].as_u64().unwrap_or_default(), told["version"].as_u64().unwrap_or_default())
}
