//! SPARQL over triples: `SELECT` and `ASK`, evaluated over a dataset that is built for one query.
//!
//! A crate of its own, because the evaluator is large and only one option of one command uses it: `ratn world query --sparql`, in a `ratn`
//! that is built with the feature `sparql`. It knows nothing of facts: its caller supplies the triples and the prefixes. There are limits
//! for the length and the nesting of the query, the time of the evaluation, and the number of rows.

use oxrdf::vocab::xsd;
use oxrdf::{Dataset, GraphName, IriParseError, Term, Triple};
use spareval::{CancellationToken, QueryEvaluationError, QueryEvaluator, QueryResults};
use spargebra::{SparqlParser, SparqlSyntaxError};
use std::sync::mpsc;
use std::time::Duration;

/// Maximum length of a query, in bytes.
pub const MAX_TEXT: usize = 16 * 1024;
/// Maximum nesting depth of parentheses, braces and brackets.
pub const MAX_NESTING: usize = 48;
/// Time limit of the evaluation.
pub const DEADLINE: Duration = Duration::from_secs(10);
/// Stack size of the evaluating thread, in bytes: a long query is a deep tree.
const STACK: usize = 256 << 20;

/// The answer to a query.
#[derive(Debug, PartialEq)]
pub enum Answer {
    /// The result of a `SELECT`.
    Rows {
        /// The names of the variables, in the order of the query.
        variables: Vec<String>,
        /// The rows: for each variable its value, if it is bound.
        rows: Vec<Vec<Option<Term>>>,
        /// Whether there are more rows than the limit.
        more: bool,
    },
    /// The result of an `ASK`.
    Truth(bool),
}

