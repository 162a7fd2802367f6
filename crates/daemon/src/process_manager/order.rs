//! The start order of templates: no worker of a template is started before each template in its `after` has a
//! ready worker.

use super::template::Template;
use crate::config::{ConfigError, rule};
use std::collections::{BTreeMap, BTreeSet};

/// Refuses orders that could never start: templates that do not exist, that have no worker without demand, or
/// that wait for each other.
pub(super) fn check(templates: &[Template]) -> Result<(), ConfigError> {
    let by_name: BTreeMap<&str, &Template> =
        templates.iter().map(|template| (template.name.as_str(), template)).collect();
    for (i, template) in templates.iter().enumerate() {
        let key = format!("template[{i}].after");
        for name in &template.after {
            let first = by_name.get(name.as_str());
            rule(&key, first.is_some(), format!("there is no template `{name}`"))?;
            let unasked = first.is_some_and(|first| first.min > 0);
            rule(&key, unasked, format!("`{name}` has min = 0: nobody would start one"))?;
        }
        rule(&key, !waits_for_itself(template, &by_name), format!("`{}` would wait for itself", template.name))?;
    }
    Ok(())
}

fn waits_for_itself(template: &Template, by_name: &BTreeMap<&str, &Template>) -> bool {
    let mut seen = BTreeSet::new();
    let mut next: Vec<&str> = template.after.iter().map(String::as_str).collect();
    while let Some(name) = next.pop() {
        if name == template.name {
            return true;
        }
        if seen.insert(name) {
            next.extend(by_name.get(name).into_iter().flat_map(|first| &first.after).map(String::as_str));
        }
    }
    false
}

#[cfg(test)]
mod tests {
    use super::*;

    fn refused(after: [(&str, u32, &[&str]); 2]) -> Option<String> {
        let template = |(name, min, after): (&str, u32, &[&str])| Template {
            min,
            after: after.iter().map(|&name| name.to_owned()).collect(),
            ..Template::new(name, "Any")
        };
        check(&after.map(template)).err().map(|error| error.to_string())
    }

    #[test]
    fn what_could_never_start_is_refused() {
        assert_eq!(refused([("a", 1, &[]), ("b", 0, &["a"])]), None);
        assert_eq!(
            refused([("a", 1, &["c"]), ("b", 1, &[])]).as_deref(),
            Some("`template[0].after`: there is no template `c`")
        );
        let nobody = "`template[1].after`: `a` has min = 0: nobody would start one";
        assert_eq!(refused([("a", 0, &[]), ("b", 1, &["a"])]).as_deref(), Some(nobody));
        let itself = "`template[0].after`: `a` would wait for itself";
        assert_eq!(refused([("a", 1, &["b"]), ("b", 1, &["a"])]).as_deref(), Some(itself));
    }
}
