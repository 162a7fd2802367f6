//! State and event logs that an earlier version wrote are read by this one; what a newer one wrote is refused with both versions named.
//!
//! `tests/fixtures/upgrade/VERSION` holds what VERSION wrote: `resource-manager` and `world-pool` (states, with a snapshot and records
//! after it), `run.jsonl` (an event log) and `expected.json` (what the daemons said of it then). `scripts/upgrade-fixture VERSION` makes
//! one more, before the formats of the next version change.

mod support;

use anyhow::{Context, ensure};
use nix::sys::signal::Signal;
use ratn_model::fact::{Change, FactKey, FactPattern, Term};
use ratn_model::id::Revision;
use ratn_model::measurement::{Certainty, Measurement};
use ratn_model::resource::{Lease, Quantity, Requirement, ResourceClass, ResourceOperation};
use ratn_model::value::Value;
use ratn_proto::types::Resource;
use ratn_storage::{Log, Options, Store};
use ratn_worker::client::{AcquireOptions, Channels, Commit, ResourceClient, WorldClient};
use ratn_worker::endpoint::Endpoint;
use ratn_worker::session::Session;
use ratn_worker::tls::ClientTls;
use serde_json::{Value as Json, json};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::time::Duration;
use support::{Place, Started, repository, texts, wait_for};

/// Where `scripts/upgrade-fixture` wants a fixture written.
const TARGET: &str = "RATN_UPGRADE_FIXTURE";
/// Longer than the test takes: sessions have their whole time once more after a restart.
const TTL: Duration = Duration::from_secs(60);
/// What every acquire waits for at the most.
const SOON: Duration = Duration::from_secs(20);
/// Small bounds, so that a few kilobytes of changes make a snapshot.
const CONFIG: &str = "[resource-manager.storage]\ncompact_bytes = 65536\n\
                      [world-pool]\nrevisions_kept = 4\nremembered_requests = 128\n\
                      [world-pool.storage]\ncompact_bytes = 65536\n";
const ROLES: [&str; 2] = ["resource-manager", "world-pool"];

/// Two daemons with a state in a place of their own.
struct System {
    place: Place,
    daemons: Vec<Started>,
}

impl System {
    fn new() -> anyhow::Result<System> {
        let place = Place::new()?;
        std::fs::write(place.path().join("ratn.toml"), CONFIG)?;
        Ok(System { place, daemons: Vec::new() })
    }

    fn path(&self, name: &str) -> String {
        self.place.path().join(name).display().to_string()
    }

    fn start(&mut self) -> anyhow::Result<()> {
        for role in ROLES {
            let daemon = self.launch(role)?;
            let endpoint = self.place.path().join(format!("run/{role}.endpoint"));
            wait_for("the daemon", || Ok(endpoint.exists().then_some(()))).with_context(|| daemon.said())?;
            self.daemons.push(daemon);
        }
        Ok(())
    }

    fn launch(&self, role: &str) -> anyhow::Result<Started> {
        let (config, state) = (self.path("ratn.toml"), self.path("state"));
        self.place.start_as(role, &[role, "--config", &config, "--state-dir", &state])
    }

    /// As a crash ends them: nothing is tidied up.
    fn kill(&mut self) -> anyhow::Result<()> {
        for mut daemon in self.daemons.drain(..) {
            daemon.signal(Signal::SIGKILL)?;
            daemon.child.wait()?;
        }
        for role in ROLES {
            std::fs::remove_file(self.place.path().join(format!("run/{role}.endpoint")))?;
        }
        Ok(())
    }

    fn endpoint(&self, role: &str) -> anyhow::Result<Endpoint> {
        Ok(format!("unix:{}", self.path(&format!("run/{role}.sock"))).parse()?)
    }

    fn json(&self, arguments: &[&str]) -> anyhow::Result<Json> {
        let output = self.place.ratn(&[arguments, &["--json"]].concat()).output()?;
        let (out, err) = texts(&output);
        ensure!(output.status.success(), "{arguments:?}: {out}{err}");
        Ok(serde_json::from_str(&out)?)
    }

    /// What the daemons say of themselves.
    fn tell(&self) -> anyhow::Result<BTreeMap<&'static str, Json>> {
        let resources = self.json(&["resource", "list"])?;
        let facts = self.json(&["world", "facts"])?;
        let history = self.json(&["world", "history", "round()"])?;
        Ok(BTreeMap::from([("resources", resources), ("facts", facts), ("history", history)]))
    }
}

/// Somebody with a session, whose requests have ids that are asked again after the upgrade.
struct Client {
    session: Session,
    resources: ResourceClient,
}

