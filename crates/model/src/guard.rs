//! `retry`, `while`, `timeout`, `finally` and collected outputs of loops, expressed by the transitions, scoped variables and conditions that every program has.
//! So both modes and routines execute them without further support.
//!
//! ```text
//! grasp: retry {times: 2, on: [aborted], before: [open]}       finally: [tuck]
//!
//! grasp ┬ try ──── success ──► success                         grasp ┬ body ──── success ──► finally
//!       ├ again    (from aborted) tries < 2, else aborted            ├ finally ─ success ──► success
//!       ├ pause    where there is one                                ├ finally_aborted ────► aborted
//!       └ before ─ success ──► try                                   └ …          one for each outcome of the body
//!
//! carry: while [lit(lamp)], timeout 20
//!
//! carry ┬ while    ─ violated ► violated        all at the same time: the first that ends stops the others
//!       ├ timeout  ─ aborted ─► aborted
//!       └ body     ─────────────► as it ends
//!
//! for: outputs {all: {each: look.boxes}}
//!
//! loop ── pass     the body; at its end `look.boxes` is appended to the list that becomes the output `all`
//! ```
//!
//! Each try is watched anew; a `finally` is not watched.
//!
//! The state in the file becomes `try` or `body`; with both, `body` contains `try`. From outside, only the state with its name is visible, with the same ports.
//! The variables that are introduced here have names that cannot be written in a task file.
//!
//! If a state is cut short from outside (a lost race, a timeout around it, the end of the run), the executive continues with `finally_preempted`.

use crate::expression::{BinaryOperator, Expr};
use crate::id::StateId;
use crate::list::List;
use crate::program::{
    ABORTED, Again, Annotations, CLOCK, Finally, Nature, PREEMPTED, Program, SUCCESS, State, StateKind, Target,
    TaskOutput, VIOLATED,
};
use crate::value::{Type, Value};
use crate::wait::{LIMIT, PAUSE, WATCH};
use std::collections::BTreeMap;

/// Limit of the number of states.
const MAX_STATES: usize = 20_000;

/// `retry`, `while`, `timeout`, `finally` and `each` of a state.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Guard {
    /// `retry`, if it is not left to the executive.
    pub retried: Option<Retried>,
    /// `while` and `timeout`, unless the executive handles them.
    pub limits: Option<Limits>,
    /// `finally`: states whose parent is the guarded state, but which are in none of its lists.
    pub finally: Vec<StateId>,
    /// For a loop: the outputs that collect a value of each iteration.
    pub collected: Vec<Collected>,
}

/// An output of a loop that is a list: one value of each iteration that ended well.
#[derive(Debug, Clone, PartialEq)]
pub struct Collected {
    /// The output's name. Its value is this list, whatever its expression says.
    pub name: String,
    /// Evaluated at the end of each iteration, in the scope of the body.
    pub value: Expr,
}

/// `while` and `timeout` of a state, which becomes a preemptive concurrency and so one node of the program.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Limits {
    /// Booleans that must hold in the actual world while the state runs; else it ends [`VIOLATED`].
    pub holds: Vec<Expr>,
    /// Timeout in the robot's seconds; the state then ends `aborted`.
    pub timeout_s: Option<f64>,
}

/// Whether a variable was introduced by the loader; a file cannot name it.
pub fn is_made(variable: &str) -> bool {
    variable.contains(' ')
}

/// `retry` of a state.
#[derive(Debug, Clone, PartialEq)]
pub struct Retried {
    /// Number of tries after the first.
    pub count: u32,
    /// The pause before the second try, doubled before each further one.
    pub backoff_s: f64,
    /// The outcomes after which the state is tried again.
    pub on: Vec<String>,
    /// Executed before each further try; states as in [`Guard::finally`].
    pub before: Vec<StateId>,
}

/// The ids of every state of the file after [`unfold`], the outermost first; the last one is the state as written. The states of a `finally` are copied once
/// per outcome.
pub type Places = BTreeMap<StateId, Vec<StateId>>;

/// Error: there would be more than 20,000 states.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct TooManyStates;

