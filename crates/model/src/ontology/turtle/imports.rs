//! Ontologies of several files: `[] a owl:Ontology ; owl:imports <base.ttl> , "../shared/robot.ttl"`.
//!
//! Imported files are read before the file that imports them, each file once; together they form one ontology. The number of files and
//! the depth of imports are limited; circular imports are refused.

use super::{OWL, OntologyError, Statements, assemble, parse, wrong};
use crate::ontology::Ontology;
use oxrdf::Term as Node;
use std::collections::BTreeSet;

/// Limit of the files of an ontology.
pub const MAX_FILES: usize = 32;
/// Limit of the depth of imports.
pub const MAX_DEPTH: usize = 8;
/// Base for relative IRIs, before they are resolved to files.
pub(super) const BASE: &str = "file:///";

/// Reads an imported file, given the importing file and the name in the import. Returns the file's name, which identifies it, and its
/// text; or why it cannot be read.
pub type ReadFile<'a> = &'a dyn Fn(&str, &str) -> Result<(String, String), String>;

/// Reads an ontology with all its imports; also returns all its texts, one after the other.
///
/// # Errors
/// [`OntologyError`] for the first error; one in an imported file has the file's name.
pub fn read_with(name: &str, text: &str, files: ReadFile<'_>) -> Result<(Ontology, String), OntologyError> {
    let mut reading = Reading {
        files,
        statements: Statements::new(),
        texts: String::new(),
        known: BTreeSet::new(),
        above: Vec::new(),
    };
    reading.file(name, text)?;
    Ok((assemble(&reading.statements)?, reading.texts))
}

struct Reading<'a> {
    files: ReadFile<'a>,
    statements: Statements,
    texts: String,
    known: BTreeSet<String>,
    /// The chain of importing files, the outermost first.
    above: Vec<String>,
}

impl Reading<'_> {
    fn file(&mut self, name: &str, text: &str) -> Result<(), OntologyError> {
        self.known.insert(name.to_owned());
        if self.known.len() > MAX_FILES {
            return Err(OntologyError::TooLarge { limit: MAX_FILES, of: "files" });
        }
        self.above.push(name.to_owned());
        let own = parse(text, self.known.len(), self.statements.values().map(Vec::len).sum())?;
        for path in imported(&own)? {
            self.import(name, &path)?;
        }
        self.above.pop();
        self.texts.push_str(text);
        for (subject, said) in own {
            self.statements.entry(subject).or_default().extend(said);
        }
        Ok(())
    }

    fn import(&mut self, using: &str, path: &str) -> Result<(), OntologyError> {
        let within = |source| OntologyError::Import { file: path.to_owned(), source: Box::new(source) };
        let refuse = |message: String| OntologyError::Statement { subject: path.to_owned(), message };
        let read = (self.files)(using, path).map_err(|why| refuse(format!("it is imported and cannot be read: {why}")));
        let (name, text) = read?;
        if self.above.contains(&name) {
            let circle = self.above.join("` imports `");
            return Err(refuse(format!("`{circle}` imports `{name}`: files cannot import each other in a circle")));
        }
        if self.above.len() >= MAX_DEPTH {
            return Err(refuse(format!("files import each other at most {MAX_DEPTH} deep")));
        }
        if self.known.contains(&name) { Ok(()) } else { self.file(&name, &text).map_err(within) }
    }
}

/// The imports of a file, in the order of its text.
fn imported(statements: &Statements) -> Result<Vec<String>, OntologyError> {
    let imports = format!("{OWL}imports");
    let all = statements.iter().flat_map(|(subject, said)| said.iter().map(move |said| (subject, said)));
    let wanted = all.filter(|(_, (property, _))| *property == imports);
    wanted.map(|(subject, (_, object))| path(object).ok_or_else(|| not_a_file(subject, object))).collect()
}

/// The path of a file, relative to the importing one.
fn path(object: &Node) -> Option<String> {
    match object {
        Node::NamedNode(iri) => iri.as_str().strip_prefix(BASE).map(str::to_owned),
        Node::Literal(text) => Some(text.value().to_owned()),
        Node::BlankNode(_) => None,
    }
}

fn not_a_file(subject: &str, object: &Node) -> OntologyError {
    wrong(
        subject,
        format!("`owl:imports` names a file beside this one, `<base.ttl>` or \"../base.ttl\", found {object}"),
    )
}
