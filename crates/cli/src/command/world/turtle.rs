//! Facts in exact Turtle. Every fact is a separate node, so that arguments and values of any kind can be represented:
//!
//! ```turtle
//! @prefix world: <urn:ratn:world#> .
//! [] world:predicate "at" ; world:argument1 "box_1" ; world:value "{\"pose\":…}"^^rdf:JSON .
//! ```
//! Truth values, integers, floats and texts are XML Schema literals, null is `world:null`, and values without an RDF type are JSON as in
//! [`super::dump`]. `world:measured` describes the measurement of a fact in the same way.

use super::dump;
use anyhow::{Context, bail, ensure};
use oxrdf::vocab::xsd;
use oxrdf::{BlankNode, Literal, NamedNode, NamedNodeRef, NamedOrBlankNode, Term as RdfTerm, Triple};
use oxttl::{TurtleParser, TurtleSerializer};
use ratn_model::fact::{FactKey, Term};
use ratn_model::id::Revision;
use ratn_model::measurement::Measurement;
use ratn_model::value::Value;
use ratn_proto::types::FactRecord;
use std::collections::BTreeMap;
use std::sync::Arc;

/// The namespace of the properties.
pub(super) const WORLD: &str = "urn:ratn:world#";
pub(super) const RDF: &str = "http://www.w3.org/1999/02/22-rdf-syntax-ns#";
pub(super) const XSD: &str = "http://www.w3.org/2001/XMLSchema#";
const PREDICATE: &str = "predicate";
const VALUE: &str = "value";
const MEASURED: &str = "measured";
const NULL: &str = "null";
/// Followed by a number, from 1.
const ARGUMENT: &str = "argument";
const RDF_JSON: NamedNodeRef<'_> = NamedNodeRef::new_unchecked("http://www.w3.org/1999/02/22-rdf-syntax-ns#JSON");
/// Maximum number of arguments.
const MAX_ARGUMENTS: usize = 64;

/// All facts as one document.
pub(super) fn write(facts: &[FactRecord]) -> anyhow::Result<String> {
    let serializer = TurtleSerializer::new().with_prefix("world", WORLD)?;
    let serializer = serializer.with_prefix("rdf", RDF)?;
    let mut writer = serializer.with_prefix("xsd", XSD)?.for_writer(Vec::new());
    for (number, fact) in facts.iter().enumerate() {
        for triple in triples(number, fact)? {
            writer.serialize_triple(&triple)?;
        }
    }
    Ok(String::from_utf8(writer.finish()?)?)
}

/// The triples of a fact, the `number`th.
pub(super) fn triples(number: usize, fact: &FactRecord) -> anyhow::Result<Vec<Triple>> {
    let argument = |(position, argument): (usize, &Term)| {
        let literal = match argument {
            Term::Int(whole) => Literal::new_typed_literal(whole.to_string(), xsd::INTEGER),
            Term::Name(name) => Literal::new_simple_literal(name),
        };
        (format!("{ARGUMENT}{}", position + 1), literal.into())
    };
    let mut said: Vec<(String, RdfTerm)> =
        vec![(PREDICATE.to_owned(), Literal::new_simple_literal(&fact.key.predicate).into())];
    said.extend(fact.key.arguments.iter().enumerate().map(argument));
    said.push((VALUE.to_owned(), object(&fact.value)?));
    if let Some(measured) = &fact.measured {
        said.push((MEASURED.to_owned(), json(measured.as_ref())?));
    }
    of_fact(number, said)
}

/// Triples with the given properties and values about the `number`th fact.
pub(super) fn of_fact(number: usize, said: Vec<(String, RdfTerm)>) -> anyhow::Result<Vec<Triple>> {
    let subject = BlankNode::new(format!("fact{number}"))?;
    let triple = |(property, object): (String, RdfTerm)| {
        Ok(Triple::new(subject.clone(), NamedNode::new(format!("{WORLD}{property}"))?, object))
    };
    said.into_iter().map(triple).collect()
}

/// Reads what [`write()`] wrote. Revisions and writers are not included.
pub(super) fn read(text: &str) -> anyhow::Result<Vec<FactRecord>> {
    let mut subjects: BTreeMap<String, BTreeMap<String, RdfTerm>> = BTreeMap::new();
    for triple in TurtleParser::new().for_slice(text.as_bytes()) {
        let triple = triple.context("not Turtle")?;
        let subject = match &triple.subject {
            NamedOrBlankNode::NamedNode(name) => name.to_string(),
            NamedOrBlankNode::BlankNode(node) => node.to_string(),
        };
        let property = triple.predicate.as_str().strip_prefix(WORLD);
        let property = property.with_context(|| format!("{} is no property of a fact", triple.predicate))?;
        let twice = subjects.entry(subject).or_default().insert(property.to_owned(), triple.object);
        ensure!(twice.is_none(), "a fact has `{property}` twice");
    }
    let facts: Vec<FactRecord> = subjects.into_values().map(fact).collect::<anyhow::Result<_>>()?;
    dump::once(&facts)?;
    Ok(facts)
}

