//! What README and `docs/` print in fenced blocks is so: commands are taken by the command line or are run, tasks load, configs are read.
//!
//! | block | is |
//! |---|---|
//! | `console` | lines `$ command`; every `ratn` command is one that the command line takes, every script is there |
//! | `console run` | run in a folder of the document's own, which its `file=` blocks are written to; what is shown must be printed, a line `…` standing for any; with `about`, numbers may differ |
//! | `usage` | lines `ratn COMMAND …`; the help of the command has every `--option` of the line, and the next lines' |
//! | `yaml` | a whole task, which `check` takes without an error, with `config=` on that system; `yaml fragment` is states of one |
//! | `toml` | a config; `toml template` is the rest of a `[[process-manager.template]]`; `toml part-of=FILE` are lines of that file of the repository, in its order |
//! | `rust example=FILE` | that file of the repository, which the compiler has read |
//! | `python example=FILE` | that file of the repository, which `scripts/check-python` runs |
//! | `json`, `turtle` | JSON, one or several documents; an ontology |
//! | `text`, `xml` | not read here; commands of the document may read a `file=` |
//! | anything else | must say why nothing runs it, behind `not run:`; they are counted |

#[path = "../support/mod.rs"]
mod support;

mod fence;
mod generated;
mod links;
mod shell;

use anyhow::{Context, bail, ensure};
use fence::Fence;
use ratn_model::catalogue::Catalogue;
use ratn_model::load::load;
use std::collections::BTreeMap;
use std::path::Path;
use std::process::Command;
use support::{Place, repository};

/// Programs that are not ours and may stand in a `console` block.
const OTHERS: [&str; 7] = ["cat", "cd", "echo", "etcd", "etcdctl", "git", "sed"];
/// What a fragment of a task takes from the rest of the task, which is not shown.
const FROM_ELSEWHERE: [&str; 3] = ["unknown-state", "unknown-variable", "unestablished-precondition"];

#[test]
fn every_block_of_the_documentation_is_what_it_says() -> anyhow::Result<()> {
    let (mut wrong, mut counts) = (Vec::new(), BTreeMap::new());
    for name in documents()? {
        let place = Place::new()?;
        for fence in fence::of_document(&repository(&name), &name)? {
            let kind = if fence.not_run.is_some() { "not run" } else { fence.language.as_str() };
            *counts.entry(kind.to_owned()).or_insert(0_u32) += 1;
            match (&fence.not_run, examined(&fence, &place)) {
                (Some(reason), _) if reason.is_empty() => wrong.push(format!("{}: no reason is given", fence.place)),
                (Some(reason), _) => eprintln!("{}: not run: {reason}", fence.place),
                (None, Err(error)) => wrong.push(format!("{}: {error:#}", fence.place)),
                (None, Ok(())) => {}
            }
        }
    }
    eprintln!("{counts:?}");
    ensure!(counts.get("console").is_some_and(|blocks| *blocks >= 10), "hardly any command was read: {counts:?}");
    ensure!(wrong.is_empty(), "{}", wrong.join("\n"));
    Ok(())
}

#[test]
fn every_link_of_the_documentation_leads_somewhere() -> anyhow::Result<()> {
    let others = ["ARCHITECTURE.md", "SECURITY.md", "CHANGELOG.md"].map(str::to_owned);
    for name in documents()?.into_iter().chain(others) {
        links::lead_somewhere(&repository(&name), &name)?;
    }
    Ok(())
}

fn documents() -> anyhow::Result<Vec<String>> {
    let mut names = vec!["README.md".to_owned(), "CONTRIBUTING.md".to_owned()];
    for entry in std::fs::read_dir(repository("docs"))? {
        let name = entry?.file_name().into_string().ok().context("a name that is no text")?;
        names.extend(Path::new(&name).extension().is_some_and(|end| end == "md").then(|| format!("docs/{name}")));
    }
    names.sort();
    Ok(names)
}

fn examined(fence: &Fence, place: &Place) -> anyhow::Result<()> {
    if fence.not_run.is_some() {
        return Ok(());
    }
    if let Some(name) = fence.value("file") {
        std::fs::write(place.path().join(name), &fence.text)?;
    }
    match fence.language.as_str() {
        "text" | "xml" => Ok(()),
        "usage" => usage(&fence.text, place),
        "console" => {
            let commands = shell::commands(&fence.text);
            ensure!(!commands.is_empty(), "no line begins with `$ `");
            for command in commands {
                taken(&command.line)?;
                if fence.is("run") {
                    run(&command, place, fence.is("about"))?;
                }
            }
            Ok(())
        }
        "yaml" if fence.is("fragment") => {
            let indent = if fence.text.starts_with(' ') { "" } else { "  " };
            let states: String = fence.text.lines().map(|line| format!("{indent}{line}\n")).collect();
            // Libraries are files of their own, which are not read here.
            let library: &[&str] = if fence.is("library") { &["unknown-library"] } else { &[] };
            findings(&format!("task: fragment\nstates:\n{states}"), &[&FROM_ELSEWHERE, library].concat())
        }
        "yaml" if fence.value("config").is_some() => {
            let (task, config) =
                (fence.value("file").context("no `file=`")?, fence.value("config").unwrap_or_default());
            printed_by(place.ratn(&["check", task, "--config", config]).current_dir(place.path())).map(drop)
        }
        "yaml" => findings(&fence.text, &[]),
        "toml" if fence.value("part-of").is_some() => {
            let file = fence.value("part-of").unwrap_or_default();
            let whole = std::fs::read_to_string(repository(file))?;
            let mut lines = whole.lines();
            for line in fence.text.lines().filter(|line| !line.is_empty()) {
                ensure!(lines.any(|of_file| of_file == line), "{file} has no line `{line}`, or an earlier one only");
            }
            Ok(())
        }
        "toml" => config(fence, place),
        "rust" | "python" => {
            let example = fence.value("example").context("no `example=` says which file this is")?;
            ensure!(std::fs::read_to_string(repository(example))? == fence.text, "this is not what {example} has");
            Ok(())
        }
        "json" => {
            let documents = serde_json::Deserializer::from_str(&fence.text).into_iter::<serde_json::Value>();
            Ok(documents.collect::<Result<Vec<_>, _>>().map(drop)?)
        }
        "turtle" => {
            std::fs::write(place.path().join("ontology.ttl"), &fence.text)?;
            std::fs::write(place.path().join("ontology.yaml"), "task: t\nontology: ontology.ttl\nstates: []\n")?;
            printed_by(place.ratn(&["check", "ontology.yaml"]).current_dir(place.path())).map(drop)
        }
        other => bail!("nothing here reads `{other}`: say why behind `not run:`"),
    }
}

