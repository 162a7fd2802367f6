//! A place in the program: what holds there, as far as the older instances have made it known.

use crate::analysis::{Analysis, StateAnalysis};
use crate::binding::{Bindings, Outputs};
use crate::effects;
use crate::window::instance::{Changed, Ended, Instances, PlaceNames, Role};
use ratn_model::expression::{EffectExpr, Scope};
use ratn_model::fact::{Change, FactPattern, Footprint};
use ratn_model::id::InstanceId;
use ratn_model::program::{Program, SUCCESS, StateKind};
use ratn_world::world::World;
use std::collections::BTreeSet;

/// What an instance sees of the older ones on its path.
#[derive(Clone)]
pub(crate) struct Place {
    /// The root with every known effect of the older instances.
    pub(crate) world: World,
    /// Those effects, in program order.
    pub(crate) changes: Vec<Change>,
    /// The facts of `world` that an older instance will write, it is not known how.
    pub(crate) unknown: Footprint,
    /// Everything that an older instance which has not retired writes.
    pub(crate) written: Footprint,
    /// The kinds of resources that an older instance which has not retired creates, deletes or consumes.
    pub(crate) operated: BTreeSet<String>,
    /// A condition on the path is undecided.
    pub(crate) speculative: bool,
    /// Every older instance has retired.
    pub(crate) oldest: bool,
}

impl Place {
    /// The place of the oldest instance: the root itself.
    pub(crate) fn root(world: &World) -> Place {
        Place {
            world: world.clone(),
            changes: Vec::new(),
            unknown: Footprint::NOTHING,
            written: Footprint::NOTHING,
            operated: BTreeSet::new(),
            speculative: false,
            oldest: true,
        }
    }

    /// Evaluates something of an instance here.
    pub(crate) fn with_scope<T>(
        &self,
        instances: &Instances,
        id: InstanceId,
        outputs: Option<&Outputs>,
        use_scope: impl FnOnce(&dyn Scope) -> T,
    ) -> Option<T> {
        let instance = instances.alive.get(&id)?;
        let names = PlaceNames { instances, environment: &instance.environment };
        Some(use_scope(&Bindings { names: &names, outputs, world: &self.world, unknown: &self.unknown }))
    }

    /// Moves on past an instance: its effects, known or not, hold from here.
    pub(crate) fn pass(&mut self, program: &Program, analysis: &Analysis, instances: &Instances, id: InstanceId) {
        let Some(instance) = instances.alive.get(&id) else { return };
        self.oldest = false;
        self.speculative |= instance.is_undecided();
        if !matches!(instance.role, Role::Node | Role::Exit) {
            return;
        }
        let state = program.state(instance.state);
        match instance.role {
            Role::Node => self.operated.extend(analysis.state(state.id).operated.iter().cloned()),
            _ => self.operated.extend(analysis.state(state.id).operations.iter().map(|r| r.kind.clone())),
        }
        let ended = instance.ended.as_ref();
        if let Some(Changed::Exactly(changes)) = ended.map(|e| &e.changes) {
            let footprint = Footprint::Patterns(changes.iter().map(Change::pattern).collect());
            self.written = std::mem::replace(&mut self.written, Footprint::NOTHING).union(footprint.clone());
            self.change(changes.clone(), footprint);
            return;
        }
        if instance.role == Role::Node && !matches!(state.kind, StateKind::Action { .. }) {
            // A routine's effects are unknown until it ends.
            let writes = self.with_scope(instances, id, None, |scope| may_write(analysis.state(state.id), scope));
            let writes = writes.unwrap_or(Footprint::Everything);
            self.written = std::mem::replace(&mut self.written, Footprint::NOTHING).union(writes.clone());
            self.forget(writes);
            return;
        }
        let outcome = ended.map_or(SUCCESS, |e| e.outcome.as_str());
        let declared = match instance.role {
            Role::Exit => state.annotations.effects.get(outcome).map_or(Some(&[][..]), |e| Some(e)),
            _ => effects::declared(state, instance.nature, outcome),
        };
        let Some(declared) = declared else {
            self.unknown = Footprint::Everything;
            self.written = Footprint::Everything;
            return;
        };
        let outputs = ended.map(|e| &e.outputs);
        // None of a node's effects sees another's: all are evaluated before any is applied.
        let bound = self.with_scope(instances, id, outputs, |scope| {
            let one = |effect| {
                let one = std::slice::from_ref(effect);
                (effects::actual(Some(one), outcome, &[], scope), EffectExpr::footprint(one, scope))
            };
            declared.iter().map(one).collect::<Vec<_>>()
        });
        for (changes, footprint) in bound.unwrap_or_default() {
            self.written = std::mem::replace(&mut self.written, Footprint::NOTHING).union(footprint.clone());
            match changes {
                Ok(mut changes) => {
                    put_measured(&mut changes, ended.map_or(&[], Ended::measured));
                    self.change(changes, footprint);
                }
                Err(_) => self.forget(footprint),
            }
        }
    }

    fn change(&mut self, changes: Vec<Change>, footprint: Footprint) {
        match self.world.apply(&changes) {
            Ok(_) => {
                for change in &changes {
                    self.learn(change);
                }
                self.changes.extend(changes);
            }
            // It will end `aborted` when it retires; until then nobody may build on it.
            Err(_) => self.forget(footprint),
        }
    }

    /// A value that is known now, whatever an older instance may have made of it.
    fn learn(&mut self, change: &Change) {
        // Growing an unknown number leaves it unknown.
        if matches!(change, Change::Increase { .. }) {
            return;
        }
        if let Footprint::Patterns(patterns) = &mut self.unknown {
            let known: FactPattern = change.pattern();
            patterns.retain(|pattern| !known.covers(pattern));
        }
    }

    fn forget(&mut self, footprint: Footprint) {
        self.unknown = std::mem::replace(&mut self.unknown, Footprint::NOTHING).union(footprint);
    }
}

/// What a node may write if it ends with success or with any outcome whose effects are declared.
pub(crate) fn may_write(analysis: &StateAnalysis, scope: &dyn Scope) -> Footprint {
    match &analysis.writes {
        Some(effects) => EffectExpr::footprint(effects, scope),
        None => Footprint::Everything,
    }
}

fn put_measured(changes: &mut [Change], measured: &[(ratn_model::fact::FactKey, ratn_model::value::Value)]) {
    for change in changes {
        if let Change::Set { fact, value } = change
            && let Some((_, actual)) = measured.iter().find(|(key, _)| key == fact)
        {
            *value = actual.clone();
        }
    }
}
