//! Spans of a run, of the daemons and of the workers at an OpenTelemetry collector: one trace, whatever the collector does.

mod support;

use anyhow::{Context, ensure};
use http_body_util::BodyExt;
use hyper::body::Incoming;
use hyper::server::conn::http1;
use hyper::service::service_fn;
use hyper::{Request, Response};
use hyper_util::rt::TokioIo;
use ratn_otlp::{Decoded, decode};
use std::collections::{BTreeMap, BTreeSet};
use std::convert::Infallible;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Instant;
use support::{Place, repository, wait_for};
use tokio::net::TcpListener;

/// The run's own span.
const ROOT: &str = "0000000000000001";

/// Stores what it is sent; one that hangs reads it and does not answer.
struct Collector {
    address: SocketAddr,
    spans: Arc<Mutex<Vec<Decoded>>>,
    _runtime: tokio::runtime::Runtime,
}

impl Collector {
    fn start(hangs: bool) -> anyhow::Result<Collector> {
        let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(1).enable_all().build()?;
        let listener = runtime.block_on(TcpListener::bind("127.0.0.1:0"))?;
        let (address, spans) = (listener.local_addr()?, Arc::new(Mutex::new(Vec::new())));
        let kept = Arc::clone(&spans);
        runtime.spawn(async move {
            while let Ok((connection, _)) = listener.accept().await {
                let kept = Arc::clone(&kept);
                tokio::spawn(async move {
                    let take = service_fn(|request| take(request, &kept, hangs));
                    let _ = http1::Builder::new().serve_connection(TokioIo::new(connection), take).await;
                });
            }
        });
        Ok(Collector { address, spans, _runtime: runtime })
    }

    fn spans(&self) -> Vec<Decoded> {
        self.spans.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }
}

async fn take(
    request: Request<Incoming>,
    kept: &Mutex<Vec<Decoded>>,
    hangs: bool,
) -> Result<Response<String>, Infallible> {
    let (is_traces, has_key) = (request.uri().path() == "/v1/traces", request.headers().contains_key("x-key"));
    let body = request.into_body().collect().await.map(|body| body.to_bytes()).unwrap_or_default();
    if hangs {
        std::future::pending::<()>().await;
    }
    if let (true, true, Ok(spans)) = (is_traces, has_key, decode(&body)) {
        kept.lock().unwrap_or_else(PoisonError::into_inner).extend(spans);
        return Ok(Response::new(String::new()));
    }
    let mut refused = Response::new(String::new());
    *refused.status_mut() = hyper::StatusCode::BAD_REQUEST;
    Ok(refused)
}

/// The config of the repository, with a collector.
fn config(place: &Place, endpoint: &str) -> anyhow::Result<PathBuf> {
    let config = std::fs::read_to_string(repository("deploy/ratn.toml"))?;
    let otlp = format!("\n[service.otlp]\nendpoint = \"{endpoint}\"\nheaders = {{ x-key = \"open\" }}\n");
    let file = place.path().join("ratn.toml");
    std::fs::write(&file, config + &otlp)?;
    Ok(file)
}

/// Of a trace, and in it.
type Id = (String, String);
type Links = BTreeSet<String>;

/// Where a span stands: its parent, and what it is linked to.
fn in_trace(span: &Decoded) -> (Id, (String, Links)) {
    let links = span.links.iter().cloned().collect();
    ((span.trace.clone(), span.id.clone()), (span.parent.clone(), links))
}

/// The spans that the export of a log has.
fn exported(place: &Place, log: &Path) -> anyhow::Result<BTreeMap<Id, (String, Links)>> {
    let exported = place.path().join("log.otlp");
    let (from, to) = (log.to_str().context("a path")?, exported.to_str().context("a path")?);
    let (code, _, said) = place.start_as("export", &["export", "otlp", from, "-o", to])?.finish()?;
    ensure!(code == Some(0), "{said}");
    let mut of_log = BTreeMap::new();
    for line in std::fs::read_to_string(&exported)?.lines() {
        let request: serde_json::Value = serde_json::from_str(line)?;
        let spans = request["resourceSpans"][0]["scopeSpans"][0]["spans"].as_array().context("spans")?;
        for span in spans {
            let text = |name: &str| span[name].as_str().unwrap_or_default().to_owned();
            let links = span["links"].as_array().into_iter().flatten();
            let links = links.filter_map(|link| link["spanId"].as_str()).map(str::to_owned).collect();
            of_log.insert((text("traceId"), text("spanId")), (text("parentSpanId"), links));
        }
    }
    Ok(of_log)
}

