//! Facts, patterns, footprints, changes.

use super::{Malformed, all, each, finite, label, missing_choice, name, required};
use crate::types::FactRecord;
use crate::v1;
use ratn_model::fact::{Change, FactKey, FactPattern, Footprint, Term};
use ratn_model::id::Revision;
use ratn_model::measurement::{Certainty, Measurement};
use std::sync::Arc;

impl From<Term> for v1::Term {
    fn from(term: Term) -> v1::Term {
        let kind = match term {
            Term::Int(i) => v1::term::Kind::Integer(i),
            Term::Name(name) => v1::term::Kind::Name(name),
        };
        v1::Term { kind: Some(kind) }
    }
}

impl TryFrom<v1::Term> for Term {
    type Error = Malformed;

    fn try_from(term: v1::Term) -> Result<Term, Malformed> {
        match term.kind.ok_or_else(|| missing_choice("integer, name"))? {
            v1::term::Kind::Integer(i) => Ok(Term::Int(i)),
            v1::term::Kind::Name(individual) => {
                name(&individual, "name")?;
                Ok(Term::Name(individual))
            }
        }
    }
}

impl From<FactKey> for v1::FactKey {
    fn from(key: FactKey) -> v1::FactKey {
        v1::FactKey { predicate: key.predicate, arguments: all(key.arguments) }
    }
}

impl TryFrom<v1::FactKey> for FactKey {
    type Error = Malformed;

    fn try_from(key: v1::FactKey) -> Result<FactKey, Malformed> {
        name(&key.predicate, "predicate")?;
        Ok(FactKey { predicate: key.predicate, arguments: each(key.arguments, "arguments")? })
    }
}

impl From<FactRecord> for v1::Fact {
    fn from(record: FactRecord) -> v1::Fact {
        v1::Fact {
            key: Some(record.key.into()),
            value: Some(record.value.into()),
            revision: record.revision.0,
            writer: record.writer.map_or_else(String::new, |writer| writer.to_string()),
            measurement: record.measured.map(|measured| measured.as_ref().clone().into()),
        }
    }
}

impl TryFrom<v1::Fact> for FactRecord {
    type Error = Malformed;

    fn try_from(fact: v1::Fact) -> Result<FactRecord, Malformed> {
        label(&fact.writer, "writer")?;
        let measured = fact.measurement.map(Measurement::try_from).transpose();
        Ok(FactRecord {
            key: required(fact.key, "key")?,
            value: required(fact.value, "value")?,
            revision: Revision(fact.revision),
            writer: (!fact.writer.is_empty()).then(|| fact.writer.into()),
            measured: measured.map_err(|m| m.within("measurement"))?.map(Arc::new),
        })
    }
}

impl From<Measurement> for v1::Measurement {
    fn from(measurement: Measurement) -> v1::Measurement {
        let certainty = measurement.certainty.map(|certainty| match certainty {
            Certainty::Confidence(p) => v1::measurement::Certainty::Confidence(p),
            Certainty::Covariance(entries) => v1::measurement::Certainty::Covariance(v1::Covariance { entries }),
        });
        v1::Measurement { source: measurement.source, certainty }
    }
}

impl TryFrom<v1::Measurement> for Measurement {
    type Error = Malformed;

    fn try_from(measurement: v1::Measurement) -> Result<Measurement, Malformed> {
        label(&measurement.source, "source")?;
        let (field, certainty) = match measurement.certainty {
            Some(v1::measurement::Certainty::Confidence(p)) => ("confidence", Some(Certainty::Confidence(p))),
            Some(v1::measurement::Certainty::Covariance(v1::Covariance { entries })) => {
                ("covariance", Some(Certainty::Covariance(entries)))
            }
            None => ("", None),
        };
        if let Some(Err(wrong)) = certainty.as_ref().map(Certainty::check) {
            return Err(Malformed::new(field, wrong));
        }
        Ok(Measurement { source: measurement.source, certainty })
    }
}

