//! The static plan: what follows from the program alone, for each state, before anything runs. It is made once per run and used by both modes.
//!
//! | file | what it finds out |
//! |---|---|
//! | [`nature`] | whether a node computes, senses or is irreversible |
//! | [`resources`] | its requirements at the resource manager, and its resource operations at its end |
//! | [`outcomes`] | where its outcomes lead, which of them are computed ahead, what each of them changes |
//! | [`footprint`] | the facts that it reads, senses, looks up and may write |
//! | [`written`] | under which keys it writes |
//! | [`waits`] | the shared facts that others may change while a state waits |
//! | [`flows`] | the outputs and variables that its expressions use |
//! | [`improves`] | whether its result may be improved later, and which outputs must not change |
//!
//! Hierarchies and routines are resolved here: a routine is one node, so its plan covers everything inside of it. Predicates and kinds of task
//! resources are numbered ([`Predicate`]), so that tables of writers are indexed by small numbers.

mod flows;
mod footprint;
mod improves;
mod nature;
mod outcomes;
mod resources;
mod waits;
mod written;

pub(crate) use nature::NodeNature;
pub(crate) use outcomes::{ArmPlan, EVERYTHING, Effects, MAX_OUTCOMES, Outcome, Outcomes, SUCCEEDED, gives_outputs};
pub(crate) use waits::WAITS;
pub(crate) use written::{Chain, Written};

use ratn_model::expression::scope::NothingKnown;
use ratn_model::expression::{EffectExpr, FactExpr};
use ratn_model::fact::Footprint;
use ratn_model::id::StateId;
use ratn_model::program::{Exceptions, Program, ResourceExpr, State, StateKind, Target, WORLD_MODEL};
use ratn_model::resource::ResourceOperation;
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

/// The number of a predicate, or of the task resources of one kind: an index into tables of writers.
pub(crate) type Predicate = usize;

/// The plan of a program.
#[derive(Debug)]
pub(crate) struct Plan {
    states: Vec<StatePlan>,
    names: Names,
    /// The facts through which regions may affect each other: those that are `shared`, and all where a region may change any.
    pub(crate) crossing: Footprint,
    /// Number of predicates, including [`EVERYTHING`], [`WAITS`] and the kinds of task resources.
    pub(crate) width: usize,
    /// Number of buckets for the keys of facts: a power of two.
    buckets: usize,
}

/// The plan of one state.
#[derive(Debug)]
pub(crate) struct StatePlan {
    /// Its place in the order in which the states are written: 0 for the root. A state stands before what it contains.
    pub(crate) place: u64,
    /// Its effect on the environment, including everything inside of it.
    pub(crate) nature: NodeNature,
    /// An action or a routine: executed as one node.
    pub(crate) is_node: bool,
    /// A composite state that is one node.
    pub(crate) is_routine: bool,
    /// A region of a concurrency.
    pub(crate) is_region: bool,
    /// Imprecise exceptions: younger PIAs may run beside it.
    pub(crate) imprecise: bool,
    /// It waits, or something that it contains does.
    pub(crate) waits: bool,
    /// Of an action: the name of its provider and its own name.
    pub(crate) action: Option<(Arc<str>, Arc<str>)>,

    /// Outcomes: `success`, the state's own, `aborted`, `preempted`.
    pub(crate) outcomes: Vec<Arc<str>>,
    /// Where each outcome leads.
    pub(crate) targets: Vec<Target>,
    /// The continuations that are computed ahead: outcomes with one target. The first contains `success`.
    pub(crate) arms: Vec<ArmPlan>,
    /// What each outcome changes.
    pub(crate) effects: Vec<Effects>,
    /// The predicates that the effects of each outcome write.
    pub(crate) effect_predicates: Vec<Vec<Predicate>>,
    /// The keys written by each outcome's effects; nothing if they may write every fact.
    pub(crate) effects_written: Vec<Vec<Written>>,
    /// The outcomes with which the exit of this composite state has work to do: effects, outputs, assignments, resources.
    pub(crate) exits: Outcomes,
    /// States of its lists may be visited more than once in one activation.
    pub(crate) repeats: bool,

