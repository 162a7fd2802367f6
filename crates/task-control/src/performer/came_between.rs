//! What others have changed since a run lost what it held: a motion that ended well meanwhile has its effects only where that is not what they are
//! made of, or overwrite. It is the test that a commit stands which was decided before the run was killed, by the same revisions.

use crate::record::Decided;
use anyhow::bail;
use ratn_executive::was_overtaken;
use ratn_model::fact::FactKey;
use ratn_model::id::{InstanceId, Revision};
use ratn_model::program::Program;
use std::collections::BTreeMap;
use std::sync::Arc;

/// Of a run that came back without what it held.
pub(super) struct CameBetween {
    program: Arc<Program>,
    /// What the run had heard of when it began what is still under way.
    began: BTreeMap<InstanceId, Revision>,
    /// The last revision of others in which each fact was changed.
    changed: BTreeMap<FactKey, Revision>,
}

impl CameBetween {
    /// These instances had begun, and others have changed these facts since.
    pub(super) fn new(
        program: Arc<Program>,
        began: BTreeMap<InstanceId, Revision>,
        changed: BTreeMap<FactKey, Revision>,
    ) -> CameBetween {
        CameBetween { program, began, changed }
    }

    /// Others have changed facts once more.
    pub(super) fn more<'a>(&mut self, revision: Revision, facts: impl IntoIterator<Item = &'a FactKey>) {
        self.changed.extend(facts.into_iter().map(|fact| (fact.clone(), revision)));
    }

    /// An instance holds again what it works with, or has come to its end.
    pub(super) fn forget(&mut self, instance: InstanceId) {
        self.began.remove(&instance);
    }

    /// Whether nothing is left of which it could say anything.
    pub(super) fn is_over(&self) -> bool {
        self.began.is_empty()
    }

    /// Refuses what others have overtaken.
    ///
    /// # Errors
    /// With what they have changed.
    pub(super) fn check(&self, decided: &Decided) -> anyhow::Result<()> {
        let Some(began) = self.began.get(&decided.instance) else { return Ok(()) };
        let after = self.changed.iter().filter(|(_, revision)| *revision > began);
        let is_meant = |key: &&FactKey| was_overtaken(&self.program, &decided.writer, &decided.changes, key);
        match after.map(|(key, _)| key).find(is_meant) {
            Some(key) => refuse(decided, key),
            None => Ok(()),
        }
    }
}

/// Others have changed what a commit overwrites or is made of.
pub(super) fn refuse(decided: &Decided, key: &FactKey) -> anyhow::Result<()> {
    bail!(
        "what {} has changed is not in the world yet, and others have changed {key}, which it changes or is made of, since the run lost its \
         resources: run the task again, or begin it in the middle (`--from`)",
        decided.writer
    );
}