impl From<(FactKey, Measurement)> for v1::Evidence {
    fn from((fact, measurement): (FactKey, Measurement)) -> v1::Evidence {
        v1::Evidence { fact: Some(fact.into()), measurement: Some(measurement.into()) }
    }
}

impl TryFrom<v1::Evidence> for (FactKey, Measurement) {
    type Error = Malformed;

    fn try_from(evidence: v1::Evidence) -> Result<(FactKey, Measurement), Malformed> {
        Ok((required(evidence.fact, "fact")?, required(evidence.measurement, "measurement")?))
    }
}

impl From<FactPattern> for v1::FactPattern {
    fn from(pattern: FactPattern) -> v1::FactPattern {
        let argument = |term: Option<Term>| v1::PatternTerm { term: term.map(v1::Term::from) };
        v1::FactPattern {
            predicate: pattern.predicate,
            arguments: pattern.arguments.into_iter().map(argument).collect(),
        }
    }
}

impl TryFrom<v1::FactPattern> for FactPattern {
    type Error = Malformed;

    fn try_from(pattern: v1::FactPattern) -> Result<FactPattern, Malformed> {
        name(&pattern.predicate, "predicate")?;
        let mut arguments = Vec::with_capacity(pattern.arguments.len());
        for (i, argument) in pattern.arguments.into_iter().enumerate() {
            let term = argument.term.map(Term::try_from).transpose();
            arguments.push(term.map_err(|m| m.within(format!("arguments[{i}].term")))?);
        }
        Ok(FactPattern { predicate: pattern.predicate, arguments })
    }
}

impl From<Footprint> for v1::Footprint {
    fn from(footprint: Footprint) -> v1::Footprint {
        let kind = match footprint {
            Footprint::Everything => v1::footprint::Kind::Everything(v1::Everything {}),
            Footprint::Patterns(patterns) => {
                v1::footprint::Kind::Patterns(v1::FactPatterns { patterns: all(patterns) })
            }
        };
        v1::Footprint { kind: Some(kind) }
    }
}

impl TryFrom<v1::Footprint> for Footprint {
    type Error = Malformed;

    fn try_from(footprint: v1::Footprint) -> Result<Footprint, Malformed> {
        match footprint.kind.ok_or_else(|| missing_choice("everything, patterns"))? {
            v1::footprint::Kind::Everything(v1::Everything {}) => Ok(Footprint::Everything),
            v1::footprint::Kind::Patterns(list) => Ok(Footprint::Patterns(each(list.patterns, "patterns")?)),
        }
    }
}

impl From<Change> for v1::Change {
    fn from(change: Change) -> v1::Change {
        let kind = match change {
            Change::Set { fact, value } => {
                v1::change::Kind::Set(v1::SetFact { fact: Some(fact.into()), value: Some(value.into()) })
            }
            Change::Delete { pattern } => v1::change::Kind::Delete(v1::DeleteFacts { pattern: Some(pattern.into()) }),
            Change::Increase { fact, by } => {
                v1::change::Kind::Increase(v1::IncreaseFact { fact: Some(fact.into()), by })
            }
        };
        v1::Change { kind: Some(kind) }
    }
}

impl TryFrom<v1::Change> for Change {
    type Error = Malformed;

    fn try_from(change: v1::Change) -> Result<Change, Malformed> {
        Ok(match change.kind.ok_or_else(|| missing_choice("set, delete, increase"))? {
            v1::change::Kind::Set(set) => {
                Change::Set { fact: required(set.fact, "set.fact")?, value: required(set.value, "set.value")? }
            }
            v1::change::Kind::Delete(delete) => Change::Delete { pattern: required(delete.pattern, "delete.pattern")? },
            v1::change::Kind::Increase(increase) => Change::Increase {
                fact: required(increase.fact, "increase.fact")?,
                by: finite(increase.by, "increase.by")?,
            },
        })
    }
}
