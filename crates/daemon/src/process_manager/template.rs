//! A pool of equal workers in the config: what to run, how many, and how they are watched and ended.

use super::account::Account;
use super::config::check_name;
use super::limits::Limits;
use super::machine::Sample;
use super::parameter::{self, Parameter};
use super::python::{self, Interpreter};
use super::readiness::Readiness;
use crate::config::{ConfigError, rule};
use nix::unistd::{AccessFlags, access};
use ratn_model::name::{KIND_RULE, is_kind};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::Stdio;
use std::time::{Duration, Instant};

/// Maximum standstill time that the resource manager waits for.
const LONGEST_STANDSTILL_MS: u64 = 60_000;
/// How long an interpreter may take to say whether it finds a package.
const PYTHON_PATIENCE: Duration = Duration::from_secs(10);
/// Ends with [`LACKS_PACKAGE`] if the script that it is given would not find the package `ratn`; the package is not imported.
const FINDS_PACKAGE: &str = "import importlib.util, os, sys; sys.path[0] = os.path.dirname(sys.argv[1]); \
                             sys.exit(0 if importlib.util.find_spec('ratn') else 3)";
const LACKS_PACKAGE: i32 = 3;
/// Maximum number of workers in a pool.
const MAX_WORKERS: u32 = 1_000;

/// A pool of equal workers.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Template {
    /// Its name, the beginning of every worker's id.
    pub name: String,
    /// The kind of resource of its workers, such as `PathPlanner`; its class is process.
    pub kind: String,
    /// The program to run; without it, this program.
    #[serde(default)]
    pub program: Option<PathBuf>,
    /// A Python script to run in place of `program`, relative to the folder of the config. It gets `--id {id} --endpoint-file {endpoint_file}
    /// --kind {kind}` before `args`.
    #[serde(default)]
    pub python: Option<PathBuf>,
    /// The interpreter of the script; by default that of the virtual environment (`.venv`, `venv`) beside the script or in a folder above, else
    /// of the environment in which the process manager was started, else `python3`.
    #[serde(default)]
    pub interpreter: Option<PathBuf>,
    /// Its arguments. `{id}`, `{kind}`, `{host}`, `{runtime_dir}`, `{endpoint_file}` and the names of `parameters` are substituted. The worker
    /// writes its endpoint to `{endpoint_file}`, which is `{runtime_dir}/{id}.endpoint`; its standard input is a pipe that closes when the
    /// process manager ends.
    #[serde(default)]
    pub args: Vec<String>,
    /// Further values to substitute, by name.
    #[serde(default)]
    pub parameters: BTreeMap<String, Parameter>,
    /// Environment variables, with the same substitutions. From the process manager's own environment the worker gets what programs need to run
    /// at all (`PATH`, `HOME`, `LANG`, `TZ` and the like) and every variable that begins with `RATN_`.
    #[serde(default)]
    pub env: BTreeMap<String, String>,
    /// Further variables of the process manager's own environment that the worker gets.
    #[serde(default)]
    pub pass_env: Vec<String>,
    /// Its working directory; by default the process manager's.
    #[serde(default)]
    pub directory: Option<PathBuf>,
    /// The user that it runs as, without supplementary groups; only root may name another user than its own.
    #[serde(default)]
    pub user: Option<String>,
    /// Its resource limits.
    #[serde(default)]
    pub limits: Limits,
    /// What has to be free on the machine for each worker beyond `min`; otherwise another host is asked.
    #[serde(default)]
    pub needs: Needs,
    /// For workers that move something: how long the next grant waits after a lease that ended otherwise than by its holder's release, in
    /// milliseconds. Such a worker does not start without it.
    #[serde(default)]
    pub standstill_ms: Option<u64>,
    /// How it shows that it is ready.
    #[serde(default)]
    pub readiness: Readiness,
    /// Templates that need a ready worker before the first worker of this one is started.
    #[serde(default)]
    pub after: Vec<String>,
    /// Minimum number of workers.
    #[serde(default = "one")]
    pub min: u32,
    /// Maximum number of workers; by default `min`, but at least one.
    #[serde(default)]
    pub max: Option<u32>,
    /// Number of workers kept ready in addition to held ones (and to `min`).
    #[serde(default)]
    pub spares: u32,
    /// A worker beyond the kept number ends when nobody has held it for this long, in seconds.
    #[serde(default = "minute")]
    pub idle_s: f64,
    /// A worker that is not ready after this long has failed, in seconds.
    #[serde(default = "ten")]
    pub start_timeout_s: f64,
    /// Health checks that detect a hung worker.
    #[serde(default)]
    pub liveness: Liveness,
    /// Time for a held worker that is to stop to be released, in seconds; then its holder loses it.
    #[serde(default = "half_a_minute")]
    pub drain_s: f64,
    /// Whether workers outlive a process manager that was killed, for a successor to adopt them. Otherwise they end with it.
    #[serde(default)]
    pub adopt: bool,
    /// A worker that nobody has adopted after this long ends, in seconds.
    #[serde(default = "ten")]
    pub adopt_grace_s: f64,
    /// A worker that moves nothing ends itself, to be replaced, when a cancelled goal still runs this long after the 3 s that it has to stop, in
    /// seconds; 0: never.
    #[serde(default = "minute")]
    pub stuck_timeout_s: f64,
    /// A worker that has not ended this long after SIGTERM is killed, in seconds.
    #[serde(default = "two")]
    pub stop_timeout_s: f64,
    /// Delay before the restart after a second crash in a row, in milliseconds; a first crash is followed by a restart at once, each further one
    /// by twice the delay, …
    #[serde(default = "backoff")]
    pub backoff_ms: u64,
    /// … up to this delay, in milliseconds.
    #[serde(default = "max_backoff")]
    pub max_backoff_ms: u64,
    /// A worker that served this long before its crash was not in a crash loop, in seconds.
    #[serde(default = "ten")]
    pub stable_s: f64,
    /// After this many crashes in a row the pool has failed: nothing is started until a client asks for workers.
    #[serde(default = "crash_limit")]
    pub crash_limit: u32,
}

