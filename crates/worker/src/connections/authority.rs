//! Replaces the server name (`:authority`) in requests over a Unix socket by one that HTTP/2 libraries accept.
//!
//! Each HTTP/2 request names the server that it is meant for (`:authority`, RFC 9113, section 8.3.1). At a Unix socket there is no host,
//! and clients of gRPC's C library (Python, C++, Ruby, PHP) send the path of the socket: `%2Frun%2Fratn%2Fx.sock`. `http::uri::Authority`
//! does not accept `%`, so `h2` answers such a request with RST_STREAM before any service sees it. No service here reads the name: its
//! bytes are replaced before `h2` reads them.
//!
//! ```text
//!   preface ─▶ frame header ─▶ payload: a header block (HEADERS, CONTINUATION) is walked through, others are skipped ─┐
//!                   ▲                                                                                                 │
//!                   └─────────────────────────────────────────────────────────────────────────────────────────────────┘
//! ```
//! Each replaced byte becomes one byte: frames keep their lengths, and both ends of the header compression (RFC 7541) keep tables of the
//! same size. So no decoding and no state of the tables is needed. Huffman-coded names and values stay as they are: no known client sends
//! the path of a socket in that form. Bytes that are not HTTP/2 pass unchanged, and `h2` refuses them.

/// Length of the client's connection preface.
const PREFACE_BYTES: usize = 24;
const FRAME_HEADER_BYTES: usize = 9;
/// Types and flags of frames (RFC 9113, section 6).
const HEADERS: u8 = 1;
const CONTINUATION: u8 = 9;
const PADDED: u8 = 0x08;
const PRIORITY: u8 = 0x20;
const PRIORITY_BYTES: u32 = 5;

const NAME: &[u8] = b":authority";
/// Index of `:authority` in the static table of the header compression (RFC 7541, appendix A).
const NAME_INDEX: u32 = 1;

/// The parser's position in the bytes of one connection.
#[derive(Debug)]
pub(super) struct Authority {
    preface_left: usize,
    frame_header: [u8; FRAME_HEADER_BYTES],
    frame_header_read: usize,
    payload: Payload,
    block: Block,
}

/// The rest of a frame's payload.
#[derive(Debug, Default)]
struct Payload {
    left: u32,
    holds_headers: bool,
    /// The first byte of the payload is the length of the padding at its end.
    says_padding: bool,
    /// Bytes before the header block.
    before: u32,
    padding: u32,
}

/// A header block, which may be split across frames at any byte.
#[derive(Debug, Default)]
struct Block {
    at: At,
    is_authority: bool,
}

/// A position in a header block.
#[derive(Debug, Default, Clone, Copy)]
enum At {
    /// Before a field.
    #[default]
    Field,
    /// Within a number of several bytes, of which `shift` bits are known.
    Number { value: u32, shift: u32, then: Then },
    /// Before the length of a name or a value.
    Length(Part),
    /// Within a name or a value.
    Text { part: Part, left: u32, is_plain: bool, read: u32 },
    /// Not in a header block.
    Nowhere,
}

/// The meaning of a number.
#[derive(Debug, Clone, Copy)]
enum Then {
    /// The index of a whole field, or the new size of the table: nothing follows.
    Whole,
    /// The index of a name in the table, or 0; a value follows.
    NameIndex,
    /// The length of a text.
    Length { part: Part, is_plain: bool },
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Part {
    Name,
    Value,
}

impl Default for Authority {
    fn default() -> Authority {
        Authority {
            preface_left: PREFACE_BYTES,
            frame_header: [0; FRAME_HEADER_BYTES],
            frame_header_read: 0,
            payload: Payload::default(),
            block: Block::default(),
        }
    }
}

impl Authority {
    /// Processes the next bytes that were read from the connection.
    pub(super) fn pass(&mut self, mut bytes: &mut [u8]) {
        while !bytes.is_empty() {
            let passed = self.pass_some(bytes);
            bytes = &mut bytes[passed..];
        }
    }