/// Expands the guards into states of the program. States get new ids.
///
/// # Errors
/// There would be too many states: a `finally` is copied once per outcome.
pub fn unfold(program: &mut Program, guards: &BTreeMap<StateId, Guard>) -> Result<Vec<Places>, TooManyStates> {
    let outcomes = program.all_outcomes();
    let scopes = vec![Scope { around: None, places: Places::new() }];
    let (new, of_scope, links, outputs, again, lastly) = Default::default();
    let old = &program.states;
    let mut unfolding = Unfolding { old, guards, outcomes, new, of_scope, scopes, links, outputs, again, lastly };
    unfolding.guarded(Program::ROOT, None, None, 0)?;
    let resolved: Vec<State> = unfolding.resolved();
    let Unfolding { scopes, .. } = &unfolding;
    for output in &mut program.outputs {
        output.value.rewrite(&mut |part| unfolding.port(StateId(0), part));
    }
    let places = scopes.iter().map(|scope| scope.places.clone()).collect();
    program.states = resolved;
    Ok(places)
}

/// The copies of the states of one `finally`, for one outcome.
struct Scope {
    around: Option<usize>,
    places: Places,
}

struct Unfolding<'a> {
    old: &'a [State],
    guards: &'a BTreeMap<StateId, Guard>,
    outcomes: Vec<Vec<String>>,
    /// New states: their lists have new ids, their transitions and expressions still have old ones.
    new: Vec<State>,
    /// Scopes by new id.
    of_scope: Vec<usize>,
    scopes: Vec<Scope>,
    /// Transitions between new ids.
    links: Vec<(StateId, String, Target)>,
    /// Guard states that take over the output ports of an inner state.
    outputs: Vec<(StateId, StateId)>,
    /// `again` annotations, with new ids.
    again: Vec<(StateId, Again)>,
    lastly: Vec<(StateId, Finally)>,
}

