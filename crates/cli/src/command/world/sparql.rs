//! SPARQL over a snapshot of the root, for people: `ratn world query --sparql 'SELECT …'`.
//!
//! The facts are as `dump --format turtle` has them: `?f world:predicate "at" ; world:argument1 ?box ; world:value ?pose`. Here each
//! also says its `world:revision` and, where it has one, its `world:writer`. The prefixes `world`, `xsd` and `rdf` are known. Bounded: by
//! the length and the nesting of the text, by the time that an answer may take, and by the number of rows.

use super::show;
use super::turtle::{self, RDF, WORLD, XSD};
use anyhow::{Context, bail, ensure};
use oxrdf::vocab::xsd;
use oxrdf::{Dataset, GraphName, Term};
use ratn_model::id::Revision;
use ratn_proto::types::FactRecord;
use serde_json::json;
use spareval::{CancellationToken, QueryEvaluator, QueryResults};
use spargebra::SparqlParser;
use std::sync::mpsc;
use std::time::Duration;

/// A query is not longer.
const MAX_TEXT: usize = 16 * 1024;
/// Parentheses, braces and brackets stand in each other no deeper.
const MAX_NESTING: usize = 48;
/// An answer takes no longer.
const DEADLINE: Duration = Duration::from_secs(10);
/// Of the thread that answers.
const STACK: usize = 256 << 20;

/// What a query comes to.
#[derive(Debug, PartialEq)]
pub(super) enum Answer {
    /// Of a `SELECT`: the variables, what they are in each row, and whether there are more rows.
    Rows { variables: Vec<String>, rows: Vec<Vec<Option<Term>>>, more: bool },
    /// Of an `ASK`.
    Truth(bool),
}

/// Answers a query over facts, with at most `limit` rows.
///
/// # Errors
/// What is wrong with the query, or that it takes too long.
pub(super) fn answer(text: &str, facts: &[FactRecord], limit: usize) -> anyhow::Result<Answer> {
    within(text, facts, limit, DEADLINE)
}

fn within(text: &str, facts: &[FactRecord], limit: usize, deadline: Duration) -> anyhow::Result<Answer> {
    ensure!(text.len() <= MAX_TEXT, "the query is longer than {MAX_TEXT} bytes");
    ensure!(nesting(text) <= MAX_NESTING, "the query is nested deeper than {MAX_NESTING}");
    let (text, dataset, token) = (text.to_owned(), dataset(facts)?, CancellationToken::new());
    let (done, answered) = mpsc::channel();
    let cancelled = token.clone();
    // What is long is a deep tree.
    let thread = std::thread::Builder::new().stack_size(STACK);
    thread.spawn(move || {
        let _ = done.send(evaluate(&text, &dataset, limit, cancelled));
    })?;
    answered.recv_timeout(deadline).unwrap_or_else(|_| {
        token.cancel();
        bail!("the answer takes longer than {} s: ask for less", deadline.as_secs())
    })
}

fn evaluate(text: &str, dataset: &Dataset, limit: usize, token: CancellationToken) -> anyhow::Result<Answer> {
    let parser = SparqlParser::new().with_prefix("world", WORLD)?.with_prefix("xsd", XSD)?.with_prefix("rdf", RDF)?;
    let query = parser.parse_query(text).context("not SPARQL")?;
    let evaluator = QueryEvaluator::new().with_cancellation_token(token);
    let results = evaluator.prepare(&query).execute(dataset).context("the query cannot be answered")?;
    let solutions = match results {
        QueryResults::Solutions(solutions) => solutions,
        QueryResults::Boolean(truth) => return Ok(Answer::Truth(truth)),
        QueryResults::Graph(_) => bail!("SELECT and ASK are answered; for all facts there is `ratn world dump`"),
    };
    let variables = solutions.variables().to_vec();
    let mut rows: Vec<Vec<Option<Term>>> = Vec::new();
    for solution in solutions.take(limit.saturating_add(1)) {
        let solution = solution.context("the query cannot be answered")?;
        rows.push(variables.iter().map(|variable| solution.get(variable).cloned()).collect());
    }
    let more = rows.len() > limit;
    rows.truncate(limit);
    let variables = variables.iter().map(|variable| variable.as_str().to_owned()).collect();
    Ok(Answer::Rows { variables, rows, more })
}

/// How deep parentheses, braces and brackets stand in each other at the most; those in texts count, too.
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