impl Client {
    async fn new(channels: &Channels, endpoint: &Endpoint, id: &str) -> anyhow::Result<Client> {
        let session = Session::open_as(channels, endpoint, id.to_owned(), "a client from before", TTL);
        session.alive(SOON).await?;
        let resources = ResourceClient::new(channels, endpoint, session.id())?;
        Ok(Client { session, resources })
    }

    async fn acquire(&self, request: &str, requirements: Vec<Requirement>) -> anyhow::Result<Lease> {
        let options = AcquireOptions { request: request.to_owned(), deadline: SOON, ..AcquireOptions::default() };
        Ok(self.resources.acquire(requirements, options).await?)
    }
}

fn arm() -> Resource {
    let pose = Value::Map(BTreeMap::from([
        ("reach_m".to_owned(), Value::Float(0.82)),
        ("left".to_owned(), Value::Bool(true)),
    ]));
    Resource::new("arm@sim", ResourceClass::Module, "Arm").with_attribute("mount", pose)
}

fn battery() -> Resource {
    let mut battery = Resource::new("battery@sim", ResourceClass::System, "Battery").with_capacity(Quantity::whole(3));
    (battery.divisible, battery.renewable) = (true, false);
    battery.with_attribute("level", Value::Float(0.5))
}

fn requirement(operation: ResourceOperation, kind: &str, thousandths: u64) -> Requirement {
    Requirement { count: Quantity::from_thousandths(thousandths), ..Requirement::new(operation, kind) }
}

fn both() -> Vec<Requirement> {
    let battery = requirement(ResourceOperation::Consume, "Battery", 750);
    let conditions = "level > 0.25".parse().into_iter().collect();
    vec![requirement(ResourceOperation::Block, "Arm", 1_000), Requirement { conditions, ..battery }]
}

fn key(predicate: &str, arguments: &[&str]) -> FactKey {
    let arguments = arguments.iter().map(|name| name.parse().map_or(Term::Name((*name).to_owned()), Term::Int));
    FactKey { predicate: predicate.to_owned(), arguments: arguments.collect() }
}

/// A value of every kind.
fn values() -> anyhow::Result<Vec<Value>> {
    let pose = json!({"pose": {"position": [0.1, 0.2, 0.3], "quaternion_xyzw": [0.0, 0.0, 0.0, 1.0]}});
    let plain = vec![
        Value::Null,
        Value::Bool(true),
        Value::Int(-7),
        Value::Float(0.1),
        Value::String("plate".to_owned()),
        Value::Joints(vec![0.5, -0.25]),
        Value::List(vec![Value::Int(1), Value::String("two".to_owned())].into()),
        Value::Map(BTreeMap::from([("b".to_owned(), Value::Int(2)), ("a".to_owned(), Value::Null)])),
        Value::Bytes(vec![0, 255, 7]),
    ];
    let posed: Value = serde_json::from_value(pose)?;
    Ok(plain.into_iter().chain([posed]).collect())
}

/// Sets, increases and deletes, with evidence for one of them.
fn commit() -> anyhow::Result<Commit> {
    let values = values()?.into_iter().enumerate();
    let set = values.map(|(n, value)| Change::Set { fact: key("value", &[&n.to_string(), "x"]), value });
    let gone = FactPattern { predicate: "gone".to_owned(), arguments: vec![None] };
    let other = [Change::Increase { fact: key("total", &[]), by: 2.5 }, Change::Delete { pattern: gone }];
    let measured = Measurement { source: "detector-1".to_owned(), certainty: Some(Certainty::Confidence(0.75)) };
    Ok(Commit {
        id: "run/i1".to_owned(),
        changes: set.chain(other).collect(),
        writer: "task/look".to_owned(),
        evidence: vec![(key("value", &["3", "x"]), measured)],
        ..Commit::default()
    })
}

fn round(n: usize, text: &str) -> Vec<Change> {
    vec![Change::Set { fact: key("round", &[]), value: Value::String(format!("{n}{text}")) }]
}

/// What a fixture was asked, and is asked once more by whoever reads it.
async fn ask(system: &System, channels: &Channels) -> anyhow::Result<(Client, Json)> {
    let client = Client::new(channels, &system.endpoint("resource-manager")?, "upgrade/client").await?;
    client.resources.create_once("upgrade/arm", arm()).await?;
    client.resources.create_once("upgrade/battery", battery()).await?;
    let lease = client.acquire("upgrade/both", both()).await?;
    let world = WorldClient::new(channels, &system.endpoint("world-pool")?)?;
    let (revision, _) = world.commit_as(commit()?).await?;
    let last = world.commit("run/last", round(0, ""), None).await?;
    let answers = json!({
        "lease": lease.id.0, "token": lease.token.0, "resources": lease.resources.len(),
        "revision": revision.0, "last": last.0,
    });
    Ok((client, answers))
}

