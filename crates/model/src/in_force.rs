//! The annotations in force for each state that performs an action, and their origin: the state, its action in the catalogue, or a default.
//! Helps to find out why a state waits.

use crate::check::{name_state, named};
use crate::expression::{EffectExpr, Expr, FactExpr};
use crate::program::{Annotations, Nature, Origin, Program, ResourceExpr, SUCCESS, StateKind, WORLD_MODEL};
use crate::resource::Quantity;
use serde::Serialize;
use std::fmt::Display;

/// The annotations of one state.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct InForce {
    /// Its path.
    pub state: String,
    /// `provider/action`
    pub action: String,
    /// Its annotations.
    pub lines: Vec<Line>,
}

/// One annotation.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Line {
    /// The key of a task file.
    pub key: &'static str,
    /// Its value as in a task file; `everything`, `nothing` or `unknown` if there is no text.
    pub text: String,
    /// Where it comes from; `None` for a default.
    pub from: Option<Origin>,
}

/// The annotations in force for every state that performs an action, in program order.
pub fn in_force(program: &Program) -> Vec<InForce> {
    let states = program.states.iter().filter(|state| !state.is_pause());
    let of_state = states.filter_map(|state| match &state.kind {
        StateKind::Action { provider, action, .. } => Some(InForce {
            state: state.path.clone(),
            action: format!("{provider}/{action}"),
            lines: lines(program, &state.annotations),
        }),
        _ => None,
    });
    of_state.collect()
}

fn lines(program: &Program, said: &Annotations) -> Vec<Line> {
    let line = |key: &'static str, text: String| Line { key, text, from: said.origin.get(key).copied() };
    let name = |expr: &mut Expr| expr.rewrite(&mut |part| name_state(program, part));
    let facts = |facts: &[FactExpr]| listed(facts, |fact| fact.arguments.iter_mut().flatten().for_each(name));
    let changed = |effects: &[EffectExpr]| listed(effects, |effect| effect.each_expression_mut(&mut |part| name(part)));
    let unknown = || "unknown".to_owned();
    let everything = || "everything".to_owned();
    // Other outcomes are listed only if they change something.
    let mut effects = vec![said.effects.get(SUCCESS).map_or_else(everything, |effects| changed(effects))];
    let others = said.effects.iter().filter(|(outcome, effects)| *outcome != SUCCESS && !effects.is_empty());
    effects.extend(others.map(|(outcome, effects)| format!("{outcome}: {}", changed(effects))));
    // A projection that is only implied gets a line of its own.
    let implied = said.origin.get(WORLD_MODEL).copied();
    let (room, own): (Vec<ResourceExpr>, Vec<ResourceExpr>) =
        said.resources.iter().cloned().partition(|line| implied.is_some() && line.kind == WORLD_MODEL);
    let mut all = vec![
        match &said.nature {
            Nature::Computes => line("computes", "true".to_owned()),
            Nature::Senses(sensed) => line("senses", facts(sensed)),
            Nature::Irreversible => line("pia", "true".to_owned()),
        },
        line("reads", said.reads.as_ref().map_or_else(everything, |read| facts(read))),
        line("requires", listed(&said.requires, name)),
        line("effects", effects.join("; ")),
        line("resources", if own.is_empty() { "nothing".to_owned() } else { resources(program, &own) }),
        line("duration", said.duration_s.as_ref().map_or_else(unknown, |duration| named(program, duration))),
    ];
    if implied.is_some() {
        all.push(Line { key: "resources", text: resources(program, &room), from: implied });
    }
    if said.anytime {
        all.push(line("anytime", "true".to_owned()));
    }
    if !said.holds.is_empty() {
        all.push(line("while", listed(&said.holds, name)));
    }
    all
}

/// `block Arm where arm = left; consume 0.2 Battery`
fn resources(program: &Program, lines: &[ResourceExpr]) -> String {
    let shown = |line: &ResourceExpr| {
        let count = if line.count == Quantity::ONE { String::new() } else { format!("{} ", line.count) };
        let attributes = line.attributes.iter().map(|(name, value)| format!("{name} = {}", named(program, value)));
        let selected: Vec<String> = attributes.chain(line.conditions.iter().map(ToString::to_string)).collect();
        let selected = if selected.is_empty() { String::new() } else { format!(" where {}", selected.join(", ")) };
        format!("{} {count}{}{selected}", line.operation, line.kind)
    };
    lines.iter().map(shown).collect::<Vec<_>>().join("; ")
}