/// The task or states load, but for errors of these rules.
fn findings(source: &str, but: &[&str]) -> anyhow::Result<()> {
    let Err(found) = load(source, "task.yaml", &Catalogue::standard()) else { return Ok(()) };
    let own = found.iter().find(|finding| !but.contains(&finding.rule.as_str()));
    own.map_or(Ok(()), |finding| bail!("{finding}"))
}

/// Each command of the line is one of ours that is taken, a script that is there, or a known program.
fn taken(line: &str) -> anyhow::Result<()> {
    for mut command in shell::words(line) {
        while command.first().is_some_and(|word| word.contains('=') && !word.starts_with('-')) {
            command.remove(0);
        }
        // What `cargo run` runs is `ratn`.
        if command.first().is_some_and(|program| program == "cargo") {
            let ours = command.iter().position(|word| word == "--").filter(|_| command.contains(&"run".to_owned()));
            let Some(ours) = ours else { continue };
            command.splice(..=ours, ["ratn".to_owned()]);
        }
        let Some(program) = command.first() else { continue };
        if program == "ratn" {
            ratn::would_take(&command).or_else(|said| {
                let asked = command.iter().any(|word| word == "--help" || word == "--version");
                if asked { Ok(()) } else { Err(anyhow::anyhow!("`{}`: {said}", command.join(" "))) }
            })?;
        } else if program.starts_with("scripts/") {
            ensure!(repository(program).exists(), "there is no {program}");
        } else {
            ensure!(OTHERS.contains(&program.as_str()), "`{program}` is no program that a document may name");
        }
    }
    Ok(())
}

/// Runs a line in a shell that finds the `ratn` under test, and compares what it printed.
fn run(command: &shell::Command, place: &Place, about: bool) -> anyhow::Result<()> {
    let programs = place.path().join("programs");
    if !programs.exists() {
        std::fs::create_dir(&programs)?;
        std::os::unix::fs::symlink(env!("CARGO_BIN_EXE_ratn-under-test"), programs.join("ratn"))?;
    }
    let path = format!("{}:{}", programs.display(), std::env::var("PATH").unwrap_or_default());
    let mut shell = place.within("bash", &["-c", &format!("{{ {}\n}} 2>&1", command.line)]);
    let output = shell.current_dir(place.path()).env("PATH", path).output()?;
    let printed = String::from_utf8_lossy(&output.stdout);
    ensure!(shell::same(&command.printed, &printed, about), "`{}` does not print this, but\n{printed}", command.line);
    Ok(())
}

/// Each command's help has the options that its lines show.
fn usage(text: &str, place: &Place) -> anyhow::Result<()> {
    let mut help = String::new();
    for line in text.lines() {
        if let Some(command) = line.strip_prefix("ratn ") {
            let name = |word: &&str| word.starts_with(|c: char| c.is_ascii_lowercase()) && !word.contains('|');
            let names: Vec<&str> = command.split_whitespace().take_while(name).collect();
            ensure!(!names.is_empty(), "`{line}` names no command");
            help = printed_by(&mut place.ratn(&[&names[..], &["--help"]].concat()))?;
        }
        let known: Vec<&str> = options(&help).collect();
        let missing = options(line).find(|option| !known.contains(option));
        ensure!(missing.is_none(), "`{line}`: there is no {}", missing.unwrap_or_default());
    }
    Ok(())
}

fn options(text: &str) -> impl Iterator<Item = &str> {
    let words = text.split(|letter: char| !letter.is_ascii_alphanumeric() && letter != '-');
    words.filter(|word| word.starts_with("--") && word.len() > 2)
}

fn config(fence: &Fence, place: &Place) -> anyhow::Result<()> {
    let whole = "[[process-manager.template]]\nname = \"documented\"\nkind = \"Documented\"\n";
    let text = if fence.is("template") { format!("{whole}{}", fence.text) } else { fence.text.clone() };
    std::fs::write(place.path().join("documented.toml"), text)?;
    let mut check = place.ratn(&["resource-manager", "--check-config", "--config", "documented.toml"]);
    printed_by(check.current_dir(place.path())).map(drop)
}

fn printed_by(command: &mut Command) -> anyhow::Result<String> {
    let output = command.output()?;
    let (out, err) = support::texts(&output);
    ensure!(output.status.success(), "{err}");
    Ok(out)
}
