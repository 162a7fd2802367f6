//! Validation of every request before it is handled: names, amounts, numbers of items.

use crate::assignment::selects_the_same;
use crate::error::{PoolError, malformed};
use crate::pool::Pool;
use crate::resource::{ENDPOINT_ATTRIBUTE, ResourceSpec};
use ratn_model::name::{KIND_RULE, is_kind, is_unseen};
use ratn_model::resource::{Quantity, Requirement, ResourceOperation};
use ratn_model::value::Value;
use ratn_model::versioned;
use serde::Serialize;

/// Maximum length of an endpoint.
const ENDPOINT_BYTES: usize = 1_024;

impl Pool {
    pub(crate) fn check_requirements(
        &self,
        requirements: &[Requirement],
        allowed: &[ResourceOperation],
    ) -> Result<(), PoolError> {
        if requirements.len() > self.limits.requirements {
            let rule = format!("at most {}", self.limits.requirements);
            return Err(malformed(&format!("{} requirements", requirements.len()), &rule));
        }
        let units: Quantity = requirements.iter().map(|requirement| requirement.count).sum();
        if units > Quantity::whole(self.limits.units_per_request) {
            let rule = format!("at most {} in one request: ask in several", self.limits.units_per_request);
            return Err(malformed(&format!("{units} units"), &rule));
        }
        for requirement in requirements {
            if !allowed.contains(&requirement.operation) {
                let names: Vec<String> = allowed.iter().map(ToString::to_string).collect();
                return Err(malformed(&requirement.to_string(), &format!("only {} here", names.join(", "))));
            }
            self.check_kind(&requirement.kind)?;
            if requirement.count.is_zero() || requirement.count > Quantity::whole(self.limits.units) {
                return Err(malformed(
                    &requirement.to_string(),
                    &format!("more than nothing and at most {} units", self.limits.units),
                ));
            }
            self.check_attributes(requirement.attributes.keys())?;
            let conditions: Vec<&String> = requirement.conditions.iter().map(|c| &c.attribute).collect();
            self.check_attributes(conditions.into_iter())?;
            let bytes = written_bytes(requirement);
            if bytes > self.limits.requirement_bytes {
                let what = format!("{} {}: {bytes} bytes", requirement.operation, requirement.kind);
                return Err(malformed(&what, &format!("at most {} in a requirement", self.limits.requirement_bytes)));
            }
        }
        self.check_work(requirements)
    }

    /// Checks that the search for what these requirements select is not too much work.
    fn check_work(&self, requirements: &[Requirement]) -> Result<(), PoolError> {
        let mut comparisons = 0_usize;
        for (index, requirement) in requirements.iter().enumerate() {
            if !requirements[..index].iter().any(|before| selects_the_same(before, requirement)) {
                let of_each = requirement.attributes.len() + requirement.conditions.len();
                comparisons += self.resources.count(&requirement.kind) * of_each;
            }
        }
        if comparisons > self.limits.comparisons {
            let what = format!("{comparisons} comparisons of attributes with resources");
            let rule =
                format!("at most {} for one request: ask with fewer attributes or conditions", self.limits.comparisons);
            return Err(malformed(&what, &rule));
        }
        Ok(())
    }

    /// Checks that a resource is small enough to be stored and reported.
    pub(crate) fn check_size(&self, spec: &ResourceSpec) -> Result<(), PoolError> {
        let name = || spec.id.as_ref().unwrap_or(&spec.kind);
        let bytes = written_bytes(spec);
        if bytes > self.limits.resource_bytes {
            let rule = format!("at most {} in a resource with its attributes", self.limits.resource_bytes);
            return Err(malformed(&format!("resource `{}`: {bytes} bytes", name()), &rule));
        }
        match spec.attributes.get(ENDPOINT_ATTRIBUTE) {
            Some(Value::String(endpoint)) if endpoint.len() > ENDPOINT_BYTES => {
                let what = format!("resource `{}`: {} bytes of `{ENDPOINT_ATTRIBUTE}`", name(), endpoint.len());
                Err(malformed(&what, &format!("at most {ENDPOINT_BYTES}: every lease of it says where it is")))
            }
            _ => Ok(()),
        }
    }

    pub(crate) fn check_attributes<'a>(
        &self,
        mut names: impl ExactSizeIterator<Item = &'a String>,
    ) -> Result<(), PoolError> {
        if names.len() > self.limits.attributes {
            let rule = format!("at most {}", self.limits.attributes);
            return Err(malformed(&format!("{} attributes", names.len()), &rule));
        }
        names.try_for_each(|name| self.check_name("attribute name", name))
    }

    pub(crate) fn check_kind(&self, kind: &str) -> Result<(), PoolError> {
        self.check_name("kind", kind)?;
        if is_kind(kind) { Ok(()) } else { Err(malformed(&format!("kind `{kind}`"), KIND_RULE)) }
    }

    pub(crate) fn check_name(&self, what: &str, name: &str) -> Result<(), PoolError> {
        if name.is_empty() || name.chars().count() > self.limits.name_length || name.chars().any(is_unseen) {
            let rule = format!(
                "1 to {} characters, none of them a control character or one that is not seen",
                self.limits.name_length
            );
            let shown: String = name.chars().take(self.limits.name_length).flat_map(char::escape_debug).collect();
            return Err(malformed(&format!("{what} `{shown}`"), &rule));
        }
        Ok(())
    }
}

/// The size when stored.
fn written_bytes(value: &impl Serialize) -> usize {
    versioned::encode(0, value).len()
}
