//! What a worker says of itself is known on the pages of `ratn dashboard` that stand open, as it is to `ratn check` and `ratn run`, which starts
//! the system of its config for that.

mod support;

use anyhow::{Context, ensure};
use ratn_worker::prelude::*;
use ratn_worker::runtime_directory::RuntimeDirectory;
use ratn_worker::worker::{Worker, WorkerOptions};
use serde_json::Value as Json;
use std::io::{Read, Write};
use std::net::TcpStream;
use support::{Place, repository, texts, wait_for};
use tokio_util::sync::CancellationToken;

const TASK: &str = "task: greet\nstates:\n  - hello: { action: greeter/greet, in: { n: 2 }, resources: [Greeter] }\n";

/// The variables that make [`greeter`] a worker: its id, and the file that it writes its endpoint to.
const ID: &str = "TEST_GREETER_ID";
const ENDPOINT_FILE: &str = "TEST_GREETER_ENDPOINT_FILE";

/// `greeter/greet`, which no catalogue has.
struct Greet;

#[async_trait]
impl Action for Greet {
    fn name(&self) -> &str {
        "greet"
    }

    fn signature(&self) -> Option<Signature> {
        Some(Signature::new().input("n", Type::Int).computes().reads("at(?)"))
    }

    async fn execute(&self, _: GoalContext) -> ActionResult {
        Ok(GoalOutcome::success())
    }
}

/// The role of a program that a config starts. As a test it does nothing.
#[test]
fn greeter() -> anyhow::Result<()> {
    let Some(file) = std::env::var_os(ENDPOINT_FILE) else { return Ok(()) };
    let options = WorkerOptions {
        id: std::env::var(ID)?,
        kind: "Greeter".to_owned(),
        endpoint_file: Some(file.into()),
        exit_with_parent: true,
        ..WorkerOptions::default()
    };
    let worker = Worker::new(options).provides("greeter", "Greeter").action(Greet);
    Ok(tokio::runtime::Builder::new_multi_thread().enable_all().build()?.block_on(worker.run())?)
}

/// No system runs, the catalogue does not have the action, and nobody could simulate the robot.
#[test]
fn a_run_starts_the_workers_of_its_config_that_describe_themselves_and_no_cell_for_a_robot_without_a_workplace()
-> anyhow::Result<()> {
    let place = Place::new()?;
    for file in ["panda.urdf", "panda.srdf", "panda.toml"] {
        std::fs::copy(repository("crates/motion/robots").join(file), place.path().join(file))?;
    }
    let robot = place.path().join("panda.toml");
    let whole = std::fs::read_to_string(&robot)?;
    std::fs::write(&robot, whole.split("[workplace]").next().context("a text")?)?;
    let (task, config) = (place.path().join("task.yaml"), place.path().join("ratn.toml"));
    std::fs::write(&task, TASK)?;
    let program = std::env::current_exe()?;
    let text = format!(
        "robot = \"panda.toml\"\n[[process-manager.template]]\nname = \"greeter\"\nkind = \"Greeter\"\nprogram = {program:?}\n\
         args = [\"--exact\", \"greeter\", \"--nocapture\"]\nenv = {{ {ID} = \"{{id}}\", {ENDPOINT_FILE} = \"{{endpoint_file}}\" }}\n"
    );
    std::fs::write(&config, text)?;
    let path = |path: &std::path::Path| path.to_str().map(str::to_owned).context("a path");
    let log = place.path().join("log.jsonl");
    let arguments = ["run", &path(&task)?, "--config", &path(&config)?, "--log", &path(&log)?];
    let output = place.ratn(&arguments).output()?;
    let (out, err) = texts(&output);
    ensure!(output.status.success() && err.contains("starting one for this run"), "{out}{err}");
    place.wait_until_empty()
}

#[test]
fn a_dashboard_knows_the_actions_of_a_worker_that_describes_itself_and_came_later() -> anyhow::Result<()> {
    let place = Place::new()?;
    let directory = place.path().join("run");
    let named = directory.to_str().context("a path")?;
    let up = place.start_as("up", &["up", "--runtime-dir", named, "--boxes", "1"])?;
    wait_for("the system", || Ok(up.said().contains("is ready").then_some(()))).with_context(|| up.said())?;
    let file = place.path().join("task.yaml");
    std::fs::write(&file, TASK)?;
    let file = file.to_str().context("a path")?;
    let _dashboard = place.start_as("dashboard", &["dashboard", "--runtime-dir", named, "--edit", file])?;
    let url = wait_for("its address", || {
        let said = std::fs::read_to_string(place.path().join("dashboardout"))?;
        Ok(said.lines().next().and_then(|line| line.strip_prefix("http://")).map(str::to_owned))
    })?;
    let (address, token) = url.split_once("/#token=").context("an address with a token")?;
    let told = annotations(address, token)?;
    ensure!(told["findings"].to_string().contains("greeter"), "nobody performs it yet: {told}");

    let end = CancellationToken::new();
    let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().build()?;
    let options = WorkerOptions {
        id: "greeter-1".to_owned(),
        kind: "Greeter".to_owned(),
        listen: format!("unix:{}", place.path().join("greeter.sock").display()).parse()?,
        resource_manager: Some(RuntimeDirectory::at(&directory).find("resource-manager")?),
        ..WorkerOptions::default()
    };
    let worker = Worker::new(options).provides("greeter", "Greeter").action(Greet).shutdown(end.clone());
    let worker = runtime.spawn(worker.run());
    let told = wait_for("the page to know it", || {
        let told = annotations(address, token)?;
        Ok(told["findings"].as_array().is_some_and(Vec::is_empty).then_some(told))
    })?;
    let offers = |word: &str| told["kinds"].as_array().is_some_and(|kinds| kinds.iter().any(|kind| kind == word));
    ensure!(offers("Greeter"), "its kind is not offered: {told}");
    let lines = told["states"][0]["in_force"].to_string();
    ensure!(lines.contains("the catalogue, of greeter/greet"), "{lines}");
    // It reads, so it has a room of the world model beside the worker, which the page has as a line of its own.
    ensure!(lines.contains("block Greeter") && lines.contains("WorldModel"), "{lines}");
    end.cancel();
    runtime.block_on(worker)??;
    Ok(())
}

/// What the page `Annotations` is told.
fn annotations(address: &str, token: &str) -> anyhow::Result<Json> {
    let mut connection = TcpStream::connect(address)?;
    write!(
        connection,
        "GET /api/annotations HTTP/1.1\r\nHost: {address}\r\nAuthorization: Bearer {token}\r\nConnection: close\r\n\r\n"
    )?;
    let mut answer = String::new();
    connection.read_to_string(&mut answer)?;
    let (_, body) = answer.split_once("\r\n\r\n").context("an answer")?;
    Ok(serde_json::from_str(body)?)
}
