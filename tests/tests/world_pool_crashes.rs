//! The world pool is killed at random moments under many committers: every commit is made whole or not at all, none that was
//! acknowledged is lost, none is made twice.
//!
//! `RATN_CRASHES` says how often (10), `RATN_SEED` which moments; `scripts/soak-world` does it 200 times. After every third kill the
//! end of the log is torn as well, as a write is that the machine did not finish.

mod support;

use anyhow::{Context, bail, ensure};
use ratn_model::fact::{Change, FactKey, FactPattern, Term};
use ratn_model::id::Revision;
use ratn_model::value::Value;
use ratn_worker::client::{CallError, Channels, WorldClient};
use ratn_worker::endpoint::Endpoint;
use ratn_worker::tls::ClientTls;
use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};
use support::crashes::{AGAIN, Daemon, PATIENCE, Random, number, wait_until};
use tokio_util::sync::CancellationToken;

const CLIENTS: usize = 16;
/// Every commit writes so many facts that have to agree.
const COPIES: u64 = 4;

/// What the clients were told.
#[derive(Debug, Default)]
struct Told {
    /// The last commit of each client that was acknowledged.
    acknowledged: BTreeMap<usize, i64>,
    /// The last that it asked for.
    asked: BTreeMap<usize, i64>,
    newest: Revision,
    commits: usize,
    /// Answers only got by asking again.
    repeated: usize,
}

type Shared = Arc<Mutex<Told>>;

fn told<T>(shared: &Shared, look: impl FnOnce(&mut Told) -> T) -> T {
    look(&mut shared.lock().unwrap_or_else(PoisonError::into_inner))
}

/// Asks until there is an answer: a pool that is not there is asked again.
async fn answered<T, F: Future<Output = Result<T, CallError>>>(
    mut ask: impl FnMut() -> F,
) -> anyhow::Result<(T, bool)> {
    let begin = Instant::now();
    let mut again = false;
    loop {
        match ask().await {
            Ok(answer) => return Ok((answer, again)),
            Err(error) if error.is_crash() && begin.elapsed() < PATIENCE => tokio::time::sleep(AGAIN).await,
            Err(error) => bail!("{error}"),
        }
        again = true;
    }
}

fn key(predicate: &str, arguments: &[i64]) -> FactKey {
    FactKey { predicate: predicate.to_owned(), arguments: arguments.iter().map(|n| Term::Int(*n)).collect() }
}

/// The same number in every copy, after what was there is gone, and one more in all.
fn changes(client: usize, round: i64) -> Vec<Change> {
    let client = client as i64;
    let every = FactPattern { predicate: "copy".to_owned(), arguments: vec![Some(Term::Int(client)), None] };
    let copies = (0..COPIES as i64).map(|n| Change::Set { fact: key("copy", &[client, n]), value: Value::Int(round) });
    let total = Change::Increase { fact: key("total", &[]), by: 1.0 };
    [Change::Delete { pattern: every }].into_iter().chain(copies).chain([total]).collect()
}

/// Commits, one after the other, until it is told to end.
async fn client(number: usize, endpoint: Endpoint, shared: Shared, end: CancellationToken) -> anyhow::Result<()> {
    let world = WorldClient::new(&Channels::new(&ClientTls::none()), &endpoint)?;
    let mut before: Option<(i64, Revision)> = None;
    for round in 1.. {
        if end.is_cancelled() {
            break;
        }
        told(&shared, |told| told.asked.insert(number, round));
        let commit = |round| {
            let world = world.clone();
            async move { world.commit(&format!("client-{number}/{round}"), changes(number, round), None).await }
        };
        let (revision, again) = answered(|| commit(round)).await?;
        told(&shared, |told| {
            told.acknowledged.insert(number, round);
            told.newest = told.newest.max(revision);
            told.commits += 1;
            told.repeated += usize::from(again);
        });
        if let Some((round, answer)) = before.filter(|_| again) {
            let (repeated, _) = answered(|| commit(round)).await?;
            ensure!(repeated == answer, "commit {round} of {number} made {answer}, and asked again {repeated}");
        }
        ensure!(before.is_none_or(|(_, before)| before < revision), "{revision} after {before:?}: it went back");
        before = Some((round, revision));
    }
    Ok(())
}

