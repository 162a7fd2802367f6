//! Invalidation: a result that was made of a prediction which did not come true is computed again.
//!
//! When an instance becomes real, those that used its outputs or effects are compared with what there is now; what differs by
//! more than the tolerance of its predicate begins again, and so does what was made of it. PIAs are never among them: they begin when
//! everything older is real.

use super::Window;
use super::instance::{Role, Status};
use super::ready::missing;
use crate::context::Context;
use crate::protocol::Note;
use ratn_model::fact::FactKey;
use ratn_model::id::InstanceId;
use ratn_model::tolerance::Tolerance;
use ratn_model::value::Value;

impl Window {
    /// Compares what an instance was made of with what there is now.
    pub(super) fn revalidate(&mut self, context: &mut Context<'_>, id: InstanceId) {
        let Some(instance) = self.instances.get(id) else { return };
        let has_begun = instance.ended.is_some() || instance.is_under_way();
        let is_final = instance.is_pia() || instance.settled.get() || instance.detached;
        if !has_begun || is_final || !matches!(instance.role, Role::Node | Role::Entry | Role::Exit) {
            return;
        }
        let sight = self.sight(context);
        let plan = self.plan.state(instance.state);
        if missing(sight, instance, &plan.flows, &plan.variables).is_some() {
            return self.invalidate(context, id, "an input is computed again".to_owned());
        }
        let Some(seen) = instance.seen.as_deref() else { return };
        let view = sight.view(instance, None);
        let mut now: Vec<(FactKey, Value)> = Vec::with_capacity(seen.facts.len());
        for read in &seen.read {
            match view.facts(read) {
                Ok(facts) => now.extend(facts),
                Err(_) => {
                    drop(view);
                    return self.invalidate(context, id, "what it read is computed again".to_owned());
                }
            }
        }
        drop(view);
        if let Some(difference) =
            difference(&seen.facts, &now, |key| context.program.tolerances.of(&key.predicate, self.tolerance))
        {
            self.invalidate(context, id, difference);
        }
    }

    fn invalidate(&mut self, context: &mut Context<'_>, id: InstanceId, reason: String) {
        self.remember(context, id);
        self.stop_instance(context, id);
        let Some(instance) = self.instances.get_mut(id) else { return };
        instance.status = Status::Expanded;
        instance.attempt += 1;
        instance.ended = None;
        instance.seen = None;
        let mut users = std::mem::take(&mut instance.users);
        users.sort_unstable();
        users.dedup();
        if instance.role == Role::Node {
            context.note(Note::Invalidated { instance: id, reason });
        }
        self.wake_waiters(id);
        self.enqueue(id);
        for user in users {
            self.revalidate(context, user);
        }
    }
}

/// The first fact that differs, as a sentence.
fn difference(
    saw: &[(FactKey, Value)],
    is: &[(FactKey, Value)],
    tolerance: impl Fn(&FactKey) -> Tolerance,
) -> Option<String> {
    let said = |value: Option<&Value>| value.map_or("nothing".to_owned(), ToString::to_string);
    let of = |facts: &[(FactKey, Value)], key: &FactKey| facts.iter().find(|(k, _)| k == key).map(|(_, v)| v.clone());
    if saw.len() == is.len()
        && saw.iter().zip(is).all(|((a, x), (b, y))| a == b && (x == y || tolerance(a).equal(x, y)))
    {
        return None;
    }
    saw.iter().chain(is).map(|(key, _)| key).find_map(|key| {
        let (before, now) = (of(saw, key), of(is, key));
        let same = match (&before, &now) {
            (Some(before), Some(now)) => tolerance(key).equal(before, now),
            (before, now) => before == now,
        };
        (!same).then(|| {
            format!("{key} was {}, as predicted, and came out as {}", said(before.as_ref()), said(now.as_ref()))
        })
    })
}
