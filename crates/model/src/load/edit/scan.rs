//! Positions in a YAML text: lines, comments, and the end of a value. This code knows quotes and brackets, and no other YAML; its results are
//! verified by parsing again.

use crate::program::Location;

/// A text, split into lines.
pub(super) struct Lines<'t> {
    pub(super) text: &'t str,
    starts: Vec<usize>,
}

impl<'t> Lines<'t> {
    pub(super) fn of(text: &'t str) -> Lines<'t> {
        let starts = std::iter::once(0).chain(text.match_indices('\n').map(|(at, _)| at + 1)).collect();
        Lines { text, starts }
    }

    pub(super) fn offset(&self, at: Location) -> Option<usize> {
        let line = (at.line as usize).checked_sub(1).filter(|line| *line < self.starts.len())?;
        let column = (at.column as usize).checked_sub(1)?;
        let content = self.content(line);
        let within = content.char_indices().map(|(byte, _)| byte).chain([content.len()]).nth(column)?;
        Some(self.starts[line] + within)
    }

    /// The line of an offset, counted from 0.
    pub(super) fn line_of(&self, offset: usize) -> usize {
        self.starts.partition_point(|start| *start <= offset).saturating_sub(1)
    }

    /// The start of a line; the end of the text for a line behind the last.
    pub(super) fn start(&self, line: usize) -> usize {
        self.starts.get(line).copied().unwrap_or(self.text.len())
    }

    /// The end of a line, before its line break.
    pub(super) fn end(&self, line: usize) -> usize {
        self.start(line) + self.content(line).len()
    }

    /// A line without its line break; empty behind the last line.
    pub(super) fn content(&self, line: usize) -> &'t str {
        self.text[self.start(line)..self.start(line + 1)].trim_end_matches(['\n', '\r'])
    }

    /// Number of characters before the offset on its line.
    pub(super) fn column(&self, offset: usize) -> usize {
        self.text[self.start(self.line_of(offset))..offset].chars().count()
    }

    /// Whether only blanks precede the offset on its line.
    pub(super) fn starts_line(&self, offset: usize) -> bool {
        self.text[self.start(self.line_of(offset))..offset].chars().all(|letter| letter == ' ')
    }

    /// The line break of the text.
    pub(super) fn newline(&self) -> &'static str {
        if self.text.contains("\r\n") { "\r\n" } else { "\n" }
    }

    /// The end of the value of a key in block style: the end of its last line, before line `bound`. Comments below the value's last line belong
    /// to the next key.
    pub(super) fn block_end(&self, first: usize, indent: usize, bound: Option<usize>) -> usize {
        let mut last = first;
        for line in first + 1..bound.unwrap_or(self.starts.len()).min(self.starts.len()) {
            let content = self.content(line);
            let own = content.trim_start_matches(' ');
            let depth = content.len() - own.len();
            if own.trim().is_empty() || own.starts_with('#') {
                continue;
            }
            let is_item = depth == indent && (own == "-" || own.starts_with("- "));
            // It closes a list or mapping in brackets and begins no key.
            let closes = own.starts_with([']', '}']);
            if depth <= indent && !is_item && !closes {
                break;
            }
            last = line;
        }
        self.end(last)
    }
}

/// The kind of text that a character belongs to.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Token {
    /// Outside of quotes and comments; true if a value can begin here.
    Plain(bool),
    Quoted,
    Comment,
}

/// Calls `each` for every character with its kind, until it returns false.
fn walk(text: &str, mut each: impl FnMut(usize, char, Token) -> bool) {
    let mut quote = None;
    let mut letters = text.char_indices().peekable();
    let (mut begins, mut after_blank, mut in_comment) = (true, true, false);
    while let Some((at, letter)) = letters.next() {
        if letter == '\n' {
            in_comment = false;
        }
        if in_comment {
            if !each(at, letter, Token::Comment) {
                return;
            }
            continue;
        }
        if let Some(open) = quote {
            if !each(at, letter, Token::Quoted) {
                return;
            }
            let next = letters.peek().copied();
            if open == '"' && letter == '\\'
                || open == '\'' && letter == '\'' && next.is_some_and(|(_, next)| next == '\'')
            {
                if let Some((at, letter)) = letters.next()
                    && !each(at, letter, Token::Quoted)
                {
                    return;
                }
            } else if letter == open {
                quote = None;
            }
            continue;
        }
        if letter == '#' && after_blank {
            in_comment = true;
            if !each(at, letter, Token::Comment) {
                return;
            }
            continue;
        }
        if matches!(letter, '"' | '\'') && begins {
            quote = Some(letter);
            (begins, after_blank) = (false, false);
            if !each(at, letter, Token::Quoted) {
                return;
            }
            continue;
        }
        if !each(at, letter, Token::Plain(begins)) {
            return;
        }
        let next_is_blank = letters.peek().is_none_or(|(_, next)| next.is_whitespace());
        after_blank = letter.is_whitespace();
        begins = match letter {
            '[' | '{' | ',' | '\n' => true,
            ':' | '-' if next_is_blank => true,
            blank if blank.is_whitespace() => begins,
            _ => false,
        };
    }
}