/// What the pool says now holds all that the clients were told, and nothing by halves or twice.
async fn verify(shared: &Shared, endpoint: &Endpoint) -> anyhow::Result<()> {
    let world = WorldClient::new(&Channels::new(&ClientTls::none()), endpoint)?;
    let (acknowledged, newest) = told(shared, |told| (told.acknowledged.clone(), told.newest));
    let ((revision, facts), _) = answered(|| world.root()).await?;
    let asked = told(shared, |told| told.asked.clone());
    ensure!(revision >= newest, "the root is at {revision}, and {newest} was acknowledged");
    let value: BTreeMap<FactKey, i64> = facts
        .into_iter()
        .map(|fact| match fact.value {
            Value::Int(whole) => Ok((fact.key, whole)),
            other => bail!("{} = {other}", fact.key),
        })
        .collect::<anyhow::Result<_>>()?;
    let mut sum = 0;
    for client in 0..CLIENTS {
        let made = value.get(&key("copy", &[client as i64, 0])).copied().unwrap_or(0);
        for copy in 0..COPIES as i64 {
            let has = value.get(&key("copy", &[client as i64, copy])).copied().unwrap_or(0);
            ensure!(has == made, "a commit of client {client} was made by halves: {made} and {has}");
        }
        let least = acknowledged.get(&client).copied().unwrap_or(0);
        ensure!(made >= least, "client {client}: {least} was acknowledged, and there is {made}");
        let most = asked.get(&client).copied().unwrap_or(0);
        ensure!(made <= most, "client {client}: {most} was asked for, and there is {made}");
        sum += made;
    }
    let total = value.get(&key("total", &[])).copied().unwrap_or(0);
    ensure!(total == sum, "{sum} commits were made, and the total is {total}: one was made twice");
    ensure!(revision == Revision(total as u64), "{total} commits made {revision}");
    Ok(())
}

#[tokio::test]
async fn a_pool_that_is_killed_again_and_again_makes_every_commit_whole_and_once_and_loses_none_acknowledged()
-> anyhow::Result<()> {
    let (crashes, seed) = (number("RATN_CRASHES", 10), number("RATN_SEED", 4_711));
    println!("{crashes} crashes, RATN_SEED={seed}");
    let mut random = Random(seed | 1);
    let mut pool = Daemon::new("world-pool")?;
    let (endpoint, shared, end) = (pool.endpoint.clone(), Shared::default(), CancellationToken::new());
    let mut clients = tokio::task::JoinSet::new();
    for number in 0..CLIENTS {
        clients.spawn(client(number, endpoint.clone(), shared.clone(), end.clone()));
    }
    let mut slowest = Duration::ZERO;
    for crash in 0..crashes {
        tokio::time::sleep(Duration::from_millis(20 + random.below(200))).await;
        pool.kill()?;
        if crash % 3 == 2 {
            pool.tear(&mut random)?;
        }
        let before = told(&shared, |told| told.commits);
        let begin = Instant::now();
        pool.start()?;
        verify(&shared, &endpoint).await.with_context(|| format!("after crash {crash}, {seed}: {}", pool.said()))?;
        slowest = slowest.max(begin.elapsed());
        wait_until(&mut clients, || told(&shared, |told| told.commits >= before + CLIENTS))
            .await
            .with_context(|| format!("after crash {crash}, {seed}: {}", pool.said()))?;
    }
    end.cancel();
    while let Some(ended) = clients.join_next().await {
        ended??;
    }
    verify(&shared, &endpoint).await?;
    let (commits, repeated) = told(&shared, |told| (told.commits, told.repeated));
    println!("{commits} commits, {repeated} answers by asking again, back within {} ms", slowest.as_millis());
    ensure!(repeated > 0, "no kill came in between");
    Ok(())
}
