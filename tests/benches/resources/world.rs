//! What the world pool costs beside a bare echo of the same messages. Echo, projections and commits take turns.
//!
//! | key | what |
//! |---|---|
//! | `echo_project_…` | a request for a projection with 20 effects and its answer, of a bare echo |
//! | `project_…` | such a projection of a root with 10,000 facts; `…_ratio`: beside the echo's; `project_100_live_…`: beside 100 that live |
//! | `commit_…` | a commit of 3 facts without durability; `durable_commit_…` on the disk, `plain_sync_…` what that takes alone |
//! | `restart_ms` | from the start of the process to its first answer, with 10,000 facts and the commits of this run |

use crate::process::{self, connect};
use crate::times::{Times, plain_sync};
use crate::{CALLS, TURNS, echo};
use ratn_proto::v1::world_pool_service_client::WorldPoolServiceClient;
use ratn_proto::v1::{self, change, footprint, term, value};
use serde_json::json;
use std::path::Path;
use std::time::Instant;
use tonic::transport::Channel;

const FACTS: i64 = 10_000;
const EFFECTS: i64 = 20;
const LIVE: usize = 100;

type Pool = WorldPoolServiceClient<Channel>;

pub(crate) async fn measure() {
    let directory = tempfile::tempdir().unwrap();
    let mut report = serde_json::Map::new();
    let mut note = |key: &str, value: f64| drop(report.insert(key.to_owned(), json!(value)));
    latency(directory.path(), &mut note).await;
    println!("{}", serde_json::to_string_pretty(&report).unwrap());
}

async fn latency(directory: &Path, note: &mut impl FnMut(&str, f64)) {
    let (_echo, at) = process::echo();
    let mut bare = echo::Client::new(connect(&at).await);
    let (_volatile, at) = process::daemon("world-pool", &directory.join("volatile"), "none").await;
    let mut volatile = filled(&at).await;
    let (durable_pool, at) = process::daemon("world-pool", &directory.join("durable"), "group").await;
    let mut durable = filled(&at).await;
    let [mut echoed, mut projected, mut crowded] = <[Times; 3]>::default();
    let [mut committed, mut synced, mut durable_commit] = <[Times; 3]>::default();
    let mut number = 0;
    for turn in 0..TURNS {
        for _ in 0..CALLS {
            number += 1;
            let question = projection(number, turn);
            let began = Instant::now();
            bare.project(question).await;
            echoed.add(began);
        }
        for _ in 0..CALLS {
            number += 1;
            let question = projection(number, turn);
            let began = Instant::now();
            let id = volatile.project(question).await.unwrap().into_inner().projection_id;
            projected.add(began);
            release(&mut volatile, id).await;
        }
        let mut live = Vec::new();
        for _ in 0..LIVE {
            number += 1;
            live.push(volatile.project(projection(number, turn)).await.unwrap().into_inner().projection_id);
        }
        for _ in 0..CALLS {
            number += 1;
            let question = projection(number, turn);
            let began = Instant::now();
            let id = volatile.project(question).await.unwrap().into_inner().projection_id;
            crowded.add(began);
            release(&mut volatile, id).await;
        }
        for id in live {
            release(&mut volatile, id).await;
        }
        plain_sync(directory, CALLS, &mut synced);
        for call in 0..CALLS {
            let question = commit(format!("commit-{turn}-{call}"), 3, FACTS);
            let began = Instant::now();
            volatile.commit(question.clone()).await.unwrap();
            committed.add(began);
            let began = Instant::now();
            durable.commit(question).await.unwrap();
            durable_commit.add(began);
        }
    }
    note("echo_project_p50_us", echoed.at(0.5));
    note("project_p50_us", projected.at(0.5));
    note("project_p99_us", projected.at(0.99));
    note("project_ratio", (projected.at(0.5) / echoed.at(0.5) * 100.0).round() / 100.0);
    note("project_100_live_p50_us", crowded.at(0.5));
    note("commit_p50_us", committed.at(0.5));
    note("plain_sync_p50_us", synced.at(0.5));
    note("durable_commit_p50_us", durable_commit.at(0.5));
    note("durable_commit_p99_us", durable_commit.at(0.99));
    note("resident_mib", (durable_pool.resident_bytes() / f64::from(1 << 20)).round());
    drop(durable_pool);
    // A killed process leaves it behind.
    std::fs::remove_file(directory.join("durable/world-pool.endpoint")).unwrap();
    let began = Instant::now();
    let (_again, at) = process::daemon("world-pool", &directory.join("durable"), "group").await;
    Pool::new(connect(&at).await)
        .query(v1::QueryRequest { patterns: vec![only(1)], ..Default::default() })
        .await
        .unwrap();
    note("restart_ms", (began.elapsed().as_secs_f64() * 1e3).round());
}

/// With the facts of a root.
async fn filled(endpoint: &str) -> Pool {
    let mut pool = Pool::new(connect(endpoint).await);
    pool.commit(commit("facts".to_owned(), FACTS, 0)).await.unwrap();
    pool
}

async fn release(pool: &mut Pool, projection_id: u64) {
    pool.release(v1::WorldPoolServiceReleaseRequest { projection_id }).await.unwrap();
}

fn commit(commit_id: String, facts: i64, above: i64) -> v1::CommitRequest {
    v1::CommitRequest { commit_id, changes: (1..=facts).map(|n| set(above + n)).collect(), ..Default::default() }
}

/// Of the root as it is after so many turns.
fn projection(number: u64, turns: usize) -> v1::ProjectRequest {
    let patterns = v1::FactPatterns { patterns: (0..EFFECTS).map(only).collect() };
    v1::ProjectRequest {
        request_id: format!("run/i{number}/1"),
        base_revision: (1 + turns * CALLS) as u64,
        changes: (0..EFFECTS).map(set).collect(),
        reads: Some(v1::Footprint { kind: Some(footprint::Kind::Patterns(patterns)) }),
        ..Default::default()
    }
}

fn named(n: i64) -> v1::Term {
    v1::Term { kind: Some(term::Kind::Name(format!("box_{n}"))) }
}

fn only(n: i64) -> v1::FactPattern {
    v1::FactPattern { predicate: "at".to_owned(), arguments: vec![v1::PatternTerm { term: Some(named(n)) }] }
}

fn set(n: i64) -> v1::Change {
    let pose = v1::Pose { position_m: vec![n as f64, 0.5, 0.25], quaternion_xyzw: vec![0.0, 0.0, 0.0, 1.0] };
    let fact = v1::FactKey { predicate: "at".to_owned(), arguments: vec![named(n)] };
    let value = v1::Value { kind: Some(value::Kind::Pose(pose)) };
    v1::Change { kind: Some(change::Kind::Set(v1::SetFact { fact: Some(fact), value: Some(value) })) }
}
