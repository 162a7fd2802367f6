//! Turtle → [`Ontology`].
//!
//! ```turtle
//! @prefix ratn: <urn:ratn:ontology#> .
//! @prefix rdfs: <http://www.w3.org/2000/01/rdf-schema#> .
//! @prefix owl: <http://www.w3.org/2002/07/owl#> .
//! @prefix : <urn:my-robot#> .
//!
//! :Object a owl:Class .
//! :Box a owl:Class ; rdfs:subClassOf :Object ; ratn:named "box_" .      # names with this prefix are boxes
//! :table a :Object .                                                    # an individual
//! :at a ratn:Predicate ; ratn:arguments ( :Object ) ; ratn:value "pose" .
//! :weight a ratn:Predicate ; ratn:arguments ( :Object ) ; ratn:value "float" ; ratn:unit "kg" ; ratn:tolerance 0.05 .
//! ```
//! A name in a task is the part of an IRI after its last `#`, `/` or `:`. An argument is a class, `owl:Thing` (anything) or
//! `xsd:integer`. A value is a type in the words of task files, or a class: then it is the name of an individual. Further
//! properties of predicates are in [`said`]. Labels and comments are for people; any other property is refused, because it
//! would not be checked. Imported ontologies are read, too ([`imports`]).
//!
//! Reading is bounded by the size of the text and by the number of statements; circular subclasses are refused.

pub mod imports;
pub mod said;

use super::{Domain, Ontology, Predicate, Range};
use crate::load::MAX_SOURCE;
use oxrdf::vocab::{rdf, rdfs, xsd};
use oxrdf::{BlankNode, NamedOrBlankNode, Term as Node, Triple};
use oxttl::TurtleParser;
use std::collections::{BTreeMap, BTreeSet};

/// Limit of statements in an ontology.
pub const MAX_STATEMENTS: usize = 20_000;
/// Limit of classes in an ontology, because all superclasses of each class are stored.
pub const MAX_CLASSES: usize = 1_000;

const OURS: &str = "urn:ratn:ontology#";
const OWL: &str = "http://www.w3.org/2002/07/owl#";

/// Error: the text is no ontology.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum OntologyError {
    /// Not Turtle.
    #[error("line {line}: {message}")]
    Syntax {
        /// The line, counted from 1.
        line: u64,
        /// What is wrong.
        message: String,
    },
    /// The ontology exceeds a limit.
    #[error("it is too large: at most {limit} {of} are read")]
    TooLarge {
        /// The limit.
        limit: usize,
        /// Of what.
        of: &'static str,
    },
    /// An error in an imported file.
    #[error("{file}")]
    Import {
        /// The file's name in the import.
        file: String,
        /// What is wrong there.
        source: Box<OntologyError>,
    },
    /// A statement is not understood, or contradicts another one.
    #[error("`{subject}`: {message}")]
    Statement {
        /// The name of its subject.
        subject: String,
        /// What is wrong.
        message: String,
    },
}

/// The statements about each subject, in the order of the text.
type Statements = BTreeMap<String, Vec<(String, Node)>>;

/// Reads an ontology from one text without imports.
///
/// # Errors
/// [`OntologyError`] for the first error.
pub fn read(text: &str) -> Result<Ontology, OntologyError> {
    let nothing = |_: &str, _: &str| Err("there are no other files here".to_owned());
    imports::read_with("", text, &nothing).map(|(ontology, _)| ontology)
}

/// The statements of one text, the `number`th of an ontology of which `before` statements have been read.
fn parse(text: &str, number: usize, before: usize) -> Result<Statements, OntologyError> {
    if text.len() > MAX_SOURCE {
        return Err(OntologyError::TooLarge { limit: MAX_SOURCE, of: "bytes" });
    }
    let base = |error| wrong(imports::BASE, format!("{error}"));
    let parser = TurtleParser::new().with_base_iri(imports::BASE).map_err(base)?;
    let mut statements = Statements::new();
    for (place, triple) in parser.for_slice(text.as_bytes()).enumerate() {
        let Triple { subject, predicate, object } = triple.map_err(|error| OntologyError::Syntax {
            line: error.location().start.line + 1,
            message: error.message().to_owned(),
        })?;
        if before + place >= MAX_STATEMENTS {
            return Err(OntologyError::TooLarge { limit: MAX_STATEMENTS, of: "statements" });
        }
        // A blank node is local to its text.
        let object = match object {
            Node::BlankNode(blank) => Node::BlankNode(BlankNode::new_unchecked(own(&blank, number))),
            other => other,
        };
        let subject = match subject {
            NamedOrBlankNode::NamedNode(iri) => iri.into_string(),
            NamedOrBlankNode::BlankNode(blank) => format!("_:{}", own(&blank, number)),
        };
        statements.entry(subject).or_default().push((predicate.into_string(), object));
    }
    Ok(statements)
}

