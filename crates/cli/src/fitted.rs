//! Fits text to the size of a terminal, which wraps long lines. Colour codes take no columns, and some characters take two.

use unicode_width::{UnicodeWidthChar, UnicodeWidthStr};

/// Number of columns of a line.
pub(crate) fn visible(line: &str) -> usize {
    // A colour code is `ESC [ … m`.
    let mut parts = line.split('\x1b');
    let first = parts.next().map_or(0, UnicodeWidthStr::width);
    first + parts.map(|part| part.split_once('m').map_or(0, |(_, seen)| seen.width())).sum::<usize>()
}

/// Pads a text with spaces to this number of columns; a longer text is unchanged.
pub(crate) fn padded(text: &str, columns: usize) -> String {
    format!("{text}{}", " ".repeat(columns.saturating_sub(visible(text))))
}

/// The beginning of a text without colours, in at most this many columns.
pub(crate) fn cut(text: &str, columns: usize) -> String {
    if text.width() <= columns {
        return text.to_owned();
    }
    let mut room = columns;
    let fits = |c: &char| {
        // The last column is for the ellipsis.
        let taken = c.width().unwrap_or(0);
        let fits = taken < room;
        room = room.saturating_sub(taken);
        fits
    };
    let mut short: String = text.chars().take_while(fits).collect();
    short.extend((columns > 0).then_some('…'));
    short
}

/// Number of rows that a line of this length takes.
pub(crate) fn rows(length: usize, width: usize) -> usize {
    length.div_ceil(width.max(1)).max(1)
}

/// Whether a whole text fits, with the last row left free.
pub(crate) fn fits(text: &str, width: usize, height: usize) -> bool {
    text.lines().map(|line| rows(visible(line), width)).sum::<usize>() < height.max(1)
}

/// As many of the first lines of a text as fit, and how many more there are. The last row stays free, so that the end of the last line does
/// not scroll the terminal.
pub(crate) fn fitted(text: &str, width: usize, height: usize) -> String {
    if fits(text, width, height) {
        return text.to_owned();
    }
    let room = height.saturating_sub(1);
    let lines: Vec<&str> = text.lines().collect();
    let rows_of = |lines: &[&str]| lines.iter().map(|line| rows(visible(line), width)).sum::<usize>();
    let more = |kept: usize| format!("… and {} more lines: there is no room for them", lines.len() - kept);
    let has_room = |kept: &usize| rows_of(&lines[..*kept]) + rows(visible(&more(*kept)), width) <= room;
    let kept = (0..lines.len()).rev().find(has_room).unwrap_or(0);
    let mut shown: Vec<&str> = lines[..kept].to_vec();
    let more = more(kept);
    shown.push(&more);
    shown.join("\n")
}

/// The beginning of a long text, and how many characters are left out.
pub(crate) fn shortened(text: &str, most: usize, where_all_is: &str) -> String {
    let all = text.chars().count();
    if all <= most {
        return text.to_owned();
    }
    let beginning: String = text.chars().take(most).collect();
    format!("{beginning}… ({} more characters: {where_all_is})", all - most)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_colours_a_line_takes_no_room() {
        assert_eq!(visible("\x1b[32mruns  plan\x1b[0m"), 10);
        assert_eq!((rows(10, 80), rows(0, 80), rows(25, 10), rows(3, 0)), (1, 1, 3, 3));
        let coloured = "\x1b[32mruns  plan\x1b[0m";
        assert_eq!(fitted(coloured, 10, 2), coloured);
    }

    #[test]
    fn wide_characters_take_two_columns_and_are_not_cut_in_half() {
        assert_eq!(
            (visible("\x1b[1m漢字\x1b[0m!"), padded("漢", 4).as_str(), padded("漢字漢", 4).as_str()),
            (5, "漢  ", "漢字漢")
        );
        for columns in 0..8 {
            let (wide, narrow) = (cut("漢字漢字", columns), cut("a漢b字", columns));
            assert!(visible(&wide) <= columns && visible(&narrow) <= columns, "{columns}: {wide} {narrow}");
            assert_eq!(wide.ends_with('…'), columns > 0);
        }
        assert_eq!(
            (cut("漢字漢字", 8).as_str(), cut("漢字漢字", 6).as_str(), cut("abc", 2).as_str()),
            ("漢字漢字", "漢字…", "a…")
        );
    }

    #[test]
    fn what_is_left_out_of_a_long_text_is_said() {
        assert_eq!(shortened("ünder ten", 9, "there"), "ünder ten");
        assert_eq!(shortened("ünder ten", 5, "see there"), "ünder… (4 more characters: see there)");
    }

    #[test]
    fn lines_that_find_no_room_are_counted() {
        let text = "1\n2\n3\n4\n5";
        assert_eq!(fitted(text, 80, 6), text);
        assert_eq!(fitted(text, 80, 5), "1\n2\n3\n… and 2 more lines: there is no room for them");
        // A wrapped line takes several rows, and so does the message about the others.
        assert_eq!(fitted("a\nbbbbbbbbbbbb\nc\nd", 6, 3), "… and 4 more lines: there is no room for them");
        assert_eq!(
            fitted("a\nb\nc\nd\ne\nf\ng\nh\ni\nj\nk", 40, 6),
            "a\nb\nc\n… and 8 more lines: there is no room for them"
        );
    }
}
