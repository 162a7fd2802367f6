//! Random programs whose annotations are partly in the catalogue, so that states contain only what differs.
//!
//! A random program is written as a task file. Each annotation is put into the state, into its action, or into both; an action's annotations refer
//! to its own inputs, sometimes to one that the state does not give. The annotations in force are computed here independently (`in_force`), and
//! the loader must find the same. The loaded program is then tested as any other, in both modes and against the reference.

mod in_force;
mod written;

use super::{Dice, Features, generator};
use in_force::{Inputs, Said, in_force};
use ratn_model::catalogue::{ActionSignature, Annotations as OfAction, Catalogue, Provider};
use ratn_model::expression::{EffectExpr, Expr, FactExpr};
use ratn_model::load::load;
use ratn_model::program::{Annotations, Nature, Program, ResourceExpr, SUCCESS, State, StateKind, WORLD_MODEL};
use ratn_model::resource::{Quantity, ResourceOperation};
use ratn_model::value::Type;
use serde_json::{Map, Value as Json, json};
use std::collections::BTreeMap;

/// The result for a random program with inherited annotations.
#[derive(Debug)]
pub enum Inherited {
    /// It was loaded, with the expected annotations in force.
    Program(Box<Program>),
    /// The rules of `check` refuse it, as they do for some random programs.
    Refused(Vec<String>),
    /// Other annotations are in force than expected: the state, and the difference.
    Differs(String),
}

/// Percentages of annotations that are put into the action, the state, or both.
const SHARES: [u64; 3] = [45, 35, 20];
/// An input of every action that no state gives.
const NEVER_GIVEN: &str = "never";

/// The random program of a seed, written with a catalogue that contains a part of its annotations, and loaded.
pub fn inherited(seed: u64) -> Inherited {
    let mut program = generator::program(seed, &Features::INHERITED);
    let mut dice = Dice(seed ^ 0x1e_4e71_7ed0);
    name_actions(&mut program);
    // Of its own, so that the other annotations of a seed stay as they are.
    let mut further = Dice(seed ^ 0x6_1fe4_0117);
    let mut catalogue = Catalogue { resources: written::resources(), ..Catalogue::default() };
    let mut own: BTreeMap<String, Map<String, Json>> = BTreeMap::new();
    let mut expected: BTreeMap<String, Annotations> = BTreeMap::new();
    for state in &program.states {
        let StateKind::Action { provider, action, inputs, outputs } = &state.kind else { continue };
        let given: Inputs = inputs.iter().cloned().collect();
        let (of_state, mut of_action) = divided(&state.annotations, &given, &mut dice);
        let success = state.annotations.effects.get(SUCCESS).into_iter().flatten();
        of_action.unknown = success.filter_map(|effect| set_by(effect).filter(|_| further.percent(30))).collect();
        let is_in_projection = written::is_in_projection(&program, state);
        let mut in_force = in_force(&of_state, &of_action, &given, &state.outcomes, is_in_projection);
        let before = &state.annotations;
        (in_force.retry, in_force.timeout_s) = (before.retry, before.timeout_s);
        (in_force.attempts, in_force.deterministic) = (before.attempts, before.deterministic);
        expected.insert(state.path.clone(), in_force);
        own.insert(state.path.clone(), said_by_state(&program, state, &of_state));
        let optional = inputs.iter().map(|(name, _)| name.clone()).chain([NEVER_GIVEN.to_owned()]);
        let signature = ActionSignature {
            optional: optional.map(|name| (name, Type::Any)).collect(),
            outputs: outputs.clone(),
            outcomes: state.outcomes.clone(),
            annotations: by_input(said_by_action(&of_action), inputs, &mut further),
            ..ActionSignature::default()
        };
        let kind = performer(&state.annotations).to_owned();
        let new = || Provider { resource: kind, joints: None, chain: None, actions: BTreeMap::new() };
        catalogue.providers.entry(provider.clone()).or_insert_with(new).actions.insert(action.clone(), signature);
    }
    if let Err(wrong) = catalogue.check() {
        return Inherited::Differs(format!("the catalogue does not read: {wrong}"));
    }
    let text = written::task(&program, &|state| own.get(&state.path).cloned().unwrap_or_default());
    let loaded = match load(&text, "inherited.yaml", &catalogue) {
        Ok(loaded) => loaded.program,
        Err(findings) => return Inherited::Refused(findings.iter().map(ToString::to_string).collect()),
    };
    for state in loaded.states.iter().filter(|state| matches!(state.kind, StateKind::Action { .. })) {
        let Some(expected) = expected.get(&state.path) else {
            return Inherited::Differs(format!("a state {} was not written", state.path));
        };
        let (theirs, ours) = (as_said(&loaded, state, &state.annotations), as_said(&program, state, expected));
        if theirs != ours {
            let path = &state.path;
            return Inherited::Differs(format!("{path}: in force is {theirs}, and should be {ours}\n{text}"));
        }
    }
    Inherited::Program(Box::new(loaded))
}

