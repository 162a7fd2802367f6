//! Splits an event or a command that is too long for one line into pieces of its text: one per line, in order and with no other line
//! between.
//!
//! ```text
//!   {"at":0,"part":1,"of":3,"text":"{\\"at\\":0,\\"event\\":\\"started\\",…"}
//!   {"at":0,"part":2,"of":3,"text":"…"}
//!   {"at":0,"part":3,"of":3,"text":"…}"}
//! ```

use super::{MAX_ENTRY_BYTES, MAX_LINE_BYTES};
use ratn_model::time::Timestamp;
use serde::{Deserialize, Serialize};
use std::borrow::Cow;
use std::io::{Error, Result};

/// Length of the text of a piece: escaping in JSON at most doubles it, and there is room for the rest of the line.
const PIECE_BYTES: usize = MAX_LINE_BYTES / 2 - 1_024;

#[derive(Serialize, Deserialize)]
struct Piece<'a> {
    at: Timestamp,
    part: usize,
    of: usize,
    text: Cow<'a, str>,
}

/// Writes an event or a command in pieces; returns the number of lines.
pub(super) fn write(out: &mut Vec<u8>, at: Timestamp, mut text: &str) -> Result<usize> {
    let mut pieces = Vec::new();
    while !text.is_empty() {
        let (piece, rest) = text.split_at(text.floor_char_boundary(PIECE_BYTES));
        pieces.push(piece);
        text = rest;
    }
    for (place, piece) in pieces.iter().enumerate() {
        let piece = Piece { at, part: place + 1, of: pieces.len(), text: Cow::Borrowed(piece) };
        serde_json::to_writer(&mut *out, &piece).map_err(Error::from)?;
        out.push(b'\n');
    }
    Ok(pieces.len())
}

/// Whether a line is a piece.
pub(super) fn is_one(line: &[u8]) -> bool {
    let behind_time = line.iter().position(|byte| *byte == b',').map(|comma| &line[comma + 1..]);
    behind_time.is_some_and(|rest| rest.starts_with(br#""part":"#))
}

/// Whether a line is a piece other than the first one.
pub(super) fn goes_on(line: &[u8]) -> bool {
    is_one(line) && serde_json::from_slice::<Piece<'_>>(line).is_ok_and(|piece| piece.part > 1)
}

/// The joined text of pieces.
#[derive(Default)]
pub(super) struct Joined {
    text: String,
    parts: usize,
    of: usize,
}

impl Joined {
    /// Adds the next piece. Returns whether it was the last one.
    pub(super) fn add(&mut self, line: &[u8]) -> std::result::Result<bool, String> {
        let piece: Piece<'_> = serde_json::from_slice(line).map_err(|error| {
            format!("not part {} of {} of an event or a command: {error}", self.parts + 1, self.of.max(1))
        })?;
        let of = if self.parts == 0 { piece.of } else { self.of };
        if piece.part != self.parts + 1 || piece.of != of || piece.part > of {
            let (part, expected) = (piece.part, self.parts + 1);
            return Err(format!(
                "part {part} of {} of an event or a command, where part {expected} was to be",
                piece.of
            ));
        }
        if self.text.len() + piece.text.len() > MAX_ENTRY_BYTES {
            return Err(format!("longer than {MAX_ENTRY_BYTES} bytes together with the parts before it"));
        }
        (self.parts, self.of) = (piece.part, of);
        self.text.push_str(&piece.text);
        Ok(self.parts == self.of)
    }

    pub(super) fn into_text(self) -> Vec<u8> {
        self.text.into_bytes()
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;

    #[test]
    fn pieces_are_joined_in_order_and_those_that_are_missing_or_strange_are_named() {
        let piece = |part: usize, of: usize| format!(r#"{{"at":0,"part":{part},"of":{of},"text":"a"}}"#);
        let mut joined = Joined::default();
        assert_eq!(joined.add(piece(1, 2).as_bytes()), Ok(false));
        assert_eq!(joined.add(piece(2, 2).as_bytes()), Ok(true));
        assert_eq!(joined.into_text(), b"aa");
        let refused = |lines: &[String]| {
            let mut joined = Joined::default();
            lines.iter().find_map(|line| joined.add(line.as_bytes()).err()).unwrap_or_default()
        };
        assert_eq!(refused(&[piece(2, 2)]), "part 2 of 2 of an event or a command, where part 1 was to be");
        assert_eq!(
            refused(&[piece(1, 3), piece(3, 3)]),
            "part 3 of 3 of an event or a command, where part 2 was to be"
        );
        assert!(refused(&[piece(1, 3), piece(2, 4)]).starts_with("part 2 of 4"));
        assert!(refused(&[piece(1, 0)]).starts_with("part 1 of 0"));
        assert!(refused(&[piece(1, 2), "{}".to_owned()]).starts_with("not part 2 of 2"));
        assert!(is_one(piece(1, 2).as_bytes()) && !goes_on(piece(1, 2).as_bytes()) && goes_on(piece(2, 2).as_bytes()));
        assert!(!is_one(br#"{"at":0,"event":"woken"}"#) && !is_one(b"hello") && !is_one(b""));
    }
}
