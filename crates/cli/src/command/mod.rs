//! One file per command; `roles.rs` has the daemons and workers.

pub(crate) mod actions;
mod certs;
mod check;
mod completions;
mod control;
mod dashboard;
mod demo;
pub(crate) mod doctor;
mod export;
mod leader;
pub(crate) mod new;
mod plan;
pub(crate) mod pool;
mod reload;
mod report;
mod reset;
pub(crate) mod resource;
mod robot;
mod roles;
mod run;
mod safety;
mod signal;
mod simulate;
mod state;
mod status;
mod tables;
mod top;
mod up;
pub(crate) mod world;

use crate::arguments::Command;
use crate::failure::Failure;
use anyhow::Context;
use ratn_worker::client::CallError;
use ratn_worker::tls::ClientTls;
use std::time::Duration;

/// Time for running computations at the end of a process.
const LAST_WORK: Duration = Duration::from_millis(200);

/// Runs a command to its end.
pub(crate) fn run(command: Command) -> Result<(), Failure> {
    // The TLS settings of every client of this process; a daemon's config may add to them.
    let tls = &ClientTls::from_environment()?;
    match command {
        Command::Demo(arguments) => demo::run(&arguments, tls),
        Command::Up(arguments) => up::run(&arguments, tls),
        Command::Run(arguments) => run::run(&arguments, tls),
        Command::Control(arguments) => control::run(&arguments),
        Command::Signal(arguments) => signal::signal(&arguments),
        Command::Answer(arguments) => signal::answer(&arguments),
        Command::Status(arguments) => status::run(&arguments, tls),
        Command::Ps(arguments) => pool::ps(&arguments, tls),
        Command::Logs(arguments) => pool::logs(&arguments, tls),
        Command::Pool(arguments) => pool::run(&arguments, tls),
        Command::Restart(arguments) => pool::restart(&arguments, tls),
        Command::Drain(arguments) => pool::drain(&arguments, tls),
        Command::Stop(arguments) => safety::stop(&arguments, tls),
        Command::Hold(arguments) => safety::hold(&arguments, tls),
        Command::GoOn(arguments) => safety::go_on(&arguments, tls),
        Command::Doctor(arguments) => doctor::run(&arguments, tls),
        Command::Reset(arguments) => reset::run(&arguments, tls),
        Command::Check(arguments) => check::run(&arguments, tls),
        Command::Actions(arguments) => actions::run(&arguments, tls),
        Command::New(arguments) => new::run(&arguments),
        Command::Resource(arguments) => resource::run(&arguments, tls),
        Command::World(arguments) => world::run(&arguments, tls),
        Command::State(arguments) => state::run(&arguments),
        Command::Certs(arguments) => certs::run(&arguments),
        Command::Completions(arguments) => completions::run(&arguments),
        Command::Man(arguments) => completions::man(&arguments),
        Command::Top(arguments) => top::run(&arguments, tls),
        Command::Dashboard(arguments) => dashboard::run(&arguments, tls),
        Command::Export(arguments) => export::run(&arguments),
        Command::Report(arguments) => report::run(&arguments),
        Command::Simulate(arguments) => simulate::run(&arguments),
        Command::Plan(arguments) => plan::run(&arguments),
        Command::Robot(arguments) => robot::run(&arguments),
        Command::Tables(arguments) => tables::run(&arguments),
        Command::ResourceManager(arguments) => roles::resource_manager(&arguments, tls),
        Command::WorldPool(arguments) => roles::world_pool(&arguments, tls),
        Command::ProcessManager(arguments) => roles::process_manager(&arguments, tls),
        Command::Cell(arguments) => roles::cell(&arguments, tls),
        Command::Worker(arguments) => roles::worker(&arguments, tls),
    }
}

/// Lets a script tell a daemon that refuses from one that does not answer.
fn unanswered(failure: Failure) -> Failure {
    let Failure::Failed(error) = failure else { return failure };
    if error.downcast_ref::<CallError>().is_some_and(CallError::is_crash) {
        return Failure::Refused(format!("ratn: {error:#}"));
    }
    Failure::Failed(error)
}

/// Runs a future on this thread: handling an event then needs no other thread to be woken.
fn blocking_here(future: impl Future<Output = Result<(), Failure>>) -> Result<(), Failure> {
    blocking_on(tokio::runtime::Builder::new_current_thread(), future)
}

/// Runs a future on a separate runtime.
fn blocking(future: impl Future<Output = Result<(), Failure>>) -> Result<(), Failure> {
    blocking_on(tokio::runtime::Builder::new_multi_thread(), future)
}

/// As [`blocking`], on a runtime of another kind.
fn blocking_on(
    mut runtime: tokio::runtime::Builder,
    future: impl Future<Output = Result<(), Failure>>,
) -> Result<(), Failure> {
    let runtime = runtime.enable_all().build().context("cannot start the asynchronous runtime")?;
    let done = runtime.block_on(future);
    // Does not wait for computations that do not notice the end.
    runtime.shutdown_timeout(LAST_WORK);
    done
}