/// Health checks of serving workers: a worker that does not answer in time is killed and replaced.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Liveness {
    /// Pause between an answer and the next check, in seconds.
    pub interval_s: f64,
    /// Timeout of an answer, in seconds.
    pub timeout_s: f64,
}

impl Default for Liveness {
    fn default() -> Self {
        Liveness { interval_s: 5.0, timeout_s: 10.0 }
    }
}

/// What has to be free on the machine for one more worker. All keys are optional.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Needs {
    /// Memory, in MiB.
    pub free_memory_mib: Option<u64>,
    /// Number of idle processors.
    pub idle_cores: Option<f64>,
}

impl Needs {
    /// How many more workers there is room for; `None` where they need nothing.
    pub(crate) fn room(&self, sample: &Sample) -> Option<u32> {
        let fits = |free: f64, of_one: f64| (free / of_one).floor().clamp(0.0, f64::from(MAX_WORKERS)) as u32;
        let memory = self.free_memory_mib.map(|mib| fits((sample.free_memory_bytes >> 20) as f64, mib as f64));
        let cores = self.idle_cores.map(|cores| fits(sample.idle_cores, cores));
        memory.into_iter().chain(cores).min()
    }

    pub(crate) fn is_something(&self) -> bool {
        *self != Needs::default()
    }

    pub(crate) fn words(&self) -> String {
        let memory = self.free_memory_mib.map(|mib| format!("{mib} MiB of free memory"));
        let cores = self.idle_cores.map(|cores| format!("{cores} idle cores"));
        memory.into_iter().chain(cores).collect::<Vec<_>>().join(" and ")
    }
}

impl Liveness {
    pub(crate) fn interval(self) -> Duration {
        Duration::from_secs_f64(self.interval_s)
    }

