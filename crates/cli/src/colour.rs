//! Colours of terminal output, unless `NO_COLOR` is set (<https://no-color.org>).

use std::io::IsTerminal;

/// Whether the output is coloured.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(crate) struct Colours(bool);

impl Colours {
    /// For standard output.
    pub(crate) fn of_output() -> Colours {
        let is_set = |name: &str| std::env::var_os(name).is_some_and(|value| !value.is_empty());
        Colours::chosen(std::io::stdout().is_terminal(), is_set("NO_COLOR"), !can_paint())
    }

    /// For standard error.
    pub(crate) fn of_errors() -> Colours {
        let is_set = |name: &str| std::env::var_os(name).is_some_and(|value| !value.is_empty());
        Colours::chosen(std::io::stderr().is_terminal(), is_set("NO_COLOR"), !can_paint())
    }

    fn chosen(is_terminal: bool, unwanted: bool, is_dumb: bool) -> Colours {
        Colours(is_terminal && !unwanted && !is_dumb)
    }

    /// For headings.
    pub(crate) fn bold(self, text: &str) -> String {
        self.painted("1", text)
    }

    /// For what is in progress.
    pub(crate) fn green(self, text: &str) -> String {
        self.painted("32", text)
    }

    /// For what waits or is held.
    pub(crate) fn yellow(self, text: &str) -> String {
        self.painted("33", text)
    }

    fn painted(self, code: &str, text: &str) -> String {
        if self.0 { format!("\x1b[{code}m{text}\x1b[0m") } else { text.to_owned() }
    }
}

/// Whether the terminal understands control sequences.
pub(crate) fn can_paint() -> bool {
    std::env::var_os("TERM").is_none_or(|term| term != "dumb")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_a_terminal_is_coloured_and_only_where_nobody_minds() {
        assert_eq!(Colours::chosen(true, false, false).green("x"), "\x1b[32mx\x1b[0m");
        for plain in [(false, false, false), (true, true, false), (true, false, true)] {
            assert_eq!(Colours::chosen(plain.0, plain.1, plain.2).bold("x"), "x");
        }
    }
}
