//! Workers that are Python scripts: the interpreter and its arguments.
//!
//! A script's packages are those of its interpreter, so the interpreter is looked for in this order: the one in the template, a virtual
//! environment beside the script or in a folder above it, the environment in which the process manager was started, and finally `python3`.

use std::path::{Path, PathBuf};

/// Usual folder names of virtual environments.
const ENVIRONMENTS: [&str; 2] = [".venv", "venv"];
const IN_ENVIRONMENT: &str = "bin/python";
const ANY: &str = "python3";
/// Arguments before those of the template: the ones that every worker of the SDK takes.
const ARGUMENTS: [&str; 6] = ["--id", "{id}", "--endpoint-file", "{endpoint_file}", "--kind", "{kind}"];

/// The interpreter of a script.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Interpreter {
    /// A path, or a name that is looked up in `PATH`.
    pub(super) program: PathBuf,
    /// Why this one was chosen.
    pub(super) because: &'static str,
}

impl Interpreter {
    /// Chooses the interpreter of a script; `said` is the template's, `active` the environment in which the process manager was started.
    pub(super) fn of(
        script: &Path,
        said: Option<&Path>,
        active: Option<&Path>,
        is_file: impl Fn(&Path) -> bool,
    ) -> Interpreter {
        if let Some(said) = said {
            return Interpreter { program: said.to_owned(), because: "the template's `interpreter`" };
        }
        let beside = script.ancestors().skip(1).flat_map(|folder| ENVIRONMENTS.map(|name| folder.join(name)));
        let mut beside = beside.map(|environment| environment.join(IN_ENVIRONMENT));
        if let Some(program) = beside.find(|program| is_file(program)) {
            return Interpreter { program, because: "the virtual environment beside the script" };
        }
        match active.map(|environment| environment.join(IN_ENVIRONMENT)).filter(|program| is_file(program)) {
            Some(program) => Interpreter { program, because: "$VIRTUAL_ENV of the process manager" },
            None => Interpreter { program: PathBuf::from(ANY), because: "nothing says another interpreter" },
        }
    }
}

/// The arguments of the script's interpreter.
pub(super) fn arguments(script: &Path, own: &[String]) -> Vec<String> {
    let first = std::iter::once(script.display().to_string());
    first.chain(ARGUMENTS.map(str::to_owned)).chain(own.iter().cloned()).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn of(said: Option<&str>, active: Option<&str>, files: &[&str]) -> (String, &'static str) {
        let script = Path::new("/home/me/project/workers/near.py");
        let is_file = |file: &Path| files.iter().any(|known| file == Path::new(known));
        let found = Interpreter::of(script, said.map(Path::new), active.map(Path::new), is_file);
        (found.program.display().to_string(), found.because)
    }

    #[test]
    fn the_nearest_environment_runs_a_script_unless_its_template_says_otherwise() {
        let above = "/home/me/project/.venv/bin/python";
        let beside = "/home/me/project/workers/venv/bin/python";
        let active = "/opt/env/bin/python";
        let all = [above, beside, active];
        assert_eq!(of(Some("python3.12"), Some("/opt/env"), &all).0, "python3.12");
        assert_eq!(of(None, Some("/opt/env"), &all).0, beside);
        assert_eq!(of(None, Some("/opt/env"), &[above, active]).0, above);
        assert_eq!(of(None, Some("/opt/env"), &[active]), (active.to_owned(), "$VIRTUAL_ENV of the process manager"));
        assert_eq!(of(None, Some("/gone"), &[]).0, "python3");
        assert_eq!(of(None, None, &[]), ("python3".to_owned(), "nothing says another interpreter"));
    }

    #[test]
    fn a_script_is_told_what_every_worker_is_and_then_what_its_template_says() {
        let all = arguments(Path::new("/x/near.py"), &["--within".to_owned(), "3".to_owned()]);
        assert_eq!(all.join(" "), "/x/near.py --id {id} --endpoint-file {endpoint_file} --kind {kind} --within 3");
    }
}