impl Unfolding<'_> {
    fn old(&self, id: StateId) -> &State {
        &self.old[id.0 as usize]
    }

    /// Copies a state with its guard; `name` replaces its own name.
    fn guarded(
        &mut self,
        id: StateId,
        parent: Option<StateId>,
        name: Option<&str>,
        scope: usize,
    ) -> Result<StateId, TooManyStates> {
        let name = name.map_or_else(|| self.old(id).name.clone(), str::to_owned);
        let Some(guard) = self.guards.get(&id) else { return self.written(id, parent, name, scope, true) };
        let (retried, finally) = (guard.retried.as_ref(), !guard.finally.is_empty());
        match (finally, retried) {
            (true, _) => self.with_finally(id, parent, name, scope, guard),
            (false, Some(retried)) => self.with_retry(id, parent, name, scope, retried, true),
            (false, None) => self.watched(id, parent, name, scope, true),
        }
    }

    /// Copies a state with its `while` and `timeout`.
    fn watched(
        &mut self,
        id: StateId,
        parent: Option<StateId>,
        name: String,
        scope: usize,
        is_outermost: bool,
    ) -> Result<StateId, TooManyStates> {
        let guards = self.guards;
        let Some(limits) = guards.get(&id).and_then(|guard| guard.limits.as_ref()) else {
            return self.written(id, parent, name, scope, is_outermost);
        };
        let around = self.around(id, parent, name, scope, is_outermost)?;
        // The watch is first: it must find a false condition before anything begins.
        let mut regions = Vec::new();
        if !limits.holds.is_empty() {
            let conditions = limits.holds.iter().map(|condition| ("for".to_owned(), condition.clone()));
            regions.push(self.wait(id, around, ("while", WATCH, VIOLATED), conditions.collect(), scope)?);
        }
        if let Some(seconds) = limits.timeout_s {
            let limit = vec![("seconds".to_owned(), Expr::Literal(Value::Float(seconds)))];
            regions.push(self.wait(id, around, ("timeout", LIMIT, ABORTED), limit, scope)?);
        }
        let body = self.written(id, Some(around), "body".to_owned(), scope, false)?;
        regions.push(body);
        self.outputs.push((around, body));
        self.at(body).outcomes.retain(|outcome| outcome != VIOLATED);
        // These outcomes end the concurrency; the body is cut short.
        let ends = [(PREEMPTED, true), (VIOLATED, !limits.holds.is_empty()), (ABORTED, limits.timeout_s.is_some())];
        for (outcome, _) in ends.into_iter().filter(|(_, ends)| *ends) {
            if let Some(effects) = self.at(body).annotations.effects.remove(outcome) {
                self.at(around).annotations.effects.insert(outcome.to_owned(), effects);
            }
        }
        self.at(around).annotations.duration_s = self.at(body).annotations.duration_s.clone();
        let (preemptive, decide, outputs) = (true, Vec::new(), Vec::new());
        self.at(around).kind = StateKind::Concurrency { regions, preemptive, successes: None, decide, outputs };
        Ok(around)
    }

    /// Adds a state in which the executive waits; it changes nothing and ends by this outcome.
    fn wait(
        &mut self,
        id: StateId,
        parent: StateId,
        (name, action, outcome): (&str, &str, &str),
        inputs: Vec<(String, Expr)>,
        scope: usize,
    ) -> Result<StateId, TooManyStates> {
        let (provider, action) = (CLOCK.to_owned(), action.to_owned());
        let kind = StateKind::Action { provider, action, inputs, outputs: BTreeMap::new() };
        let wait = self.made(id, parent, name, kind, scope)?;
        let nothing = |outcome: &str| (outcome.to_owned(), Vec::new());
        self.at(wait).annotations.effects = [SUCCESS, ABORTED, PREEMPTED, outcome].map(nothing).into();
        self.at(wait).outcomes = own([outcome]);
        Ok(wait)
    }

    /// Copies the state as written.
    fn written(
        &mut self,
        id: StateId,
        parent: Option<StateId>,
        name: String,
        scope: usize,
        is_outermost: bool,
    ) -> Result<StateId, TooManyStates> {
        let mut state = self.old(id).clone();
        state.name = name;
        if !is_outermost {
            state.transitions = BTreeMap::new();
            state.annotations.shared = Vec::new();
        }
        let kind = state.kind.clone();
        let new = self.push(state, parent, scope)?;
        self.place(id, new, scope);
        let mut listed = |list: &[StateId]| -> Result<Vec<StateId>, TooManyStates> {
            list.iter().map(|child| self.guarded(*child, Some(new), None, scope)).collect()
        };
        let kind = match kind {
            StateKind::Action { .. } => kind,
            StateKind::Sequence { children, outputs } => StateKind::Sequence { children: listed(&children)?, outputs },
            StateKind::ForEach { variable, index, collection, body, outputs } => {
                let body = self.passes(id, new, &body, scope)?;
                StateKind::ForEach { variable, index, collection, body, outputs }
            }
            StateKind::While { predicate, body_first, index, body, outputs } => {
                let body = self.passes(id, new, &body, scope)?;
                StateKind::While { predicate, body_first, index, body, outputs }
            }
            StateKind::Concurrency { regions, preemptive, successes, decide, outputs } => {
                StateKind::Concurrency { regions: listed(&regions)?, preemptive, successes, decide, outputs }
            }
            StateKind::Condition { predicate, then, otherwise, outputs } => {
                let (then, otherwise) = (listed(&then)?, listed(&otherwise)?);
                StateKind::Condition { predicate, then, otherwise, outputs }
            }
        };
        self.at(new).kind = kind;
        let (path, guards) = (self.at(new).path.clone(), self.guards);
        for Collected { name, .. } in guards.get(&id).into_iter().flat_map(|guard| &guard.collected) {
            let list = Expr::Variable(format!("{name} of {path}"));
            let outputs = self.at(new).kind.outputs_mut().into_iter().flatten();
            outputs.filter(|output| output.name == *name).for_each(|output| output.value = list.clone());
        }
        Ok(new)
    }

    /// Copies the body of a loop, put into a state that appends this iteration's values at its end if the loop collects any ([`Program::is_pass`]).
    fn passes(
        &mut self,
        id: StateId,
        new: StateId,
        body: &[StateId],
        scope: usize,
    ) -> Result<Vec<StateId>, TooManyStates> {
        let collected = self.guards.get(&id).map_or(&[][..], |guard| &guard.collected);
        if collected.is_empty() {
            return body.iter().map(|child| self.guarded(*child, Some(new), None, scope)).collect();
        }
        let pass = self.sequence(id, new, "pass", body, scope)?;
        let path = self.at(new).path.clone();
        for Collected { name, value } in collected {
            let variable = format!("{name} of {path}");
            let list = Box::new(Expr::Variable(variable.clone()));
            let longer = Expr::Binary(BinaryOperator::Add, list, Box::new(Expr::List(vec![value.clone()])));
            self.at(pass).assign.push((variable.clone(), longer));
            self.at(new).variables.push((variable, Expr::Literal(Value::List(List::new()))));
        }
        Ok(vec![pass])
    }

    /// Copies a state with its `retry`.
    fn with_retry(
        &mut self,
        id: StateId,
        parent: Option<StateId>,
        name: String,
        scope: usize,
        retried: &Retried,
        is_outermost: bool,
    ) -> Result<StateId, TooManyStates> {
        let around = self.around(id, parent, name, scope, is_outermost)?;
        let body = self.watched(id, Some(around), "try".to_owned(), scope, false)?;
        self.at(body).annotations.exceptional.extend(retried.on.iter().cloned());
        self.links.push((body, SUCCESS.to_owned(), Target::Outcome(SUCCESS.to_owned())));
        self.outputs.push((around, body));
        let path = self.at(around).path.clone();
        let (tries, pause_s) = (format!("tries of {path}"), format!("pause of {path}"));
        let number = |n: i64| Expr::Literal(Value::Int(n));
        let variable = |name: &str| Expr::Variable(name.to_owned());
        let of = |operator, left, right| Expr::Binary(operator, Box::new(left), Box::new(right));
        self.at(around).variables = vec![(tries.clone(), number(0))];
        let mut children = vec![body];
        let mut again = Vec::new();
        for outcome in &retried.on {
            let name = if retried.on.len() == 1 { "again".to_owned() } else { format!("again_{outcome}") };
            let predicate = of(BinaryOperator::Less, variable(&tries), number(i64::from(retried.count)));
            let (then, otherwise, outputs) = Default::default();
            let kind = StateKind::Condition { predicate, then, otherwise, outputs };
            let state = self.made(id, around, &name, kind, scope)?;
            let enough = self.step(id, state, "enough", outcome, scope)?;
            if let StateKind::Condition { otherwise, .. } = &mut self.at(state).kind {
                otherwise.push(enough);
            }
            self.at(state).outcomes = own([outcome.as_str()]);
            self.at(state).assign = vec![(tries.clone(), of(BinaryOperator::Add, variable(&tries), number(1)))];
            self.links.push((body, outcome.clone(), Target::State(state)));
            again.push(state);
        }
        children.extend(again.iter().copied());
        let mut last = again;
        if retried.backoff_s > 0.0 {
            let seconds = vec![("seconds".to_owned(), variable(&pause_s))];
            let pause = self.wait(id, around, ("pause", PAUSE, SUCCESS), seconds, scope)?;
            self.at(pause).annotations.duration_s = Some(variable(&pause_s));
            self.at(pause).assign =
                vec![(pause_s.clone(), of(BinaryOperator::Multiply, variable(&pause_s), number(2)))];
            self.at(around).variables.push((pause_s, Expr::Literal(Value::Float(retried.backoff_s))));
            children.push(pause);
            self.lead(&last, Target::State(pause));
            last = vec![pause];
        }
        let mut before = None;
        if !retried.before.is_empty() {
            let state = self.sequence(id, around, "before", &retried.before, scope)?;
            children.push(state);
            self.lead(&last, Target::State(state));
            last = vec![state];
            before = Some(state);
        }
        self.lead(&last, Target::State(body));
        let (count, on) = (retried.count, retried.on.clone());
        self.again.push((around, Again { body, count, on, before }));
        self.at(around).kind = StateKind::Sequence { children, outputs: Vec::new() };
        Ok(around)
    }

    /// Copies a state with its `finally`.
    fn with_finally(
        &mut self,
        id: StateId,
        parent: Option<StateId>,
        name: String,
        scope: usize,
        guard: &Guard,
    ) -> Result<StateId, TooManyStates> {
        let around = self.around(id, parent, name, scope, true)?;
        let body = match &guard.retried {
            Some(retried) => self.with_retry(id, Some(around), "body".to_owned(), scope, retried, false)?,
            None => self.watched(id, Some(around), "body".to_owned(), scope, false)?,
        };
        self.outputs.push((around, body));
        self.at(body).annotations.exceptional.extend([ABORTED, PREEMPTED].map(str::to_owned));
        let mut children = vec![body];
        let mut lastly = BTreeMap::new();
        let mut outcomes = self.outcomes[id.0 as usize].clone();
        let before = guard.retried.iter().flat_map(|retried| &retried.before);
        for outcome in before.flat_map(|state| self.leaves_by(*state)).collect::<Vec<_>>() {
            if !outcomes.contains(&outcome) {
                outcomes.push(outcome);
            }
        }
        for outcome in outcomes {
            let name = if outcome == SUCCESS { "finally".to_owned() } else { format!("finally_{outcome}") };
            self.scopes.push(Scope { around: Some(scope), places: Places::new() });
            let state = self.sequence(id, around, &name, &guard.finally, self.scopes.len() - 1)?;
            self.links.push((body, outcome.clone(), Target::State(state)));
            self.links.push((state, SUCCESS.to_owned(), Target::Outcome(outcome.clone())));
            children.push(state);
            lastly.insert(outcome, state);
        }
        self.lastly.push((around, Finally { body, lastly }));
        self.at(around).kind = StateKind::Sequence { children, outputs: Vec::new() };
        Ok(around)
    }

    /// Adds the state that is visible from outside.
    fn around(
        &mut self,
        id: StateId,
        parent: Option<StateId>,
        name: String,
        scope: usize,
        is_outermost: bool,
    ) -> Result<StateId, TooManyStates> {
        let old = self.old(id);
        let mut state = bare(old, name, StateKind::Sequence { children: Vec::new(), outputs: Vec::new() });
        state.outcomes.clone_from(&old.outcomes);
        state.defaults.clone_from(&old.defaults);
        state.annotations.exceptional.clone_from(&old.annotations.exceptional);
        state.annotations.exceptions = old.annotations.exceptions;
        if is_outermost {
            state.transitions.clone_from(&old.transitions);
            state.annotations.shared.clone_from(&old.annotations.shared);
        }
        let new = self.push(state, parent, scope)?;
        self.place(id, new, scope);
        Ok(new)
    }

    fn made(
        &mut self,
        id: StateId,
        parent: StateId,
        name: &str,
        kind: StateKind,
        scope: usize,
    ) -> Result<StateId, TooManyStates> {
        let state = bare(self.old(id), name.to_owned(), kind);
        self.push(state, Some(parent), scope)
    }

    /// Adds a state that only leaves its list by an outcome.
    fn step(
        &mut self,
        id: StateId,
        parent: StateId,
        name: &str,
        outcome: &str,
        scope: usize,
    ) -> Result<StateId, TooManyStates> {
        let kind = StateKind::Sequence { children: Vec::new(), outputs: Vec::new() };
        let step = self.made(id, parent, name, kind, scope)?;
        self.links.push((step, SUCCESS.to_owned(), Target::Outcome(outcome.to_owned())));
        Ok(step)
    }

    fn sequence(
        &mut self,
        id: StateId,
        parent: StateId,
        name: &str,
        list: &[StateId],
        scope: usize,
    ) -> Result<StateId, TooManyStates> {
        let outputs = Vec::new();
        let state = self.made(id, parent, name, StateKind::Sequence { children: Vec::new(), outputs }, scope)?;
        let children = list.iter().map(|child| self.guarded(*child, Some(state), None, scope));
        let children = children.collect::<Result<Vec<StateId>, TooManyStates>>()?;
        self.at(state).kind = StateKind::Sequence { children, outputs: Vec::new() };
        Ok(state)
    }

    /// The outcomes by which a state leaves its list.
    fn leaves_by(&self, id: StateId) -> Vec<String> {
        let left = |outcome: &String| match self.old(id).transitions.get(outcome) {
            Some(Target::Outcome(by)) => Some(by.clone()),
            Some(Target::State(_)) => None,
            None => Some(outcome.clone()),
        };
        self.outcomes[id.0 as usize].iter().filter_map(left).collect()
    }

    fn lead(&mut self, from: &[StateId], to: Target) {
        self.links.extend(from.iter().map(|from| (*from, SUCCESS.to_owned(), to.clone())));
    }

    fn push(&mut self, mut state: State, parent: Option<StateId>, scope: usize) -> Result<StateId, TooManyStates> {
        if self.new.len() >= MAX_STATES {
            return Err(TooManyStates);
        }
        let id = StateId(self.new.len() as u64);
        let around = parent.map_or("", |parent| &self.new[parent.0 as usize].path);
        state.path = match (parent, around) {
            (None, _) => String::new(),
            (Some(_), "") => state.name.clone(),
            (Some(_), around) => format!("{around}/{}", state.name),
        };
        (state.id, state.parent) = (id, parent);
        self.new.push(state);
        self.of_scope.push(scope);
        Ok(id)
    }

    fn at(&mut self, id: StateId) -> &mut State {
        &mut self.new[id.0 as usize]
    }

    fn place(&mut self, old: StateId, new: StateId, scope: usize) {
        self.scopes[scope].places.entry(old).or_default().push(new);
    }

    /// The new states, with new ids in transitions and expressions, too.
    fn resolved(&self) -> Vec<State> {
        let mut states = self.new.clone();
        for state in &mut states {
            let id = state.id;
            for target in state.transitions.values_mut() {
                if let Target::State(to) = target {
                    *to = self.entered_from(id, *to);
                }
            }
            state.each_expression_mut(&mut |_, expression| expression.rewrite(&mut |part| self.port(id, part)));
            state.annotations.each_mark_mut(&mut |marked| *marked = self.seen_from(id, *marked));
        }
        for (around, again) in &self.again {
            states[around.0 as usize].annotations.again = Some(again.clone());
        }
        for (around, finally) in &self.lastly {
            states[around.0 as usize].annotations.finally = Some(finally.clone());
        }
        for (from, outcome, to) in &self.links {
            states[from.0 as usize].transitions.insert(outcome.clone(), to.clone());
        }
        // Inner states were made first.
        for (around, body) in &self.outputs {
            let port = |name: &String, ty: &Type| {
                let value = Expr::Port { state: *body, port: name.clone() };
                TaskOutput { name: name.clone(), ty: ty.clone(), value }
            };
            let own: Vec<TaskOutput> = match &states[body.0 as usize].kind {
                StateKind::Action { outputs, .. } => outputs.iter().map(|(name, ty)| port(name, ty)).collect(),
                _ => {
                    let outputs = states[body.0 as usize].outputs();
                    outputs.iter().map(|output| port(&output.name, &output.ty)).collect()
                }
            };
            if let StateKind::Sequence { outputs, .. } | StateKind::Concurrency { outputs, .. } =
                &mut states[around.0 as usize].kind
            {
                *outputs = own;
            }
        }
        states
    }

    fn port(&self, from: StateId, part: &mut Expr) {
        if let Expr::Port { state, .. } = part {
            *state = self.seen_from(from, *state);
        }
    }

    /// The new state that an expression in `from` means by an old state: the outermost one that does not contain `from` and is not watched beside it. If there
    /// is none, the outermost one, with the outputs of its last visit: a guard does not change what a state sees of itself.
    fn seen_from(&self, from: StateId, old: StateId) -> StateId {
        let layers = self.layers(from, old);
        let up = |id: &StateId| self.new[id.0 as usize].parent;
        let contains = |layer: &StateId| std::iter::successors(Some(from), up).any(|id| id == *layer);
        let is_beside = |layer: &StateId| {
            let around = up(layer).filter(|around| layers.contains(around) && contains(around));
            around.is_some_and(|around| matches!(self.new[around.0 as usize].kind, StateKind::Concurrency { .. }))
        };
        let is_outside = |layer: &&StateId| !contains(layer) && !is_beside(layer);
        layers.iter().find(is_outside).or(layers.first()).copied().unwrap_or(old)
    }

    /// The target of a transition to an old state: the outermost new state, with the whole guard.
    fn entered_from(&self, from: StateId, old: StateId) -> StateId {
        self.layers(from, old).first().copied().unwrap_or(old)
    }

    /// The new states of an old state that are visible from a new state.
    fn layers(&self, from: StateId, old: StateId) -> &[StateId] {
        let mut scope = Some(self.of_scope[from.0 as usize]);
        while let Some(at) = scope {
            if let Some(layers) = self.scopes[at].places.get(&old) {
                return layers;
            }
            scope = self.scopes[at].around;
        }
        &[]
    }
}

/// A state that does nothing, at the location of another one in the file.
fn bare(old: &State, name: String, kind: StateKind) -> State {
    let effects = [(SUCCESS.to_owned(), Vec::new())].into();
    State {
        id: old.id,
        name,
        path: String::new(),
        parent: None,
        kind,
        outcomes: Vec::new(),
        transitions: BTreeMap::new(),
        variables: Vec::new(),
        assign: Vec::new(),
        defaults: BTreeMap::new(),
        annotations: Annotations {
            nature: Nature::Irreversible,
            reads: Some(Vec::new()),
            effects,
            ..Annotations::default()
        },
        location: old.location,
    }
}

/// The outcomes that not every state has.
fn own<'n>(outcomes: impl IntoIterator<Item = &'n str>) -> Vec<String> {
    let is_common = |outcome: &&str| [SUCCESS, ABORTED, PREEMPTED].contains(outcome);
    outcomes.into_iter().filter(|outcome| !is_common(outcome)).map(str::to_owned).collect()
}
