//! `ratn check TASK`, and the checks that `ratn run` makes first.

mod annotations;

use super::blocking_here;
use super::tables::improvement;
use crate::arguments::CheckArguments;
use crate::columns::aligned;
use crate::failure::Failure;
use crate::system::config::SystemConfig;
use crate::system::{DIRECTORY_VARIABLE, System, catalogue, public_directory};
use crate::{input, output};
use ratn_model::catalogue::Catalogue;
use ratn_model::diagnostic::Diagnostic;
use ratn_model::expression::scope::NothingKnown;
use ratn_model::load::{Files, Loaded};
use ratn_model::parameters::ParameterError;
use ratn_model::program::Program;
use ratn_model::resource::Quantity;
use ratn_model::value::Value;
use ratn_simulation::sequential::{Assumptions, Gain, Link, Sequential, sequential};
use ratn_task_control::learn;
use ratn_worker::tls::ClientTls;
use serde::Serialize;
use std::path::Path;

/// Rules of findings about an action without a description.
const NOT_DESCRIBED: [&str; 2] = ["unknown-provider", "unknown-action"];
/// Maximum number of states shown at the end of a chain; `--json` has all.
const MAX_LINKS: usize = 40;

/// The output of `--json`.
#[derive(Debug, Serialize)]
struct Checked<'a> {
    /// The task's name; `None` for a task that is refused.
    task: Option<&'a str>,
    findings: &'a [Diagnostic],
    /// Differences between the workers of the running system and its catalogue, and resources that nobody offers.
    workers: &'a [String],
    /// What keeps the task sequential, unless that was left out or is unknown.
    sequential: Option<&'a Sequential>,
    /// Why that is unknown.
    obstacle: Option<&'a str>,
}

/// Reports what is wrong with a task file, and what keeps the task sequential.
pub(crate) fn run(arguments: &CheckArguments, tls: &ClientTls) -> Result<(), Failure> {
    let (config, system) = against(arguments, tls)?;
    let file = arguments.task.display().to_string();
    let text = read(&arguments.task)?;
    let loaded = match ratn_model::load::load_with(&text, &file, &config.catalogue, &input::Libraries) {
        Ok(loaded) => loaded,
        Err(findings) => {
            if arguments.json {
                let checked =
                    Checked { task: None, findings: &findings, workers: &[], sequential: None, obstacle: None };
                output::result(serde_json::to_string_pretty(&checked)?)?;
            }
            return Err(match system {
                None => refused_unheard(&findings, &config),
                Some(_) => refused(&findings),
            });
        }
    };
    let (program, findings) = (loaded.program, loaded.warnings);
    if arguments.annotations {
        findings.iter().for_each(output::progress);
        return annotations::print(&program, arguments.json);
    }
    let mut workers =
        system.map(|system| [system.offered.lacking(&program), system.mismatches].concat()).unwrap_or_default();
    workers.extend(arms_not_there(&program, &config));
    let simulated = if arguments.no_simulation { None } else { Some(simulate(&program, &config, arguments)?) };
    if arguments.json {
        let (sequential, obstacle) = match &simulated {
            Some(Ok(sequential)) => (Some(sequential), None),
            Some(Err(obstacle)) => (None, Some(obstacle.as_str())),
            None => (None, None),
        };
        let checked =
            Checked { task: Some(&program.name), findings: &findings, workers: &workers, sequential, obstacle };
        return output::result(serde_json::to_string_pretty(&checked)?).map_err(Failure::from);
    }
    findings.iter().for_each(output::progress);
    workers.iter().for_each(|what| output::progress(format_args!("warning: {what}")));
    // State 0 is the task itself.
    let states = output::counted(program.states.len().saturating_sub(1), "state");
    output::progress(format_args!("{file}: task `{}` is good: {states}", program.name));
    match simulated {
        None => Ok(()),
        Some(Ok(sequential)) => output::result(report(&sequential)).map_err(Failure::from),
        Some(Err(obstacle)) => {
            output::progress(format_args!("what keeps it sequential cannot be said: {obstacle}"));
            Ok(())
        }
    }
}

