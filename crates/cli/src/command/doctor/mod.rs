//! `ratn doctor`: reports what is missing on this machine or in this config, and what to do about it.
//!
//! Every check reports `ok`, a `warning` (it works for now) or a `problem` (it does not work). Nothing is changed; a port is bound for
//! a moment. Each file has the checks of one kind: `machine` (directories, disk space, limits, cgroups), `tls` (TLS files),
//! `templates`, `system` (daemons, hosts, clocks, pools).

mod machine;
mod system;
mod templates;
mod tls;

use super::blocking_on;
use crate::failure::Failure;
use crate::output;
use crate::system::config::SystemConfig;
use crate::system::{denied, directory_of};
use clap::Args;
use ratn_worker::tls::ClientTls;
use serde::Serialize;
use std::path::PathBuf;

#[derive(Debug, Clone, Args)]
pub(crate) struct DoctorArguments {
    /// The system's config, TOML; without it the one that `ratn up` runs here, else the built-in default
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Where endpoint files are; $RATN_RUNTIME_DIR, $XDG_RUNTIME_DIR/ratn or /tmp/ratn-UID unless given
    #[arg(long, value_name = "DIR")]
    runtime_dir: Option<PathBuf>,
    /// Only what is not well
    #[arg(short, long)]
    quiet: bool,
    /// Print one JSON document on standard output
    #[arg(long)]
    json: bool,
}

/// Severity.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
enum Level {
    Ok,
    Warning,
    Problem,
}

/// The result of a check.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
struct Finding {
    level: Level,
    /// The subject: `[service.tls] key`, `template path-planner`, `host compute`.
    about: String,
    found: String,
    /// What to do; empty where there is nothing to do.
    help: String,
}

/// The results of the checks so far.
#[derive(Debug, Default)]
struct Findings(Vec<Finding>);

impl Findings {
    fn ok(&mut self, about: impl Into<String>, found: impl Into<String>) {
        self.add(Level::Ok, about, found, "");
    }

    fn warning(&mut self, about: impl Into<String>, found: impl Into<String>, help: impl Into<String>) {
        self.add(Level::Warning, about, found, help);
    }

    fn problem(&mut self, about: impl Into<String>, found: impl Into<String>, help: impl Into<String>) {
        self.add(Level::Problem, about, found, help);
    }

    fn add(&mut self, level: Level, about: impl Into<String>, found: impl Into<String>, help: impl Into<String>) {
        self.0.push(Finding { level, about: about.into(), found: found.into(), help: help.into() });
    }
}

/// Examines this machine. Fails where there is a problem; warnings are no failure.
pub(super) fn run(arguments: &DoctorArguments, client_tls: &ClientTls) -> Result<(), Failure> {
    let directory = directory_of(arguments.runtime_dir.as_deref());
    let mut findings = Findings::default();
    let of_up = directory.join("system.toml");
    let file = arguments.config.clone().or_else(|| of_up.is_file().then_some(of_up));
    let name = file.as_ref().map_or("the built-in config".to_owned(), |file| file.display().to_string());
    let config = match SystemConfig::load(file.as_deref()) {
        Ok(config) => {
            findings.ok("config", format!("{name} is good"));
            config
        }
        Err(refused) => {
            let help = "the rest is looked at as the built-in config would have it";
            findings.problem("config", refused.to_string(), help);
            SystemConfig::load(None)?
        }
    };
    // Files that cannot be read are reported by the check of the certificates.
    let client_tls = &config.service.client_tls(client_tls).unwrap_or_else(|_| client_tls.clone());
    machine::check(&mut findings, &config, &directory);
    tls::check(&mut findings, &config);
    templates::check(&mut findings, &config);
    if let Some(why) = denied(&directory) {
        findings.problem("system", why, "look at one of your own: --runtime-dir DIR, or $RATN_RUNTIME_DIR");
        return conclude(arguments, findings);
    }
    blocking_on(tokio::runtime::Builder::new_current_thread(), async {
        system::check(&mut findings, &config, client_tls, &directory).await;
        Ok(())
    })?;
    conclude(arguments, findings)
}

/// Prints the results.
fn conclude(arguments: &DoctorArguments, mut findings: Findings) -> Result<(), Failure> {
    let count = |level| findings.0.iter().filter(|finding| finding.level == level).count();
    let (problems, warnings) = (count(Level::Problem), count(Level::Warning));
    if arguments.quiet {
        findings.0.retain(|finding| finding.level != Level::Ok);
    }
    if arguments.json {
        let document = serde_json::json!({ "problems": problems, "warnings": warnings, "findings": findings.0 });
        output::result(document)?;
    } else {
        let text = findings.0.iter().map(line).collect::<Vec<_>>().join("\n");
        if !text.is_empty() {
            output::result(text)?;
        }
        output::progress(format_args!("{problems} problems, {warnings} warnings"));
    }
    if problems == 0 { Ok(()) } else { Err(Failure::Program(1)) }
}

fn line(finding: &Finding) -> String {
    let mark = match finding.level {
        Level::Ok => "ok      ",
        Level::Warning => "warning ",
        Level::Problem => "PROBLEM ",
    };
    let help = if finding.help.is_empty() { String::new() } else { format!("\n          {}", finding.help) };
    format!("{mark}  {}: {}{help}", finding.about, finding.found)
}
