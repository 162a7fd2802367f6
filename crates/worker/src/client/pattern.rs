//! Parses facts and patterns as users type them: `at(box_1)`, `on(?, table)`, `full(2)`. A name with a comma, a parenthesis or a space has
//! to be quoted, and so does a name that looks like a number.

use ratn_model::fact::{FactKey, FactPattern, Term};

/// Parses a pattern.
///
/// # Errors
/// The syntax that was expected.
pub fn pattern(text: &str) -> Result<FactPattern, String> {
    let wrong = || format!("`{text}` is no pattern: expected `predicate(argument, ?)`");
    let (predicate, rest) = text.trim().split_once('(').ok_or_else(wrong)?;
    let inside = rest.strip_suffix(')').ok_or_else(wrong)?;
    let predicate = predicate.trim().to_owned();
    if predicate.is_empty() || predicate.contains(['"', ',', ')']) {
        return Err(wrong());
    }
    let mut arguments = Vec::new();
    let mut rest = inside.trim();
    while !rest.is_empty() {
        let (argument, after) = match rest.strip_prefix('"') {
            Some(quoted) => {
                let (name, after) = quoted.split_once('"').ok_or_else(wrong)?;
                (Some(Term::Name(name.to_owned())), after.trim_start())
            }
            None => {
                let end = rest.find(',').unwrap_or(rest.len());
                (argument(rest[..end].trim()).ok_or_else(wrong)?, &rest[end..])
            }
        };
        arguments.push(argument);
        rest = match after.strip_prefix(',') {
            Some(more) if more.trim().is_empty() => return Err(wrong()),
            Some(more) => more.trim(),
            None if after.is_empty() => after,
            None => return Err(wrong()),
        };
    }
    Ok(FactPattern { predicate, arguments })
}

/// Parses a pattern without `?`: a fact's key.
///
/// # Errors
/// The syntax that was expected.
pub fn fact(text: &str) -> Result<FactKey, String> {
    let FactPattern { predicate, arguments } = pattern(text)?;
    let arguments: Option<Vec<Term>> = arguments.into_iter().collect();
    let arguments = arguments.ok_or_else(|| format!("`{text}` is no single fact: say every argument"))?;
    Ok(FactKey { predicate, arguments })
}

/// Parses an argument without quotes.
fn argument(text: &str) -> Option<Option<Term>> {
    match text {
        "?" => Some(None),
        _ if text.is_empty() || text.contains(['(', ')', '"', ' ']) => None,
        _ => Some(Some(text.parse().map_or_else(|_| Term::Name(text.to_owned()), Term::Int))),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn check(text: &str, expect: &str) {
        let read = pattern(text).map(|pattern| format!("{pattern:?}"));
        assert_eq!(read.is_ok(), !expect.is_empty(), "{text}: {read:?}");
        if let Ok(read) = read {
            assert_eq!(read.replace("FactPattern ", ""), expect, "{text}");
        }
    }

    #[test]
    fn patterns_are_read_and_what_is_none_is_refused() {
        check("at()", r#"{ predicate: "at", arguments: [] }"#);
        check(" on( ?, table )", r#"{ predicate: "on", arguments: [None, Some(Name("table"))] }"#);
        check("full(-2)", r#"{ predicate: "full", arguments: [Some(Int(-2))] }"#);
        check(r#"at("2", "a, b")"#, r#"{ predicate: "at", arguments: [Some(Name("2")), Some(Name("a, b"))] }"#);
        for none in
            ["at", "at(", "at)", "(x)", "at(x", "at(x,)", "at(x y)", "at(\"x)", "at(\"x\"y)", "at(x) = 2", "a,b(x)"]
        {
            check(none, "");
        }
        assert!(fact("at(?)").is_err());
    }
}