/// What only the writer of a fixture does, so that there are a snapshot and records after it.
async fn make_a_snapshot(system: &System, channels: &Channels) -> anyhow::Result<()> {
    let endpoint = system.endpoint("resource-manager")?;
    let other = Client::new(channels, &endpoint, "upgrade/other").await?;
    let long = "x".repeat(1_000);
    for n in 0..70 {
        let tool = Resource::new("tool@sim", ResourceClass::Module, "Tool");
        let text = if n < 66 { format!("{n}{long}") } else { n.to_string() };
        other.resources.create(tool.with_attribute("text", Value::String(text))).await?;
    }
    let lease = other.acquire("", vec![requirement(ResourceOperation::Block, "Tool", 1_000)]).await?;
    other.resources.release(lease.id).await?;
    other.resources.create(Resource::new("", ResourceClass::Task, "Numbered")).await?;
    other.resources.create(Resource::new("gone@sim", ResourceClass::Task, "Gone")).await?;
    other.resources.delete("gone@sim").await?;
    let world = WorldClient::new(channels, &system.endpoint("world-pool")?)?;
    world.commit("run/gone", vec![Change::Set { fact: key("gone", &["cup"]), value: Value::Null }], None).await?;
    for n in 1..70 {
        let text = if n < 66 { long.as_str() } else { "" };
        world.commit(&format!("run/r{n}"), round(n, text), None).await?;
    }
    other.session.close().await;
    Ok(())
}

#[tokio::test]
#[ignore = "writes a fixture: scripts/upgrade-fixture VERSION"]
async fn what_is_here_is_written_down_for_later_versions() -> anyhow::Result<()> {
    let Some(target) = std::env::var_os(TARGET).map(PathBuf::from) else {
        eprintln!("skipped: {TARGET} names no directory to write to");
        return Ok(());
    };
    std::fs::create_dir_all(&target)?;
    let mut system = System::new()?;
    system.start()?;
    let channels = Channels::new(&ClientTls::none());
    make_a_snapshot(&system, &channels).await?;
    let (_client, answers) = ask(&system, &channels).await?;
    let mut expected = system.tell()?;
    expected.insert("answers", answers);
    system.kill()?;
    for role in ROLES {
        let (state, copy) = (system.path(&format!("state/{role}")), target.join(role));
        let _ = std::fs::remove_dir_all(&copy);
        system.json(&["state", "backup", &state, &copy.display().to_string()])?;
        let shown = system.json(&["state", "show", &copy.display().to_string()])?;
        ensure!(shown["snapshot"]["through"] != 0 && shown["records"]["count"] != 0, "{role}: {shown}");
    }
    let log = target.join("run.jsonl");
    write_event_log(&system.place, &log)?;
    expected.insert("report", system.json(&["report", &log.display().to_string()])?);
    Ok(std::fs::write(target.join("expected.json"), serde_json::to_string_pretty(&expected)? + "\n")?)
}

/// The log of a short run on a system of its own; the task is named without where it was.
fn write_event_log(place: &Place, target: &Path) -> anyhow::Result<()> {
    let (task, log) = (repository("examples/when_charged.yaml"), place.path().join("run.jsonl"));
    let texts_of = |path: &Path| path.to_str().map(str::to_owned).context("a path");
    let (task, file) = (texts_of(&task)?, texts_of(&log)?);
    let (code, _, said) = place.start(&["run", &task, "--speed", "20", "--log", &file])?.finish()?;
    ensure!(code == Some(0), "{said}");
    let named = std::path::absolute(&task)?.display().to_string();
    std::fs::write(target, std::fs::read_to_string(&log)?.replace(&named, "when_charged.yaml"))?;
    Ok(())
}

/// The directories of the versions that left something.
fn fixtures() -> anyhow::Result<Vec<PathBuf>> {
    let place = repository("tests/fixtures/upgrade");
    let entries = std::fs::read_dir(&place).with_context(|| place.display().to_string())?;
    let mut found: Vec<PathBuf> = entries.flatten().map(|entry| entry.path()).filter(|path| path.is_dir()).collect();
    found.sort();
    ensure!(!found.is_empty(), "no fixtures in {}", place.display());
    Ok(found)
}