fn fact(mut properties: BTreeMap<String, RdfTerm>) -> anyhow::Result<FactRecord> {
    let predicate = properties.remove(PREDICATE).context("a fact has no `predicate`")?;
    let Value::String(predicate) = value(&predicate)? else { bail!("{predicate} is no predicate: expected a text") };
    let mut arguments = Vec::new();
    while let Some(argument) = properties.remove(&format!("{ARGUMENT}{}", arguments.len() + 1)) {
        ensure!(arguments.len() < MAX_ARGUMENTS, "{predicate} has more than {MAX_ARGUMENTS} arguments");
        arguments.push(match value(&argument)? {
            Value::Int(whole) => Term::Int(whole),
            Value::String(name) => Term::Name(name),
            other => bail!("{other} is no argument: expected a text or a whole number"),
        });
    }
    let key = FactKey { predicate, arguments };
    let said = properties.remove(VALUE).with_context(|| format!("{key} has no `value`"))?;
    let measured = properties.remove(MEASURED).map(|term| -> anyhow::Result<Arc<Measurement>> {
        let RdfTerm::Literal(literal) = &term else { bail!("{term} is no measurement") };
        Ok(Arc::new(serde_json::from_str(literal.value()).with_context(|| format!("{literal} is no measurement"))?))
    });
    let measured = measured.transpose()?;
    if let Some(unknown) = properties.keys().next() {
        bail!("{key} has `{unknown}`, which facts have not");
    }
    Ok(FactRecord { key, value: value(&said)?, revision: Revision(0), writer: None, measured })
}

fn object(value: &Value) -> anyhow::Result<RdfTerm> {
    Ok(match value {
        Value::Null => NamedNode::new(format!("{WORLD}{NULL}"))?.into(),
        Value::Bool(truth) => Literal::new_typed_literal(truth.to_string(), xsd::BOOLEAN).into(),
        Value::Int(whole) => Literal::new_typed_literal(whole.to_string(), xsd::INTEGER).into(),
        // The shortest text for this number, with an exponent, as doubles require.
        Value::Float(number) => Literal::new_typed_literal(format!("{number:E}"), xsd::DOUBLE).into(),
        Value::String(text) => Literal::new_simple_literal(text).into(),
        other => json(other)?,
    })
}

fn json(value: &impl serde::Serialize) -> anyhow::Result<RdfTerm> {
    Ok(Literal::new_typed_literal(serde_json::to_string(value)?, RDF_JSON).into())
}

fn value(term: &RdfTerm) -> anyhow::Result<Value> {
    let literal = match term {
        RdfTerm::Literal(literal) => literal,
        RdfTerm::NamedNode(name) if name.as_str().strip_prefix(WORLD) == Some(NULL) => return Ok(Value::Null),
        other => bail!("{other} is no value: expected a literal or world:null"),
    };
    let (text, wrong) = (literal.value(), || format!("{literal} is not what its type says"));
    let datatype = literal.datatype();
    Ok(if datatype == xsd::STRING {
        Value::String(text.to_owned())
    } else if datatype == xsd::INTEGER {
        Value::Int(text.parse().with_context(wrong)?)
    } else if datatype == xsd::DOUBLE || datatype == xsd::DECIMAL {
        let number: f64 = text.parse().with_context(wrong)?;
        ensure!(number.is_finite(), "{literal} is not finite");
        Value::Float(number)
    } else if datatype == xsd::BOOLEAN {
        Value::Bool(matches!(text, "true" | "1"))
    } else if datatype == RDF_JSON {
        serde_json::from_str(text).with_context(wrong)?
    } else {
        bail!("{literal}: values of this type are not known")
    })
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;

    #[test]
    fn what_people_write_is_read() {
        let text = "@prefix w: <urn:ratn:world#> .
            [] w:predicate \"at\" ; w:argument1 \"box\" ; w:argument2 2 ; w:value 1.5 .
            w:x w:predicate \"full\" ; w:value true .";
        let facts = read(text).unwrap();
        let mut shown: Vec<String> = facts.iter().map(|fact| format!("{} = {}", fact.key, fact.value)).collect();
        shown.sort();
        assert_eq!(shown, ["at(box, 2) = 1.5", "full() = true"]);
    }

    #[test]
    fn what_is_no_fact_is_refused_with_why() {
        for (body, why) in [
            ("[] w:value 1 .", "no `predicate`"),
            ("[] w:predicate \"at\" .", "at() has no `value`"),
            ("[] w:predicate \"at\" ; w:value 1, 2 .", "`value` twice"),
            ("[] w:predicate \"at\" ; w:value 1 ; w:argument2 2 .", "`argument2`, which"),
            ("[] w:predicate \"at\" ; w:value 1 ; <http://x.org/y> 2 .", "no property of a fact"),
            ("[] w:predicate \"at\" ; w:value []  .", "no value"),
            (
                "[] w:predicate \"at\" ; w:value \"{\"^^<http://www.w3.org/1999/02/22-rdf-syntax-ns#JSON> .",
                "its type says",
            ),
            ("[] w:predicate \"at\" ; w:value 99999999999999999999 .", "its type says"),
            ("[] w:predicate \"at\" ; w:value", "not Turtle"),
        ] {
            let refused = format!("{:#}", read(&format!("@prefix w: <urn:ratn:world#> .\n{body}")).unwrap_err());
            assert!(refused.contains(why), "{body}: {refused}");
        }
    }
}
