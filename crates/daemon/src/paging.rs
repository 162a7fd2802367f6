//! Answers in pages: any state that can be stored can also be read, however large it is.
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

/// Bytes that a message needs apart from its repeated items.
const ENVELOPE_BYTES: usize = 64 * 1024;

/// How much of an answer is wanted at once.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Page {
    /// `None` for the whole answer.
    bytes: Option<usize>,
}

impl Page {
    /// The page that a request asks for.
    pub(crate) fn of(bytes: u32, token: &str) -> Page {
        let asked = usize::try_from(bytes).unwrap_or(MAX_PAGE_BYTES).min(MAX_PAGE_BYTES);
        let asked = if asked == 0 { MAX_PAGE_BYTES } else { asked };
        Page { bytes: (bytes > 0 || !token.is_empty()).then_some(asked) }
    }

    /// Takes items until the page is full. Returns whether any are left.
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

/// The items of a page.
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

/// Bytes of a field apart from its message.
const ITEM_BYTES: usize = 8;

/// A snapshot in parts of at most a page each, each with whether another one follows. There is at least one part, which may be empty. `make` makes a
/// part when it is asked for, so at most one part is in memory for a client that does not read. A client that does not support parts gets everything
/// in one part, where that fits into a message.
pub(crate) fn snapshot_parts<T>(
    in_parts: bool,
    mut make: impl FnMut(Page, &mut Filled<T>) -> Result<bool, Status>,
) -> impl Iterator<Item = Result<(Vec<T>, bool), Status>> {
    let page = Page { bytes: in_parts.then_some(MAX_PAGE_BYTES) };
    let mut follows = true;
    std::iter::from_fn(move || {
        if !std::mem::take(&mut follows) {
            return None;
        }
        let mut part = Filled::default();
        Some(make(page, &mut part).map(|more| {
            follows = more;
            (part.items, more)
        }))
    })
}

/// As many of the first items as a page has room for.
pub(crate) fn first<T: Message>(items: Vec<T>) -> Vec<T> {
    let mut filled = Filled::default();
    let page = Page { bytes: Some(MAX_PAGE_BYTES) };
    // A page with a byte limit is never too large.
    let _ = page.fill(items, &mut filled);
    filled.items
}

/// The place in a token, for a call that asks for the same as before: a revision, and the number of items on the pages before.
pub(crate) fn place(token: &str, asked: &impl Message) -> Result<Option<(u64, usize)>, Status> {
    let place = behind(token, asked)?;
    if place.is_empty() {
        return Ok(None);
    }
    let read = || place.split_once(':').and_then(|(at, seen)| Some((at.parse().ok()?, seen.parse().ok()?)));
    read().map(Some).ok_or_else(no_token)
}

/// The token of the next page, where there is one; as [`token_behind`].
pub(crate) fn token(more: bool, revision: u64, seen: usize, asked: &impl Message) -> String {
    let place = more.then(|| format!("{revision}:{seen}"));
    token_behind(place.as_deref(), asked)
}

/// The token of the page behind the one that ends with this id, where there is one. The token is only valid for the same request: `asked` is the
/// request without its paging fields.
pub(crate) fn token_behind(last: Option<&str>, asked: &impl Message) -> String {
    last.map_or_else(String::new, |last| format!("{:016x}:{last}", seal(last, asked)))
}

/// The id after which a token continues; empty for the first page.
pub(crate) fn behind<'a>(token: &'a str, asked: &impl Message) -> Result<&'a str, Status> {
    if token.is_empty() {
        return Ok("");
    }
    label(token, "page_token")?;
    let own = token.split_once(':').filter(|(sealed, last)| *sealed == format!("{:016x}", seal(last, asked)));
    own.map(|(_, last)| last).ok_or_else(no_token)
}

/// FNV-1a hash of the request's type, its content and an id: it tells a token of ours from any other text, and is no protection.
fn seal<T: Message>(last: &str, asked: &T) -> u64 {
    let question = std::any::type_name::<T>().bytes().chain(asked.encode_to_vec());
    let bytes = question.chain([0]).chain(last.bytes());
    bytes.fold(0xcbf2_9ce4_8422_2325, |hash, byte| (hash ^ u64::from(byte)).wrapping_mul(0x0000_0100_0000_01b3))
}

fn no_token() -> Status {
    let message = "page_token: is none of a page of this answer: begin with an empty one";
    status(Code::InvalidArgument, "MALFORMED", message)
}

/// The refusal of an answer that does not fit into one message.
pub(crate) fn too_large() -> Status {
    let message = format!(
        "the answer has more than the {MAX_MESSAGE_BYTES} bytes of a message: ask for it in pages (page_bytes, for a watch \
         in_parts), as clients of this version do"
    );
    status(Code::ResourceExhausted, "TOO_LARGE", message)
}

/// An answer that has no pages: unchanged where it fits into one message, otherwise a refusal that names the alternative.
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
        // A string field has a tag and its length in addition to its characters.
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
            // Near the limit the length of a field takes as many bytes as at the limit.
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
    fn parts_hold_everything_in_order_and_each_is_made_when_it_is_asked_for() {
        let half = MAX_PAGE_BYTES / 2;
        let parts = |sizes: &[usize], in_parts| {
            let (all, mut at) = (texts(sizes), 0);
            snapshot_parts(in_parts, move |page, part| {
                let more = page.fill(all[at..].iter().cloned(), part)?;
                at += part.items.len();
                Ok(more)
            })
        };
        let sizes = |parts: Vec<Result<(Vec<String>, bool), Status>>| -> Vec<(usize, bool)> {
            parts.into_iter().map(|part| part.map(|(part, more)| (part.len(), more)).unwrap()).collect()
        };
        let four = [half, half, 1, half];
        assert_eq!(sizes(parts(&four, true).collect()), [(1, true), (2, true), (1, false)]);
        assert_eq!(sizes(parts(&[], true).collect()), [(0, false)]);
        assert_eq!(sizes(parts(&four, false).collect()), [(4, false)]);
        let too_large: Vec<_> = parts(&[half; 5], false).collect();
        assert!(too_large.len() == 1 && too_large[0].is_err());
        assert_eq!(first(texts(&four)).len(), 1);
    }

    #[test]
    fn a_token_is_read_as_it_was_written_by_who_asks_for_the_same() {
        let (asked, other) = ("boxes".to_owned(), "cups".to_owned());
        assert_eq!(place(&token(true, 7, 12, &asked), &asked).unwrap(), Some((7, 12)));
        assert_eq!(place(&token(false, 7, 12, &asked), &asked).unwrap(), None);
        for none in ["7", "7:12", "a:b", "0000000000000000:7:12"] {
            let refused = place(none, &asked).unwrap_err();
            assert!(refused.message().contains("page_token"), "{refused}");
        }
        assert!(place(&token(true, 7, 12, &asked), &other).is_err());
    }
}
