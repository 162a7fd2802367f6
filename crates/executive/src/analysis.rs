//! What follows from the program alone, per state, before anything runs: what kind of node it is, what it asks of the
//! resource manager, and which states its inputs flow from. Hierarchies and routines are resolved here.

use crate::effects;
use ratn_model::expression::{EffectExpr, Expr, FactExpr};
use ratn_model::id::StateId;
use ratn_model::program::{ABORTED, Nature, PREEMPTED, Program, ResourceExpr, State, StateKind, WORLD_MODEL};
use ratn_model::resource::{Quantity, ResourceOperation};
use std::collections::BTreeSet;

/// What a node does to the environment. A routine computes if all of it does, else it is irreversible.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum NodeNature {
    /// Works on a projection.
    Computes,
    /// Looks at the environment.
    Senses,
    /// A potentially irreversible action.
    Irreversible,
}

/// One state's analysis.
#[derive(Debug, Clone)]
pub(crate) struct StateAnalysis {
    /// What it is.
    pub(crate) nature: NodeNature,
    /// Blocks (its own and its hierarchies', merged by maximum), consumes and exists.
    pub(crate) requirements: Vec<ResourceExpr>,
    /// The kinds of resources that it, or what it contains, creates, deletes or consumes.
    pub(crate) operated: BTreeSet<String>,
    /// What it does to resources when it ends with success.
    pub(crate) operations: Vec<ResourceExpr>,
    /// The states whose outputs it needs before it starts; for a routine, those outside of it.
    pub(crate) flows: Vec<StateId>,
    /// What it senses, with that of what it contains.
    pub(crate) senses: Vec<FactExpr>,
    /// What it reads, with what its expressions look up, and with that of the hierarchies around it and of what it contains;
    /// `None` is everything.
    pub(crate) reads: Option<Vec<FactExpr>>,
    /// What it may write, with that of what it contains, unless it fails; `None` is everything.
    pub(crate) writes: Option<Vec<EffectExpr>>,
    /// Whether it works on a projection of the world model.
    pub(crate) needs_world: bool,
}

/// The analysis of a program, by state.
#[derive(Debug, Clone)]
pub(crate) struct Analysis {
    states: Vec<StateAnalysis>,
}

impl Analysis {
    /// Analyses every state of a loaded program.
    pub(crate) fn of(program: &Program) -> Analysis {
        Analysis { states: program.states.iter().map(|state| analyse(program, state)).collect() }
    }

    /// The analysis of one state.
    pub(crate) fn state(&self, id: StateId) -> &StateAnalysis {
        &self.states[id.0 as usize]
    }
}

/// The children of a composite, of both branches of a condition.
pub(crate) fn children(state: &State) -> Vec<StateId> {
    match &state.kind {
        StateKind::Action { .. } => Vec::new(),
        StateKind::Sequence { children, .. } => children.clone(),
        StateKind::ForEach { body, .. } | StateKind::While { body, .. } => body.clone(),
        StateKind::Concurrency { regions, .. } => regions.clone(),
        StateKind::Condition { then, otherwise, .. } => then.iter().chain(otherwise).copied().collect(),
    }
}

fn analyse(program: &Program, state: &State) -> StateAnalysis {
    let mut subtree = BTreeSet::from([state.id]);
    let mut open = vec![state.id];
    while let Some(id) = open.pop() {
        for child in children(program.state(id)) {
            subtree.insert(child);
            open.push(child);
        }
    }
    let contained: Vec<&State> = subtree.iter().map(|id| program.state(*id)).collect();
    let around = ancestors(program, state);
    let requirements = requirements(&contained, &around);
    let mut flows: BTreeSet<StateId> = contained.iter().flat_map(|s| start_flows(s)).collect();
    if contained.len() > 1 {
        // What its own effects are made of is needed to finish it, and it is one node.
        flows.extend(contained.iter().flat_map(|s| effect_flows(s)));
    }
    flows.retain(|id| !subtree.contains(id));
    StateAnalysis {
        nature: match contained.iter().map(|s| own_nature(s)).max() {
            // What it senses may depend on what it changed just before: it runs at its place in the program.
            Some(NodeNature::Senses) if contained.len() > 1 => NodeNature::Irreversible,
            nature => nature.unwrap_or(NodeNature::Computes),
        },
        needs_world: requirements.iter().any(|r| r.kind == WORLD_MODEL),
        operated: contained.iter().flat_map(|s| operated(s)).cloned().collect(),
        operations: operations(state),
        writes: contained
            .iter()
            .map(|s| own_writes(program, state, s))
            .collect::<Option<Vec<_>>>()
            .map(|all| all.concat()),
        reads: reads(&contained, &around, &requirements),
        senses: contained
            .iter()
            .flat_map(|s| match &s.annotations.nature {
                Nature::Senses(facts) => facts.clone(),
                _ => Vec::new(),
            })
            .collect(),
        requirements,
        flows: flows.into_iter().collect(),
    }
}

