//! One round: daemons, clients and a story of faults from a seed; then everything heals, everybody ends, and the history is checked.

use super::asking::channel;
use super::clients::{self, Client};
use super::exclusion::{self, Measured};
use super::history::{History, Record};
use super::line::{DOWN, Line, UP};
use super::manager::{Faults, Manager, Shim};
use super::model::{Pool, STOCK};
use super::provider::{KIND, TTL, Tool};
use super::search::{Verdict, search};
use crate::support::crashes::Random;
use anyhow::{Context, ensure};
use nix::sys::signal::Signal;
use ratn_model::resource::{Quantity, ResourceClass};
use ratn_proto::types::{Resource, ResourceEventKind, ResourceUpdate};
use ratn_proto::v1;
use ratn_proto::v1::resource_service_client::ResourceServiceClient;
use ratn_worker::client::{CallError, Channels, ResourceClient};
use ratn_worker::endpoint::Endpoint;
use ratn_worker::tls::ClientTls;
use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;
use tokio::task::JoinSet;
use tokio::time::Instant;
use tokio_util::sync::CancellationToken;

pub(crate) const CLIENTS: usize = 5;
/// Lines of each client: two to the manager, one to the provider. The last line of all is the provider's to the manager.
const LINES: usize = 3;
/// How long clients work while there are faults.
const STORY: Duration = Duration::from_millis(900);
/// How long it may take until everybody has an answer once nothing is wrong any more.
const PATIENCE: Duration = Duration::from_secs(30);
const AGAIN: Duration = Duration::from_millis(5);
/// States that the search looks at; a history for which these do not suffice counts as undecided, and is no proof of anything.
const MOST_STATES: usize = 40_000;
/// What a busy machine adds to the time that the provider takes to notice.
const SLACK: Duration = Duration::from_secs(1);
/// Calls that are shown of every thread where there is no order.
const SHOWN: usize = 4;

/// Something that goes wrong, and for how long.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Fault {
    KillManager,
    StopManager,
    KillProvider,
    StopProvider,
    /// Nothing of the directions arrives.
    Hold {
        line: usize,
        up: bool,
        down: bool,
    },
    /// Both directions take so many milliseconds.
    Delay {
        line: usize,
        up: u64,
        down: u64,
    },
    Cut {
        line: usize,
    },
    LoseAnswer {
        line: usize,
    },
    /// Every sync takes so many milliseconds.
    SlowDisk {
        ms: i64,
    },
    /// Every sync fails, or every write; then the manager is killed and started again.
    FailSync,
    FailWrite,
    /// The clock of the day is wrong by so many seconds from now on.
    ClockStep {
        seconds: i64,
    },
}

/// A fault with when it begins and ends, in milliseconds of the round.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Planned {
    begin: u64,
    end: u64,
    fault: Fault,
}

/// What came of a round.
#[derive(Debug, Default)]
pub(crate) struct Outcome {
    pub(crate) counts: BTreeMap<String, usize>,
    pub(crate) measured: Measured,
    pub(crate) calls: usize,
    /// That were looked at until there was an order; none where none was found in the most that are looked at.
    pub(crate) states: Option<usize>,
}

/// The story of a seed.
pub(crate) fn story(seed: u64, shim: bool) -> Vec<Planned> {
    let mut random = Random(seed.wrapping_mul(0x9E37_79B9_7F4A_7C15) | 1);
    let lines = (CLIENTS * LINES + 1) as u64;
    let faults = 3 + random.below(6);
    let mut planned: Vec<Planned> = (0..faults)
        .filter_map(|_| {
            let begin = random.below(STORY.as_millis() as u64);
            let length = 20 + random.below(600);
            let line = random.below(lines) as usize;
            let fault = match random.below(18) {
                0..3 => Fault::KillManager,
                3..6 => Fault::StopManager,
                6 => Fault::KillProvider,
                7..9 => Fault::StopProvider,
                9..11 => Fault::Hold { line, up: random.below(3) > 0, down: random.below(3) > 0 },
                11 => Fault::Delay { line, up: random.below(40), down: random.below(40) },
                12 => Fault::Cut { line },
                13 | 14 => Fault::LoseAnswer { line },
                15 if shim => Fault::SlowDisk { ms: 1 + random.below(300) as i64 },
                16 if shim && random.below(2) == 0 => Fault::FailSync,
                16 if shim => Fault::FailWrite,
                17 if shim => Fault::ClockStep { seconds: random.below(200_000) as i64 - 100_000 },
                _ => return None,
            };
            Some(Planned { begin, end: begin + length, fault })
        })
        .collect();
    planned.sort_by_key(|planned| planned.begin);
    planned
}