/// Runs a task to its end; what it said, and where its log is.
fn run(place: &Place, endpoint: Option<&str>) -> anyhow::Result<(String, PathBuf)> {
    let (task, log) = (repository("examples/fetch_boxes.yaml"), place.path().join("log.jsonl"));
    let (task, log_name) = (task.to_str().context("a path")?, log.to_str().context("a path")?);
    let mut arguments = vec!["run", task, "--set", "boxes=1", "--speed", "50", "--log", log_name];
    let config = endpoint.map(|endpoint| config(place, endpoint)).transpose()?;
    let config = config.as_ref().and_then(|config| config.to_str());
    arguments.extend(config.into_iter().flat_map(|config| ["--config", config]));
    let (code, _, said) = place.start(&arguments)?.finish()?;
    ensure!(code == Some(0), "{code:?}\n{said}");
    Ok((said, log))
}

#[test]
fn a_run_its_acquires_projections_and_goals_are_one_trace() -> anyhow::Result<()> {
    let (place, collector) = (Place::new()?, Collector::start(false)?);
    let (said, log) = run(&place, Some(&format!("http://{}", collector.address)))?;
    ensure!(!said.contains("OTLP"), "{said}");
    let spans = collector.spans();
    let roots: Vec<&Decoded> = spans.iter().filter(|span| span.id == ROOT).collect();
    let [root] = roots[..] else { anyhow::bail!("{} spans of a run: {spans:?}", roots.len()) };
    ensure!(root.service == "ratn" && root.parent.is_empty() && root.error.is_none(), "{root:?}");

    // What the run sends is what the export of its log has, and each span once.
    let of_log = exported(&place, &log)?;
    let own: Vec<&Decoded> = spans.iter().filter(|span| span.service == "ratn").collect();
    let of_run: BTreeMap<Id, (String, Links)> = own.iter().map(|span| in_trace(span)).collect();
    ensure!(of_run.len() == own.len(), "a span was sent twice");
    ensure!(of_run == of_log, "{of_run:?}\n{of_log:?}");
    ensure!(of_run.values().any(|(_, links)| !links.is_empty()), "no node waited for another");

    // What the others did for a node is its child, there and then.
    let nodes: BTreeMap<&str, &Decoded> =
        own.iter().filter(|span| span.parent == ROOT).map(|span| (span.id.as_str(), *span)).collect();
    for (service, name) in [
        ("ratn-resource-manager", "ratn.v1.ResourceService/Acquire"),
        ("ratn-resource-manager", "ratn.v1.ResourceService/Release"),
        ("ratn-world-pool", "ratn.v1.WorldPoolService/Project"),
        ("ratn-world-pool", "ratn.v1.WorldPoolService/Commit"),
        ("ratn-cell", "ratn.v1.ActionService/Execute"),
        ("ratn-worker", "ratn.v1.ActionService/Execute"),
    ] {
        let these = |span: &&Decoded| span.service == service && span.name == name;
        let these: Vec<&Decoded> = spans.iter().filter(these).collect();
        // What the task begins and ends with is committed by the run itself.
        let these: Vec<&Decoded> =
            these.into_iter().filter(|span| span.parent != ROOT || !name.ends_with("/Commit")).collect();
        ensure!(!these.is_empty(), "no {name} of {service} for a node");
        for span in these {
            // A goal may give another one: the detector asks the cell for a picture.
            let mut parent = span.parent.as_str();
            while !nodes.contains_key(parent)
                && let Some(between) = spans.iter().find(|span| span.id == parent && span.name.ends_with("/Execute"))
            {
                parent = &between.parent;
            }
            let node = nodes.get(parent).with_context(|| format!("no node is the parent of {span:?}"))?;
            ensure!(span.trace == root.trace && span.time_unix_ns.0 <= span.time_unix_ns.1, "{span:?}");
            // To a tenth of a second: clocks are read one after the other.
            ensure!(span.time_unix_ns.0 + 100_000_000 >= node.time_unix_ns.0, "{span:?} began before {node:?}");
        }
    }
    // Nothing hangs in the air.
    let known: BTreeSet<&str> = spans.iter().map(|span| span.id.as_str()).collect();
    let astray =
        spans.iter().find(|span| span.trace == root.trace && !span.parent.is_empty() && !known.contains(&*span.parent));
    ensure!(astray.is_none(), "{astray:?} has no parent");
    Ok(())
}

/// First what a run has left behind it for seconds when its task control is killed, then what it is in the middle of.
const KILLED: &str = "\
task: killed
variables:
  left: 300
