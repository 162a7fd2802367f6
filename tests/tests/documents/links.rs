//! Links from one page of the documentation to another, or to a heading of it.

use anyhow::{Context, ensure};
use std::path::Path;

/// Every link of the file that names no other site leads to a file, and to a heading where it names one.
pub(crate) fn lead_somewhere(file: &Path, name: &str) -> anyhow::Result<()> {
    let text = std::fs::read_to_string(file)?;
    for rest in text.split("](").skip(1) {
        let target = rest.split(')').next().unwrap_or_default();
        if target.contains("://") || target.contains(' ') {
            continue;
        }
        let (path, heading) = target.split_once('#').map_or((target, None), |(path, heading)| (path, Some(heading)));
        let aim = if path.is_empty() { file.to_owned() } else { file.parent().context("no folder")?.join(path) };
        ensure!(aim.exists(), "{name}: the link `{target}` leads nowhere");
        let Some(heading) = heading else { continue };
        let aim = std::fs::read_to_string(&aim).with_context(|| format!("{name}: `{target}`"))?;
        let found = aim.lines().any(|line| line.starts_with('#') && anchor(line) == heading);
        ensure!(found, "{name}: the link `{target}` names no heading");
    }
    Ok(())
}

/// What a heading is called in links.
fn anchor(heading: &str) -> String {
    let kept = heading.trim_start_matches('#').trim().to_lowercase();
    let kept = kept.chars().filter(|letter| letter.is_alphanumeric() || "-_ ".contains(*letter));
    kept.map(|letter| if letter == ' ' { '-' } else { letter }).collect()
}