/// Gives every action its own name, with the provider of its resource.
fn name_actions(program: &mut Program) {
    for state in &mut program.states {
        let performer = performer(&state.annotations).to_lowercase();
        if let StateKind::Action { provider, action, .. } = &mut state.kind {
            (*provider, *action) = (performer, format!("do{}", state.id.0));
        }
    }
}

/// The resource kind of an action's provider: the first that it blocks.
fn performer(annotations: &Annotations) -> &str {
    let blocks = |line: &&ResourceExpr| line.operation == ResourceOperation::Block;
    annotations.resources.iter().find(blocks).map_or("Planner", |line| &line.kind)
}

/// All annotations as a state would have them, for comparison.
fn as_said(program: &Program, state: &State, all: &Annotations) -> String {
    let said = Said {
        nature: Some(all.nature.clone()),
        reads: all.reads.clone(),
        requires: Some(all.requires.clone()),
        effects: Some(all.effects.clone()),
        resources: Some(all.resources.clone()),
        duration: all.duration_s.clone(),
        unknown: Vec::new(),
    };
    let state = State { annotations: all.clone(), ..state.clone() };
    Json::Object(said_by_state(program, &state, &said)).to_string()
}

/// Divides a state's annotations between the state and its action, the latter in terms of its inputs.
fn divided(all: &Annotations, given: &Inputs, dice: &mut Dice) -> (Said, Said) {
    let (mut state, mut action) = (Said::default(), Said::default());
    let who = |dice: &mut Dice| {
        let chance = dice.below(100);
        (chance >= SHARES[0], chance < SHARES[0] || chance >= SHARES[0] + SHARES[1])
    };
    let any = |fact: &FactExpr| FactExpr { arguments: vec![None; fact.arguments.len()], ..fact.clone() };
    let (own, of_action) = who(dice);
    if own {
        state.nature = Some(all.nature.clone());
    }
    if of_action {
        action.nature = match &all.nature {
            // A catalogue cannot say `irreversible`. It says `computes` only if the state overrides that.
            Nature::Irreversible => own.then_some(Nature::Computes),
            Nature::Computes => Some(Nature::Computes),
            Nature::Senses(facts) => of_inputs(facts, given).filter(|facts| !facts.is_empty()).map(Nature::Senses),
        };
        let is_said = action.nature.is_some() || all.nature == Nature::Irreversible;
        if !is_said {
            state.nature = Some(all.nature.clone());
        }
    }
    if let Some(reads) = &all.reads {
        let (own, of_action) = who(dice);
        let inputs = of_inputs(reads, given);
        action.reads = inputs.filter(|_| of_action).map(|mut facts| {
            if own {
                facts = facts.iter().map(any).collect();
            } else if dice.percent(10) {
                facts.push(FactExpr { predicate: "p0".to_owned(), arguments: vec![Some(variable(NEVER_GIVEN))] });
            }
            facts
        });
        state.reads = (own || action.reads.is_none()).then(|| reads.clone());
    }
    if !all.requires.is_empty() {
        let (own, of_action) = who(dice);
        let inputs: Vec<Option<Expr>> = all.requires.iter().map(|one| in_terms_of(one, given)).collect();
        let inputs: Option<Vec<Expr>> = inputs.into_iter().collect();
        action.requires = inputs.filter(|_| of_action);
        state.requires = (own || action.requires.is_none()).then(|| all.requires.clone());
    }
    divide_effects(all, given, dice, &mut state, &mut action);
    divide_resources(all, dice, &mut state, &mut action);
    if let Some(duration) = &all.duration_s {
        let (own, of_action) = who(dice);
        action.duration = in_terms_of(duration, given).filter(|_| of_action);
        state.duration = (own || action.duration.is_none()).then(|| duration.clone());
    }
    // A computing action has no effects in the catalogue.
    if action.nature == Some(Nature::Computes) && action.effects.as_ref().is_some_and(has_some) {
        state.effects = Some(all.effects.clone());
        action.effects = None;
    }
    (state, action)
}

