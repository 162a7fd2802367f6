//! `ratn dashboard [LOG…]`: web pages about runs and a system.

use super::blocking;
use crate::arguments::DashboardArguments;
use crate::failure::Failure;
use crate::interrupt::Interrupt;
use crate::system::config::SystemConfig;
use crate::system::known::KnownSystem;
use crate::system::{CONFIG_FILE, public_directory};
use crate::{input, output};
use ratn_dashboard::{Dashboard, DashboardError, Editing, Known, Options, Robots, Tasks};
use ratn_model::diagnostic::{Diagnostic, Severity};
use ratn_model::load::load_with;
use ratn_model::program::{Location, Program};
use ratn_model::resource::Quantity;
use ratn_model::value::Value;
use ratn_motion::description::DescriptionError;
use ratn_motion::looks::Looks;
use ratn_motion::robot::Robot;
use ratn_simulation::sequential::{Assumptions, makespan_s};
use ratn_worker::tls::ClientTls;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Assumed number of elements in a list that an action returns, as in `ratn check`.
const ASSUMED_ELEMENTS: usize = 3;
/// Maximum number of events when the gain of a change is simulated, which bounds the memory; the dashboard sets the time limit.
const MAX_EVENTS: usize = 50_000;

/// Serves the pages until the user ends it.
pub(crate) fn run(arguments: &DashboardArguments, tls: &ClientTls) -> Result<(), Failure> {
    let directory = public_directory(arguments.runtime_dir.as_deref())?;
    let known = KnownSystem::of(directory.clone(), tls.clone());
    let options = Options {
        address: arguments.listen,
        logs: arguments.logs.clone(),
        control: arguments.control,
        edit: arguments.edit.as_deref().map(|file| editing(file, &known)).transpose()?,
        tasks: tasks(known),
        robots: robots(directory.clone(), arguments.robot.clone()),
        ..Options::of(directory, tls.clone())
    };
    blocking(async {
        let interrupt = Interrupt::listen()?;
        let dashboard = Dashboard::bind(options).await.map_err(refused)?;
        output::result(dashboard.url())?;
        let what = match (arguments.control, &arguments.edit) {
            (true, None) => "the pages may pause and end runs".to_owned(),
            (false, None) => "the pages only look".to_owned(),
            (true, Some(file)) => format!("the pages may pause and end runs, and change {}", file.display()),
            (false, Some(file)) => format!("the pages may change {}", file.display()),
        };
        output::progress(format_args!("open this address in a browser on this machine; {what}; Ctrl-C ends it"));
        tokio::select! {
            () = dashboard.serve() => {}
            () = interrupt.asked_times(1) => {}
        }
        Ok(())
    })
}

/// The read-only pages of a running system; prints their address.
pub(super) async fn of_system(directory: &Path, tls: &ClientTls) -> anyhow::Result<Dashboard> {
    let known = KnownSystem::of(directory.to_owned(), tls.clone());
    let (tasks, robots) = (tasks(known), robots(directory.to_owned(), None));
    let options = Options { tasks, robots, ..Options::of(directory.to_owned(), tls.clone()) };
    let dashboard = Dashboard::bind(options).await?;
    output::progress(format_args!("its dashboard is at {}", dashboard.url()));
    Ok(dashboard)
}

/// The task file whose annotations the pages may change, checked as `ratn check` does.
fn editing(file: &Path, known: &KnownSystem) -> Result<Editing, Failure> {
    let refused = |error| Failure::Refused(format!("{}: cannot be read: {error}", file.display()));
    input::read(file).map_err(refused)?;
    let name = file.display().to_string();
    let of_kinds = known.clone();
    let kinds =
        move || of_kinds.config().map_or_else(|_| Vec::new(), |it| it.catalogue.resources.keys().cloned().collect());
    let of_check = known.clone();
    let check = move |text: &str| match of_check.config() {
        Ok(config) => load_with(text, &name, &config.catalogue, &input::Libraries),
        Err(problem) => Err(vec![no_config(&name, problem)]),
    };
    let of_makespan = known.clone();
    let makespan = move |program: &Program, goes_on: &dyn Fn() -> bool| {
        let config = of_makespan.config()?;
        let parameters = program.bind_parameters(&[]).map_err(|error| error.to_string())?;
        let assumptions = assumptions(&config, parameters);
        makespan_s(program, &config.catalogue, &assumptions, MAX_EVENTS, goes_on)
            .map_err(|obstacle| obstacle.to_string())
    };
    Ok(Editing::of(file.to_owned(), kinds, check, makespan))
}

