//! Reports about the root world: new revisions, differences between two, and the history of a fact.

use super::{Malformed, all, each, label, missing_choice, required};
use crate::types::{Contradiction, FactDifference, FactRecord, FactVersion, WorldChange, WorldUpdate};
use crate::v1;
use crate::v1::world_pool_service_watch_response::Kind;
use ratn_model::id::{ProjectionId, Revision};
use ratn_model::value::Value;
use std::sync::Arc;

impl From<WorldUpdate> for v1::WorldPoolServiceWatchResponse {
    fn from(update: WorldUpdate) -> v1::WorldPoolServiceWatchResponse {
        let kind = match update {
            WorldUpdate::Snapshot { revision, facts } => {
                Kind::Snapshot(v1::WorldSnapshot { revision: revision.0, facts: all(facts), more: false })
            }
            WorldUpdate::Changed(change) => Kind::Change(v1::WorldChange {
                revision: change.revision.0,
                commit_id: change.commit,
                written: all(change.written),
                gone: all(change.gone),
                writer: said(change.writer),
            }),
        };
        v1::WorldPoolServiceWatchResponse { kind: Some(kind) }
    }
}

impl TryFrom<v1::WorldPoolServiceWatchResponse> for WorldUpdate {
    type Error = Malformed;

    fn try_from(update: v1::WorldPoolServiceWatchResponse) -> Result<WorldUpdate, Malformed> {
        Ok(match update.kind.ok_or_else(|| missing_choice("snapshot, change"))? {
            Kind::Snapshot(snapshot) => WorldUpdate::Snapshot {
                revision: Revision(snapshot.revision),
                facts: each(snapshot.facts, "snapshot.facts")?,
            },
            Kind::Change(change) => {
                label(&change.commit_id, "change.commit_id")?;
                WorldUpdate::Changed(WorldChange {
                    revision: Revision(change.revision),
                    commit: change.commit_id,
                    written: each(change.written, "change.written")?,
                    gone: each(change.gone, "change.gone")?,
                    writer: named(&change.writer, "change.writer")?,
                })
            }
        })
    }
}

impl From<FactDifference> for v1::FactDifference {
    fn from(difference: FactDifference) -> v1::FactDifference {
        v1::FactDifference {
            key: Some(difference.key.into()),
            before: difference.before.map(v1::Fact::from),
            after: difference.after.map(v1::Fact::from),
        }
    }
}

impl TryFrom<v1::FactDifference> for FactDifference {
    type Error = Malformed;

    fn try_from(difference: v1::FactDifference) -> Result<FactDifference, Malformed> {
        Ok(FactDifference {
            key: required(difference.key, "key")?,
            before: maybe(difference.before, "before")?,
            after: maybe(difference.after, "after")?,
        })
    }
}

impl From<FactVersion> for v1::FactVersion {
    fn from(version: FactVersion) -> v1::FactVersion {
        v1::FactVersion {
            revision: version.revision.0,
            commit_id: version.commit,
            fact: version.fact.map(v1::Fact::from),
            writer: said(version.writer),
        }
    }
}

impl TryFrom<v1::FactVersion> for FactVersion {
    type Error = Malformed;

    fn try_from(version: v1::FactVersion) -> Result<FactVersion, Malformed> {
        label(&version.commit_id, "commit_id")?;
        Ok(FactVersion {
            revision: Revision(version.revision),
            commit: version.commit_id,
            fact: maybe(version.fact, "fact")?,
            writer: named(&version.writer, "writer")?,
        })
    }
}

impl From<Contradiction> for v1::Contradiction {
    fn from(contradiction: Contradiction) -> v1::Contradiction {
        v1::Contradiction {
            projection_id: contradiction.projection.0,
            fact: Some(contradiction.fact.into()),
            was: contradiction.was.map(v1::Value::from),
            is: contradiction.is.map(v1::Value::from),
            revision: contradiction.revision.0,
        }
    }
}

impl TryFrom<v1::Contradiction> for Contradiction {
    type Error = Malformed;

    fn try_from(contradiction: v1::Contradiction) -> Result<Contradiction, Malformed> {
        let value = |value: Option<v1::Value>, field: &str| {
            value.map(Value::try_from).transpose().map_err(|m: Malformed| m.within(field))
        };
        Ok(Contradiction {
            projection: ProjectionId(contradiction.projection_id),
            fact: required(contradiction.fact, "fact")?,
            was: value(contradiction.was, "was")?,
            is: value(contradiction.is, "is")?,
            revision: Revision(contradiction.revision),
        })
    }
}

/// The writer on the wire; empty for none.
fn said(writer: Option<Arc<str>>) -> String {
    writer.map_or_else(String::new, |writer| writer.to_string())
}

fn named(writer: &str, field: &str) -> Result<Option<Arc<str>>, Malformed> {
    label(writer, field)?;
    Ok(Some(writer).filter(|writer| !writer.is_empty()).map(Arc::from))
}

fn maybe(fact: Option<v1::Fact>, field: &str) -> Result<Option<FactRecord>, Malformed> {
    fact.map(FactRecord::try_from).transpose().map_err(|m| m.within(field))
}
