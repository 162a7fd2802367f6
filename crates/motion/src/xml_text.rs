//! How all files of XML are opened: without entities of their own, which make a small file a large text.

use xml::reader::{EventReader, ParserConfig2};

/// What is said of a file with a document type.
pub(crate) const NO_DOCUMENT_TYPE: &str =
    "it has a document type (`<!DOCTYPE`), whose entities are not supported: remove it";

/// The longest attribute, in bytes: those of the outermost element are read before its document type is refused.
const LONGEST_ATTRIBUTE: usize = 1 << 20;

/// A reader of the text. Whoever uses it refuses a [`doctype`](EventReader::doctype) at the first element: [`NO_DOCUMENT_TYPE`].
pub(crate) fn reader(text: &[u8]) -> EventReader<&[u8]> {
    EventReader::new_with_config(text, ParserConfig2::new().max_attribute_length(LONGEST_ATTRIBUTE))
}
