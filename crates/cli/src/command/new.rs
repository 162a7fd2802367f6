//! `ratn new worker NAME` and `ratn new task NAME`: a starting point that builds, runs and passes the checks as it is.

use crate::failure::Failure;
use crate::output;
use anyhow::Context;
use clap::{Args, Subcommand};
use std::fs;
use std::path::{Path, PathBuf};

/// Maximum length of a name in bytes.
const MOST_NAME: usize = 40;
/// The SDK's source where this program was built; it may not exist on another machine.
const SDK: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../worker");

#[derive(Debug, Clone, Args)]
pub(crate) struct NewArguments {
    #[command(subcommand)]
    what: New,
}

#[derive(Debug, Clone, Subcommand)]
enum New {
    /// Make a crate of a worker: a folder NAME with one action, its test, its pool and a task that uses it
    Worker {
        /// Letters, digits, `-` and `_`; tasks call it so, with `_` for `-`
        name: String,
        /// Where the source of `ratn-worker` is: the folder `crates/worker` of the repository
        #[arg(long, value_name = "DIR")]
        sdk: Option<PathBuf>,
    },
    /// Make a task file NAME.yaml with comments
    Task {
        /// Letters, digits, `-` and `_`
        name: String,
    },
}

/// Makes the worker or the task.
pub(crate) fn run(arguments: &NewArguments) -> Result<(), Failure> {
    match &arguments.what {
        New::Worker { name, sdk } => worker(name, sdk.as_deref()),
        New::Task { name } => {
            let words = Words::of(name)?;
            let file = PathBuf::from(format!("{name}.yaml"));
            write(&file, &words.fill(include_str!("new/task.yaml")))?;
            output::progress(format_args!(
                "{file}: try `ratn check {file}`, then `ratn run {file}`",
                file = file.display()
            ));
            Ok(())
        }
    }
}

fn worker(name: &str, sdk: Option<&Path>) -> Result<(), Failure> {
    let words = Words::of(name)?;
    let sdk = sdk.unwrap_or(Path::new(SDK));
    let sdk = sdk.canonicalize().ok().filter(|sdk| sdk.join("Cargo.toml").is_file()).ok_or_else(|| {
        Failure::Refused(format!(
            "ratn: the source of `ratn-worker` is not in {}: say where it is, `ratn new worker {name} --sdk REPOSITORY/crates/worker`",
            sdk.display()
        ))
    })?;
    let folder = PathBuf::from(name);
    if folder.exists() {
        return Err(Failure::Refused(format!("ratn: {name} is there already: name another one, or remove it")));
    }
    fs::create_dir_all(folder.join("src")).with_context(|| format!("cannot make the folder {name}"))?;
    let here = folder.canonicalize().with_context(|| format!("cannot find the folder {name}"))?;
    let fill = |text: &str| {
        let text = words.fill(text);
        text.replace("@SDK@", &sdk.display().to_string()).replace("@HERE@", &here.display().to_string())
    };
    for (file, text) in [
        ("Cargo.toml", include_str!("new/worker/Cargo.toml.in")),
        ("src/main.rs", include_str!("new/worker/main.rs.in")),
        ("catalogue.toml", include_str!("new/worker/catalogue.toml")),
        ("system.toml", include_str!("new/worker/system.toml")),
        ("task.yaml", include_str!("new/worker/task.yaml")),
        ("README.md", include_str!("new/worker/README.md")),
        (".gitignore", "target\n"),
    ] {
        write(&folder.join(file), &fill(text))?;
    }
    output::progress(format_args!("{name}: go on with {name}/README.md: `cd {name} && cargo test`"));
    Ok(())
}

/// Writes a file that does not exist yet.
fn write(file: &Path, text: &str) -> Result<(), Failure> {
    if file.exists() {
        return Err(Failure::Refused(format!(
            "ratn: {} is there already: name another one, or remove it",
            file.display()
        )));
    }
    Ok(fs::write(file, text).with_context(|| format!("cannot write {}", file.display()))?)
}

/// A name in the spellings of Rust, tasks and configs.
struct Words {
    name: String,
    /// For example `box_counter`.
    provider: String,
    /// For example `BoxCounter`.
    kind: String,
}

impl Words {
    fn of(name: &str) -> Result<Words, Failure> {
        let good = |c: char| c.is_ascii_alphanumeric() || c == '-' || c == '_';
        let begins = name.starts_with(|c: char| c.is_ascii_lowercase());
        if !begins || name.len() > MOST_NAME || !name.chars().all(good) {
            return Err(Failure::Refused(format!(
                "ratn: `{name}` is no name: 1 to {MOST_NAME} letters, digits, `-` and `_`, the first one a small letter"
            )));
        }
        let provider = name.replace('-', "_").to_lowercase();
        let capital = |word: &str| {
            let mut letters = word.chars();
            letters.next().map(|first| first.to_ascii_uppercase().to_string() + letters.as_str()).unwrap_or_default()
        };
        let kind = provider.split('_').map(capital).collect();
        Ok(Words { name: name.to_owned(), provider, kind })
    }

    fn fill(&self, text: &str) -> String {
        text.replace("@NAME@", &self.name).replace("@PROVIDER@", &self.provider).replace("@KIND@", &self.kind)
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;
    use ratn_model::catalogue::Catalogue;
    use ratn_model::load::load;

    #[test]
    fn a_new_task_is_good_and_has_no_warnings() {
        let text = Words::of("my-first_task").unwrap().fill(include_str!("new/task.yaml"));
        let loaded = load(&text, "task.yaml", &Catalogue::standard()).unwrap();
        assert_eq!(loaded.warnings, []);
        assert_eq!(loaded.program.name, "my_first_task");
    }

    #[test]
    fn the_task_of_a_new_worker_is_good_by_the_catalogue_of_that_worker() {
        let words = Words::of("pose-meter").unwrap();
        let catalogue = Catalogue::from_toml(&words.fill(include_str!("new/worker/catalogue.toml"))).unwrap();
        let loaded = load(&words.fill(include_str!("new/worker/task.yaml")), "task.yaml", &catalogue).unwrap();
        assert_eq!(loaded.warnings, []);
    }

    #[test]
    fn names_that_are_none_are_refused() {
        for name in ["", "Big", "../up", "a b", "1st", &"x".repeat(MOST_NAME + 1)] {
            assert!(Words::of(name).is_err(), "{name}");
        }
        assert_eq!(Words::of("box-counter").unwrap().kind, "BoxCounter");
    }
}
