//! Answers in pages: whatever can be stored can be told of, however much there is of it.
//!
//! ```text
//!   page_bytes = 0: all at once, or RESOURCE_EXHAUSTED (TOO_LARGE) that says to ask in pages
//!   page_bytes > 0: as many as fit, at least one, and a token of where the next page begins
//! ```

use crate::details::status;
use prost::Message;
use ratn_proto::convert::label;
use ratn_proto::{MAX_MESSAGE_BYTES, MAX_PAGE_BYTES};
use tonic::{Code, Status};

/// Room that a message needs beside what it repeats.
const ENVELOPE_BYTES: usize = 64 * 1024;

/// How much of an answer is wanted at once.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Page {
    /// Nothing where all of it is.
    bytes: Option<usize>,
}

impl Page {
    /// Of what a request says.
    pub(crate) fn of(bytes: u32, token: &str) -> Page {
        let asked = usize::try_from(bytes).unwrap_or(MAX_PAGE_BYTES).min(MAX_PAGE_BYTES);
        let asked = if asked == 0 { MAX_PAGE_BYTES } else { asked };
        Page { bytes: (bytes > 0 || !token.is_empty()).then_some(asked) }
    }

    /// Takes from what there is until the page is full. Whether something is left.
    pub(crate) fn fill<T: Message>(
        self,
        items: impl IntoIterator<Item = T>,
        filled: &mut Filled<T>,
    ) -> Result<bool, Status> {
        for item in items {
            let bytes = item.encoded_len() + ITEM_BYTES;
            match self.bytes {
                Some(most) if filled.bytes + bytes > most && !filled.items.is_empty() => return Ok(true),
                None if filled.bytes + bytes > MAX_MESSAGE_BYTES - ENVELOPE_BYTES => return Err(too_large()),
                _ => {}
            }
            filled.bytes += bytes;
            filled.items.push(item);
        }
        Ok(false)
    }
}

/// What is on a page.
#[derive(Debug)]
pub(crate) struct Filled<T> {
    pub(crate) items: Vec<T>,
    bytes: usize,
}

impl<T> Default for Filled<T> {
    fn default() -> Filled<T> {
        Filled { items: Vec::new(), bytes: 0 }
    }
}

/// What a field takes beside its message.
const ITEM_BYTES: usize = 8;

/// Cut into parts of at most a page each; at least one, which may be empty.
pub(crate) fn parts<T: Message>(items: Vec<T>) -> Vec<Vec<T>> {
    let (mut parts, mut bytes) = (vec![Vec::new()], 0);
    for item in items {
        let more = item.encoded_len() + ITEM_BYTES;
        if bytes + more > MAX_PAGE_BYTES
            && let Some(last) = parts.last()
            && !last.is_empty()
        {
            parts.push(Vec::new());
            bytes = 0;
        }
        bytes += more;
        if let Some(last) = parts.last_mut() {
            last.push(item);
        }
    }
    parts
}

/// A snapshot's items in parts of at most a page each. A client that takes no parts gets all in one part, where that fits into a message.
pub(crate) fn snapshot_parts<T: Message>(items: Vec<T>, in_parts: bool) -> Result<Vec<Vec<T>>, Status> {
    let parts = parts(items);
    if parts.len() == 1 || in_parts {
        return Ok(parts);
    }
    let mut filled = Filled::default();
    Page::of(0, "").fill(parts.into_iter().flatten(), &mut filled)?;
    Ok(vec![filled.items])
}

/// As many from the first on as a page has room for.
pub(crate) fn first<T: Message>(items: Vec<T>) -> Vec<T> {
    parts(items).swap_remove(0)
}

/// What a token says: a revision, and how many were on the pages before.
pub(crate) fn place(token: &str) -> Result<Option<(u64, usize)>, Status> {
    label(token, "page_token")?;
    if token.is_empty() {
        return Ok(None);
    }
    let read = || token.split_once(':').and_then(|(at, seen)| Some((at.parse().ok()?, seen.parse().ok()?)));
    read().map(Some).ok_or_else(no_token)
}

/// The token of the page behind, where there is one.
pub(crate) fn token(more: bool, revision: u64, seen: usize) -> String {
    if more { format!("{revision}:{seen}") } else { String::new() }
}

/// The token of the page behind the one that ends with this id, where there is one. Only a call that asks for the same goes on with it: `asked` is
/// the request without what it says of pages.
pub(crate) fn token_behind(last: Option<&str>, asked: &impl Message) -> String {
    last.map_or_else(String::new, |last| format!("{:016x}:{last}", seal(last, asked)))
}

/// The id behind which a token goes on; empty for the first page.
pub(crate) fn behind<'a>(token: &'a str, asked: &impl Message) -> Result<&'a str, Status> {
    if token.is_empty() {
        return Ok("");
    }
    label(token, "page_token")?;
    let own = token.split_once(':').filter(|(sealed, last)| *sealed == format!("{:016x}", seal(last, asked)));
    own.map(|(_, last)| last).ok_or_else(no_token)
}

