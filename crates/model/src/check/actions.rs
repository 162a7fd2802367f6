//! Actions against the catalogue: actions, ports and outcomes must exist there.

use super::Subject;
use crate::diagnostic::Findings;
use crate::load::suggestion;
use crate::program::{State, StateKind};

pub(super) fn check(subject: &Subject<'_>, findings: &mut Findings) {
    let all = subject.program.all_outcomes();
    for (state, own) in subject.program.states.iter().zip(&all) {
        if let StateKind::Action { provider, action, inputs, .. } = &state.kind
            && !state.is_pause()
        {
            ports(subject, state, provider, action, inputs.iter().map(|(port, _)| port.as_str()).collect(), findings);
        }
        outcomes(subject, state, own, findings);
    }
}

fn ports(
    subject: &Subject<'_>,
    state: &State,
    provider: &str,
    action: &str,
    given: Vec<&str>,
    findings: &mut Findings,
) {
    let at = subject.place(state, "action");
    let path = &state.path;
    let Some(offered) = subject.catalogue.providers.get(provider) else {
        let known = subject.catalogue.providers.keys().map(String::as_str);
        let help = suggestion(provider, known, "", "add the provider to the catalogue of the system");
        findings.error("unknown-provider", at, path, format!("nothing provides `{provider}`"), help);
        return;
    };
    let Some(signature) = offered.actions.get(action) else {
        let help = suggestion(action, offered.actions.keys().map(String::as_str), "", "it has no actions");
        findings.error("unknown-action", at, path, format!("`{provider}` has no action `{action}`"), help);
        return;
    };
    for port in &given {
        if !signature.inputs.contains_key(*port) && !signature.optional.contains_key(*port) {
            let known = signature.inputs.keys().chain(signature.optional.keys()).map(String::as_str);
            let help = suggestion(port, known, "", "leave it out");
            let message = format!("`{provider}/{action}` has no input port `{port}`");
            findings.error("unknown-port", subject.place(state, &format!("in.{port}")), path, message, help);
        }
    }
    for (port, ty) in &signature.inputs {
        if !given.contains(&port.as_str()) {
            let message = format!("`{provider}/{action}` needs the input `{port}` ({ty})");
            findings.error("missing-input", at, path, message, format!("add it: `in: {{{port}: …}}`"));
        }
    }
}

/// Effects may be declared only for outcomes that the state can have.
fn outcomes(subject: &Subject<'_>, state: &State, own: &[String], findings: &mut Findings) {
    if let StateKind::Action { provider, action, .. } = &state.kind
        && (subject.catalogue.action(provider, action).is_none() && !state.is_pause())
    {
        // Reported elsewhere.
        return;
    }
    for outcome in state.annotations.effects.keys().filter(|outcome| !own.contains(outcome)) {
        let at = subject.place(state, &format!("effects.{outcome}"));
        let help = suggestion(outcome, own.iter().map(String::as_str), "", "");
        findings.error("unknown-outcome", at, &state.path, format!("this state has no outcome `{outcome}`"), help);
    }
}
