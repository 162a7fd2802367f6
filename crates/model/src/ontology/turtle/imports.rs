//! Ontologies of several files: `[] a owl:Ontology ; owl:imports <base.ttl> , "../shared/robot.ttl"`.
//!
//! What a file imports is read before it, each file once, and all of it is one ontology. Bounded: by the number of files and by how
//! deep they import each other; a file that imports itself, directly or over others, is refused.

use super::{OWL, OntologyError, Statements, assemble, parse, wrong};
use crate::ontology::Ontology;
use oxrdf::Term as Node;
use std::collections::BTreeSet;

/// An ontology is of no more files.
pub const MAX_FILES: usize = 32;
/// Files import each other no deeper.
pub const MAX_DEPTH: usize = 8;
/// What a relative IRI stands for, before it is one of a file.
pub(super) const BASE: &str = "file:///";

/// Where the texts of imported files come from: of the file that imports and what it calls the other, the other's name, by which it is
/// known again, and its text; or why it cannot be read.
pub type ReadFile<'a> = &'a dyn Fn(&str, &str) -> Result<(String, String), String>;

/// Reads an ontology with all that it imports; its texts, too, one after the other.
///
/// # Errors
/// [`OntologyError`] for the first thing that is wrong; in an imported file with its name.
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
    /// The files that import each other, the first first.
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

/// What a file imports, in the order of its text.
fn imported(statements: &Statements) -> Result<Vec<String>, OntologyError> {
    let imports = format!("{OWL}imports");
    let all = statements.iter().flat_map(|(subject, said)| said.iter().map(move |said| (subject, said)));
    let wanted = all.filter(|(_, (property, _))| *property == imports);
    wanted.map(|(subject, (_, object))| path(object).ok_or_else(|| not_a_file(subject, object))).collect()
}

/// The path of a file that is relative to the one that names it.
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
