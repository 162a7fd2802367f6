//! What workers say in words, as it is kept and shown: a terminal obeys none of it, and it has a bound.

/// So many characters of what a worker says are kept.
pub(super) const MAX_SAID: usize = 4096;

/// As [`readable`], in one line: what is shown beside the lines of a run is none of them.
pub(super) fn one_line(said: &str) -> String {
    readable(said).split_whitespace().collect::<Vec<_>>().join(" ")
}

/// Whether it changes the order in which the characters around it are shown.
fn turns(character: char) -> bool {
    matches!(character, '\u{61c}' | '\u{200e}' | '\u{200f}' | '\u{202a}'..='\u{202e}' | '\u{2066}'..='\u{2069}')
}

/// Control characters but the ends of lines and tabs are written out, `\u{1b}`, and so are those that turn the direction of a text; what is longer
/// ends with `…`.
pub(super) fn readable(said: &str) -> String {
    let is_obeyed = |character: char| turns(character) || character.is_control() && !matches!(character, '\n' | '\t');
    let mut text = String::new();
    for (number, character) in said.chars().enumerate() {
        if number == MAX_SAID {
            text.push('…');
            break;
        }
        if is_obeyed(character) {
            text.extend(character.escape_unicode());
        } else {
            text.push(character);
        }
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_a_terminal_would_obey_is_written_out_and_what_is_long_is_cut() {
        assert_eq!(readable("no way:\n\tGröße \u{1b}[2J\r\u{9b}31m"), "no way:\n\tGröße \\u{1b}[2J\\u{d}\\u{9b}31m");
        let long = readable(&"ä".repeat(MAX_SAID + 1));
        assert_eq!(readable("ab\u{202e}cd"), "ab\\u{202e}cd");
        assert_eq!(one_line("at 50 %\n    12.0 s\tsuccess\n"), "at 50 % 12.0 s success");
        assert_eq!((long.chars().count(), long.chars().last()), (MAX_SAID + 1, Some('…')));
        assert_eq!(readable(&"ä".repeat(MAX_SAID)).chars().last(), Some('ä'));
    }
}
