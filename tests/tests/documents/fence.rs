//! The fenced blocks of a Markdown file, with where they stand and what their first line says of them.

use anyhow::{Context, ensure};
use std::path::Path;

/// A block between two lines of three backticks.
pub(crate) struct Fence {
    /// `docs/running.md:12`, the line of its first backticks.
    pub(crate) place: String,
    /// The first word behind the backticks.
    pub(crate) language: String,
    /// The other words.
    words: Vec<String>,
    /// Why nothing runs it: what stands behind `not run:`.
    pub(crate) not_run: Option<String>,
    pub(crate) text: String,
}

impl Fence {
    pub(crate) fn is(&self, word: &str) -> bool {
        self.words.iter().any(|found| found == word)
    }

    /// The value of `name=value`.
    pub(crate) fn value(&self, name: &str) -> Option<&str> {
        self.words.iter().find_map(|word| word.strip_prefix(name)?.strip_prefix('='))
    }
}

/// The blocks of the file `name` of the repository, in order. Lines that are indented by four blanks are a block too, one that says
/// nothing of itself: they are refused, except within a list or a fence.
pub(crate) fn of_document(file: &Path, name: &str) -> anyhow::Result<Vec<Fence>> {
    let document = std::fs::read_to_string(file).with_context(|| format!("cannot read {name}"))?;
    let (mut fences, mut indented_list) = (Vec::new(), false);
    let mut lines = document.lines().enumerate();
    while let Some((at, line)) = lines.next() {
        let place = format!("{name}:{}", at + 1);
        let Some(info) = line.trim_start().strip_prefix("```") else {
            let begins_item = line.trim_start().starts_with("- ") || line.starts_with(|c: char| c.is_ascii_digit());
            indented_list = begins_item || (indented_list && (line.is_empty() || line.starts_with("  ")));
            ensure!(
                indented_list || !line.starts_with("    "),
                "{place}: an indented block: put it between lines of three backticks, the first with its language"
            );
            continue;
        };
        let indent = line.len() - line.trim_start().len();
        let (info, not_run) = match info.split_once("not run:") {
            Some((info, reason)) => (info, Some(reason.trim().to_owned())),
            None => (info, None),
        };
        let mut words = info.split_whitespace().map(str::to_owned);
        let language = words.next().with_context(|| format!("{place}: a block without a language"))?;
        let text = lines.by_ref().map(|(_, line)| line).take_while(|line| line.trim() != "```");
        let text = text.map(|line| line.get(indent..).unwrap_or("").to_owned() + "\n").collect();
        fences.push(Fence { place, language, words: words.collect(), not_run, text });
    }
    Ok(fences)
}