    /// What it acquires when it starts: consumes, exists, and blocks (its own, and those of its parts and of the hierarchies around it, merged
    /// by maximum).
    pub(crate) requirements: Vec<ResourceExpr>,
    /// The resources that an action uses, each selector once: a unit performs one goal at a time.
    pub(crate) works_with: Vec<ResourceExpr>,
    /// Its resource operations when it ends with success.
    pub(crate) operations: Vec<ResourceExpr>,
    /// Whether its acquire consumes something, which is not given back.
    pub(crate) uses_up: bool,
    /// Whether it works on a projection of the world model.
    pub(crate) needs_world: bool,
    /// The kinds of task resources on which it depends: those that it blocks, consumes, creates, deletes or requires to exist.
    pub(crate) kinds: Vec<Predicate>,
    /// The kinds of task resources that it creates, deletes or consumes; of a node, including its parts.
    pub(crate) operated: Vec<Predicate>,

    /// The facts that it reads, including those that its expressions look up, and those of its parts and of the hierarchies around it. `None`:
    /// it may read every fact.
    pub(crate) reads: Option<Vec<FactExpr>>,
    /// The facts that it senses, including its parts.
    pub(crate) senses: Vec<FactExpr>,
    /// Of a node: facts that its result states or depends on exactly. For these it is computed again even if a deviation from the prediction is
    /// within the tolerance.
    pub(crate) exact: Vec<FactExpr>,
    /// The facts that are looked up when it ends, whatever its outcome: by its effects, its resource operations and the ontology.
    pub(crate) looked_up_at_end: Vec<FactExpr>,
    /// The effects that it may have, including its parts, if it does not end by an unhandled failure. `None`: it may write every fact.
    pub(crate) may_write: Option<Vec<EffectExpr>>,
    /// Of a node that waits: the facts that regions beside it may change meanwhile.
    pub(crate) awaited: Effects,
    /// The predicates and kinds that it writes with an outcome that is computed ahead, and [`WAITS`]. If it may write every fact: [`EVERYTHING`]
    /// and the kinds.
    pub(crate) writes: Vec<Predicate>,
    /// The keys that it writes; nothing if it may write every fact.
    pub(crate) written: Vec<Written>,

    /// The states whose outputs it needs before it starts; of a routine, those outside of it.
    pub(crate) start_flows: Vec<StateId>,
    /// The states whose outputs any of its expressions reads; of a routine, those outside of it.
    pub(crate) flows: Vec<StateId>,
    /// The variables that any of its expressions reads; of a routine, with what it contains.
    pub(crate) variables: Vec<String>,
    /// The variables to which it assigns; of a routine, with what it contains.
    pub(crate) assigns: Vec<String>,
    /// Whether any state, or the task, reads its outputs.
    pub(crate) is_read: bool,
    /// The states inside of it whose outputs are read: these outputs are removed when it is entered.
    pub(crate) read_inside: Vec<StateId>,
    /// Of an anytime action whose result may be improved later: the outputs that must stay as in the first result.
    pub(crate) improves: Option<Box<[String]>>,
}

impl Plan {
    pub(crate) fn of(program: &Program) -> Plan {
        let mut names = Names::default();
        let transitions = outcomes::Transitions::of(program);
        let operated = resources::operated_anywhere(program);
        let read = flows::read_anywhere(program);
        let crossing = crossing(program);
        let of =
            |state| StatePlan::of(&Subject::of(program, state), &transitions, &operated, &read, &crossing, &mut names);
        let states: Vec<StatePlan> = program.states.iter().map(of).collect();
        let (width, buckets) = (names.numbers.len() + 2, Plan::buckets(program.horizon));
        let mut plan = Plan { states, crossing, width, buckets, names };
        let mut open = vec![Program::ROOT];
        for place in 0.. {
            let Some(id) = open.pop() else { break };
            plan.states[index(id)].place = place;
            let inside: Vec<StateId> = program.state(id).children().collect();
            open.extend(inside.into_iter().rev());
        }
        for (id, kept) in improves::of(program, &plan) {
            plan.states[index(id)].improves = Some(kept);
        }
        for id in &read {
            let around = std::iter::successors(program.state(*id).parent, |id| program.state(*id).parent);
            for parent in around.filter(|parent| !program.is_pass(*parent)) {
                plan.states[index(parent)].read_inside.push(*id);
            }
        }
        plan
    }