/// A list as text, with the names of states instead of their ids.
fn listed<T: Display + Clone>(items: &[T], name: impl Fn(&mut T)) -> String {
    if items.is_empty() {
        return "nothing".to_owned();
    }
    let mut items = items.to_vec();
    items.iter_mut().for_each(name);
    let texts: Vec<String> = items.iter().map(ToString::to_string).collect();
    texts.join("; ")
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::catalogue::Catalogue;
    use crate::load::load;

    /// The text `s1.` is also how an output of the first state would be displayed.
    #[test]
    fn a_text_that_looks_like_a_state_stays_what_it_is() {
        let task = r#"
task: t
states:
  - plan: { action: path_planner/plan, in: { start: "joints(0, 0, 0, 0, 0, 0, 0)", goal: "joints(1, 0, 0, 0, 0, 0, 0)" } }
  - follow:
      action: arm/follow
      in: { trajectory: plan.trajectory }
      requires: ["concat('pos1.', s1) != 'bus1.2' or plan.length_rad > 1"]
      effects: ["at(box, 'pos1.') = plan.end_pose"]
"#;
        let program = load(task, "t.yaml", &Catalogue::standard()).map(|loaded| loaded.program);
        let told = in_force(&program.unwrap_or_else(|found| panic!("{found:?}")));
        let of = |key: &str| told[1].lines.iter().find(|line| line.key == key).map(|line| line.text.clone());
        assert_eq!(of("requires").as_deref(), Some("concat(\"pos1.\", s1) != \"bus1.2\" or plan.length_rad > 1"));
        assert!(
            of("effects").is_some_and(|effects| effects.contains("at(box, \"pos1.\") = plan.end_pose")),
            "{told:?}"
        );
    }

    #[test]
    fn who_reads_facts_ahead_of_its_place_has_a_projection_whether_or_not_it_is_said() {
        let catalogue = r#"
[resources]
Brain = { class = "process", count = 2 }
WorldModel = { class = "world", count = 8 }
[providers.brain]
resource = "Brain"
actions.think = {}
actions.plan.annotations = { computes = true, reads = ["at(?)"], resources = ["Brain"] }
"#;
        let task = r#"
task: t
states:
  - says_it: { action: brain/think, computes: true, reads: ['at(?)'], resources: [Brain, world_model] }
  - reads: { action: brain/think, computes: true, reads: ['at(?)'], resources: [Brain] }
  - by_its_action: { action: brain/plan }
  - everything: { action: brain/think, computes: true, resources: [Brain] }
  - looks: { action: brain/think, senses: ['light()'], reads: ['at(?)'], effects: [], resources: [Brain] }
  - nothing: { action: brain/think, computes: true, reads: [], in: {}, resources: [Brain] }
  - only_senses: { action: brain/think, senses: ['light()'], effects: [], resources: [Brain] }
  - acts: { action: brain/think, pia: true, reads: ['at(?)'], effects: [], resources: [Brain] }
  - around:
      reads: ['at(?)']
      states:
        - inside: { action: brain/think, computes: true, reads: [], resources: [Brain] }
"#;
        let catalogue = Catalogue::from_toml(catalogue).unwrap_or_else(|error| panic!("{error}"));
        let program = load(task, "t.yaml", &catalogue).map(|loaded| loaded.program);
        let told = in_force(&program.unwrap_or_else(|found| panic!("{found:?}")));
        let lines = told.iter().flat_map(|state| {
            let resources = state.lines.iter().filter(|line| line.key == "resources");
            resources.map(|line| format!("{}: {} ({:?})", state.state, line.text, line.from))
        });
        insta::assert_snapshot!(lines.collect::<Vec<_>>().join("\n"), @r"
        says_it: block Brain; block WorldModel (Some(State))
        reads: block Brain (Some(State))
        reads: block WorldModel (Some(Reads))
        by_its_action: block Brain (Some(Action))
        by_its_action: block WorldModel (Some(Reads))
        everything: block Brain (Some(State))
        everything: block WorldModel (Some(Reads))
        looks: block Brain (Some(State))
        looks: block WorldModel (Some(Reads))
        nothing: block Brain (Some(State))
        only_senses: block Brain (Some(State))
        acts: block Brain (Some(State))
        around/inside: block Brain (Some(State))
        around/inside: block WorldModel (Some(Reads))
        ");
    }

    #[test]
    fn what_is_in_force_is_told_with_who_says_so() {
        let task = r#"
task: t
world: ["hand_empty(gripper)", "at(box_1) = pose(0, 0, 0)"]
states:
  - plan: { action: path_planner/plan, in: { start: "joints(0, 0, 0, 0, 0, 0, 0)", goal: "joints(1, 0, 0, 0, 0, 0, 0)" }, duration: 2 }
  - grasp:
      action: gripper/grasp
      in: { object: box_1, expected: plan.end_pose }
      pia: true
"#;
        let catalogue = Catalogue::standard();
        let program =
            load(task, "t.yaml", &catalogue).map(|loaded| loaded.program).unwrap_or_else(|found| panic!("{found:?}"));
        let told: Vec<String> = in_force(&program)
            .into_iter()
            .flat_map(|state| state.lines.into_iter().map(move |line| (state.state.clone(), line)))
            .map(|(state, line)| format!("{state} {}: {} ({:?})", line.key, line.text, line.from))
            .collect();
        insta::assert_snapshot!(told.join("\n"), @r"
        plan computes: true (Some(Action))
        plan reads: at(?); shape(?); in_gripper(?); in_gripper(?, ?); on(?, ?) (Some(Action))
        plan requires: nothing (None)
        plan effects: nothing (None)
        plan resources: block PathPlanner; block WorldModel (Some(Action))
        plan duration: 2 (Some(State))
        plan anytime: true (Some(Action))
        grasp pia: true (Some(State))
        grasp reads: at(base); at(box_1) (Some(Action))
        grasp requires: hand_empty(gripper) (Some(Action))
        grasp effects: set in_gripper(box_1) = plan.end_pose; delete hand_empty(gripper) (Some(Action))
        grasp resources: block Arm; block Gripper (Some(Action))
        grasp duration: 1.1 (Some(Action))
        ");
    }
}