fn dataset(facts: &[FactRecord]) -> anyhow::Result<Dataset> {
    let mut dataset = Dataset::new();
    for (number, fact) in facts.iter().enumerate() {
        for triple in turtle::triples(number, fact)?.into_iter().chain(turtle::origin(number, fact)?) {
            dataset.insert(&triple.in_graph(GraphName::DefaultGraph));
        }
    }
    Ok(dataset)
}

/// For people.
pub(super) fn table(answer: &Answer) -> String {
    match answer {
        Answer::Truth(truth) => if *truth { "yes" } else { "no" }.to_owned(),
        Answer::Rows { variables, rows, more } => {
            let cell = |term: &Option<Term>| term.as_ref().map_or_else(|| "-".to_owned(), shown);
            show::table(variables, rows.iter().map(|row| row.iter().map(cell).collect()).collect(), *more)
        }
    }
}

/// For programs: each term as SPARQL and Turtle write it.
pub(super) fn json(revision: Revision, answer: &Answer) -> serde_json::Value {
    match answer {
        Answer::Truth(truth) => json!({ "revision": revision.0, "truth": truth }),
        Answer::Rows { variables, rows, more } => {
            let cell = |term: &Option<Term>| term.as_ref().map(ToString::to_string);
            let rows: Vec<Vec<Option<String>>> = rows.iter().map(|row| row.iter().map(cell).collect()).collect();
            json!({ "revision": revision.0, "variables": variables, "rows": rows, "more": more })
        }
    }
}

/// A term as a table has it: texts and numbers as they are, what else there is as RDF has it.
fn shown(term: &Term) -> String {
    match term {
        Term::Literal(literal) if [xsd::STRING, xsd::INTEGER, xsd::BOOLEAN].contains(&literal.datatype()) => {
            literal.value().to_owned()
        }
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
    use ratn_model::fact::{FactKey, Term as Argument};
    use ratn_model::id::Revision;
    use ratn_model::value::Value;

    fn fact(predicate: &str, arguments: &[&str], value: Value) -> FactRecord {
        let arguments = arguments.iter().map(|name| Argument::Name((*name).to_owned())).collect();
        let key = FactKey { predicate: predicate.to_owned(), arguments };
        FactRecord { key, value, revision: Revision(7), writer: Some("place[1]".into()), measured: None }
    }

    fn kitchen() -> Vec<FactRecord> {
        vec![
            fact("on", &["cup", "table"], Value::Bool(true)),
            fact("on", &["plate", "shelf"], Value::Bool(true)),
            fact("weight", &["cup"], Value::Float(0.25)),
            fact("weight", &["plate"], Value::Int(2)),
        ]
    }

    fn rows(query: &str) -> Vec<String> {
        let Answer::Rows { rows, .. } = answer(query, &kitchen(), 100).unwrap() else { return Vec::new() };
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
        let written = "SELECT DISTINCT ?writer ?revision { ?f world:writer ?writer ; world:revision ?revision }";
        assert_eq!(rows(written), ["place[1] 7"]);
        let count = "SELECT (COUNT(?f) AS ?n) { ?f world:predicate \"on\" }";
        assert_eq!(rows(count), ["2"]);
        let truth = answer("ASK { ?f world:value true }", &kitchen(), 1).unwrap();
        assert_eq!(truth, Answer::Truth(true));
    }

    #[test]
    fn rows_are_no_more_than_asked_for() {
        let all = "SELECT ?a ?b ?c ?d { ?a ?b ?c . ?d ?b ?c }";
        let found = answer(all, &kitchen(), 3).unwrap();
        assert!(matches!(&found, Answer::Rows { rows, more: true, .. } if rows.len() == 3), "{found:?}");
        assert_eq!(table(&found).lines().count(), 5);
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
            let refused = format!("{:#}", answer(query, &kitchen(), 10).unwrap_err());
            assert!(refused.contains(why), "{refused}");
        }
        let chain = format!("ASK {{ FILTER ({} true) }}", "false || ".repeat(1_500));
        assert_eq!(answer(&chain, &kitchen(), 1).unwrap(), Answer::Truth(true));
        // Nobody waits for all of these.
        let product: String = ('a'..='h').map(|v| format!("?{v}1 ?{v}2 ?{v}3 . ")).collect();
        let query = format!("SELECT (COUNT(*) AS ?n) {{ {product} }}");
        let refused = within(&query, &kitchen(), 1, Duration::from_millis(50)).unwrap_err().to_string();
        assert!(refused.contains("takes longer"), "{refused}");
    }
}