/// The comments of a text, each from `#` to the end of its line.
pub(super) fn comments(text: &str) -> Vec<&str> {
    let mut found = Vec::new();
    let mut begun: Option<usize> = None;
    walk(text, |at, _, token| {
        match (token, begun) {
            (Token::Comment, None) => begun = Some(at),
            (Token::Plain(_) | Token::Quoted, Some(from)) => {
                found.push(text[from..at].trim_end());
                begun = None;
            }
            _ => {}
        }
        true
    });
    if let Some(from) = begun {
        found.push(text[from..].trim_end());
    }
    found
}

/// Whether the text contains an anchor, an alias or a merge.
pub fn has_anchor(text: &str) -> bool {
    begins_with(text, ['&', '*'])
}

/// Whether the text contains a tag.
pub fn has_tag(text: &str) -> bool {
    begins_with(text, ['!'; 2])
}

/// Whether the text contains a block scalar (`|` or `>`) and a quote that may hide a comment. Quotes in block scalars are plain characters,
/// which this code does not know.
pub(super) fn has_hidden_comment(text: &str) -> bool {
    let begins = text.lines().filter(|line| line.starts_with('#') || line.contains(" #") || line.contains("\t#"));
    begins_with(text, ['|', '>']) && begins.count() > comments(text).len()
}

fn begins_with(text: &str, letters: [char; 2]) -> bool {
    let mut found = false;
    walk(text, |_, letter, token| {
        found |= token == Token::Plain(true) && letters.contains(&letter);
        !found
    });
    found
}

/// The offset of the comma or bracket that ends an entry in flow style.
pub(super) fn flow_end(text: &str, from: usize) -> Option<usize> {
    let (mut depth, mut end) = (0_usize, None);
    walk(&text[from..], |at, letter, token| {
        let Token::Plain(_) = token else { return true };
        match letter {
            '[' | '{' => depth += 1,
            ',' | '}' | ']' if depth == 0 => end = Some(from + at),
            ']' | '}' => depth -= 1,
            _ => {}
        }
        end.is_none()
    });
    end
}

/// The end of the last character between two offsets that is neither blank nor in a comment.
pub(super) fn without_comments_end(text: &str, from: usize, to: usize) -> usize {
    let mut end = from;
    walk(&text[from..to], |at, letter, token| {
        if token != Token::Comment && !letter.is_whitespace() {
            end = from + at + letter.len_utf8();
        }
        true
    });
    end
}

/// The text as a scalar that is parsed as this text anywhere: plain if that is safe, else quoted.
pub(super) fn scalar(text: &str) -> String {
    let is_plain = |letter: char| letter.is_ascii_alphanumeric() || " _$.()=+/<>?".contains(letter);
    let begins = text.starts_with(|letter: char| letter.is_ascii_alphabetic() || letter == '_' || letter == '$');
    let lower = text.to_ascii_lowercase();
    let is_other = ["true", "false", "null", "yes", "no", "on", "off", "y", "n"].contains(&lower.as_str());
    if begins && !is_other && !text.ends_with(' ') && text.chars().all(is_plain) {
        return text.to_owned();
    }
    let mut quoted = String::from('"');
    for letter in text.chars() {
        match letter {
            '"' | '\\' => quoted.extend(['\\', letter]),
            '\n' => quoted.push_str("\\n"),
            '\t' => quoted.push_str("\\t"),
            '\r' => quoted.push_str("\\r"),
            control if control.is_control() => quoted.push_str(&format!("\\u{:04x}", u32::from(control))),
            other => quoted.push(other),
        }
    }
    quoted.push('"');
    quoted
}
