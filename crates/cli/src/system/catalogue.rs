//! A catalogue composed of the built-in one and files. Later ones override earlier ones, action by action and kind by kind.

use crate::input;
use anyhow::Context;
use ratn_model::catalogue::{Catalogue, Provider};
use std::collections::BTreeSet;
use std::collections::btree_map::Entry;
use std::path::Path;

/// The name of the built-in catalogue.
pub(crate) const BUILT_IN: &str = "built-in";
/// Maximum number of files of a catalogue.
const MOST_FILES: usize = 32;

/// Composes the catalogues with these names, in order; also returns the kinds of resources that only the built-in one has. Files are
/// found relative to `folder`.
pub(crate) fn compose(names: &[String], folder: &Path) -> anyhow::Result<(Catalogue, BTreeSet<String>)> {
    anyhow::ensure!(names.len() <= MOST_FILES, "{} catalogues: at most {MOST_FILES} are read", names.len());
    let (mut composed, mut built_in) = (Catalogue::default(), BTreeSet::new());
    for name in names {
        if name == BUILT_IN {
            let standard = Catalogue::standard();
            built_in.extend(standard.resources.keys().cloned());
            extend(&mut composed, standard);
        } else {
            let said = read(&folder.join(name))?;
            built_in.retain(|kind| !said.resources.contains_key(kind));
            extend(&mut composed, said);
        }
    }
    Ok((composed, built_in))
}

/// A catalogue from a file.
pub(crate) fn read(file: &Path) -> anyhow::Result<Catalogue> {
    let text = input::read(file).with_context(|| format!("cannot read the catalogue {}", file.display()))?;
    Catalogue::from_toml(&text).with_context(|| file.display().to_string())
}

/// Adds another catalogue; where both have an entry, the added one wins.
pub(crate) fn extend(catalogue: &mut Catalogue, by: Catalogue) {
    for (name, Provider { resource, joints, chain, actions }) in by.providers {
        match catalogue.providers.entry(name) {
            Entry::Occupied(mut known) => {
                let known = known.get_mut();
                known.resource = resource;
                if joints.is_some() {
                    (known.joints, known.chain) = (joints, chain);
                }
                known.actions.extend(actions);
            }
            Entry::Vacant(place) => {
                place.insert(Provider { resource, joints, chain, actions });
            }
        }
    }
    catalogue.resources.extend(by.resources);
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;

    const INSPECTOR: &str = "[resources.Inspector]\nclass = \"process\"\ncount = 2\n\
        [providers.inspector]\nresource = \"Inspector\"\n[providers.inspector.actions.nearest]\ninputs = { from = \"pose\" }\n";
    const PLANNER: &str = "[providers.path_planner]\nresource = \"PathPlanner\"\n\
        [providers.path_planner.actions.plan]\ninputs = { to = \"pose\" }\n[providers.path_planner.actions.look]\n";

    #[test]
    fn files_extend_the_built_in_catalogue_and_override_it_action_by_action() {
        let folder = tempfile::tempdir().unwrap();
        std::fs::write(folder.path().join("inspector.toml"), INSPECTOR).unwrap();
        std::fs::write(folder.path().join("planner.toml"), PLANNER).unwrap();
        let names = [BUILT_IN, "inspector.toml", "planner.toml"].map(str::to_owned);
        let (composed, built_in) = compose(&names, folder.path()).unwrap();
        assert!(composed.action("inspector", "nearest").is_some());
        assert!(composed.action("path_planner", "plan").unwrap().inputs.contains_key("to"));
        let drive = Catalogue::standard().providers["path_planner"].actions.keys().find(|key| *key != "plan").cloned();
        assert!(drive.is_none_or(|other| composed.action("path_planner", &other).is_some()));
        assert_eq!(composed.providers["path_planner"].joints, Some(7));
        assert!(composed.action("path_planner", "look").is_some());
        assert!(built_in.contains("PathPlanner") && !built_in.contains("Inspector"));
    }

    #[test]
    fn a_catalogue_that_is_not_there_and_one_that_is_none_are_refused_by_name() {
        let folder = tempfile::tempdir().unwrap();
        std::fs::write(folder.path().join("odd.toml"), "[resource.X]\n").unwrap();
        let refused = |name: &str| format!("{:#}", compose(&[name.to_owned()], folder.path()).unwrap_err());
        assert!(refused("absent.toml").contains("cannot read the catalogue"), "{}", refused("absent.toml"));
        assert!(refused("odd.toml").contains("odd.toml: not a catalogue"), "{}", refused("odd.toml"));
    }
}
