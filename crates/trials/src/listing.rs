//! A program as readable text: one line per state, indented by depth.

use ratn_model::expression::{EffectExpr, Expr};
use ratn_model::program::{Exceptions, Nature, Program, State, StateKind, Target, TaskOutput};

/// One line per state, with all its annotations.
pub fn listing(program: &Program) -> String {
    let mut text = format!("horizon {}, width {}", program.horizon, program.speculation_width);
    if program.exceptions == Exceptions::Imprecise {
        text += ", imprecise";
    }
    for parameter in &program.parameters {
        text +=
            &format!(", ${} = {}", parameter.name, parameter.default.as_ref().map_or("?".into(), ToString::to_string));
    }
    if program.ontology.is_some() {
        text += ", with an ontology";
    }
    text += &program.deadline_s.map(|limit| format!(", deadline {limit} s")).unwrap_or_default();
    let initial: Vec<String> = program.initial.iter().map(ToString::to_string).collect();
    text += &format!("\nworld {}\n", initial.join(", "));
    lines(program, program.state(Program::ROOT), "", &mut text);
    let outputs = outputs(&program.outputs);
    if !outputs.is_empty() {
        text += &format!("outputs {outputs}\n");
    }
    text
}

fn lines(program: &Program, state: &State, indent: &str, text: &mut String) {
    *text += &format!("{indent}{} ({}): {}{}\n", state.name, state.id, kind(state), said(program, state));
    for (number, list) in state.lists().into_iter().enumerate() {
        if number == 1 && matches!(state.kind, StateKind::Condition { .. }) && !list.is_empty() {
            *text += &format!("{indent}else\n");
        }
        for child in list {
            lines(program, program.state(*child), &format!("{indent}  "), text);
        }
    }
}

fn kind(state: &State) -> String {
    match &state.kind {
        StateKind::Action { action, inputs, .. } => {
            let nature = match &state.annotations.nature {
                Nature::Irreversible => "pia".to_owned(),
                Nature::Computes => "computes".to_owned(),
                Nature::Senses(facts) => format!("senses [{}]", joined(facts)),
            };
            format!("{action}({}) {nature}", pairs(inputs))
        }
        StateKind::Sequence { outputs: declared, .. } => format!("sequence{}", arrow(declared)),
        StateKind::ForEach { variable, index, collection, outputs: declared, .. } => {
            format!("for {variable}{} in {collection}{}", with_index(index), arrow(declared))
        }
        StateKind::While { predicate, body_first, index, outputs: declared, .. } => {
            let kind = if *body_first { "do while" } else { "while" };
            format!("{kind}{} {predicate}{}", with_index(index), arrow(declared))
        }
        StateKind::Concurrency { preemptive, successes, decide, outputs: declared, .. } => {
            let kind = match successes {
                Some(wanted) => format!("{wanted} of the regions"),
                None => if *preemptive { "preemptive" } else { "barrier" }.to_owned(),
            };
            format!("{kind} decide {{{}}}{}", pairs(decide), arrow(declared))
        }
        StateKind::Condition { predicate, outputs: declared, .. } => format!("if {predicate}{}", arrow(declared)),
    }
}

/// All annotations of a state.
fn said(program: &Program, state: &State) -> String {
    let mut said = Vec::new();
    let a = &state.annotations;
    if let (StateKind::Action { .. }, Some(reads)) = (&state.kind, &a.reads) {
        said.push(format!("reads [{}]", joined(reads)));
    }
    for (outcome, effects) in &a.effects {
        said.push(format!("{outcome}! [{}]", joined::<EffectExpr>(effects)));
    }
    said.extend(a.requires.iter().map(|required| format!("requires {required}")));
    said.extend(a.holds.iter().map(|holds| format!("while {holds}")));
    let resources = a.resources.iter().map(|r| {
        let unordered = if r.unordered { " unordered" } else { "" };
        let mut like: Vec<String> = r.attributes.iter().map(|(name, value)| format!("{name} = {value}")).collect();
        like.extend(r.conditions.iter().map(ToString::to_string));
        let like = if like.is_empty() { String::new() } else { format!(" where {}", like.join(", ")) };
        format!("{:?} {} {}{like}{unordered}", r.operation, r.count, r.kind).to_lowercase()
    });
    said.extend(resources);
    for (outcome, target) in &state.transitions {
        let to = match target {
            Target::State(id) => program.state(*id).name.clone(),
            Target::Outcome(name) => format!("out by {name}"),
        };
        said.push(format!("{outcome} → {to}"));
    }
    let declared = [("variables", &state.variables), ("assign", &state.assign)];
    said.extend(
        declared.into_iter().filter(|(_, all)| !all.is_empty()).map(|(what, all)| format!("{what} {}", pairs(all))),
    );
    if !state.defaults.is_empty() {
        let defaults: Vec<String> = state.defaults.iter().map(|(port, value)| format!("{port}: {value}")).collect();
        said.push(format!("defaults {}", defaults.join(", ")));
    }
    if !state.outcomes.is_empty() {
        said.push(format!("outcomes {}", state.outcomes.join(", ")));
    }
    if !a.exceptional.is_empty() {
        said.push(format!("exceptional {}", a.exceptional.join(", ")));
    }
    said.extend(a.retry.map(|retry| format!("retry {} after {} s", retry.count, retry.backoff_s)));
    said.extend(a.timeout_s.map(|limit| format!("timeout {limit} s")));
    said.extend(a.attempts.map(|limit| format!("attempts {limit}")));
    said.extend(a.duration_s.as_ref().map(|estimate| format!("duration {estimate}")));
    said.extend(a.exceptions.map(|exceptions| format!("{exceptions:?}").to_lowercase()));
    said.extend(a.routine.then(|| "routine".to_owned()));
    said.extend(a.deterministic.then(|| "deterministic".to_owned()));
    said.extend(a.anytime.then(|| "anytime".to_owned()));
    said.iter().map(|part| format!(" | {part}")).collect()
}

fn arrow(declared: &[TaskOutput]) -> String {
    if declared.is_empty() { String::new() } else { format!(" → {}", outputs(declared)) }
}

fn outputs(declared: &[TaskOutput]) -> String {
    declared.iter().map(|o| format!("{}: {}", o.name, o.value)).collect::<Vec<_>>().join(", ")
}

fn with_index(index: &Option<String>) -> String {
    index.as_ref().map(|index| format!(" [{index}]")).unwrap_or_default()
}

fn pairs(all: &[(String, Expr)]) -> String {
    all.iter().map(|(name, value)| format!("{name}: {value}")).collect::<Vec<_>>().join(", ")
}

fn joined<T: ToString>(all: &[T]) -> String {
    all.iter().map(ToString::to_string).collect::<Vec<_>>().join(", ")
}