states:
  - count:
      while: $left > 0
      do:
        - one: { wait: { seconds: 0 }, assign: { left: $left - 1 } }
  - long_after: { wait: { seconds: 200 } }
  - look: { action: gripper/release, pia: true, reads: [], effects: [], resources: [Gripper] }
  - go: { wait: { signal: go } }
  - end: { action: gripper/release, pia: true, reads: [], effects: [], resources: [Gripper] }
";

#[test]
fn a_run_that_goes_on_after_its_task_control_was_killed_goes_on_in_its_trace() -> anyhow::Result<()> {
    let (place, collector) = (Place::new()?, Collector::start(false)?);
    let config = config(&place, &format!("http://{}", collector.address))?;
    let config = config.to_str().context("a path")?;
    let directory = place.path().join("run");
    let directory = directory.to_str().context("a path")?;
    let up = ["up", "--runtime-dir", directory, "--config", config, "--speed", "50"];
    let up = place.start_as("up", &up)?;
    wait_for("the system", || Ok(up.said().contains("is ready").then_some(()))).with_context(|| up.said())?;
    let (task, log) = (place.path().join("killed.yaml"), place.path().join("log.jsonl"));
    std::fs::write(&task, KILLED)?;
    let (task, log_name) = (task.to_str().context("a path")?, log.to_str().context("a path")?);
    let run = place.start_as("run", &["run", task, "--log", log_name, "--checkpoint-every", "2"])?;
    let waits = || Ok(std::fs::read_to_string(&log).unwrap_or_default().contains("\"signal\":\"go\"").then_some(()));
    wait_for("the wait for the signal", waits).with_context(|| run.said())?;
    // It is made beside the run, a moment later.
    let checkpoint = || {
        let files: Result<Vec<_>, _> = std::fs::read_dir(place.path())?.collect();
        Ok(files?.iter().any(|file| file.file_name().to_string_lossy().ends_with(".checkpoint")).then_some(()))
    };
    wait_for("a checkpoint", checkpoint).with_context(|| run.said())?;
    run.process()?.kill()?;
    drop(run);
    let before: Vec<Decoded> = collector.spans().into_iter().filter(|span| span.service == "ratn").collect();
    ensure!(!before.is_empty() && before.iter().all(|span| span.id != ROOT), "{before:?}");

    let mut again = place.start_as("again", &["run", "--resume", log_name])?;
    wait_for("the run to go on", || {
        Ok(std::fs::read_to_string(&log)?.contains("\"event\":\"resumed\"").then_some(()))
    })?;
    let mut signal = place.start_as("signal", &["signal", "killed", "go"])?;
    let (code, _, said) = signal.finish()?;
    ensure!(code == Some(0), "{said}");
    let (code, _, said) = again.finish()?;
    ensure!(code == Some(0) && said.contains("a checkpoint after") && !said.contains("OTLP"), "{code:?}: {said}");

    // Together both have sent what the export of the log has, in one trace, and nothing twice that was sent long before.
    let spans = collector.spans();
    let of_run: Vec<&Decoded> = spans.iter().filter(|span| span.service == "ratn").collect();
    let own: BTreeMap<Id, (String, Links)> = of_run.iter().map(|span| in_trace(span)).collect();
    let of_log = exported(&place, &log)?;
    ensure!(own == of_log, "{own:?}\n{of_log:?}");
    let roots: Vec<&&Decoded> = of_run.iter().filter(|span| span.id == ROOT).collect();
    let [root] = roots[..] else { anyhow::bail!("{} spans of the run", roots.len()) };
    ensure!(own.keys().all(|(trace, _)| *trace == root.trace), "more than one trace");
    // The last node ends after the one before the kill, and the run is around all of them.
    let is_squashed = |span: &Decoded| span.attributes.iter().any(|(_, value)| value == "squashed");
    let node = |name: &str| {
        let node = of_run.iter().find(|span| span.name == name && !is_squashed(span));
        node.with_context(|| format!("no span of {name}"))
    };
    // What ended a moment before the kill may have left the killed process, and is sent again with the same id.
    let long_after = node("long_after")?;
    let mut seen = BTreeSet::new();
    let twice = of_run.iter().filter(|span| !seen.insert((&span.trace, &span.id)));
    let long_ago: Vec<_> = twice.filter(|span| span.time_unix_ns.1 < long_after.time_unix_ns.1).collect();
    ensure!(long_ago.is_empty(), "{} spans of {} were sent twice: {long_ago:?}", long_ago.len(), own.len());
    let (look, end) = (node("look")?, node("end")?);
    ensure!(look.time_unix_ns.1 <= end.time_unix_ns.1, "{look:?} {end:?}");
    ensure!(of_run.iter().all(|span| span.time_unix_ns.0 >= root.time_unix_ns.0), "{root:?}");
    let served = |node: &Decoded| {
        let of_node =
            |span: &&Decoded| span.name.ends_with("/Execute") && span.trace == root.trace && span.parent == node.id;
        collector.spans().iter().find(of_node).cloned()
    };
    for node in [look, end] {
        // The system goes on, and sends its spans when it has some.
        let goal = wait_for("the span of its goal", || Ok(served(node))).with_context(|| format!("of {node:?}"))?;
        ensure!(goal.time_unix_ns.0 + 100_000_000 >= node.time_unix_ns.0, "{goal:?} began before {node:?}");
        ensure!(goal.time_unix_ns.1 <= node.time_unix_ns.1 + 100_000_000, "{goal:?} ended after {node:?}");
    }
    Ok(())
}

