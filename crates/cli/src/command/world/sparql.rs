//! SPARQL over a snapshot of the root, for people: `ratn world query --sparql 'SELECT …'`.
//!
//! The facts are as in `dump --format turtle`: `?f world:predicate "at" ; world:argument1 ?box ; world:value ?pose`. In addition
//! each has its `world:revision` and, where known, its `world:writer`. The prefixes `world`, `xsd` and `rdf` are predefined.
//! `ratn_sparql` evaluates and bounds a query. Without the feature `sparql`, `ratn` refuses the query and does not contain this
//! module.

use super::show;
use super::turtle::{self, RDF, WORLD, XSD};
use anyhow::Context;
use oxrdf::vocab::xsd;
use oxrdf::{Literal, Term, Triple};
use ratn_model::id::Revision;
use ratn_proto::types::FactRecord;
use ratn_sparql::{Answer, shown};
use serde_json::json;

/// Answers a query over facts, with at most `limit` rows.
///
/// # Errors
/// An error in the query, or a query that takes too long.
pub(super) fn answer(text: &str, facts: &[FactRecord], limit: usize) -> anyhow::Result<Answer> {
    let mut triples = Vec::new();
    for (number, fact) in facts.iter().enumerate() {
        triples.extend(turtle::triples(number, fact).context("the facts")?);
        triples.extend(origin(number, fact).context("the facts")?);
    }
    let prefixes = [("world", WORLD), ("xsd", XSD), ("rdf", RDF)];
    Ok(ratn_sparql::answer(text, &prefixes, triples, limit)?)
}

/// The revision and the writer of a fact. A dump leaves them out, because they cannot be loaded.
fn origin(number: usize, fact: &FactRecord) -> anyhow::Result<Vec<Triple>> {
    let revision = Literal::new_typed_literal(fact.revision.0.to_string(), xsd::INTEGER);
    let mut said: Vec<(String, Term)> = vec![("revision".to_owned(), revision.into())];
    let writer = fact.writer.as_deref().map(Literal::new_simple_literal);
    said.extend(writer.map(|writer| ("writer".to_owned(), writer.into())));
    turtle::of_fact(number, said)
}

/// Text for people.
pub(super) fn table(answer: &Answer) -> String {
    match answer {
        Answer::Truth(truth) => if *truth { "yes" } else { "no" }.to_owned(),
        Answer::Rows { variables, rows, more } => {
            let cell = |term: &Option<Term>| term.as_ref().map_or_else(|| "-".to_owned(), shown);
            show::table(variables, rows.iter().map(|row| row.iter().map(cell).collect()).collect(), *more)
        }
    }
}

/// JSON for programs: each term as in SPARQL and Turtle.
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

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;
    use ratn_model::fact::{FactKey, Term as Argument};
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

    fn lines(query: &str, limit: usize) -> Vec<String> {
        table(&answer(query, &kitchen(), limit).unwrap()).lines().map(str::to_owned).collect()
    }

    #[test]
    fn facts_are_what_a_dump_says_with_their_origin() {
        let joined = "SELECT ?what ?where ?kg WHERE {
            ?a world:predicate \"on\" ; world:argument1 ?what ; world:argument2 ?where .
            ?b world:predicate \"weight\" ; world:argument1 ?what ; world:value ?kg } ORDER BY ?what";
        assert_eq!(lines(joined, 9), ["?what  ?where  ?kg", "cup    table   0.25", "plate  shelf   2"]);
        let written = "SELECT DISTINCT ?writer ?revision { ?f world:writer ?writer ; world:revision ?revision }";
        assert_eq!(lines(written, 9), ["?writer   ?revision", "place[1]  7"]);
        assert_eq!(lines("ASK { ?f world:value true }", 1), ["yes"]);
    }

    #[test]
    fn a_table_says_that_there_are_more_rows() {
        assert_eq!(lines("SELECT ?a ?b ?c ?d { ?a ?b ?c . ?d ?b ?c }", 3).len(), 5);
    }

    #[test]
    fn programs_get_terms_as_turtle_writes_them() {
        let found = answer(
            "SELECT ?kg { ?f world:argument1 \"cup\" ; world:predicate \"weight\" ; world:value ?kg }",
            &kitchen(),
            1,
        );
        let double = "\"0.25\"^^<http://www.w3.org/2001/XMLSchema#double>";
        assert_eq!(
            json(Revision(7), &found.unwrap()),
            json!({ "revision": 7, "variables": ["kg"], "rows": [[double]], "more": false })
        );
    }
}
