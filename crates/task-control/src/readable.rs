//! Texts from workers, made safe for terminals and limited in length, as they are kept and shown.

/// Maximum number of characters kept of a worker's text.
pub(super) const MAX_SAID: usize = 4096;

/// Like [`readable`], in one line, so that it cannot imitate lines of a run.
pub(super) fn one_line(said: &str) -> String {
    readable(said).split_whitespace().collect::<Vec<_>>().join(" ")
}

/// Like [`ratn_model::readable::readable`]; longer texts are cut and end with `…`.
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
