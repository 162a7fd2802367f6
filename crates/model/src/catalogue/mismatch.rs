//! Differences between a worker's description of itself and the catalogue's entry for it. A task that was checked against the catalogue
//! would then wait for ever or fail.

use super::{ActionSignature, Catalogue, WorkerDescription};
use crate::value::Type;
use std::collections::BTreeMap;

/// Limit of reported mismatches of one worker; the last entry then gives the number of the others.
const TOLD: usize = 16;

impl WorkerDescription {
    /// The points in which the catalogue differs from a worker that is offered as `kind`, each as a sentence.
    pub fn mismatches(&self, catalogue: &Catalogue, kind: &str) -> Vec<String> {
        let mut found = Vec::new();
        if !self.kind.is_empty() && self.kind != kind {
            found.push(format!(
                "the worker says that it is a `{}`, and its template that it is a `{kind}`: no state that blocks a `{}` gets it",
                self.kind, self.kind
            ));
        }
        match catalogue.providers.get(&self.provider) {
            Some(provider) if provider.resource != kind => found.push(format!(
                "the catalogue says that `{}` is a `{}`, and the template of the worker that it is a `{kind}`: a state that blocks a \
                 `{}` does not get it",
                self.provider, provider.resource, provider.resource
            )),
            Some(_) => self.compare(catalogue, &self.provider, &mut found),
            None => {
                let of_kind = catalogue.providers.iter().filter(|(_, provider)| provider.resource == kind);
                let names: Vec<&String> = of_kind.map(|(name, _)| name).collect();
                if !self.provider.is_empty() && !names.is_empty() {
                    let known = names.iter().map(|name| format!("`{name}`")).collect::<Vec<_>>().join(", ");
                    found.push(format!(
                        "the worker calls itself `{}`, and the catalogue what is a `{kind}` {known}",
                        self.provider
                    ));
                } else {
                    names.iter().for_each(|name| self.compare(catalogue, name, &mut found));
                }
            }
        }
        if found.len() > TOLD {
            let more = found.len() - (TOLD - 1);
            found.truncate(TOLD - 1);
            found.push(format!("and {more} more"));
        }
        found
    }

    fn compare(&self, catalogue: &Catalogue, provider: &str, found: &mut Vec<String>) {
        let Some(known) = catalogue.providers.get(provider) else { return };
        for (action, catalogued) in &known.actions {
            let name = format!("{provider}/{action}");
            match self.actions.get(action) {
                None => {
                    let performs: Vec<&str> = self.actions.keys().map(String::as_str).collect();
                    let performs = if performs.is_empty() { "nothing".to_owned() } else { performs.join(", ") };
                    found.push(format!("the catalogue has `{name}`, and the worker performs {performs}"));
                }
                Some(None) => {}
                Some(Some(said)) => compare(&name, catalogued, said, found),
            }
        }
    }
}

fn compare(name: &str, catalogued: &ActionSignature, said: &ActionSignature, found: &mut Vec<String>) {
    let mut tell = |what: String| found.push(format!("`{name}`: {what}"));
    let takes = |port: &String| said.inputs.get(port).or_else(|| said.optional.get(port));
    for (port, of_type) in catalogued.inputs.iter().chain(&catalogued.optional) {
        match takes(port) {
            None => tell(format!("the catalogue has an input `{port}`, which the worker does not take")),
            Some(taken) if !taken.accepts_type(of_type) => {
                tell(format!("input `{port}` is {of_type} in the catalogue, and the worker takes {taken}"));
            }
            Some(_) => {}
        }
    }
    for port in said.inputs.keys().filter(|port| !catalogued.inputs.contains_key(*port)) {
        let in_catalogue = if catalogued.optional.contains_key(port) { "is optional" } else { "is not there" };
        tell(format!("the worker needs an input `{port}`, which {in_catalogue} in the catalogue"));
    }
    missing(&catalogued.outputs, &said.outputs, &mut tell);
    for outcome in said.outcomes.iter().filter(|outcome| !catalogued.outcomes.contains(outcome)) {
        tell(format!("the worker may end with `{outcome}`, which is not among the outcomes of the catalogue"));
    }
}

fn missing(catalogued: &BTreeMap<String, Type>, said: &BTreeMap<String, Type>, tell: &mut impl FnMut(String)) {
    for (port, of_type) in catalogued {
        match said.get(port) {
            None => tell(format!("the catalogue has an output `{port}`, which the worker does not write")),
            Some(written) if !of_type.accepts_type(written) => {
                tell(format!("output `{port}` is {of_type} in the catalogue, and the worker writes {written}"));
            }
            Some(_) => {}
        }
    }
}
