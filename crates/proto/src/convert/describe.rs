//! Descriptions of workers.

use crate::v1;
use prost::Message;
use ratn_model::catalogue::{ActionSignature, Annotations, DescriptionError, WorkerDescription};
use std::collections::BTreeMap;

/// Maximum size of a description on the wire.
pub const MAX_DESCRIPTION_BYTES: usize = 65_536;

/// Checks that a description is small enough for its readers.
///
/// # Errors
/// [`DescriptionError::TooLarge`].
pub fn check_size(said: &v1::DescribeResponse) -> Result<(), DescriptionError> {
    let (bytes, most) = (said.encoded_len(), MAX_DESCRIPTION_BYTES);
    if bytes <= most { Ok(()) } else { Err(DescriptionError::TooLarge { bytes, most }) }
}

impl From<ActionSignature> for v1::ActionSignature {
    fn from(signature: ActionSignature) -> v1::ActionSignature {
        let ActionSignature { inputs, optional, outputs, outcomes, defaults, annotations, .. } = signature;
        let port = |optional: bool, defaults: &BTreeMap<String, String>, (name, of_type): (String, _)| {
            let default_value = defaults.get(&name).cloned().unwrap_or_default();
            v1::PortDescription { name, r#type: String::from(of_type), optional, default_value }
        };
        let none = BTreeMap::new();
        let required = inputs.into_iter().map(|given| port(false, &none, given));
        let inputs = required.chain(optional.into_iter().map(|given| port(true, &defaults, given))).collect();
        let outputs = outputs.into_iter().map(|given| port(false, &none, given)).collect();
        let annotations = (!annotations.is_empty()).then(|| annotations.into());
        v1::ActionSignature { inputs, outputs, outcomes, annotations }
    }
}

impl From<Annotations> for v1::ActionAnnotations {
    fn from(said: Annotations) -> v1::ActionAnnotations {
        let is_none = |said: &Option<Vec<String>>| said.as_ref().is_some_and(Vec::is_empty);
        v1::ActionAnnotations {
            computes: said.computes,
            reads_nothing: is_none(&said.reads),
            changes_nothing: is_none(&said.effects),
            reads: said.reads.unwrap_or_default(),
            senses: said.senses,
            requires: said.requires,
            effects: said.effects.unwrap_or_default(),
            resources: said.resources,
            duration: said.duration.unwrap_or_default(),
            anytime: said.anytime,
            unknown_after_failure: said.unknown_after_failure,
            given: said.given.into_iter().map(|(input, said)| (input, said.into())).collect(),
        }
    }
}

impl From<v1::ActionAnnotations> for Annotations {
    fn from(said: v1::ActionAnnotations) -> Annotations {
        let list = |said: Vec<String>, is_none: bool| (is_none || !said.is_empty()).then_some(said);
        Annotations {
            computes: said.computes,
            reads: list(said.reads, said.reads_nothing),
            senses: said.senses,
            requires: said.requires,
            effects: list(said.effects, said.changes_nothing),
            resources: said.resources,
            duration: Some(said.duration).filter(|duration| !duration.is_empty()),
            anytime: said.anytime,
            unknown_after_failure: said.unknown_after_failure,
            given: said.given.into_iter().map(|(input, said)| (input, said.into())).collect(),
        }
    }
}

impl TryFrom<v1::DescribeResponse> for WorkerDescription {
    type Error = DescriptionError;

    /// Accepts only descriptions within the limits.
    fn try_from(said: v1::DescribeResponse) -> Result<WorkerDescription, DescriptionError> {
        let mut actions = BTreeMap::new();
        for action in said.actions {
            let signature = match action.signature {
                Some(signature) => Some(read(&action.name, action.description, signature)?),
                None => None,
            };
            actions.insert(action.name, signature);
        }
        let description = WorkerDescription { provider: said.provider, kind: said.kind, actions };
        description.check().map(|()| description)
    }
}

fn read(action: &str, description: String, said: v1::ActionSignature) -> Result<ActionSignature, DescriptionError> {
    let mut signature = ActionSignature { outcomes: said.outcomes, description, ..ActionSignature::default() };
    for port in said.inputs {
        let of_type = of_type(action, &port)?;
        if !port.default_value.is_empty() {
            signature.defaults.insert(port.name.clone(), port.default_value);
        }
        let ports = if port.optional { &mut signature.optional } else { &mut signature.inputs };
        once(action, ports.insert(port.name.clone(), of_type), port.name)?;
    }
    for port in said.outputs {
        let of_type = of_type(action, &port)?;
        once(action, signature.outputs.insert(port.name.clone(), of_type), port.name)?;
    }
    if let Some(said) = said.annotations {
        signature.annotations = said.into();
    }
    Ok(signature)
}

fn of_type(action: &str, port: &v1::PortDescription) -> Result<ratn_model::value::Type, DescriptionError> {
    port.r#type.parse().map_err(|_| DescriptionError::Type {
        action: shown(action),
        port: shown(&port.name),
        why: format!("`{}` is no type", shown(&port.r#type)),
    })
}

fn once<T>(action: &str, before: Option<T>, port: String) -> Result<(), DescriptionError> {
    let twice = || DescriptionError::Port { action: shown(action), port: shown(&port) };
    before.map_or(Ok(()), |_| Err(twice()))
}

/// A text from outside, cut to fit into a message.
fn shown(said: &str) -> String {
    said.chars().take(64).map(|c| if c.is_control() { '?' } else { c }).collect()
}
