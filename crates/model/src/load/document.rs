//! A task file as a plain tree without locations, for other languages that read, change and write it.
//!
//! The only check is that it is YAML as in task files: booleans are `true` and `false`, and keys are unique.

use super::advice;
use super::yaml::{self, Content, Node};
use crate::diagnostic::{Diagnostic, Findings};

/// A node of the tree.
#[derive(Debug, Clone, PartialEq)]
pub enum Document {
    /// Nothing.
    Null,
    /// `true` or `false`.
    Bool(bool),
    /// A whole number.
    Int(i64),
    /// A number.
    Float(f64),
    /// Text: a name or an expression.
    Text(String),
    /// A list.
    List(Vec<Document>),
    /// A mapping, in the order of the file.
    Map(Vec<(String, Document)>),
}

impl Document {
    /// Parses a file; `file` is its name in messages.
    ///
    /// # Errors
    /// The text is no YAML: a finding with the rule `invalid-yaml`, as in [`super::load`].
    pub fn read(source: &str, file: &str) -> Result<Document, Box<Diagnostic>> {
        yaml::read(source).map(Document::of).map_err(|error| {
            let mut findings = Findings::default();
            let help = advice::advice(source, &error);
            findings.error("invalid-yaml", error.at, "", error.message, help);
            Box::new(findings.in_file(file).swap_remove(0))
        })
    }

    pub(super) fn of(node: Node) -> Document {
        match node.content {
            Content::Null => Document::Null,
            Content::Bool(truth) => Document::Bool(truth),
            Content::Int(number) => Document::Int(number),
            Content::Float(number) => Document::Float(number),
            Content::Text(text) => Document::Text(text),
            Content::List(items) => Document::List(items.into_iter().map(Document::of).collect()),
            Content::Map(entries) => {
                Document::Map(entries.into_iter().map(|entry| (entry.key, Document::of(entry.value))).collect())
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_file_is_read_in_its_order_and_what_is_no_yaml_is_refused_with_its_place() {
        let text = |text: &str| Document::Text(text.to_owned());
        let read = Document::read("task: odd\nb: [1, 2.5, yes, true, ]\na: { }\nc:\n", "odd.yaml");
        let list = vec![Document::Int(1), Document::Float(2.5), text("yes"), Document::Bool(true)];
        let entries = [
            ("task", text("odd")),
            ("b", Document::List(list)),
            ("a", Document::Map(Vec::new())),
            ("c", Document::Null),
        ];
        assert_eq!(read, Ok(Document::Map(entries.map(|(key, value)| (key.to_owned(), value)).to_vec())));
        let refused = Document::read("task: a\ntask: b\n", "twice.yaml");
        assert!(refused.is_err_and(|finding| finding.rule == "invalid-yaml"
            && finding.file == "twice.yaml"
            && finding.location.line == 2));
    }
}