fn has_some(effects: &BTreeMap<String, Vec<EffectExpr>>) -> bool {
    effects.values().any(|effects| !effects.is_empty())
}

/// Divides the effects: the action gets those of success on some predicates, the state the others, sometimes also on these predicates.
fn divide_effects(all: &Annotations, given: &Inputs, dice: &mut Dice, state: &mut Said, action: &mut Said) {
    let Some(success) = all.effects.get(SUCCESS) else {
        state.effects = (!all.effects.is_empty()).then(|| all.effects.clone());
        return;
    };
    let (mut own, mut of_action) = (Vec::new(), Vec::new());
    for effect in success {
        let inputs = effect_in_terms_of(effect, given).filter(|_| dice.percent(60));
        match inputs {
            Some(inputs) => of_action.push(inputs),
            None => own.push(effect.clone()),
        }
    }
    if dice.percent(15)
        && let Some(EffectExpr::Set(fact, _)) = own.first()
        && let Some(overridden) = effect_in_terms_of(&EffectExpr::Delete(fact.clone()), given)
    {
        of_action.push(overridden);
    }
    if dice.percent(8) {
        let fact = FactExpr { predicate: "p1".to_owned(), arguments: vec![Some(variable(NEVER_GIVEN))] };
        of_action.push(EffectExpr::Delete(fact));
    }
    let mut by_outcome = all.effects.clone();
    by_outcome.remove(SUCCESS);
    if !own.is_empty() || of_action.is_empty() && dice.percent(50) {
        by_outcome.insert(SUCCESS.to_owned(), own);
    }
    state.effects = (!by_outcome.is_empty()).then_some(by_outcome);
    let says = !of_action.is_empty() || state.effects.as_ref().is_none_or(|own| !own.contains_key(SUCCESS));
    action.effects = says.then(|| BTreeMap::from([(SUCCESS.to_owned(), of_action)]));
}

/// Divides the resources: an action can only block one unit of a kind, including its provider's kind.
fn divide_resources(all: &Annotations, dice: &mut Dice, state: &mut Said, action: &mut Said) {
    let plain = |line: &ResourceExpr| {
        *line == ResourceExpr { kind: line.kind.clone(), ..ResourceExpr::new(ResourceOperation::Block, "") }
            && line.count == Quantity::ONE
    };
    let kinds: std::collections::BTreeSet<&str> = all.resources.iter().map(|line| line.kind.as_str()).collect();
    let is_plain = !all.resources.is_empty() && all.resources.iter().all(plain) && kinds.len() == all.resources.len();
    if is_plain && dice.percent(60) {
        action.resources = Some(all.resources.clone());
        return;
    }
    state.resources = Some(all.resources.clone());
    if dice.percent(30) {
        action.resources = Some(vec![ResourceExpr::new(ResourceOperation::Block, performer(all))]);
    }
}

fn variable(name: &str) -> Expr {
    Expr::Variable(name.to_owned())
}

fn of_inputs(facts: &[FactExpr], given: &Inputs) -> Option<Vec<FactExpr>> {
    let fact = |fact: &FactExpr| match in_terms_of(&Expr::Fact(fact.clone()), given)? {
        Expr::Fact(fact) => Some(fact),
        _ => None,
    };
    facts.iter().map(fact).collect()
}

fn effect_in_terms_of(effect: &EffectExpr, given: &Inputs) -> Option<EffectExpr> {
    // A catalogue contains only single effects.
    if matches!(effect, EffectExpr::ForEach { .. }) {
        return None;
    }
    let (mut effect, mut is_known) = (effect.clone(), true);
    effect.each_expression_mut(&mut |expression| match in_terms_of(expression, given) {
        Some(now) => *expression = now,
        None => is_known = false,
    });
    is_known.then_some(effect)
}

/// A state's expression in terms of its action's inputs; `None` if it uses anything else.
fn in_terms_of(expression: &Expr, given: &Inputs) -> Option<Expr> {
    let is_simple = |given: &Expr| matches!(given, Expr::Variable(_) | Expr::Port { .. });
    let (mut expression, mut is_known) = (expression.clone(), true);
    expression.rewrite(&mut |part| {
        let input = given.iter().find(|(_, value)| is_simple(value) && *value == part).map(|(input, _)| input.clone());
        match (&*part, input) {
            (_, Some(input)) => *part = Expr::Variable(input),
            (Expr::Variable(_) | Expr::Port { .. }, None) => is_known = false,
            _ => {}
        }
    });
    is_known.then_some(expression)
}