/// The daemons of a round.
struct Stage {
    manager: Manager,
    tool: Tool,
    lines: Vec<Arc<Line>>,
    record: Arc<Record>,
}

impl Stage {
    async fn set(shim: Shim, record: Arc<Record>) -> anyhow::Result<Stage> {
        let manager = Manager::start(shim)?;
        let tool_line = Arc::new(Line::to(manager.socket()).await?);
        let tool = Tool::start(manager.place(), tool_line.endpoint.clone())?;
        let mut lines = Vec::new();
        for _ in 0..CLIENTS {
            lines.push(Arc::new(Line::to(manager.socket()).await?));
            lines.push(Arc::new(Line::to(manager.socket()).await?));
            lines.push(Arc::new(Line::to(tool.socket()).await?));
        }
        lines.push(tool_line);
        Ok(Stage { manager, tool, lines, record })
    }

    fn endpoint(&self) -> Endpoint {
        Endpoint::Unix(self.manager.socket())
    }

    /// What there is at the beginning, and the tool.
    async fn stock(&self) -> anyhow::Result<()> {
        let channels = Channels::new(&ClientTls::none());
        let operator = ResourceClient::new(&channels, &self.endpoint(), "")?;
        for (id, capacity) in STOCK {
            let kind = id[..1].to_uppercase();
            let resource =
                Resource::new(id, ResourceClass::Module, &kind).with_capacity(Quantity::from_thousandths(capacity));
            let resource = if kind == "C" { resource.divisible().non_renewable() } else { resource };
            within("the stock", async {
                while operator.create_once(id, resource.clone()).await.is_err() {
                    channels.forget(&self.endpoint());
                    tokio::time::sleep(AGAIN).await;
                }
                Ok(())
            })
            .await?;
        }
        within("the tool", async {
            while !operator.list(&[KIND]).await.is_ok_and(|tools| !tools.is_empty()) {
                tokio::time::sleep(AGAIN).await;
            }
            Ok(())
        })
        .await
        .context(self.tool.said())
    }

    fn begin(&mut self, fault: Fault) -> anyhow::Result<()> {
        self.record.count(name(fault));
        match fault {
            Fault::KillManager => self.manager.kill(),
            Fault::StopManager => self.manager.signal(Signal::SIGSTOP),
            Fault::KillProvider => self.tool.kill(),
            Fault::StopProvider => self.tool.signal(Signal::SIGSTOP),
            Fault::Hold { line, up, down } => {
                self.lines[line].change(|trouble| {
                    trouble.held[UP] |= up;
                    trouble.held[DOWN] |= down;
                });
                Ok(())
            }
            Fault::Delay { line, up, down } => {
                self.lines[line].change(|trouble| trouble.delay = [up, down].map(Duration::from_millis));
                Ok(())
            }
            Fault::Cut { line } => {
                self.lines[line].change(|trouble| trouble.cuts += 1);
                Ok(())
            }
            Fault::LoseAnswer { line } => {
                self.lines[line].lose_answer();
                Ok(())
            }
            Fault::SlowDisk { ms } => self.manager.change(|faults| faults.sync_ms = ms),
            Fault::FailSync => self.manager.change(|faults| faults.sync_error = nix::libc::EIO.into()),
            Fault::FailWrite => self.manager.change(|faults| faults.write_error = nix::libc::ENOSPC.into()),
            Fault::ClockStep { seconds } => self.manager.change(|faults| faults.clock_s = seconds),
        }
    }

    fn end(&mut self, fault: Fault) -> anyhow::Result<()> {
        match fault {
            Fault::KillManager => self.manager.start_again(),
            Fault::StopManager => self.manager.signal(Signal::SIGCONT),
            Fault::KillProvider => self.tool.start_again(),
            Fault::StopProvider => self.tool.signal(Signal::SIGCONT),
            Fault::Hold { line, .. } | Fault::Delay { line, .. } => {
                self.lines[line].heal();
                Ok(())
            }
            Fault::SlowDisk { .. } => self.manager.change(|faults| faults.sync_ms = 0),
            Fault::FailSync | Fault::FailWrite => {
                self.manager.change(|faults| (faults.sync_error, faults.write_error) = (0, 0))?;
                // As an operator does where its health says that the disk has failed.
                self.manager.kill()?;
                self.manager.start_again()
            }
            Fault::Cut { .. } | Fault::LoseAnswer { .. } | Fault::ClockStep { .. } => Ok(()),
        }
    }

