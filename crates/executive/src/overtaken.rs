//! Whether a commit that a run has not made yet is still valid after the run lost the leases under which it was decided.

use ratn_model::expression::EffectExpr;
use ratn_model::expression::scope::NothingKnown;
use ratn_model::fact::{Change, FactKey};
use ratn_model::program::{Nature, Program, State, StateKind};

/// Whether another writer's change of `key` affects a commit that overwrites this fact or was computed from it. `writer` is the path of the committing
/// state, with visits; a routine that only computes commits what its parts have changed. An argument that only the run knew stands for every fact of its
/// predicate.
#[must_use]
pub fn was_overtaken(program: &Program, writer: &str, changes: &[Change], key: &FactKey) -> bool {
    let parts = writer.split('/').map(|part| part.split(['[', '#']).next().unwrap_or(part));
    let path = parts.collect::<Vec<_>>().join("/");
    let state = program.states.iter().find(|state| state.path == path);
    let parts = state.filter(|state| commits_for_its_parts(program, state)).into_iter();
    let parts = parts.flat_map(|routine| program.states.iter().filter(|part| is_inside(program, part, routine)));
    let effects = state.into_iter().chain(parts).flat_map(|state| state.annotations.effects.values());
    let mut looked_up = effects.flat_map(|effects| EffectExpr::fact_expressions(effects));
    changes.iter().any(|change| change.pattern().matches(key))
        || looked_up.any(|fact| fact.pattern(&NothingKnown).matches(key))
}

/// Whether the parts of a state commit nothing themselves: it is a routine without motions.
fn commits_for_its_parts(program: &Program, state: &State) -> bool {
    let acts = |part: &State| {
        let is_action = matches!(part.kind, StateKind::Action { .. }) && !part.is_pause();
        is_action && part.annotations.nature == Nature::Irreversible
    };
    state.is_routine() && !program.states.iter().any(|part| acts(part) && is_inside(program, part, state))
}

fn is_inside(program: &Program, part: &State, state: &State) -> bool {
    let mut around = std::iter::successors(part.parent, |id| program.state(*id).parent);
    around.any(|id| id == state.id)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]

    use super::*;
    use ratn_model::catalogue::Catalogue;
    use ratn_model::fact::Term;
    use ratn_model::value::Value;

    #[test]
    fn what_changes_overwrite_and_what_they_are_made_of_overtakes_them_and_nothing_else_does() {
        let text = r#"
task: count
world: ["tools(rack) = 1", "boxes(rack) = 2", "cups(rack) = 3"]
states:
  - part:
      states:
        - count: { action: gripper/release, pia: true, effects: ["tools(rack) = boxes(rack) + 1"], resources: [{ block: Gripper }] }
        - each: { for: 'place in [rack]', do: [write: { action: gripper/release, pia: true, effects: ["tools(rack) = boxes($place)"], resources: [{ block: Gripper }] }] }
        - other: { action: gripper/release, pia: true, effects: ["tools(rack) = cups(rack)"], resources: [{ block: Gripper }] }
  - total:
      routine: true
      states:
        - add: { states: [], effects: ["tools(rack) = boxes(rack) + 1"] }
  - act:
      routine: true
      states:
        - add: { action: gripper/release, pia: true, effects: ["tools(rack) = boxes(rack) + 1"], resources: [{ block: Gripper }] }
"#;
        let program = ratn_model::load::load(text, "count.yaml", &Catalogue::standard()).unwrap().program;
        let fact =
            |name: &str, of: &str| FactKey { predicate: name.to_owned(), arguments: vec![Term::Name(of.to_owned())] };
        let changes = [Change::Set { fact: fact("tools", "rack"), value: Value::Int(3) }];
        let overtaken = |name: &str, of| was_overtaken(&program, "part#2/count", &changes, &fact(name, of));
        assert!(overtaken("tools", "rack") && overtaken("boxes", "rack"));
        assert!(!overtaken("cups", "rack") && !overtaken("tools", "deck") && !overtaken("boxes", "deck"));
        // A routine that computes commits for its parts; one that acts does not.
        let overtaken = |path: &str, name: &str| was_overtaken(&program, path, &changes, &fact(name, "rack"));
        assert!(overtaken("total#3", "boxes") && !overtaken("total", "cups"));
        assert!(!overtaken("act", "boxes"));
        // Only the run knew which place it is.
        assert!(was_overtaken(&program, "part#2/each[0]/write", &changes, &fact("boxes", "deck")));
    }
}
