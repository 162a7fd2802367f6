//! Makes untrusted text safe to show: no character in it can control a terminal or change the direction of the text around it.

use std::borrow::Cow;

/// Escapes control characters (`\u{1b}`), except line ends and tabs, and characters that change the text direction.
pub fn readable(text: &str) -> Cow<'_, str> {
    written_out(text, |character| steers(character) && !matches!(character, '\n' | '\t'))
}

/// As [`readable`], for text within a line: line ends and tabs are escaped, too.
pub fn in_line(text: &str) -> Cow<'_, str> {
    written_out(text, steers)
}

/// Whether a terminal acts on this character instead of showing it.
fn steers(character: char) -> bool {
    let turns =
        matches!(character, '\u{61c}' | '\u{200e}' | '\u{200f}' | '\u{202a}'..='\u{202e}' | '\u{2066}'..='\u{2069}');
    turns || character.is_control()
}

fn written_out(text: &str, is_meant: impl Fn(char) -> bool) -> Cow<'_, str> {
    if !text.contains(&is_meant) {
        return Cow::Borrowed(text);
    }
    let mut out = String::with_capacity(text.len());
    for character in text.chars() {
        match is_meant(character) {
            true => out.extend(character.escape_unicode()),
            false => out.push(character),
        }
    }
    Cow::Owned(out)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_a_terminal_would_obey_is_written_out() {
        let said = "no way:\n\tGröße \u{1b}[2J\r\u{9b}31m ab\u{202e}cd";
        assert_eq!(readable(said), "no way:\n\tGröße \\u{1b}[2J\\u{d}\\u{9b}31m ab\\u{202e}cd");
        assert_eq!(in_line("a\n\tb\u{7f}"), "a\\u{a}\\u{9}b\\u{7f}");
        assert!(matches!(in_line("漢字 עברית 🦾"), Cow::Borrowed(_)));
    }
}