    /// Processes at least one byte; returns how many.
    fn pass_some(&mut self, bytes: &mut [u8]) -> usize {
        if self.preface_left > 0 {
            let passed = self.preface_left.min(bytes.len());
            self.preface_left -= passed;
            return passed;
        }
        if self.payload.left == 0 {
            let wanted = &mut self.frame_header[self.frame_header_read..];
            let passed = wanted.len().min(bytes.len());
            wanted[..passed].copy_from_slice(&bytes[..passed]);
            self.frame_header_read += passed;
            if self.frame_header_read == FRAME_HEADER_BYTES {
                self.frame_header_read = 0;
                self.begin_payload();
            }
            return passed;
        }
        if !self.payload.holds_headers {
            let left = usize::try_from(self.payload.left).unwrap_or(usize::MAX);
            let passed = left.min(bytes.len());
            self.payload.left -= u32::try_from(passed).unwrap_or(self.payload.left);
            return passed;
        }
        self.payload.pass(&mut bytes[0], &mut self.block);
        1
    }

    fn begin_payload(&mut self) {
        let [length_2, length_1, length_0, kind, flags, ..] = self.frame_header;
        let left = u32::from_be_bytes([0, length_2, length_1, length_0]);
        self.payload = Payload { left, holds_headers: matches!(kind, HEADERS | CONTINUATION), ..Payload::default() };
        if kind == HEADERS {
            self.block = Block::default();
            self.payload.says_padding = flags & PADDED != 0;
            self.payload.before = if flags & PRIORITY != 0 { PRIORITY_BYTES } else { 0 };
        }
    }
}

impl Payload {
    fn pass(&mut self, byte: &mut u8, block: &mut Block) {
        if self.says_padding {
            (self.says_padding, self.padding) = (false, u32::from(*byte));
        } else if self.before > 0 {
            self.before -= 1;
        } else if self.left > self.padding {
            block.pass(byte);
        }
        self.left -= 1;
    }
}

impl Block {
    fn pass(&mut self, byte: &mut u8) {
        self.at = match self.at {
            At::Field => {
                self.is_authority = false;
                // RFC 7541, section 6: the first bits give the kind of the field, the other bits begin a number.
                match *byte {
                    0x80.. => self.number(*byte, 7, Then::Whole),
                    0x40..0x80 => self.number(*byte, 6, Then::NameIndex),
                    0x20..0x40 => self.number(*byte, 5, Then::Whole),
                    0x00..0x20 => self.number(*byte, 4, Then::NameIndex),
                }
            }
            At::Number { value, shift, then } => {
                let more = u32::from(*byte & 0x7f).checked_shl(shift).and_then(|more| value.checked_add(more));
                match more {
                    None => At::Nowhere,
                    Some(value) if *byte & 0x80 != 0 => At::Number { value, shift: shift + 7, then },
                    Some(value) => self.after(value, then),
                }
            }
            At::Length(part) => self.number(*byte, 7, Then::Length { part, is_plain: *byte & 0x80 == 0 }),
            At::Text { part, left, is_plain, read } => {
                match part {
                    Part::Name => {
                        let expected = usize::try_from(read).ok().and_then(|read| NAME.get(read));
                        self.is_authority &= is_plain && expected == Some(byte);
                    }
                    Part::Value if self.is_authority && is_plain => {
                        if !byte.is_ascii_alphanumeric() && *byte != b'.' {
                            *byte = b'-';
                        }
                    }
                    Part::Value => {}
                }
                text(part, left - 1, is_plain, read + 1)
            }
            At::Nowhere => At::Nowhere,
        };
    }

    /// Begins a number in the last `bits` bits of a byte (RFC 7541, section 5.1).
    fn number(&mut self, byte: u8, bits: u32, then: Then) -> At {
        let most = (1 << bits) - 1;
        let value = u32::from(byte) & most;
        if value == most { At::Number { value, shift: 0, then } } else { self.after(value, then) }
    }

