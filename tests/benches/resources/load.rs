//! A manager that has much: 100,000 resources and 10,000 waiters, beside an empty one.

use super::line::{Line, block, create, exists};
use super::process::{Process, connect, manager};
use super::times::Times;
use futures::StreamExt;
use futures::stream::FuturesUnordered;
use ratn_proto::v1::resource_service_client::ResourceServiceClient;
use ratn_proto::v1::session_request::Kind as Asked;
use ratn_proto::v1::{self, ExplainRequest};
use std::path::Path;
use std::time::Instant;
use tonic::transport::Channel;

/// A little below the limits of resources and waiters.
const KINDS: usize = 999;
const OF_EACH: usize = 100;
/// Every waiter asks for all of a kind of which somebody has one.
const SESSIONS: usize = 10;
const WAITERS_OF_EACH: usize = 999;
/// Calls at once while it is filled.
const TOGETHER: usize = 64;
const CALLS: usize = 100;
const TURNS: usize = 5;

pub(crate) async fn measure(directory: &Path, note: &mut impl FnMut(&str, f64)) {
    let place = directory.join("crowd");
    let (_empty, empty) = manager(&directory.join("nobody"), "none").await;
    let (process, crowded) = manager(&place, "none").await;
    let (empty, channel) = (connect(&empty).await, connect(&crowded).await);
    let mut idle = line(&empty).await;
    let mut busy = line(&channel).await;
    let before = process.resident_bytes();
    fill(&channel).await;
    note("resource_bytes", ((process.resident_bytes() - before) / (KINDS * OF_EACH) as f64).round());
    let _waiting = wait(&channel).await;

    let [mut idle_times, mut busy_times, mut one, mut hundred] = <[Times; 4]>::default();
    let mut client = ResourceServiceClient::new(channel.clone());
    for turn in 0..TURNS {
        for call in 0..CALLS {
            for (line, times) in [(&mut idle, &mut idle_times), (&mut busy, &mut busy_times)] {
                let began = Instant::now();
                let lease = line.block("Arm", turn * CALLS + call).await;
                times.add(began);
                line.release(lease).await;
            }
        }
        for call in 0..CALLS {
            for (request_id, times) in [(format!("crowd-3/{call}"), &mut one), (String::new(), &mut hundred)] {
                let began = Instant::now();
                let waiting = client.explain(ExplainRequest { request_id }).await.unwrap().into_inner().waiting;
                times.add(began);
                assert!(waiting.iter().all(|waiter| !waiter.obstacles.is_empty()) && !waiting.is_empty());
            }
        }
    }
    note("empty_stream_block_p50_us", idle_times.at(0.5));
    note("crowded_stream_block_p50_us", busy_times.at(0.5));
    note("explain_one_p50_us", one.at(0.5));
    note("explain_hundred_p50_us", hundred.at(0.5));
    // What the writing thread still had is on its way to the system after some milliseconds.
    tokio::time::sleep(std::time::Duration::from_millis(200)).await;
    drop(process);
    std::fs::remove_file(place.join("resource-manager.endpoint")).unwrap();
    let began = Instant::now();
    let (_process, restarted): (Process, _) = manager(&place, "none").await;
    let channel = connect(&restarted).await;
    assert!(exists(&channel, &kind(KINDS - 1)).await, "it is there again");
    note("restart_100000_resources_ms", (began.elapsed().as_secs_f64() * 1e4).round() / 10.0);
}

async fn line(channel: &Channel) -> Line {
    let line = Line::open(channel.clone(), "bench").await;
    create(&mut ResourceServiceClient::new(channel.clone()), "bench", "Arm").await;
    line
}

fn kind(number: usize) -> String {
    format!("Kind{number}")
}

/// Almost 100,000 resources.
async fn fill(channel: &Channel) {
    let work = (0..TOGETHER).map(|first| {
        let mut client = ResourceServiceClient::new(channel.clone());
        tokio::spawn(async move {
            for number in (first..KINDS * OF_EACH).step_by(TOGETHER) {
                let resource = v1::Resource {
                    id: format!("resource-{number}@compute"),
                    class: v1::ResourceClass::Module.into(),
                    kind: kind(number % KINDS),
                    capacity: 1.0,
                    host: "compute".to_owned(),
                    ..Default::default()
                };
                let (request_id, session_id) = (format!("create/{number}"), "bench".to_owned());
                let request = v1::CreateRequest { request_id, session_id, resource: Some(resource) };
                client.create(request).await.unwrap();
            }
        })
    });
    let work: FuturesUnordered<_> = work.collect();
    work.for_each(|done| async { done.unwrap() }).await;
}

/// Almost 10,000 waiters in ten sessions; they leave with the lines.
async fn wait(channel: &Channel) -> Vec<Line> {
    let mut lines = Vec::new();
    for session in 0..SESSIONS {
        let name = format!("crowd-{session}");
        let mut line = Line::open(channel.clone(), &name).await;
        for waiter in 0..WAITERS_OF_EACH {
            let wanted = kind(waiter % KINDS);
            if session == 0 {
                line.block(&wanted, 0).await;
            }
            let mut asked = block(&name, &wanted, waiter);
            asked.request_id = format!("{name}/{waiter}");
            asked.deadline_ms = 600_000;
            if let Some(requirement) = &mut asked.requirement {
                requirement.count = OF_EACH as f64;
            }
            line.say(1_000_000 + waiter, Asked::Block(asked)).await;
        }
        lines.push(line);
    }
    // They have all arrived when somebody counts them.
    let mut client = ResourceServiceClient::new(channel.clone());
    let began = Instant::now();
    while client.explain(ExplainRequest::default()).await.unwrap().into_inner().total
        < (SESSIONS * WAITERS_OF_EACH) as u32
    {
        assert!(began.elapsed().as_secs() < 30, "waiters are missing");
        tokio::time::sleep(std::time::Duration::from_millis(20)).await;
    }
    lines
}
