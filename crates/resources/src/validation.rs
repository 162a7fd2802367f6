//! What every request is checked for before it is looked at: names, amounts, numbers of things.

use crate::error::{PoolError, malformed};
use crate::pool::Pool;
use ratn_model::resource::{Quantity, Requirement, ResourceOperation};

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
        for requirement in requirements {
            if !allowed.contains(&requirement.operation) {
                let names: Vec<String> = allowed.iter().map(ToString::to_string).collect();
                return Err(malformed(&requirement.to_string(), &format!("only {} here", names.join(", "))));
            }
            self.check_name("kind", &requirement.kind)?;
            if requirement.count.is_zero() || requirement.count > Quantity::whole(self.limits.units) {
                return Err(malformed(
                    &requirement.to_string(),
                    &format!("more than nothing and at most {} units", self.limits.units),
                ));
            }
            self.check_attributes(requirement.attributes.keys())?;
            let conditions: Vec<&String> = requirement.conditions.iter().map(|c| &c.attribute).collect();
            self.check_attributes(conditions.into_iter())?;
        }
        Ok(())
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

    pub(crate) fn check_name(&self, what: &str, name: &str) -> Result<(), PoolError> {
        if name.is_empty() || name.chars().count() > self.limits.name_length || name.chars().any(char::is_control) {
            let rule = format!("1 to {} characters, none of them a control character", self.limits.name_length);
            let shown: String = name.chars().take(self.limits.name_length).flat_map(char::escape_debug).collect();
            return Err(malformed(&format!("{what} `{shown}`"), &rule));
        }
        Ok(())
    }
}