    async fn suffer(&mut self, story: &[Planned]) -> anyhow::Result<()> {
        let start = Instant::now();
        let mut moments: Vec<(u64, bool, Fault)> =
            story.iter().flat_map(|one| [(one.begin, true, one.fault), (one.end, false, one.fault)]).collect();
        moments.sort_by_key(|(at, begins, _)| (*at, *begins));
        for (at, begins, fault) in moments {
            tokio::time::sleep_until(start + Duration::from_millis(at)).await;
            if begins { self.begin(fault)? } else { self.end(fault)? }
        }
        tokio::time::sleep_until(start + STORY).await;
        Ok(())
    }

    /// Nothing is wrong any more.
    fn heal(&mut self) -> anyhow::Result<()> {
        self.manager.change(|faults| *faults = Faults { clock_s: faults.clock_s, ..Faults::default() })?;
        self.manager.signal(Signal::SIGCONT)?;
        self.tool.signal(Signal::SIGCONT)?;
        self.manager.start_again()?;
        self.tool.start_again()?;
        self.lines.iter().for_each(|line| line.heal());
        Ok(())
    }
}

fn name(fault: Fault) -> &'static str {
    match fault {
        Fault::KillManager => "manager killed",
        Fault::StopManager => "manager suspended",
        Fault::KillProvider => "provider killed",
        Fault::StopProvider => "provider suspended",
        Fault::Hold { up: true, down: true, .. } => "line held both ways",
        Fault::Hold { .. } => "line held one way",
        Fault::Delay { .. } => "line slow",
        Fault::Cut { .. } => "line cut",
        Fault::LoseAnswer { .. } => "answer lost",
        Fault::SlowDisk { .. } => "disk slow",
        Fault::FailSync => "sync failed",
        Fault::FailWrite => "write failed",
        Fault::ClockStep { .. } => "clock stepped",
    }
}

async fn within<T>(what: &str, work: impl Future<Output = anyhow::Result<T>>) -> anyhow::Result<T> {
    tokio::time::timeout(PATIENCE, work).await.with_context(|| format!("waited in vain for {what}"))?
}

/// Watches everything, so that it is known what was granted without an answer.
async fn observe(endpoint: Endpoint, record: Arc<Record>) {
    let mut position = None;
    loop {
        // One of its own every time: it is not to wait for a connection that broke.
        if let Ok(client) = ResourceClient::new(&Channels::new(&ClientTls::none()), &endpoint, "")
            && let Err(error) = follow(&client, &mut position, &record).await
            && error.code() == Some(tonic::Code::OutOfRange)
        {
            position = None;
        }
        tokio::time::sleep(AGAIN).await;
    }
}

async fn follow(
    client: &ResourceClient,
    position: &mut Option<ratn_proto::types::WatchPosition>,
    record: &Record,
) -> Result<(), CallError> {
    let mut watch = client.watch_from(&[], *position).await?;
    while let Some(update) = watch.next().await? {
        match update {
            ResourceUpdate::Snapshot { resources, .. } => {
                resources.into_iter().for_each(|resource| clients::saw(record, &v1::Resource::from(resource)));
            }
            ResourceUpdate::Event(event) => {
                if let Some(before) = position.filter(|before| event.revision <= before.revision)
                    && event.part == 0
                {
                    record.failed(format!("the watch told {event:?} after {before:?}"));
                }
                *position = Some(event.position());
                if event.kind == ResourceEventKind::Deleted && event.resource.kind == KIND {
                    record.open().tool_vanished = true;
                }
                clients::saw(record, &v1::Resource::from(event.resource));
            }
        }
    }
    Ok(())
}