/// Makes the ontology of all statements.
fn assemble(statements: &Statements) -> Result<Ontology, OntologyError> {
    let reader = Reader { statements };
    reader.names_are_unique()?;
    reader.read()
}

fn own(blank: &BlankNode, number: usize) -> String {
    format!("t{number}.{}", blank.as_str())
}

struct Reader<'a> {
    statements: &'a Statements,
}

impl Reader<'_> {
    fn read(&self) -> Result<Ontology, OntologyError> {
        let mut ontology = Ontology::default();
        let mut above: BTreeMap<String, BTreeSet<String>> = BTreeMap::new();
        let named = || self.statements.iter().filter(|(subject, _)| !subject.starts_with("_:"));
        for (subject, said) in named().filter(|(_, said)| is_any(said, &classes())) {
            let parents = above.entry(name(subject)).or_default();
            for (property, object) in said {
                match property.as_str() {
                    p if p == rdfs::SUB_CLASS_OF.as_str() => {
                        parents.insert(self.class(subject, object)?);
                    }
                    p if p == ours("named") => {
                        let prefix = literal(subject, "ratn:named", object)?;
                        if prefix.is_empty() {
                            return Err(wrong(subject, "`ratn:named` is how names begin, not empty"));
                        }
                        if ontology.named.insert(prefix.clone(), name(subject)).is_some() {
                            return Err(wrong(subject, format!("two classes are `ratn:named` \"{prefix}\"")));
                        }
                    }
                    p if p == rdf::TYPE.as_str() || is_for_people(p) => {}
                    p => return Err(not_understood(subject, p)),
                }
            }
        }
        ontology.classes = closure(&above)?;
        for (subject, said) in named() {
            if is_any(said, &[ours("Predicate")]) {
                ontology.predicates.insert(name(subject), self.predicate(subject, said)?);
            } else if !is_any(said, &classes()) && !is_any(said, &[format!("{OWL}Ontology")]) {
                ontology.individuals.insert(name(subject), self.individual(subject, said)?);
            }
        }
        Ok(ontology)
    }

    /// Names must be unique; else their meaning would depend on the order of the text.
    fn names_are_unique(&self) -> Result<(), OntologyError> {
        let mut seen: BTreeMap<String, &str> = BTreeMap::new();
        for subject in self.statements.keys().filter(|subject| !subject.starts_with("_:")) {
            if let Some(other) = seen.insert(name(subject), subject) {
                return Err(wrong(subject, format!("`{other}` and `{subject}` would have one name in tasks")));
            }
        }
        Ok(())
    }

    fn predicate(&self, subject: &str, said: &[(String, Node)]) -> Result<Predicate, OntologyError> {
        let (mut domain, mut range, mut more) = (None, None, said::More::default());
        let mut before = BTreeSet::new();
        for (property, object) in said {
            let local = property.strip_prefix(OURS);
            if let Some(what) = local
                && !before.insert(what)
            {
                return Err(wrong(subject, format!("`ratn:{what}` is said twice")));
            }
            match local {
                Some("arguments") => domain = Some(self.arguments(subject, object)?),
                Some("value") => range = Some(self.range(subject, object)?),
                Some(what) if more.takes(subject, what, object)? => {}
                None if property == rdf::TYPE.as_str() || is_for_people(property) => {}
                _ => return Err(not_understood(subject, property)),
            }
        }
        let missing = |what| wrong(subject, format!("a predicate says its `ratn:{what}`"));
        let domain = domain.ok_or_else(|| missing("arguments ( … )"))?;
        let range = range.ok_or_else(|| missing("value"))?;
        let functional = is_any(said, &[format!("{OWL}FunctionalProperty")]);
        more.predicate(subject, domain, range, functional)
    }

    fn individual(&self, subject: &str, said: &[(String, Node)]) -> Result<BTreeSet<String>, OntologyError> {
        let mut classes = BTreeSet::new();
        for (property, object) in said {
            match property.as_str() {
                p if p == rdf::TYPE.as_str() => {
                    classes.insert(self.class(subject, object)?);
                }
                p if is_for_people(p) => {}
                p => return Err(not_understood(subject, p)),
            }
        }
        if classes.is_empty() {
            return Err(wrong(subject, "nothing says what it is; write `a :Class`"));
        }
        Ok(classes)
    }

    /// The elements of a list; it has at most as many as there are statements.
    fn arguments(&self, subject: &str, list: &Node) -> Result<Vec<Domain>, OntologyError> {
        let mut arguments = Vec::new();
        let mut rest = list.clone();
        for _ in 0..=self.statements.len() {
            let cell = match &rest {
                Node::NamedNode(end) if *end == rdf::NIL => return Ok(arguments),
                Node::BlankNode(cell) => self.statements.get(&cell.to_string()),
                _ => None,
            };
            let of = |wanted: &str| Some(cell?.iter().find(|(property, _)| property == wanted)?.1.clone());
            let (Some(first), Some(next)) = (of(rdf::FIRST.as_str()), of(rdf::REST.as_str())) else { break };
            arguments.push(self.domain(subject, &first)?);
            rest = next;
        }
        Err(wrong(subject, "`ratn:arguments` is a list of classes, `( :Object )`, or `()`"))
    }

    fn domain(&self, subject: &str, object: &Node) -> Result<Domain, OntologyError> {
        Ok(match object {
            Node::NamedNode(iri) if iri.as_str() == format!("{OWL}Thing") => Domain::Anything,
            Node::NamedNode(iri) if *iri == xsd::INTEGER => Domain::Integer,
            _ => Domain::Class(self.class(subject, object)?),
        })
    }

    fn range(&self, subject: &str, object: &Node) -> Result<Range, OntologyError> {
        if matches!(object, Node::NamedNode(_)) {
            return Ok(Range::Class(self.class(subject, object)?));
        }
        let text = literal(subject, "ratn:value", object)?;
        text.parse().map(Range::Type).map_err(|error| wrong(subject, error))
    }

    /// The name of a declared class.
    fn class(&self, subject: &str, object: &Node) -> Result<String, OntologyError> {
        match object {
            Node::NamedNode(iri) if self.statements.get(iri.as_str()).is_some_and(|said| is_any(said, &classes())) => {
                Ok(name(iri.as_str()))
            }
            other => Err(wrong(subject, format!("`{other}` is not declared as a class, `a owl:Class`"))),
        }
    }
}