    pub(crate) fn timeout(self) -> Duration {
        Duration::from_secs_f64(self.timeout_s)
    }
}

impl Template {
    /// The command line, for messages.
    pub(super) fn command_line(&self) -> String {
        let (program, args) = self.invocation();
        let program = program.map_or_else(|| "ratn".to_owned(), |program| program.display().to_string());
        std::iter::once(program).chain(args).collect::<Vec<_>>().join(" ")
    }

    /// The program (`None` for this program) and its arguments, before substitution.
    pub(super) fn invocation(&self) -> (Option<PathBuf>, Vec<String>) {
        match &self.python {
            None => (self.program.clone(), self.args.clone()),
            Some(script) => (Some(self.interpreter_of(script).program), python::arguments(script, &self.args)),
        }
    }

    fn interpreter_of(&self, script: &Path) -> Interpreter {
        let active = std::env::var_os("VIRTUAL_ENV").map(PathBuf::from);
        Interpreter::of(script, self.interpreter.as_deref(), active.as_deref(), Path::is_file)
    }

    /// Makes relative paths absolute, from the config's folder.
    pub fn settle(&mut self, folder: &Path) {
        if let Some(script) = self.python.as_mut().filter(|script| script.is_relative()) {
            let from_here = folder.join(&*script);
            *script = std::path::absolute(&from_here).unwrap_or(from_here);
        }
    }

    /// A template with the default of every optional key.
    pub fn new(name: impl Into<String>, kind: impl Into<String>) -> Template {
        Template {
            name: name.into(),
            kind: kind.into(),
            program: None,
            python: None,
            interpreter: None,
            args: Vec::new(),
            parameters: BTreeMap::new(),
            env: BTreeMap::new(),
            pass_env: Vec::new(),
            directory: None,
            user: None,
            limits: Limits::default(),
            needs: Needs::default(),
            standstill_ms: None,
            readiness: Readiness::default(),
            after: Vec::new(),
            min: one(),
            max: None,
            spares: 0,
            idle_s: minute(),
            start_timeout_s: ten(),
            liveness: Liveness::default(),
            drain_s: half_a_minute(),
            adopt: false,
            adopt_grace_s: ten(),
            stuck_timeout_s: minute(),
            stop_timeout_s: two(),
            backoff_ms: backoff(),
            max_backoff_ms: max_backoff(),
            stable_s: ten(),
            crash_limit: crash_limit(),
        }
    }

    /// Maximum number of workers.
    pub fn max_workers(&self) -> u32 {
        self.max.unwrap_or(self.min.max(1))
    }

    pub(crate) fn start_timeout(&self) -> Duration {
        Duration::from_secs_f64(self.start_timeout_s)
    }

    pub(crate) fn idle(&self) -> Duration {
        Duration::from_secs_f64(self.idle_s)
    }

    pub(crate) fn drain(&self) -> Duration {
        Duration::from_secs_f64(self.drain_s)
    }

    pub(crate) fn stop_timeout(&self) -> Duration {
        Duration::from_secs_f64(self.stop_timeout_s)
    }

    /// How long a worker's device may go on moving after its lease has ended; `None` for a worker without one.
    pub(crate) fn standstill(&self) -> Option<Duration> {
        self.standstill_ms.map(Duration::from_millis)
    }

    /// How long a worker's cancelled goal may run on; `None` for no limit, as for workers that move something.
    pub(crate) fn stuck_timeout(&self) -> Option<Duration> {
        let is_ended = self.stuck_timeout_s > 0.0 && self.standstill_ms.is_none();
        is_ended.then(|| Duration::from_secs_f64(self.stuck_timeout_s))
    }

    pub(crate) fn stable(&self) -> Duration {
        Duration::from_secs_f64(self.stable_s)
    }

    /// Whether the pool may grow because requests wait for held workers. Not for workers that move something: there is only one robot.
    pub(crate) fn grows_with_the_queue(&self) -> bool {
        self.standstill_ms.is_none() && self.max_workers() > 1
    }