/// The config with the catalogue that a task is checked against, and the running system, where one is named or implied.
fn against(arguments: &CheckArguments, tls: &ClientTls) -> Result<(SystemConfig, Option<System>), Failure> {
    let robot = arguments.robot.as_deref();
    let given = arguments.config.as_deref().map(|file| SystemConfig::load_for(Some(file), robot)).transpose()?;
    let tls = &given.as_ref().map_or_else(|| Ok(tls.clone()), |config| config.client_tls(tls))?;
    let mut system = None;
    let named = arguments.runtime_dir.is_some();
    // A system that only the environment names is used if nothing else is specified and the system runs.
    let usual = given.is_none() && robot.is_none() && std::env::var_os(DIRECTORY_VARIABLE).is_some();
    if named || usual {
        let directory = public_directory(arguments.runtime_dir.as_deref())?;
        blocking_here(async {
            system = Box::pin(System::find(&directory, given.clone(), tls)).await?;
            Ok(())
        })?;
        if named && system.is_none() {
            return Err(Failure::Refused(format!("ratn: no system runs in {}", directory.display())));
        }
    }
    let mut config = match (&system, given) {
        (Some(system), _) => system.config.clone(),
        (None, given) => given.map_or_else(|| SystemConfig::load_for(None, robot), Ok)?,
    };
    if system.is_none() {
        config.offer_templates();
    }
    for file in &arguments.catalogue {
        let said = catalogue::read(file).map_err(|error| Failure::Refused(format!("ratn: {error:#}")))?;
        catalogue::extend(&mut config.catalogue, said);
    }
    Ok((config, system))
}

/// The states that select an arm, or its gripper, by a name that no arm of the robot has: a run would wait there for ever.
fn arms_not_there(program: &Program, config: &SystemConfig) -> Vec<String> {
    let mut told = Vec::new();
    for state in &program.states {
        for resource in state.annotations.resources.iter().filter(|one| config.is_module_of_arm(&one.kind)) {
            let said = resource.attributes.iter().filter(|(name, _)| name == "arm");
            for (_, value) in said {
                let Ok(Value::String(arm)) = value.evaluate(&NothingKnown) else { continue };
                let all = config.module_attributes().get(&resource.kind).map_or(&[][..], Vec::as_slice);
                let names = all.iter().filter_map(|said| match said.get("arm") {
                    Some(Value::String(name)) => Some(name.clone()),
                    _ => None,
                });
                let names: Vec<String> = names.collect();
                let (kind, path) = (&resource.kind, &state.path);
                match &names[..] {
                    [] => told.push(format!(
                        "`{path}` asks for a `{kind}` whose `arm` is `{arm}`, and the run will wait there: the robot has one arm, whose \
                         resources have no attribute `arm`; leave it out"
                    )),
                    names if !names.contains(&arm) => told.push(format!(
                        "`{path}` asks for a `{kind}` whose `arm` is `{arm}`, and the run will wait there: the arms of the robot that have one \
                         are {}",
                        names.join(", ")
                    )),
                    _ => {}
                }
            }
        }
    }
    told
}

/// What keeps the task sequential, or why that is unknown.
fn simulate(
    program: &Program,
    config: &SystemConfig,
    arguments: &CheckArguments,
) -> Result<Result<Sequential, String>, Failure> {
    let parameters = match program.bind_parameters(&arguments.set) {
        Ok(parameters) => parameters,
        Err(missing @ ParameterError::Missing { .. }) => return Ok(Err(missing.to_string())),
        Err(error) => {
            let file = arguments.task.display();
            return Err(Failure::Refused(format!("{file}: error[invalid-parameter]: {error}")));
        }
    };
    let learned = learn::from_files(&arguments.learn, &program.name, &output::messages())?;
    let assumptions = Assumptions {
        parameters,
        elements: usize::from(arguments.elements),
        durations_s: learned.durations_s,
        // Workers that a system starts on demand are assumed to be ready in time.
        units: config.promised_resources().into_iter().map(|(kind, units)| (kind, units.max(Quantity::ONE))).collect(),
        attributes: config.module_attributes().clone(),
    };
    Ok(sequential(program, &config.catalogue, &assumptions).map_err(|obstacle| obstacle.to_string()))
}

fn report(sequential: &Sequential) -> String {
    let Sequential { hsm_s, cdtn_s, .. } = sequential;
    let mut lines = vec![format!(
        "as written {hsm_s:.1} s; as a dataflow network {cdtn_s:.1} s ({:.1} % less), by simulation with the durations that are known",
        improvement(*hsm_s, *cdtn_s)
    )];
    if !sequential.unknown_durations.is_empty() {
        let states = sequential.unknown_durations.join(", ");
        lines.push(format!("a second is assumed, for want of a `duration`, of: {states}"));
    }
    lines.push("\nthe longest chain:".to_owned());
    let hidden = sequential.chain.len().saturating_sub(MAX_LINKS);
    if hidden > 0 {
        lines.push(format!("  … {hidden} states before"));
    }
    let shown = sequential.chain.iter().skip(hidden);
    let row = |Link { path, began_s, ended_s, because }: &Link| {
        [format!("{began_s:>9.1} – {ended_s:>7.1} s"), path.to_string(), because.to_string()]
    };
    lines.extend(aligned(&shown.map(row).collect::<Vec<_>>()));
    if !sequential.exceptional.is_empty() {
        lines.push(
            "\nwhat not computing ahead for a failure, a timeout or an answer would gain, if it is seldom:".to_owned(),
        );
        lines.extend(gains(&sequential.exceptional));
    }
    if sequential.gains.is_empty() {
        lines.push("\nevery state that is executed says what it reads and changes".to_owned());
        return lines.join("\n");
    }
    lines.push("\nwhat annotating would gain, if nothing is read or changed but what the state names:".to_owned());
    lines.extend(gains(&sequential.gains));
    if let Some(annotated_s) = sequential.annotated_s {
        let less = improvement(*hsm_s, annotated_s);
        lines.push(format!("all of them: {annotated_s:.1} s ({less:.1} % less than as written)"));
    }
    lines.join("\n")
}