#[test]
fn a_collector_that_hangs_does_not_delay_a_run() -> anyhow::Result<()> {
    let began = Instant::now();
    run(&Place::new()?, None)?;
    let without_s = began.elapsed().as_secs_f64();
    let (place, collector) = (Place::new()?, Collector::start(true)?);
    let began = Instant::now();
    run(&place, Some(&format!("http://{}", collector.address)))?;
    let with_s = began.elapsed().as_secs_f64();
    // At its end 2 s for the run and half a second for each of the processes that it ends; the rest is the machine's.
    ensure!(with_s < without_s + 2.0 + 2.0 + without_s / 2.0, "{with_s} s, and {without_s} s without a collector");
    Ok(())
}

#[test]
fn a_collector_that_is_away_is_said_once() -> anyhow::Result<()> {
    let place = Place::new()?;
    let free = std::net::TcpListener::bind("127.0.0.1:0")?.local_addr()?;
    let (said, _) = run(&place, Some(&format!("http://{free}")))?;
    let lines: Vec<&str> = said.lines().filter(|line| line.contains("OTLP collector")).collect();
    let [line] = lines[..] else { anyhow::bail!("{} lines:\n{said}", lines.len()) };
    ensure!(line.contains(&format!("http://{free}/v1/traces")) && line.contains("cannot connect"), "{line}");
    Ok(())
}

#[test]
fn a_daemon_says_in_its_metrics_what_became_of_its_spans() -> anyhow::Result<()> {
    let place = Place::new()?;
    let free = std::net::TcpListener::bind("127.0.0.1:0")?.local_addr()?;
    let config = config(&place, &format!("http://{free}"))?;
    let config = config.to_str().context("a path")?;
    let metrics = std::net::TcpListener::bind("127.0.0.1:0")?.local_addr()?.to_string();
    let manager = place.start(&["resource-manager", "--config", config, "--metrics", &metrics])?;
    wait_for("the manager", || Ok(manager.said().contains("is ready").then_some(())))?;
    // Every command is a trace of its own.
    let (code, _, said) = place.start_as("list", &["resource", "list"])?.finish()?;
    ensure!(code == Some(0), "{said}");
    let page = wait_for("spans that are dropped", || {
        use std::io::{Read, Write};
        let mut connection = std::net::TcpStream::connect(&metrics)?;
        connection.write_all(b"GET /metrics HTTP/1.1\r\nHost: here\r\n\r\n")?;
        let mut page = String::new();
        connection.read_to_string(&mut page)?;
        let dropped = page.lines().find_map(|line| line.strip_prefix("ratn_otlp_spans_dropped_total "));
        Ok(dropped.is_some_and(|count| count != "0").then_some(page.clone()))
    })?;
    ensure!(page.contains("ratn_otlp_spans_sent_total 0"), "{page}");
    let said = manager.said();
    ensure!(said.matches("OTLP collector").count() == 1, "{said}");
    Ok(())
}

#[test]
fn an_endpoint_that_is_none_is_refused_with_what_to_write() -> anyhow::Result<()> {
    let place = Place::new()?;
    let config = config(&place, "https://collector:4318")?;
    let config = config.to_str().context("a path")?;
    let (code, _, said) = place.start(&["world-pool", "--config", config, "--check-config"])?.finish()?;
    ensure!(code == Some(2), "{code:?}: {said}");
    for part in ["ratn.toml", "otlp.endpoint", "is https", "http://127.0.0.1:4318"] {
        ensure!(said.contains(part), "`{part}` is not in: {said}");
    }
    Ok(())
}