    /// Whether its workers are started in the same way as those of `other`: their number and the restart policy do not count.
    pub(crate) fn starts_the_same_as(&self, other: &Template) -> bool {
        let of_the_process = |template: &Template| Template {
            name: String::new(),
            kind: template.kind.clone(),
            program: template.program.clone(),
            python: template.python.clone(),
            interpreter: template.interpreter.clone(),
            args: template.args.clone(),
            parameters: template.parameters.clone(),
            env: template.env.clone(),
            pass_env: template.pass_env.clone(),
            directory: template.directory.clone(),
            user: template.user.clone(),
            limits: template.limits,
            standstill_ms: template.standstill_ms,
            readiness: template.readiness.clone(),
            adopt: template.adopt,
            adopt_grace_s: template.adopt_grace_s,
            stuck_timeout_s: template.stuck_timeout_s,
            ..Template::new("", "")
        };
        of_the_process(self) == of_the_process(other)
    }

    /// What is missing on this machine to start a worker, for people.
    pub fn obstacle(&self) -> Option<String> {
        if let Some(directory) = self.directory.as_ref().filter(|directory| !directory.is_dir()) {
            return Some(format!("there is no directory {}", directory.display()));
        }
        if let Some(Err(why)) = self.user.as_deref().map(Account::named) {
            return Some(why);
        }
        if let Some(script) = &self.python {
            if !script.is_file() {
                return Some(format!("there is no Python script {}", script.display()));
            }
            let Interpreter { program, because } = self.interpreter_of(script);
            return not_there(&program).map(|why| format!("{why}, which is to run {} ({because})", script.display()));
        }
        not_there(self.program.as_ref()?)
    }

    /// The interpreter of a Python worker and why it was chosen, for people.
    pub fn interpreter(&self) -> Option<String> {
        let Interpreter { program, because } = self.interpreter_of(self.python.as_deref()?);
        Some(format!("{} runs it ({because})", program.display()))
    }