/// A table of missing annotations, under a heading.
fn gains(gains: &[Gain]) -> Vec<String> {
    let row = |gain: &Gain| {
        let Gain { path, missing, alone_s, alone_percent, last_s } = gain;
        format!("{alone_s:>7.1} s {alone_percent:>5.1} %  {last_s:>8.1} s          {path}: {}", missing.join(", "))
    };
    std::iter::once("    alone           with all the others".to_owned()).chain(gains.iter().map(row)).collect()
}

fn read(path: &Path) -> Result<String, Failure> {
    input::read(path).map_err(|error| Failure::Refused(format!("{}: cannot be read: {error}", path.display())))
}

pub(super) fn refused(findings: &[Diagnostic]) -> Failure {
    let lines: Vec<String> = findings.iter().map(Diagnostic::to_string).collect();
    Failure::Refused(lines.join("\n"))
}

/// Whether the catalogue lacks an action that a worker may still describe.
pub(super) fn is_lacking(findings: &[Diagnostic]) -> bool {
    findings.iter().any(|finding| NOT_DESCRIBED.contains(&finding.rule.as_str()))
}

/// The refusal of a task where no worker was asked: what workers of the config's templates would describe is unknown.
fn refused_unheard(findings: &[Diagnostic], config: &SystemConfig) -> Failure {
    let templates = config.may_describe();
    if templates.is_empty() || !is_lacking(findings) {
        return refused(findings);
    }
    Failure::Refused(format!(
        "{}\nratn: what workers of the templates `{}` describe is known only where they run: start the system (`ratn up`) and say its directory \
         (`ratn check --runtime-dir DIR`), or name a file that describes their actions in the config (`catalogues`)",
        refused(findings),
        templates.join("`, `")
    ))
}

/// The program of a task file, beginning at the state `from` where one is given, or the findings where the task is refused; warnings go to standard
/// error.
pub(super) fn found(
    path: &Path,
    from: Option<&str>,
    catalogue: &Catalogue,
) -> Result<Result<Program, Vec<Diagnostic>>, Failure> {
    let (text, file) = (read(path)?, path.display().to_string());
    Ok(ratn_model::load::load_beginning(&text, &file, catalogue, &input::Libraries, from).map(told))
}

/// The program from a task file's text, with libraries from `libraries`; `file` is its name in messages.
pub(super) fn load_from(
    libraries: &impl Files,
    text: &str,
    file: &str,
    catalogue: &Catalogue,
) -> Result<Program, Failure> {
    accepted(ratn_model::load::load_with(text, file, catalogue, libraries))
}

fn accepted(loaded: Result<Loaded, Vec<Diagnostic>>) -> Result<Program, Failure> {
    match loaded {
        Ok(loaded) => Ok(told(loaded)),
        Err(findings) => Err(refused(&findings)),
    }
}

/// Prints warnings to standard error.
fn told(loaded: Loaded) -> Program {
    loaded.warnings.iter().for_each(output::progress);
    loaded.program
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;
    use clap::Parser;

    #[derive(Debug, Parser)]
    struct Line {
        #[command(flatten)]
        arguments: CheckArguments,
    }

    #[test]
    fn a_task_that_uses_what_a_worker_may_describe_is_refused_with_where_to_ask() {
        let folder = tempfile::tempdir().unwrap();
        let file = |name: &str, text: &str| {
            let file = folder.path().join(name);
            std::fs::write(&file, text).unwrap();
            file
        };
        let template = "[[process-manager.template]]\nname = \"nearest\"\nkind = \"Inspector\"\nprogram = \"true\"\n";
        let action = "{ action: inspector/nearest, computes: true, reads: [], resources: [Inspector] }";
        let task = file("t.yaml", &format!("task: t\nstates:\n  - look: {action}\n"));
        let given = ["check".into(), task, "--config".into(), file("c.toml", template)];
        let said = run(&Line::parse_from(given).arguments, &ClientTls::none()).unwrap_err().to_string();
        assert!(said.contains("[unknown-provider]") && said.contains("workers of the templates `nearest`"), "{said}");
        assert!(!said.contains("[unknown-resource]"), "its template offers it: {said}");
    }
}