    pub(crate) fn state(&self, id: StateId) -> &StatePlan {
        &self.states[index(id)]
    }

    /// The number of a predicate; `None` if no effect of the program names it.
    pub(crate) fn predicate(&self, name: &str) -> Option<Predicate> {
        self.names.numbers.get(name).copied()
    }

    pub(crate) fn predicates(&self) -> impl Iterator<Item = Predicate> {
        0..self.width
    }

    /// Number of states.
    pub(crate) fn len(&self) -> usize {
        self.states.len()
    }
}

impl StatePlan {
    fn of(
        subject: &Subject<'_>,
        transitions: &outcomes::Transitions,
        operated: &BTreeSet<&str>,
        read: &BTreeSet<StateId>,
        crossing: &Footprint,
        names: &mut Names,
    ) -> StatePlan {
        let (program, state) = (subject.program, subject.state);
        let nature = nature::of(subject, crossing);
        let may_write = footprint::may_write(subject);
        let awaited = waits::awaited(subject);
        let ends = outcomes::of(subject, transitions, nature, &awaited, names);
        let waits = subject.is_node && subject.contained.iter().any(|state| state.is_pause());
        let is_watched = subject.is_node
            && subject.contained.iter().any(|state| state.is_pause() || !state.annotations.holds.is_empty());
        let may_differ = match (&may_write, &awaited) {
            (Some(own), Effects::Declared(others)) => Some([own.as_slice(), others].concat()),
            (None, _) | (_, Effects::Unknown) => None,
        };
        let mut writes = footprint::writes(subject, &ends, may_differ.as_deref(), names);
        let (written, effects_written) = footprint::written(subject, &ends, may_differ.as_deref(), names);
        let resources = resources::of(subject, operated, crossing, names);
        writes.extend(&resources.operated);
        writes.extend(waits.then_some(WAITS));
        // A `finally` begins when everything inside has ended, and the state is left after it.
        let around = state.parent.map(|parent| program.state(parent));
        let lastly = around.and_then(|around| around.annotations.finally.as_ref());
        let is_before_finally = lastly.is_some_and(|finally| finally.body == state.id);
        let exits = match subject.is_node {
            true => 0,
            false if is_before_finally || state.annotations.finally.is_some() => outcomes::every(&ends),
            false => outcomes::exits(state, &ends, &resources.operations),
        };
        let around = around.map(|around| &around.kind);
        let exceptions = state.annotations.exceptions.unwrap_or(program.exceptions);
        StatePlan {
            place: 0,
            nature,
            is_node: subject.is_node,
            is_routine: subject.is_routine(),
            is_region: matches!(around, Some(StateKind::Concurrency { .. })),
            imprecise: nature::of_parts(subject) == NodeNature::Irreversible
                && exceptions == Exceptions::Imprecise
                && !is_watched
                && !is_before_finally,
            waits,
            action: match &state.kind {
                StateKind::Action { provider, action, .. } => Some((Arc::from(&**provider), Arc::from(&**action))),
                _ => None,
            },
            outcomes: ends.names,
            targets: ends.targets,
            arms: ends.arms,
            effects_written,
            written,
            effects: ends.effects,
            effect_predicates: ends.predicates,
            exits,
            repeats: transitions.repeats(state.id),
            uses_up: resources.requirements.iter().any(|r| r.operation == ResourceOperation::Consume),
            needs_world: resources.requirements.iter().any(|r| r.kind == WORLD_MODEL),
            kinds: resources.kinds,
            operated: resources.operated,
            reads: footprint::reads(subject, &resources.requirements),
            senses: footprint::senses(subject),
            exact: footprint::exact(subject),
            looked_up_at_end: footprint::looked_up_at_end(subject, &resources.operations),
            may_write,
            awaited,
            writes: writes.into_iter().collect(),
            requirements: resources.requirements,
            works_with: resources.works_with,
            operations: resources.operations,
            start_flows: flows::start_flows(subject),
            flows: flows::flows(subject),
            variables: flows::variables(subject),
            assigns: flows::assigns(subject).into_iter().collect(),
            is_read: read.contains(&state.id),
            read_inside: Vec::new(),
            improves: None,
        }
    }