fn ancestors<'a>(program: &'a Program, state: &State) -> Vec<&'a State> {
    std::iter::successors(state.parent, |id| program.state(*id).parent).map(|id| program.state(id)).collect()
}

/// The kinds of resources that a state changes, rather than holds.
fn operated(state: &State) -> impl Iterator<Item = &String> {
    let changes = |r: &&ResourceExpr| !matches!(r.operation, ResourceOperation::Block | ResourceOperation::Exists);
    state.annotations.resources.iter().filter(changes).map(|r| &r.kind)
}

fn own_nature(state: &State) -> NodeNature {
    if operated(state).next().is_some() {
        return NodeNature::Irreversible;
    }
    match (&state.kind, &state.annotations.nature) {
        (StateKind::Action { .. }, Nature::Irreversible) => NodeNature::Irreversible,
        (StateKind::Action { .. }, Nature::Senses(_)) => NodeNature::Senses,
        _ => NodeNature::Computes,
    }
}

/// The effects of every outcome with which a node may end inside of `whole` and `whole` go on or end well: `None` where one of
/// them may change everything.
fn own_writes(program: &Program, whole: &State, state: &State) -> Option<Vec<EffectExpr>> {
    if !is_action(state) {
        return Some(state.annotations.effects.values().flatten().cloned().collect());
    }
    let mut all = Vec::new();
    for outcome in program.outcomes(state.id) {
        match effects::declared(state, own_nature(state), outcome) {
            Some(declared) => all.extend(declared.iter().cloned()),
            None if matches!(outcome, ABORTED | PREEMPTED) && ends(program, whole, state, outcome) => {}
            None => return None,
        }
    }
    Some(all)
}

/// Whether `whole` ends by this outcome when a state inside of it does: nothing on the way is connected to something else.
fn ends(program: &Program, whole: &State, state: &State, outcome: &str) -> bool {
    let around = std::iter::successors(Some(state), |inner| {
        inner.parent.filter(|_| inner.id != whole.id).map(|parent| program.state(parent))
    });
    around
        .into_iter()
        .all(|state| !matches!(state.kind, StateKind::Concurrency { .. }) && !state.transitions.contains_key(outcome))
}

/// Blocks of one state add up, those of states inside of each other merge by maximum; what an action consumes and what exists
/// add up as they are, but only from within.
fn requirements(contained: &[&State], around: &[&State]) -> Vec<ResourceExpr> {
    let mut merged: Vec<ResourceExpr> = Vec::new();
    for (state, within) in contained.iter().map(|s| (s, true)).chain(around.iter().map(|s| (s, false))) {
        let mut blocked: Vec<ResourceExpr> = Vec::new();
        for wanted in &state.annotations.resources {
            match wanted.operation {
                ResourceOperation::Block => merge(&mut blocked, wanted, |have, more| have + more),
                ResourceOperation::Exists if within => merged.push(wanted.clone()),
                ResourceOperation::Consume if is_action(state) => merged.push(wanted.clone()),
                _ => {}
            }
        }
        blocked.iter().for_each(|wanted| merge(&mut merged, wanted, Quantity::max));
    }
    merged
}

fn merge(into: &mut Vec<ResourceExpr>, wanted: &ResourceExpr, counts: impl FnOnce(Quantity, Quantity) -> Quantity) {
    let same = |have: &&mut ResourceExpr| have.operation == wanted.operation && have.selects_the_same(wanted);
    match into.iter_mut().find(same) {
        Some(have) => have.count = counts(have.count, wanted.count),
        None => into.push(wanted.clone()),
    }
}

fn is_action(state: &State) -> bool {
    matches!(state.kind, StateKind::Action { .. })
}