/// Why a query has no answer.
#[derive(Debug, thiserror::Error)]
pub enum QueryError {
    /// The text is too long.
    #[error("the query is longer than {MAX_TEXT} bytes")]
    TooLong,
    /// The text is nested too deeply.
    #[error("the query is nested deeper than {MAX_NESTING}")]
    TooDeep,
    /// A prefix from the caller is not an IRI.
    #[error("the prefix `{0}` is no IRI")]
    Prefix(String, #[source] IriParseError),
    /// The text is not a SPARQL query.
    #[error("not SPARQL")]
    NotSparql(#[source] SparqlSyntaxError),
    /// The evaluation failed.
    #[error("the query cannot be answered")]
    Evaluation(#[source] QueryEvaluationError),
    /// The query asks for triples, which is not supported.
    #[error("SELECT and ASK are answered; for all facts there is `ratn world dump`")]
    Graph,
    /// The evaluation exceeded its time limit, and was stopped.
    #[error("the answer takes longer than {0} s: ask for less")]
    Late(u64),
    /// The evaluating thread could not be started.
    #[error("no thread could be started for the query")]
    Thread(#[source] std::io::Error),
}

/// Evaluates `query` over `triples`, with at most `limit` rows. `prefixes` (name and IRI) can be used in the query.
///
/// # Errors
/// The fault of the query, or that the evaluation takes too long.
pub fn answer(
    query: &str,
    prefixes: &[(&str, &str)],
    triples: impl IntoIterator<Item = Triple>,
    limit: usize,
) -> Result<Answer, QueryError> {
    within(query, prefixes, triples, limit, DEADLINE)
}

fn within(
    text: &str,
    prefixes: &[(&str, &str)],
    triples: impl IntoIterator<Item = Triple>,
    limit: usize,
    deadline: Duration,
) -> Result<Answer, QueryError> {
    if text.len() > MAX_TEXT {
        return Err(QueryError::TooLong);
    }
    if nesting(text) > MAX_NESTING {
        return Err(QueryError::TooDeep);
    }
    let mut parser = SparqlParser::new();
    for (name, iri) in prefixes {
        parser = parser.with_prefix(*name, *iri).map_err(|error| QueryError::Prefix((*name).to_owned(), error))?;
    }
    let mut dataset = Dataset::new();
    for triple in triples {
        dataset.insert(&triple.in_graph(GraphName::DefaultGraph));
    }
    let (text, token) = (text.to_owned(), CancellationToken::new());
    let (done, answered) = mpsc::channel();
    let cancelled = token.clone();
    let thread = std::thread::Builder::new().stack_size(STACK);
    let started = thread.spawn(move || {
        let _ = done.send(evaluate(parser, &text, &dataset, limit, cancelled));
    });
    started.map_err(QueryError::Thread)?;
    answered.recv_timeout(deadline).unwrap_or_else(|_| {
        token.cancel();
        Err(QueryError::Late(deadline.as_secs()))
    })
}

fn evaluate(
    parser: SparqlParser,
    text: &str,
    dataset: &Dataset,
    limit: usize,
    token: CancellationToken,
) -> Result<Answer, QueryError> {
    let query = parser.parse_query(text).map_err(QueryError::NotSparql)?;
    let evaluator = QueryEvaluator::new().with_cancellation_token(token);
    let results = evaluator.prepare(&query).execute(dataset).map_err(QueryError::Evaluation)?;
    let solutions = match results {
        QueryResults::Solutions(solutions) => solutions,
        QueryResults::Boolean(truth) => return Ok(Answer::Truth(truth)),
        QueryResults::Graph(_) => return Err(QueryError::Graph),
    };
    let variables = solutions.variables().to_vec();
    let mut rows: Vec<Vec<Option<Term>>> = Vec::new();
    for solution in solutions.take(limit.saturating_add(1)) {
        let solution = solution.map_err(QueryError::Evaluation)?;
        rows.push(variables.iter().map(|variable| solution.get(variable).cloned()).collect());
    }
    let more = rows.len() > limit;
    rows.truncate(limit);
    let variables = variables.iter().map(|variable| variable.as_str().to_owned()).collect();
    Ok(Answer::Rows { variables, rows, more })
}

/// The maximum nesting depth of parentheses, braces and brackets; those within string literals count, too.
fn nesting(text: &str) -> usize {
    let (mut depth, mut deepest) = (0_usize, 0);
    for character in text.chars() {
        match character {
            '(' | '{' | '[' => depth += 1,
            ')' | '}' | ']' => depth = depth.saturating_sub(1),
            _ => {}
        }
        deepest = deepest.max(depth);
    }
    deepest
}

/// A term for people: texts and numbers as they are, everything else in RDF's notation.
#[must_use]
pub fn shown(term: &Term) -> String {
    match term {
        Term::Literal(literal) if literal.datatype() == xsd::DOUBLE => {
            literal.value().parse::<f64>().map_or_else(|_| literal.value().to_owned(), |number| number.to_string())
        }
        Term::Literal(literal) => literal.value().to_owned(),
        Term::NamedNode(name) => name.as_str().to_owned(),
        Term::BlankNode(node) => node.to_string(),
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;
    use oxrdf::{BlankNode, Literal, NamedNode};

    const WORLD: &str = "urn:kitchen#";
    const PREFIXES: [(&str, &str); 1] = [("world", WORLD)];

    fn fact(number: usize, said: &[(&str, Literal)]) -> Vec<Triple> {
        let subject = BlankNode::new(format!("fact{number}")).unwrap();
        let property = |name: &str| NamedNode::new(format!("{WORLD}{name}")).unwrap();
        said.iter().map(|(name, object)| Triple::new(subject.clone(), property(name), object.clone())).collect()
    }

    fn kitchen() -> Vec<Triple> {
        let name = |text: &str| Literal::new_simple_literal(text);
        let on = |what, place| {
            [("predicate", name("on")), ("argument1", name(what)), ("argument2", name(place)), ("value", true.into())]
        };
        let weight = |what, kg: Literal| {
            [("predicate", name("weight")), ("argument1", name(what)), ("value", kg), ("writer", name("place[1]"))]
        };
        let facts = [
            on("cup", "table"),
            on("plate", "shelf"),
            weight("cup", 0.25.into()),
            weight("plate", Literal::new_typed_literal("2", xsd::INTEGER)),
        ];
        facts.iter().enumerate().flat_map(|(number, said)| fact(number, said)).collect()
    }

    fn asked(query: &str, limit: usize) -> Result<Answer, QueryError> {
        answer(query, &PREFIXES, kitchen(), limit)
    }

    fn rows(query: &str) -> Vec<String> {
        let Answer::Rows { rows, .. } = asked(query, 100).unwrap() else { return Vec::new() };
        let cell = |term: &Option<Term>| term.as_ref().map_or_else(String::new, shown);
        rows.iter().map(|row| row.iter().map(cell).collect::<Vec<_>>().join(" ")).collect()
    }

    #[test]
    fn facts_are_joined_filtered_and_ordered() {
        let joined = "SELECT ?what ?where ?kg WHERE {
            ?a world:predicate \"on\" ; world:argument1 ?what ; world:argument2 ?where .
            ?b world:predicate \"weight\" ; world:argument1 ?what ; world:value ?kg FILTER (?kg < 10) } ORDER BY ?what";
        assert_eq!(rows(joined), ["cup table 0.25", "plate shelf 2"]);
        assert_eq!(rows(&joined.replace("?kg < 10", "?kg < 1")), ["cup table 0.25"]);
        assert_eq!(rows("SELECT DISTINCT ?writer { ?f world:writer ?writer }"), ["place[1]"]);
        assert_eq!(rows("SELECT (COUNT(?f) AS ?n) { ?f world:predicate \"on\" }"), ["2"]);
        assert_eq!(asked("ASK { ?f world:value true }", 1).unwrap(), Answer::Truth(true));
    }

    #[test]
    fn rows_are_no_more_than_asked_for() {
        let found = asked("SELECT ?a ?b ?c ?d { ?a ?b ?c . ?d ?b ?c }", 3).unwrap();
        assert!(matches!(&found, Answer::Rows { rows, more: true, .. } if rows.len() == 3), "{found:?}");
    }

    #[test]
    fn what_is_hostile_is_refused_soon() {
        let deep = format!("SELECT * {{ ?s ?p ?o FILTER ({}1{}) }}", "(".repeat(5_000), ")".repeat(5_000));
        let long = format!("SELECT * {{ ?s ?p \"{}\" }}", "x".repeat(MAX_TEXT));
        for (query, why) in [
            (deep.as_str(), "nested deeper"),
            (&long, "longer than"),
            ("SELECT", "not SPARQL"),
            ("INSERT DATA { <a:b> <a:b> <a:b> }", "not SPARQL"),
            ("CONSTRUCT { ?s ?p ?o } WHERE { ?s ?p ?o }", "SELECT and ASK"),
        ] {
            let refused = asked(query, 10).unwrap_err().to_string();
            assert!(refused.contains(why), "{refused}");
        }
        let chain = format!("ASK {{ FILTER ({} true) }}", "false || ".repeat(1_500));
        assert_eq!(asked(&chain, 1).unwrap(), Answer::Truth(true));
        // A query whose evaluation would take far too long.
        let product: String = ('a'..='h').map(|v| format!("?{v}1 ?{v}2 ?{v}3 . ")).collect();
        let query = format!("SELECT (COUNT(*) AS ?n) {{ {product} }}");
        let refused = within(&query, &PREFIXES, kitchen(), 1, Duration::from_millis(50)).unwrap_err().to_string();
        assert!(refused.contains("takes longer"), "{refused}");
    }
}