    /// Whether it depends on no fact: its annotations say so, and its expressions look up none.
    pub(crate) fn reads_nothing(&self) -> bool {
        self.reads.as_ref().is_some_and(Vec::is_empty)
    }

    /// The number of an outcome by its name.
    pub(crate) fn outcome(&self, name: &str) -> Option<Outcome> {
        self.outcomes.iter().position(|outcome| &**outcome == name)
    }
}

/// The state whose plan is made, with its place in the tree.
struct Subject<'a> {
    program: &'a Program,
    state: &'a State,
    is_node: bool,
    /// The state and everything inside of it, in program order.
    contained: Vec<&'a State>,
    /// The states around it, innermost first.
    around: Vec<&'a State>,
}

impl<'a> Subject<'a> {
    fn of(program: &'a Program, state: &'a State) -> Subject<'a> {
        let mut contained = vec![state];
        let mut next = 0;
        while next < contained.len() {
            contained.extend(contained[next].children().map(|child| program.state(child)));
            next += 1;
        }
        contained.sort_by_key(|state| state.id);
        let around = std::iter::successors(state.parent, |id| program.state(*id).parent);
        let is_node = is_action(state) || state.is_routine();
        Subject { program, state, is_node, contained, around: around.map(|id| program.state(id)).collect() }
    }

    fn is_routine(&self) -> bool {
        self.is_node && !is_action(self.state)
    }

    fn contains_others(&self) -> bool {
        self.contained.len() > 1
    }

    /// The states that execute together: of a node everything inside of it, of any other state itself alone.
    fn executed(&self) -> &[&'a State] {
        if self.is_node { &self.contained } else { std::slice::from_ref(&self.state) }
    }
}

/// Gives numbers to predicates and kinds in the order in which they are met. 0 is [`EVERYTHING`], 1 is [`WAITS`].
#[derive(Debug, Default)]
struct Names {
    numbers: BTreeMap<String, Predicate>,
}

impl Names {
    fn of_predicate(&mut self, name: &str) -> Predicate {
        if let Some(known) = self.numbers.get(name) {
            return *known;
        }
        let next = self.numbers.len() + 2;
        self.numbers.insert(name.to_owned(), next);
        next
    }

    /// The number of the task resources of a kind and of all related kinds, under a name that no predicate can have.
    fn of_kind(&mut self, program: &Program, kind: &str) -> Predicate {
        let family = program.family(kind);
        self.of_predicate(&format!("#{}", family.first().unwrap_or(&kind)))
    }
}

fn crossing(program: &Program) -> Footprint {
    let regions = program.states.iter().flat_map(|state| match &state.kind {
        StateKind::Concurrency { regions, .. } => regions.as_slice(),
        _ => &[],
    });
    let may_write = |region: &StateId| footprint::may_write(&Subject::of(program, program.state(*region)));
    if regions.into_iter().any(|region| may_write(region).is_none()) {
        return Footprint::Everything;
    }
    let shared = program.states.iter().flat_map(|state| &state.annotations.shared);
    FactExpr::footprint(&shared.cloned().collect::<Vec<_>>(), &NothingKnown)
}

fn index(id: StateId) -> usize {
    id.0 as usize
}

fn is_action(state: &State) -> bool {
    matches!(state.kind, StateKind::Action { .. })
}