    /// For a Python worker whose interpreter runs and does not find the package `ratn`: what is missing where, for people. The interpreter is asked
    /// in the template's environment, as far as that has no substitutions; one that gives no answer in 10 s has the package.
    pub fn lacks_package(&self) -> Option<String> {
        let script = self.python.as_deref()?;
        let Interpreter { program, because } = self.interpreter_of(script);
        let mut command = std::process::Command::new(&program);
        command.args(["-c", FINDS_PACKAGE]).arg(script).envs(self.env.iter().filter(|(_, value)| !value.contains('{')));
        command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null());
        if let Some(directory) = &self.directory {
            command.current_dir(directory);
        }
        let (mut child, until) = (command.spawn().ok()?, Instant::now() + PYTHON_PATIENCE);
        let ended = loop {
            match child.try_wait() {
                Ok(None) if Instant::now() < until => std::thread::sleep(Duration::from_millis(10)),
                ended => break ended.ok().flatten(),
            }
        };
        if ended.is_none() {
            let _ = child.kill().and_then(|()| child.wait().map(drop));
        }
        let lacks = ended?.code() == Some(LACKS_PACKAGE);
        lacks.then(|| format!("{} ({because}) finds no package `ratn`", program.display()))
    }

    /// Reports what is wrong with it; `at` is its place in the config.
    pub(super) fn check(&self, at: &str) -> Result<(), ConfigError> {
        let key = |name: &str| format!("{at}.{name}");
        check_name(&key("name"), &self.name)?;
        check_name(&key("kind"), &self.kind)?;
        rule(key("kind"), is_kind(&self.kind), format!("`{}` has to be {KIND_RULE}", self.kind))?;
        let one_of_both = self.python.is_none() || self.program.is_none();
        rule(key("python"), one_of_both, "instead of `program`, not beside it: `interpreter` is what runs the script")?;
        let runs_something = self.interpreter.is_none() || self.python.is_some();
        rule(key("interpreter"), runs_something, "beside `python`, whose script it runs")?;
        let max = self.max_workers();
        rule(key("max"), self.min <= max, format!("min = {} is above max = {max}", self.min))?;
        rule(key("max"), max <= MAX_WORKERS, format!("at most {MAX_WORKERS}"))?;
        let kept = self.min.saturating_add(self.spares);
        rule(key("spares"), self.spares == 0 || kept <= max, format!("min + spares = {kept} is above max = {max}"))?;
        for (name, seconds) in [
            ("start_timeout_s", self.start_timeout_s),
            ("drain_s", self.drain_s),
            ("adopt_grace_s", self.adopt_grace_s),
            ("stop_timeout_s", self.stop_timeout_s),
            ("stable_s", self.stable_s),
            ("idle_s", self.idle_s),
            ("liveness.interval_s", self.liveness.interval_s),
            ("liveness.timeout_s", self.liveness.timeout_s),
        ] {
            rule(key(name), (0.001..=86_400.0).contains(&seconds), "from 0.001 s to a day")?;
        }
        let stuck = self.stuck_timeout_s == 0.0 || (0.001..=86_400.0).contains(&self.stuck_timeout_s);
        rule(key("stuck_timeout_s"), stuck, "0, which is never, or from 0.001 s to a day")?;
        let standstill = self.standstill_ms.is_none_or(|ms| (1..=LONGEST_STANDSTILL_MS).contains(&ms));
        rule(key("standstill_ms"), standstill, format!("from 1 to {LONGEST_STANDSTILL_MS} ms"))?;
        let one = self.standstill_ms.is_none() || max == 1;
        rule(
            key("max"),
            one,
            "1 where standstill_ms is set: two workers cannot move the same robot, and each robot has a template of its own",
        )?;
        rule(key("crash_limit"), self.crash_limit >= 1, "at least 1")?;
        rule(key("backoff_ms"), self.backoff_ms >= 1, "at least 1 ms")?;
        rule(key("max_backoff_ms"), self.max_backoff_ms >= self.backoff_ms, "at least backoff_ms")?;
        let absolute = self.directory.as_ref().is_none_or(|directory| directory.is_absolute());
        rule(key("directory"), absolute, "an absolute path")?;
        if let Some(user) = &self.user {
            check_name(&key("user"), user)?;
        }
        let line = matches!(self.readiness, Readiness::Line { .. });
        rule(
            key("adopt"),
            !(self.adopt && line),
            "who is ready by a line of its output cannot be adopted: nobody could ask it",
        )?;
        self.limits.check(&key("limits"))?;
        rule(key("needs.free_memory_mib"), self.needs.free_memory_mib != Some(0), "at least 1 MiB")?;
        let cores = self.needs.idle_cores.is_none_or(|cores| (0.01..=4_096.0).contains(&cores));
        rule(key("needs.idle_cores"), cores, "from 0.01 to 4096")?;
        self.readiness.check(&key("readiness"), self)?;
        for (name, parameter) in &self.parameters {
            parameter.check(&key(&format!("parameters.{name}")), name)?;
        }
        let texts = self.args.iter().enumerate().map(|(i, text)| (format!("args[{i}]"), text));
        for (name, text) in texts.chain(self.env.iter().map(|(name, text)| (format!("env.{name}"), text))) {
            let unknown = parameter::unknown(text, &self.parameters);
            rule(key(&name), unknown.is_none(), format!("`{{{}}}` is not known", unknown.unwrap_or_default()))?;
        }
        Ok(())
    }
}

/// Why a program cannot be started.
fn not_there(program: &Path) -> Option<String> {
    let runs = |file: &Path| file.is_file() && access(file, AccessFlags::X_OK).is_ok();
    if program.components().count() > 1 {
        return match (program.is_file(), runs(program)) {
            (false, _) => Some(format!("there is no program {}", program.display())),
            (true, false) => Some(format!("{} may not be executed", program.display())),
            (true, true) => None,
        };
    }
    let path = std::env::var_os("PATH").unwrap_or_default();
    let found = std::env::split_paths(&path).any(|directory| runs(&directory.join(program)));
    (!found).then(|| format!("there is no program {} in PATH", program.display()))
}

