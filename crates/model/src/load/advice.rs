//! Advice for a text that is no YAML. The YAML parser reports a place and a technical reason; people make a few typical mistakes, and the
//! line at that place shows which.

use super::yaml::InvalidYaml;
use crate::program::Location;

pub(super) fn advice(source: &str, error: &InvalidYaml) -> String {
    let lines: Vec<&str> = source.lines().collect();
    let index = (error.at.line as usize).saturating_sub(1);
    let Some(line) = lines.get(index) else { return String::new() };
    let above = lines[..index].iter().rev().find(|line| !line.trim().is_empty()).copied();
    let message = error.message.as_str();
    if line.chars().take_while(|c| c.is_whitespace()).any(|c| c == '\t') {
        return "indent with blanks: YAML takes no tabs".to_owned();
    }
    if message.contains("unsupported tag") || message.contains("unknown anchor") {
        return "YAML reads a `!`, `&` or `*` at the beginning of a value as its own: quote the value, and for a negation write `not`"
            .to_owned();
    }
    if message.contains("unexpected character") {
        return "quote the text: YAML keeps this character for itself at the beginning of a value".to_owned();
    }
    if message.contains("trailing content after") {
        return "a text ends at its closing quote: put the whole value into quotes of the other kind, such as '$mode = \"fast\"'"
            .to_owned();
    }
    if let Some((key, value)) = unspaced(line).or_else(|| unspaced(above?)) {
        return format!("put a blank behind the colon: `{key}: {value}`");
    }
    if let Some((key, value)) = second_colon(line, error.at) {
        return format!("quote the text, for it contains `: `: `{key}: \"{value}\"`");
    }
    indentation(line, above, &lines[..index]).unwrap_or_default()
}

/// `action:arm/move_to`: key and value without a space, which is parsed as one text.
fn unspaced(line: &str) -> Option<(&str, &str)> {
    let text = item(line);
    let (key, value) = text.split_once(':')?;
    let is_key = !key.is_empty() && key.chars().all(|c| c.is_ascii_alphanumeric() || c == '_');
    (is_key && value.starts_with(|c: char| c.is_ascii_alphabetic())).then_some((key, value))
}

/// `description: first: look`: the key and its value, if the parser stopped at the second colon.
fn second_colon(line: &str, at: Location) -> Option<(&str, &str)> {
    let upto: String = line.chars().take(at.column as usize).collect();
    let within_braces = upto.rfind(['{', ',']).map(|brace| &line[brace + 1..]);
    let text = item(within_braces.unwrap_or(line));
    let (key, value) = text.split_once(": ")?;
    let value = if within_braces.is_some() { value.split([',', '}']).next().unwrap_or(value) } else { value };
    let value = value.trim();
    let is_plain = !value.starts_with(['"', '\'', '{', '[', '&', '*', '!', '|', '>']);
    (is_plain && value.contains(": ") && !value.contains('"')).then_some((key.trim(), value))
}

/// A line with wrong indentation.
fn indentation(line: &str, above: Option<&str>, before: &[&str]) -> Option<String> {
    let own = indent(line);
    let above = above?;
    let what = item(line).split([':', ' ']).next().unwrap_or_default();
    if is_item(line) {
        let list = before.iter().rev().find(|line| is_item(line) && indent(line) < own).or_else(|| {
            let any = before.iter().rev().find(|line| is_item(line));
            any.filter(|line| indent(line) != own)
        })?;
        return Some(format!(
            "begin every `-` of a list in the same column: this one stands in column {}, the list above in column {}",
            own + 1,
            indent(list) + 1
        ));
    }
    // The column in which the keys of the line above begin, after a `-` if there is one.
    let beside = above.len() - item(above).len();
    if own > beside {
        return Some(format!(
            "`{what}` stands in column {} and the key above it, which has a value already, in column {}: begin both in the same column",
            own + 1,
            beside + 1
        ));
    }
    let columns: Vec<usize> = before.iter().map(|line| line.len() - item(line).len()).collect();
    let nearest = columns.iter().rev().filter(|column| **column != own).min_by_key(|column| column.abs_diff(own))?;
    (!columns.contains(&own)).then(|| {
        format!(
            "`{what}` stands in column {}, where no key above it does: begin it in column {}, as those beside it",
            own + 1,
            nearest + 1
        )
    })
}

/// The line without its indentation and list dash.
fn item(line: &str) -> &str {
    let line = line.trim_start();
    line.strip_prefix("- ").map_or(line, str::trim_start)
}

fn is_item(line: &str) -> bool {
    line.trim_start().starts_with("- ")
}

fn indent(line: &str) -> usize {
    line.len() - line.trim_start().len()
}