/// Plays the round of a seed, and checks it.
pub(crate) async fn play(seed: u64, shim: Shim) -> anyhow::Result<Outcome> {
    let story = story(seed, shim.is_there());
    let record = Arc::new(Record::default());
    record.open().threads = vec![Vec::new(); 2 * CLIENTS + 1];
    let mut stage = Stage::set(shim, record.clone()).await?;
    let played = perform(&mut stage, &story, seed).await;
    let history = std::mem::take(&mut *record.open());
    let checked = played.and_then(|()| check(&history, &stage, &story));
    checked.with_context(|| {
        let story: Vec<String> = story.iter().map(|planned| format!("{planned:?}")).collect();
        let said = (stage.manager.said(), stage.tool.said());
        let file = std::env::temp_dir().join(format!("ratn-faults-{seed}.txt"));
        let whole = format!(
            "{}\n{history:#?}\nthe manager said:\n{}\nthe provider said:\n{}",
            story.join("\n"),
            said.0,
            said.1
        );
        let written = std::fs::write(&file, whole);
        format!("seed {seed}; the whole history: {} ({written:?})\n{}", file.display(), story.join("\n"))
    })
}

async fn perform(stage: &mut Stage, story: &[Planned], seed: u64) -> anyhow::Result<()> {
    stage.stock().await?;
    let (end, over) = (CancellationToken::new(), CancellationToken::new());
    let mut others = JoinSet::new();
    others.spawn(observe(stage.endpoint(), stage.record.clone()));
    let mut working = JoinSet::new();
    for number in 0..CLIENTS {
        let lines = &stage.lines[number * LINES..][..LINES];
        let client = Client::new(number, lines, stage.record.clone(), seed, end.clone())?;
        others.spawn(client.pinging(over.clone()));
        working.spawn(client.work());
    }
    stage.suffer(story).await?;
    stage.heal()?;
    end.cancel();
    within("the clients", async {
        while let Some(ended) = working.join_next().await {
            ended?;
        }
        Ok(())
    })
    .await?;
    // The last look: whatever the clients were told is there, and nothing else.
    let line = Line::to(stage.manager.socket()).await?;
    let mut rpc = ResourceServiceClient::new(channel(&line)?);
    within("the last look", async {
        while !clients::look(&mut rpc, PATIENCE, &stage.record, 2 * CLIENTS, 0).await {
            tokio::time::sleep(AGAIN).await;
        }
        Ok(())
    })
    .await?;
    over.cancel();
    others.shutdown().await;
    Ok(())
}

/// How long the tool may move under a lease after the next client was told that it holds it: as long as the provider's session lives
/// without the manager, and as long as it was suspended itself.
fn may_be_late(story: &[Planned]) -> Duration {
    let suspended = story.iter().filter(|one| one.fault == Fault::StopProvider).map(|one| one.end - one.begin);
    TTL + Duration::from_millis(suspended.sum()) + SLACK
}

fn check(history: &History, stage: &Stage, story: &[Planned]) -> anyhow::Result<Outcome> {
    ensure!(history.failures.is_empty(), "{:#?}", history.failures);
    let steps = stage.tool.steps()?;
    let (wrong, measured) = exclusion::check(&steps, history, may_be_late(story));
    ensure!(wrong.is_empty(), "{wrong:#?}\nholders of the tool:\n{}", exclusion::told(history));
    let states = explained(history)?;
    let counts = history.counts.iter().map(|(what, count)| ((*what).to_owned(), *count)).collect();
    let calls = history.threads.iter().map(Vec::len).sum();
    Ok(Outcome { counts, measured, calls, states })
}

/// How many states were looked at until there was an order; none where that is not decided.
fn explained(history: &History) -> anyhow::Result<Option<usize>> {
    let furthest = match search(&history.threads, Pool::new(history, clients::client_of), MOST_STATES) {
        Verdict::Explained { states } => return Ok(Some(states)),
        Verdict::Undecided => return Ok(None),
        Verdict::Impossible { furthest } => furthest,
    };
    let next = |(thread, at): (usize, &usize)| {
        let calls = &history.threads[thread];
        let shown = calls.iter().skip(at.saturating_sub(SHOWN)).take(2 * SHOWN);
        let calls: Vec<String> = shown.map(|timed| format!("    {timed:?}")).collect();
        format!("  thread {thread}, explained up to call {at}, around it:\n{}", calls.join("\n"))
    };
    let threads: Vec<String> = furthest.iter().enumerate().map(next).collect();
    let grants: Vec<String> = history.grants.iter().map(|grant| format!("  {grant:?}")).collect();
    let perhaps: Vec<String> = history.perhaps.iter().map(|timed| format!("  {timed:?}")).collect();
    anyhow::bail!(
        "no order of the calls explains their answers:\n{}\nperhaps:\n{}\ngrants that somebody saw:\n{}",
        threads.join("\n"),
        perhaps.join("\n"),
        grants.join("\n")
    )
}