/// FNV-1a of what is asked and an id: it tells a token of ours from another text, and protects nothing.
fn seal(last: &str, asked: &impl Message) -> u64 {
    let bytes = asked.encode_to_vec().into_iter().chain([0]).chain(last.bytes());
    bytes.fold(0xcbf2_9ce4_8422_2325, |hash, byte| (hash ^ u64::from(byte)).wrapping_mul(0x0000_0100_0000_01b3))
}

fn no_token() -> Status {
    let message = "page_token: is none of a page of this answer: begin with an empty one";
    status(Code::InvalidArgument, "MALFORMED", message)
}

/// An answer that does not fit into one message.
pub(crate) fn too_large() -> Status {
    let message = format!(
        "the answer has more than the {MAX_MESSAGE_BYTES} bytes of a message: ask for it in pages (page_bytes, for a watch \
         in_parts), as clients of this version do"
    );
    status(Code::ResourceExhausted, "TOO_LARGE", message)
}

/// An answer that has no pages: as it is where it fits into one message, else refused with what to ask for instead.
pub(crate) fn whole<T: Message>(answer: T, what: &str, instead: &str) -> Result<T, Status> {
    let bytes = answer.encoded_len();
    if bytes <= MAX_MESSAGE_BYTES {
        return Ok(answer);
    }
    let message = format!("{what} has {bytes} bytes, more than the {MAX_MESSAGE_BYTES} of a message: {instead}");
    Err(status(Code::ResourceExhausted, "TOO_LARGE", message))
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;

    fn texts(sizes: &[usize]) -> Vec<String> {
        sizes.iter().map(|size| "x".repeat(*size)).collect()
    }

    #[test]
    fn a_page_has_as_many_as_fit_and_at_least_one() {
        let page = Page::of(1_000, "");
        let mut filled = Filled::default();
        assert!(page.fill(texts(&[400, 400, 400]), &mut filled).unwrap());
        assert_eq!(filled.items.len(), 2);
        let mut filled = Filled::default();
        assert!(page.fill(texts(&[5_000, 1]), &mut filled).unwrap());
        assert_eq!(filled.items.len(), 1);
        let mut filled = Filled::default();
        assert!(!page.fill(texts(&[1, 1]), &mut filled).unwrap());
    }

    #[test]
    fn an_answer_without_pages_is_refused_where_it_is_more_than_a_message() {
        let whole = Page::of(0, "");
        let edge = MAX_MESSAGE_BYTES - ENVELOPE_BYTES - ITEM_BYTES;
        // A text has a tag and its length beside its letters.
        let at_edge = |more: usize| "x".repeat(edge - 5 + more);
        assert_eq!(at_edge(0).encoded_len(), edge);
        assert!(!whole.fill([at_edge(0)], &mut Filled::default()).unwrap());
        let refused = whole.fill([at_edge(1)], &mut Filled::default()).unwrap_err();
        assert!(refused.code() == Code::ResourceExhausted && refused.message().contains("page_bytes"), "{refused}");
    }

    #[test]
    fn answers_without_pages_at_the_edge_of_a_message_and_one_byte_past_it() {
        use ratn_proto::v1;
        let named = |bytes| v1::FactKey { predicate: "x".repeat(bytes), ..Default::default() };
        let scene = |bytes| v1::GetSceneResponse { from: vec![7; bytes], ..Default::default() };
        let contradiction = |bytes| v1::WatchProjectionResponse {
            contradiction: Some(v1::Contradiction { fact: Some(named(bytes)), ..Default::default() }),
        };
        fn check<T: Message>(with: impl Fn(usize) -> T) {
            // Near the edge the length of a field takes as many bytes as at the edge.
            let near = MAX_MESSAGE_BYTES - 1_000;
            let edge = near + (MAX_MESSAGE_BYTES - with(near).encoded_len());
            assert_eq!(whole(with(edge), "it", "ask for less").unwrap().encoded_len(), MAX_MESSAGE_BYTES);
            let refused = whole(with(edge + 1), "it", "ask for less").map(|_| ()).unwrap_err();
            let says =
                format!("it has {} bytes, more than the {MAX_MESSAGE_BYTES} of a message", MAX_MESSAGE_BYTES + 1);
            assert!(refused.code() == Code::ResourceExhausted && refused.message().starts_with(&says), "{refused}");
        }
        check(scene);
        check(contradiction);
    }

    #[test]
    fn parts_hold_everything_in_order() {
        let half = MAX_PAGE_BYTES / 2;
        let sizes: Vec<usize> = parts(texts(&[half, half, 1, half])).iter().map(Vec::len).collect();
        assert_eq!(sizes, [1, 2, 1]);
        assert_eq!(parts(texts(&[])).len(), 1);
    }

    #[test]
    fn a_token_is_read_as_it_was_written() {
        assert_eq!(place(&token(true, 7, 12)).unwrap(), Some((7, 12)));
        assert_eq!(place(&token(false, 7, 12)).unwrap(), None);
        assert!(place("7").is_err() && place("a:b").is_err());
    }
}