/// A state's annotations as keys of a task file.
fn said_by_state(program: &Program, state: &State, said: &Said) -> Map<String, Json> {
    let mut keys = Map::new();
    keys.extend(said.nature.as_ref().map(|nature| written::nature(program, nature)));
    let facts = |facts: &Vec<FactExpr>| facts.iter().map(|fact| json!(written::fact(program, fact))).collect();
    keys.extend(said.reads.as_ref().map(|reads| ("reads".to_owned(), facts(reads))));
    let texts = |all: &Vec<Expr>| all.iter().map(|one| json!(written::text(program, one))).collect();
    keys.extend(said.requires.as_ref().map(|requires| ("requires".to_owned(), texts(requires))));
    let effects = said.effects.as_ref().map(|effects| Json::Object(written::by_outcome(program, effects)));
    keys.extend(effects.map(|effects| ("effects".to_owned(), effects)));
    let resources = said.resources.as_ref();
    let resources = resources.map(|all| all.iter().map(|line| written::resource(program, line)).collect());
    keys.extend(resources.map(|resources| ("resources".to_owned(), resources)));
    keys.extend(
        said.duration.as_ref().map(|duration| ("duration".to_owned(), json!(written::text(program, duration)))),
    );
    let annotations = &state.annotations;
    let retry = annotations.retry.map(|retry| json!({ "times": retry.count, "backoff": retry.backoff_s }));
    keys.extend(retry.map(|retry| ("retry".to_owned(), retry)));
    keys.extend(annotations.timeout_s.map(|limit| ("timeout".to_owned(), json!(limit))));
    keys.extend(annotations.attempts.map(|attempts| ("attempts".to_owned(), json!(attempts))));
    keys.extend(annotations.deterministic.then(|| ("deterministic".to_owned(), json!(true))));
    keys
}

/// Annotations as texts of a catalogue.
fn said_by_action(said: &Said) -> OfAction {
    let texts = |facts: &Vec<FactExpr>| facts.iter().map(ToString::to_string).collect::<Vec<_>>();
    let kind =
        |line: &ResourceExpr| if line.kind == WORLD_MODEL { "world_model".to_owned() } else { line.kind.clone() };
    OfAction {
        computes: said.nature == Some(Nature::Computes),
        senses: match &said.nature {
            Some(Nature::Senses(facts)) => texts(facts),
            _ => Vec::new(),
        },
        reads: said.reads.as_ref().map(texts),
        requires: said.requires.iter().flatten().map(ToString::to_string).collect(),
        effects: said.effects.as_ref().map(|all| all.values().flatten().map(ToString::to_string).collect()),
        resources: said.resources.iter().flatten().map(kind).collect(),
        duration: said.duration.as_ref().map(ToString::to_string),
        unknown_after_failure: said.unknown.clone(),
        ..OfAction::default()
    }
}

/// The same annotations: some of them only where an input is given that the state gives, in place of others that are not in force then. Others are said
/// for an input that no state gives.
fn by_input(mut said: OfAction, inputs: &[(String, Expr)], dice: &mut Dice) -> OfAction {
    let others = || OfAction {
        reads: Some(vec!["p0(?)".to_owned()]),
        requires: vec!["1 = 2".to_owned()],
        effects: Some(vec!["delete p1(?)".to_owned()]),
        duration: Some("77".to_owned()),
        ..OfAction::default()
    };
    let is_given = |(_, value): &&(String, Expr)| *value != Expr::Literal(ratn_model::value::Value::Null);
    let input = inputs.iter().find(is_given).map(|(input, _)| input.clone());
    if let Some(input) = input.filter(|_| dice.percent(30)) {
        let mut then = OfAction::default();
        if said.reads.is_some() && dice.percent(50) {
            then.reads = std::mem::replace(&mut said.reads, others().reads);
        }
        if !said.requires.is_empty() && dice.percent(50) {
            then.requires = std::mem::replace(&mut said.requires, others().requires);
        }
        if said.effects.is_some() && !said.computes && dice.percent(50) {
            then.effects = std::mem::replace(&mut said.effects, others().effects);
        }
        if said.duration.is_some() && dice.percent(50) {
            then.duration = std::mem::replace(&mut said.duration, others().duration);
        }
        said.given.insert(input, then);
    }
    if dice.percent(20) && !said.computes {
        said.given.insert(NEVER_GIVEN.to_owned(), others());
    }
    said
}

/// The predicate of the fact that an effect sets.
fn set_by(effect: &EffectExpr) -> Option<String> {
    match effect {
        EffectExpr::Set(fact, _) => Some(fact.predicate.clone()),
        _ => None,
    }
}