/// What contains others consumes at its exit too; an action did so when it acquired.
fn operations(state: &State) -> Vec<ResourceExpr> {
    let at_end = |r: &&ResourceExpr| match r.operation {
        ResourceOperation::Create | ResourceOperation::Delete => true,
        ResourceOperation::Consume => !is_action(state),
        ResourceOperation::Block | ResourceOperation::Exists => false,
    };
    state.annotations.resources.iter().filter(at_end).cloned().collect()
}

fn reads(contained: &[&State], around: &[&State], requirements: &[ResourceExpr]) -> Option<Vec<FactExpr>> {
    let mut all = Vec::new();
    for state in contained {
        match (&state.kind, &state.annotations.reads) {
            (_, Some(reads)) => all.extend(reads.iter().cloned()),
            // A sensing node reads what it senses; anything else without the annotation reads everything.
            (StateKind::Action { .. }, None) if !matches!(state.annotations.nature, Nature::Senses(_)) => return None,
            _ => {}
        }
        let expressions: Vec<&Expr> = match &state.kind {
            StateKind::Action { inputs, .. } => inputs.iter().map(|(_, e)| e).collect(),
            StateKind::Condition { predicate, .. } | StateKind::While { predicate, .. } => vec![predicate],
            StateKind::ForEach { collection, .. } => vec![collection],
            StateKind::Sequence { outputs, .. } => outputs.iter().map(|o| &o.value).collect(),
            StateKind::Concurrency { decide, outputs, .. } => {
                decide.iter().map(|(_, e)| e).chain(outputs.iter().map(|o| &o.value)).collect()
            }
        };
        let boundary = state.variables.iter().chain(&state.assign).map(|(_, e)| e);
        all.extend(expressions.into_iter().chain(boundary).flat_map(Expr::fact_expressions).cloned());
        all.extend(state.annotations.requires.iter().flat_map(Expr::fact_expressions).cloned());
        if contained.len() > 1 {
            // It is one node: what happens at the ends of its parts happens within it.
            let effects = state.annotations.effects.values();
            all.extend(effects.flat_map(|effects| EffectExpr::fact_expressions(effects)).cloned());
            let selectors = state.annotations.resources.iter().flat_map(|r| r.expressions());
            all.extend(selectors.flat_map(Expr::fact_expressions).cloned());
        }
    }
    for state in around {
        all.extend(state.annotations.reads.iter().flatten().cloned());
    }
    let selectors = requirements.iter().flat_map(|r| r.expressions());
    all.extend(selectors.flat_map(Expr::fact_expressions).cloned());
    Some(all)
}

/// The states whose outputs a state needs to start.
fn start_flows(state: &State) -> Vec<StateId> {
    let mut flows = Vec::new();
    match &state.kind {
        StateKind::Action { inputs, .. } => inputs.iter().for_each(|(_, e)| flows.extend(e.flows())),
        StateKind::Sequence { outputs, .. } => outputs.iter().for_each(|o| flows.extend(o.value.flows())),
        StateKind::ForEach { collection, .. } => flows.extend(collection.flows()),
        StateKind::Condition { predicate, .. } | StateKind::While { predicate, .. } => flows.extend(predicate.flows()),
        StateKind::Concurrency { decide, outputs, .. } => {
            decide.iter().for_each(|(_, e)| flows.extend(e.flows()));
            outputs.iter().for_each(|o| flows.extend(o.value.flows()));
        }
    }
    let boundary = state.variables.iter().chain(&state.assign);
    boundary.for_each(|(_, e)| flows.extend(e.flows()));
    state.annotations.requires.iter().for_each(|e| flows.extend(e.flows()));
    for resource in &state.annotations.resources {
        if !matches!(resource.operation, ResourceOperation::Create | ResourceOperation::Delete) {
            resource.expressions().for_each(|e| flows.extend(e.flows()));
        }
    }
    flows
}

/// The states whose outputs a state's effects and resource operations are made of.
pub(crate) fn effect_flows(state: &State) -> Vec<StateId> {
    let mut flows: Vec<StateId> = state.annotations.effects.values().flat_map(|e| EffectExpr::flows(e)).collect();
    for resource in &state.annotations.resources {
        resource.expressions().for_each(|e| flows.extend(e.flows()));
    }
    flows
}