/// A system on a copy of what a version left.
fn left_by(fixture: &Path) -> anyhow::Result<System> {
    let system = System::new()?;
    for role in ROLES {
        let (from, to) = (fixture.join(role), system.place.path().join("state").join(role));
        std::fs::create_dir_all(&to)?;
        for entry in std::fs::read_dir(&from).with_context(|| from.display().to_string())? {
            let entry = entry?;
            std::fs::copy(entry.path(), to.join(entry.file_name()))?;
        }
    }
    Ok(system)
}

/// What was said then.
fn expected(fixture: &Path) -> anyhow::Result<Json> {
    let file = fixture.join("expected.json");
    let text = std::fs::read_to_string(&file).with_context(|| file.display().to_string())?;
    Ok(serde_json::from_str(&text)?)
}

/// Whether everything that was said then is said now; now may say more.
fn same(then: &Json, now: &Json) -> bool {
    match (then, now) {
        (Json::Object(then), Json::Object(now)) => {
            then.iter().all(|(key, then)| now.get(key).is_some_and(|now| same(then, now)))
        }
        (Json::Array(then), Json::Array(now)) => {
            then.len() == now.len() && then.iter().zip(now).all(|(then, now)| same(then, now))
        }
        (then, now) => then == now,
    }
}

#[tokio::test]
async fn what_earlier_versions_left_is_there_and_their_requests_asked_again_get_the_same_answers() -> anyhow::Result<()>
{
    for fixture in fixtures()? {
        let place = fixture.display();
        let expected = expected(&fixture)?;
        let mut system = left_by(&fixture)?;
        system.start()?;
        for (what, now) in system.tell()? {
            ensure!(same(&expected[what], &now), "{place}: {what}\nthen {}\nnow  {now}", expected[what]);
        }
        let channels = Channels::new(&ClientTls::none());
        let (client, answers) = ask(&system, &channels).await.with_context(|| place.to_string())?;
        ensure!(same(&expected["answers"], &answers), "{place}: then {}, now {answers}", expected["answers"]);
        let state = *client.session.state().borrow();
        ensure!(state.found, "{place}: the session is made anew: {state:?}");
        go_on(&system, &channels, &client, &answers).await.with_context(|| place.to_string())?;

        // And what this version wrote behind it is read again.
        let before = system.tell()?;
        system.kill()?;
        system.start()?;
        let again = system.tell()?;
        ensure!(before["facts"] == again["facts"], "{place}: {again:?}");
    }
    Ok(())
}

/// What is new goes on from what was.
async fn go_on(system: &System, channels: &Channels, client: &Client, answers: &Json) -> anyhow::Result<()> {
    client.resources.release(answers["lease"].as_u64().map(ratn_model::id::LeaseId).context("a lease")?).await?;
    let lease = client.acquire("upgrade/again", vec![requirement(ResourceOperation::Block, "Arm", 1_000)]).await?;
    ensure!(Some(lease.token.0) > answers["token"].as_u64(), "token {} after {answers}", lease.token);
    let world = WorldClient::new(channels, &system.endpoint("world-pool")?)?;
    let revision = world.commit("run/new", round(81, ""), None).await?;
    let last = answers["last"].as_u64().map(Revision).context("a revision")?;
    ensure!(revision > last, "revision {revision} after {last}");
    Ok(())
}

#[test]
fn event_logs_of_earlier_versions_are_reported_as_they_were_then() -> anyhow::Result<()> {
    for fixture in fixtures()? {
        let report = System::new()?.json(&["report", &fixture.join("run.jsonl").display().to_string()])?;
        let then = expected(&fixture)?["report"].clone();
        ensure!(same(&then, &report), "{}:\nthen {then}\nnow  {report}", fixture.display());
    }
    Ok(())
}

#[test]
fn what_a_newer_version_wrote_is_refused_with_both_versions_and_stays_as_it_is() -> anyhow::Result<()> {
    let fixture = fixtures()?.pop().context("a fixture")?;
    for role in ROLES {
        let system = left_by(&fixture)?;
        let state = system.place.path().join("state").join(role);
        let (_, mut writer) = Log::new(&state, Options::default()).open()?;
        writer.append(&[250, 0])?;
        writer.close()?;
        let (code, _, said) = system.launch(role)?.finish()?;
        ensure!(code == Some(1), "{role}: {code:?} {said}");
        let named = said.contains("format 250 of the records of a") && said.contains("this program reads up to ");
        ensure!(named, "{role}: {said}");
        let left = Log::new(&state, Options::default()).read()?;
        ensure!(left.records.last().is_some_and(|record| record.payload[..] == [250, 0]), "{role}");
    }
    Ok(())
}