/// Every class with all its superclasses, by depth-first search with an explicit stack.
fn closure(above: &BTreeMap<String, BTreeSet<String>>) -> Result<BTreeMap<String, BTreeSet<String>>, OntologyError> {
    if above.len() > MAX_CLASSES {
        return Err(OntologyError::TooLarge { limit: MAX_CLASSES, of: "classes" });
    }
    let mut closed = BTreeMap::new();
    for (class, parents) in above {
        let mut all = BTreeSet::from([class.clone()]);
        let mut todo: Vec<&String> = parents.iter().collect();
        while let Some(next) = todo.pop() {
            if next == class {
                return Err(wrong(class, "it is a subclass of itself, directly or over others; break the circle"));
            }
            if all.insert(next.clone()) {
                todo.extend(above.get(next).into_iter().flatten());
            }
        }
        closed.insert(class.clone(), all);
    }
    Ok(closed)
}

fn classes() -> [String; 2] {
    [format!("{OWL}Class"), rdfs::CLASS.as_str().to_owned()]
}

fn is_any(said: &[(String, Node)], types: &[String]) -> bool {
    said.iter().any(|(property, object)| {
        property == rdf::TYPE.as_str()
            && matches!(object, Node::NamedNode(iri) if types.iter().any(|ty| ty == iri.as_str()))
    })
}

fn is_for_people(property: &str) -> bool {
    [rdfs::LABEL, rdfs::COMMENT].iter().any(|iri| iri.as_str() == property)
}

fn ours(term: &str) -> String {
    format!("{OURS}{term}")
}

fn name(iri: &str) -> String {
    iri.rsplit(['#', '/', ':']).next().unwrap_or(iri).to_owned()
}

fn literal(subject: &str, what: &str, object: &Node) -> Result<String, OntologyError> {
    match object {
        Node::Literal(literal) => Ok(literal.value().to_owned()),
        other => Err(wrong(subject, format!("`{what}` is a text, found {other}"))),
    }
}

fn not_understood(subject: &str, property: &str) -> OntologyError {
    wrong(subject, format!("`{property}` is not understood here; leave it out"))
}

fn wrong(subject: &str, message: impl ToString) -> OntologyError {
    OntologyError::Statement { subject: name(subject), message: message.to_string() }
}