    fn after(&mut self, value: u32, then: Then) -> At {
        match then {
            Then::Whole => At::Field,
            Then::NameIndex if value == 0 => At::Length(Part::Name),
            Then::NameIndex => {
                self.is_authority = value == NAME_INDEX;
                At::Length(Part::Value)
            }
            Then::Length { part, is_plain } => {
                if part == Part::Name {
                    self.is_authority = usize::try_from(value) == Ok(NAME.len());
                }
                text(part, value, is_plain, 0)
            }
        }
    }
}

/// The position within a text, or after it.
fn text(part: Part, left: u32, is_plain: bool, read: u32) -> At {
    match (left, part) {
        (0, Part::Name) => At::Length(Part::Value),
        (0, Part::Value) => At::Field,
        _ => At::Text { part, left, is_plain, read },
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;

    const SENT: &[u8] = b"%2Frun%2Fmy_robot%2Fx.sock";
    const TAKEN: &[u8] = b"-2Frun-2Fmy-robot-2Fx.sock";

    fn frame(kind: u8, flags: u8, payload: &[u8]) -> Vec<u8> {
        let length = u32::try_from(payload.len()).unwrap().to_be_bytes();
        [&length[1..], &[kind, flags, 0, 0, 0, 1], payload].concat()
    }

    fn short(text: &[u8]) -> Vec<u8> {
        [&[u8::try_from(text.len()).unwrap()], text].concat()
    }

    /// A header block with the authority between other fields: fields from the tables, with a literal name, in Huffman code, and a table
    /// size.
    fn block(field: &[u8], authority: &[u8]) -> Vec<u8> {
        let long = [b"%".repeat(300), vec![b'x'; 100]].concat();
        let length = [0x7f, 0x91, 0x02]; // 127 + 17 + 2 * 128
        let other = [&[0x00][..], &short(b"x-path"), &length, &long].concat();
        let huffman = [&[0x41, 0x83][..], b"%%%"].concat();
        [
            &[0x3f, 0xe1, 0x1f, 0x83, 0x86][..],
            &other,
            field,
            &short(authority),
            &[0xbe, 0x44],
            &short(b"/a%b"),
            &huffman,
        ]
        .concat()
    }

    fn preface() -> Vec<u8> {
        b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n".to_vec()
    }

    /// The bytes after processing; the result must not depend on where they are split.
    fn passed(bytes: &[u8]) -> Vec<u8> {
        let whole = |cut: usize| {
            let (mut bytes, mut authority) = (bytes.to_vec(), Authority::default());
            bytes.chunks_mut(cut).for_each(|chunk| authority.pass(chunk));
            bytes
        };
        let at_once = whole(bytes.len());
        for cut in [1, 2, 3, 7, 100] {
            assert_eq!(whole(cut), at_once, "cut every {cut} bytes");
        }
        at_once
    }

    /// The authority field with an indexed and with a literal name, each added and not added to the dynamic table.
    fn fields() -> [Vec<u8>; 5] {
        let named = |first: u8| [&[first][..], &short(NAME)].concat();
        [vec![0x41], vec![0x01], vec![0x11], named(0x40), named(0x00)]
    }

    #[test]
    fn the_path_of_a_socket_is_taken_as_a_name_and_nothing_else_is_changed() {
        for field in fields() {
            let with = |authority| {
                let (block, data) = (block(&field, authority), frame(0, 1, SENT));
                [preface(), frame(4, 0, &[]), frame(HEADERS, 4, &block), data, frame(HEADERS, 4, &block)].concat()
            };
            assert_eq!(passed(&with(SENT)), with(TAKEN), "{field:?}");
        }
    }

    #[test]
    fn padding_priority_and_frames_that_go_on_are_no_part_of_a_name() {
        for field in fields() {
            for at in 0..block(&field, SENT).len() {
                let with = |authority| {
                    let block = block(&field, authority);
                    let head = [&[3][..], &[0x41, 1, b'%', 0, 0], &block[..at], b"%%%"].concat();
                    [preface(), frame(HEADERS, PADDED | PRIORITY, &head), frame(CONTINUATION, 4, &block[at..])].concat()
                };
                assert_eq!(passed(&with(SENT)), with(TAKEN), "{field:?}, cut at {at}");
            }
        }
    }

    #[test]
    fn a_name_that_only_begins_so_is_another_one() {
        for name in [&b":authorit"[..], b":authority2", b":Authority", b":authoritx"] {
            let block = [&[0x40][..], &short(name), &short(SENT)].concat();
            let bytes = [preface(), frame(HEADERS, 4, &block)].concat();
            assert_eq!(passed(&bytes), bytes);
        }
    }

    #[test]
    fn what_is_no_http_2_passes_unchanged() {
        let numbers_without_end = [preface(), frame(HEADERS, 4, &[0xff; 64])].concat();
        assert_eq!(passed(&numbers_without_end), numbers_without_end);
        let all_padding = [preface(), frame(HEADERS, PADDED, &[255, 0x41, 2, b'%', b'%'])].concat();
        assert_eq!(passed(&all_padding), all_padding);
        let mut random = 1_u32;
        for length in 1..400 {
            let mut byte = || {
                random = random.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                random.to_be_bytes()[0]
            };
            let bytes: Vec<u8> = (0..length).map(|_| byte()).collect();
            assert_eq!(passed(&bytes).len(), bytes.len());
        }
    }
}