/// The finding that there is no config to check a file against.
fn no_config(file: &str, problem: String) -> Diagnostic {
    Diagnostic {
        rule: "no-config".to_owned(),
        severity: Severity::Error,
        file: file.to_owned(),
        location: Location::default(),
        path: String::new(),
        message: problem,
        help: String::new(),
    }
}

fn assumptions(config: &SystemConfig, parameters: BTreeMap<String, Value>) -> Assumptions {
    Assumptions {
        parameters,
        elements: ASSUMED_ELEMENTS,
        durations_s: BTreeMap::new(),
        units: config.promised_resources().into_iter().map(|(kind, units)| (kind, units.max(Quantity::ONE))).collect(),
        attributes: config.module_attributes().clone(),
    }
}

/// The robot that the user names, else the one that the log names. For a log without a robot: the robot of the system that runs, or ran, in a
/// directory, else the built-in one. It has to have everything that the log moves.
fn robots(directory: PathBuf, named: Option<String>) -> Robots {
    Robots::by(move |of_log| {
        let own = || SystemConfig::read(&directory.join(CONFIG_FILE)).ok().map(|config| config.robot);
        if let Some(named) = &named {
            return robot(named, "as --robot says".to_owned());
        }
        if !of_log.is_empty() {
            let needs =
                |why| format!("the log is of the robot {of_log}: {why}; --robot names another description of it");
            return robot_of_log(of_log).map_err(needs);
        }
        let (own, whence) = match own() {
            Some(own) => (own, format!("the robot of the system in {}", directory.display())),
            None => (SystemConfig::default().robot, "the built-in robot".to_owned()),
        };
        robot(&own, format!("{whence}: the log does not say which one, --robot names another one"))
    })
}

/// A built-in robot, or one described by a file.
fn robot(named: &str, whence: String) -> Result<Known, String> {
    known(named, whence, |error| error.to_string())
}

/// The robot that a log names. A log may name any file, so the content of a file that describes no robot is not shown.
fn robot_of_log(named: &str) -> Result<Known, String> {
    known(named, "as the log says".to_owned(), |error| match error {
        DescriptionError::Form { file, .. } => format!("{} describes no robot", file.display()),
        other => other.to_string(),
    })
}

fn known(named: &str, whence: String, why: impl Fn(DescriptionError) -> String) -> Result<Known, String> {
    let robot =
        Robot::named_or_file(named).map_err(|error| format!("the robot {named} is not known: {}", why(error)))?;
    Ok(Known { robot, looks: Looks::named_or_file(named), whence })
}

/// Task files are read again for each request: they are small, and may have been restored.
fn tasks(known: KnownSystem) -> Tasks {
    Tasks::by(move |file| {
        if file.as_os_str().is_empty() {
            return Err("the log does not say which task file it is of".to_owned());
        }
        let place = file.display();
        let source = input::read(file).map_err(|error| format!("cannot read the task file {place}: {error}"))?;
        let name = place.to_string();
        let loaded = load_with(&source, &name, &known.config()?.catalogue, &input::Libraries);
        loaded
            .map(|loaded| loaded.program)
            .map_err(|_| format!("`ratn check {place}` says what is wrong with the task file"))
    })
}

/// Maps an error to a refusal or a failure.
fn refused(error: DashboardError) -> Failure {
    match error {
        DashboardError::Exposed { .. } | DashboardError::TooMany { .. } => Failure::Refused(format!("ratn: {error}")),
        other => Failure::Failed(other.into()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nothing_of_a_file_that_a_log_names_as_its_robot_is_shown() -> anyhow::Result<()> {
        let file = tempfile::NamedTempFile::new()?;
        std::fs::write(file.path(), "root:x:0:0:secret\n")?;
        let named = file.path().display().to_string();
        let refused = robot_of_log(&named).err().unwrap_or_default();
        assert!(refused.ends_with("describes no robot") && !refused.contains("secret"), "{refused}");
        // A user who names the file is told what is wrong with it.
        assert!(robot(&named, String::new()).err().unwrap_or_default().contains("secret"));
        Ok(())
    }
}
