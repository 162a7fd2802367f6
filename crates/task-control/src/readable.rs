//! What workers say in words, as it is kept and shown: a terminal obeys none of it, and it has a bound.

/// So many characters of what a worker says are kept.
pub(super) const MAX_SAID: usize = 4096;

/// Control characters but the ends of lines and tabs are written out, `\u{1b}`; what is longer ends with `…`.
pub(super) fn readable(said: &str) -> String {
    let is_obeyed = |character: char| character.is_control() && !matches!(character, '\n' | '\t');
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
        assert_eq!((long.chars().count(), long.chars().last()), (MAX_SAID + 1, Some('…')));
        assert_eq!(readable(&"ä".repeat(MAX_SAID)).chars().last(), Some('ä'));
    }
}
