//! Opens all XML files: without custom entities, by which a small file can expand to a large text.

use xml::attribute::OwnedAttribute;
use xml::reader::{EventReader, ParserConfig2, XmlEvent};
use xml::writer::EmitterConfig;

/// The error for a file with a document type.
pub(crate) const NO_DOCUMENT_TYPE: &str =
    "it has a document type (`<!DOCTYPE`), whose entities are not supported: remove it";

/// Maximum length of an attribute, in bytes: the attributes of the outermost element are read before its document type is refused.
const LONGEST_ATTRIBUTE: usize = 1 << 20;

/// A reader of the text. The caller has to refuse a [`doctype`](EventReader::doctype) at the first element: [`NO_DOCUMENT_TYPE`].
pub(crate) fn reader(text: &[u8]) -> EventReader<&[u8]> {
    EventReader::new_with_config(text, ParserConfig2::new().max_attribute_length(LONGEST_ATTRIBUTE))
}

/// The text without the elements, with their content, for which `is_left_out` is true by parent element, name and attributes.
///
/// # Errors
/// The place where the text is not XML.
pub(crate) fn without(
    text: &str,
    is_left_out: impl Fn(&str, &str, &[OwnedAttribute]) -> bool,
) -> Result<String, String> {
    let (mut out, mut open, mut left_out) = (Vec::new(), Vec::new(), 0_usize);
    let mut writer = EmitterConfig::new().create_writer(&mut out);
    for event in reader(text.as_bytes()) {
        let event = event.map_err(|error| error.to_string())?;
        let was_left_out = left_out > 0;
        match &event {
            XmlEvent::StartElement { name, attributes, .. } => {
                let holds = open.last().map_or("", String::as_str);
                left_out += usize::from(was_left_out || is_left_out(holds, &name.local_name, attributes));
                open.push(name.local_name.clone());
            }
            XmlEvent::EndElement { .. } => {
                left_out = left_out.saturating_sub(1);
                open.pop();
            }
            _ => {}
        }
        if let Some(event) = event.as_writer_event().filter(|_| !was_left_out && left_out == 0) {
            writer.write(event).map_err(|error| error.to_string())?;
        }
    }
    String::from_utf8(out).map_err(|error| error.to_string())
}
