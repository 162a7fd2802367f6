//! Names from a log for a column of a table: readable, and short enough that the following columns stay visible.

use ratn_model::readable::in_line;

/// Maximum number of characters of a name; of a longer one, the middle is omitted.
const MOST: usize = 100;

/// A column of names, each ready to be shown.
pub(crate) struct Names {
    names: Vec<String>,
    /// Width of the longest name, or the given minimum.
    pub(crate) width: usize,
}

impl Names {
    /// A column that has at least the width `least`.
    pub(crate) fn of<'n>(names: impl IntoIterator<Item = &'n str>, least: usize) -> Names {
        let names: Vec<String> = names.into_iter().map(shown).collect();
        let width = names.iter().map(|name| name.chars().count()).max().unwrap_or(0).max(least);
        Names { names, width }
    }

    /// The names in the given order.
    pub(crate) fn iter(&self) -> impl Iterator<Item = &str> {
        self.names.iter().map(String::as_str)
    }
}

/// A name in the form for a line of a table.
pub(crate) fn shown(name: &str) -> String {
    let name = in_line(name);
    let all = name.chars().count();
    if all <= MOST {
        return name.into_owned();
    }
    let begin = name.chars().take(MOST / 2 - 1);
    let end = name.chars().skip(all - MOST / 2);
    begin.chain(['…']).chain(end).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_middle_of_a_long_name_is_left_out() {
        let long = format!("begin{}end", "ä".repeat(66_000));
        let names = Names::of(["short\n", &long], 22);
        let all: Vec<&str> = names.iter().collect();
        assert_eq!((all[0], names.width), ("short\\u{a}", MOST));
        assert!(all[1].starts_with("beginä") && all[1].ends_with("äend") && all[1].contains("ä…ä"), "{}", all[1]);
        assert_eq!(shown(&"x".repeat(MOST)), "x".repeat(MOST));
    }
}