fn one() -> u32 {
    1
}

fn two() -> f64 {
    2.0
}

fn ten() -> f64 {
    10.0
}

fn half_a_minute() -> f64 {
    30.0
}

fn minute() -> f64 {
    60.0
}

fn backoff() -> u64 {
    100
}

fn max_backoff() -> u64 {
    5_000
}

fn crash_limit() -> u32 {
    5
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;

    #[test]
    fn a_script_is_run_in_place_of_a_program() {
        let with = |program: Option<&str>, python: Option<&str>, interpreter: Option<&str>| Template {
            program: program.map(PathBuf::from),
            python: python.map(PathBuf::from),
            interpreter: interpreter.map(PathBuf::from),
            ..Template::new("near", "Near")
        };
        let refused = |template: Template| template.check("templates[0]").map_err(|error| error.to_string());
        assert!(refused(with(None, Some("near.py"), Some("python3"))).is_ok());
        assert!(refused(with(Some("x"), Some("near.py"), None)).is_err_and(|why| why.contains("templates[0].python")));
        assert!(refused(with(None, None, Some("x"))).is_err_and(|why| why.contains("templates[0].interpreter")));
        let mut near = with(None, Some("near.py"), Some("python3"));
        near.settle(Path::new("/project"));
        assert!(near.command_line().starts_with("python3 /project/near.py --id {id} "), "{}", near.command_line());
        assert!(near.obstacle().is_some_and(|why| why.contains("no Python script /project/near.py")));
    }

    #[test]
    fn an_interpreter_that_does_not_find_the_package_is_told() {
        let with = |interpreter: &str| Template {
            python: Some("near.py".into()),
            interpreter: Some(interpreter.into()),
            ..Template::new("near", "Near")
        };
        // A program that ends by itself, whatever it is asked, and one that is not there.
        assert_eq!(with("true").lacks_package(), None);
        assert_eq!(with("no-such-python").lacks_package(), None);
        let folder = tempfile::tempdir().unwrap();
        let script = folder.path().join("python");
        std::fs::write(&script, "#!/bin/sh\nexit 3\n").unwrap();
        std::fs::set_permissions(&script, std::os::unix::fs::PermissionsExt::from_mode(0o755)).unwrap();
        let lacks = with(&script.display().to_string()).lacks_package().unwrap();
        assert!(lacks.ends_with("python (the template's `interpreter`) finds no package `ratn`"), "{lacks}");
    }

    #[test]
    fn what_moves_has_one_worker() {
        let arms = |max| Template { standstill_ms: Some(6_000), max: Some(max), ..Template::new("arm", "Arm") };
        assert!(arms(1).check("templates[0]").is_ok());
        let refused = arms(2).check("templates[0]").map_err(|error| error.to_string());
        assert!(
            refused.is_err_and(|why| why.contains("templates[0].max") && why.contains("1 where standstill_ms is set"))
        );
    }
    #[test]
    fn a_worker_that_moves_nothing_ends_itself_when_it_is_stuck_unless_its_template_says_never() {
        let after = |stuck_timeout_s, standstill_ms| {
            let template = Template { stuck_timeout_s, standstill_ms, ..Template::new("planner", "PathPlanner") };
            template.check("templates[0]").map(|()| template.stuck_timeout()).map_err(|error| error.to_string())
        };
        assert_eq!(after(60.0, None), Ok(Some(Duration::from_secs(60))));
        assert_eq!([after(0.0, None), after(60.0, Some(6_000))], [Ok(None), Ok(None)]);
        for none in [-1.0, f64::NAN, 1e300] {
            assert!(after(none, None).is_err_and(|why| why.contains("templates[0].stuck_timeout_s")), "{none}");
        }
    }
}
