//! What workers say in words, as it is kept and shown: a terminal obeys none of it, and it has a bound.

/// So many characters of what a worker says are kept.
pub(super) const MAX_SAID: usize = 4096;

/// As [`readable`], in one line: what is shown beside the lines of a run is none of them.
pub(super) fn one_line(said: &str) -> String {
    readable(said).split_whitespace().collect::<Vec<_>>().join(" ")
}

/// As [`ratn_model::readable::readable`] writes it; what is longer ends with `…`.
pub(super) fn readable(said: &str) -> String {
    match said.char_indices().nth(MAX_SAID) {
        Some((end, _)) => format!("{}…", ratn_model::readable::readable(&said[..end])),
        None => ratn_model::readable::readable(said).into_owned(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_a_terminal_would_obey_is_written_out_and_what_is_long_is_cut() {
        assert_eq!(readable("no way:\n\t\u{1b}[2J"), "no way:\n\t\\u{1b}[2J");
        let long = readable(&"ä".repeat(MAX_SAID + 1));
        assert_eq!(one_line("at 50 %\n    12.0 s\tsuccess\n"), "at 50 % 12.0 s success");
        assert_eq!((long.chars().count(), long.chars().last()), (MAX_SAID + 1, Some('…')));
        assert_eq!(readable(&"ä".repeat(MAX_SAID)).chars().last(), Some('ä'));
    }
}
