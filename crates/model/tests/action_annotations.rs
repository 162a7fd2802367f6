//! What an action says in the catalogue is in force for the states that perform it, as if each had said it.

#![allow(clippy::unwrap_used, reason = "a test may panic")]

use ratn_model::catalogue::Catalogue;
use ratn_model::in_force::in_force;
use ratn_model::load::load;
use ratn_model::program::Program;

fn program(states: &str) -> Program {
    let task = format!(
        "task: t\nworld: [\"hand_empty(gripper)\", \"at(box_1) = pose(0, 0, 0)\", \"posture(arm) = home\"]\nstates:\n{states}"
    );
    match load(&task, "t.yaml", &Catalogue::standard()) {
        Ok(loaded) => loaded.program,
        Err(findings) => panic!("{findings:#?}\n{task}"),
    }
}

/// What is in force, without who says it.
fn held(states: &str) -> Vec<(String, &'static str, String)> {
    let told = in_force(&program(states)).into_iter();
    told.flat_map(|state| state.lines.into_iter().map(move |line| (state.state.clone(), line.key, line.text))).collect()
}

/// What the catalogue says of a motion of the arm that fails.
const ARM_UNKNOWN: &str = "aborted: delete arm_at(arm); preempted: delete arm_at(arm)";

const GRASP: &str = "
  - plan: { action: path_planner/plan, in: { start: \"joints(0, 0, 0, 0, 0, 0, 0)\", goal: \"joints(1, 0, 0, 0, 0, 0, 0)\" } }
  - for: name in [box_1]
    do:
      - grasp:
          action: gripper/grasp
          in: { object: $name, expected: plan.end_pose }";

#[test]
fn a_state_that_says_nothing_is_as_one_that_says_what_its_action_does() {
    let whole = format!(
        "{}
          pia: true
          reads: [at(base), at($name)]
          requires: [hand_empty(gripper)]
          effects: [\"in_gripper($name) = plan.end_pose\", not hand_empty(gripper)]
          resources: [{{ block: Arm }}, {{ block: Gripper }}]
          duration: 1.1
",
        GRASP.replace(
            " } }\n",
            " }, computes: true, reads: [scene], resources: [{ block: PathPlanner }, world_model] }\n"
        )
    );
    assert_eq!(held(&format!("{GRASP}\n")), held(&whole));
}

#[test]
fn what_a_state_says_stands_in_place_and_its_effects_are_added() {
    let states = "
  - tuck:
      action: arm/move_to
      in: { joints: \"joints(1, 0, 0, 0, 0, 0, 0)\" }
      reads: [\"at(table)\"]
      effects: [\"posture(arm) = tucked\"]
  - back:
      action: arm/move_to
      in: { joints: \"joints(0, 0, 0, 0, 0, 0, 0)\" }
      effects: [\"arm_at(arm) = home\", \"posture(arm) = home\"]
  - left:
      action: arm/move_to
      in: { joints: \"joints(0, 0, 0, 0, 0, 0, 0)\" }
      effects: { success: [\"arm_at(left) = out\"], aborted: [\"posture(arm) = lost\"] }
      resources: [{ block: Arm, where: { arm: left } }]
";
    let held = held(states);
    let of =
        |state: &str, key: &str| held.iter().find(|(s, k, _)| s == state && *k == key).map(|(.., text)| text.as_str());
    assert_eq!(of("tuck", "reads"), Some("at(table)"));
    let added = format!("set arm_at(arm) = joints(1, 0, 0, 0, 0, 0, 0); set posture(arm) = tucked; {ARM_UNKNOWN}");
    assert_eq!(of("tuck", "effects"), Some(&*added), "a fact of one's own does not hide that the arm has moved");
    let back = format!("set arm_at(arm) = home; set posture(arm) = home; {ARM_UNKNOWN}");
    assert_eq!(of("back", "effects"), Some(&*back));
    let left =
        "set arm_at(left) = out; aborted: set posture(arm) = lost; delete arm_at(left); preempted: delete arm_at(left)";
    assert_eq!(of("left", "effects"), Some(left), "of two arms, the one it names");
    assert_eq!(of("left", "resources"), Some("block Arm where arm = left"));
}

#[test]
fn where_an_arm_is_after_a_motion_that_failed_is_unknown_unless_the_state_says_it() {
    let states = "
  - watched:
      action: arm/move_to
      in: { joints: \"joints(0, 0, 0, 0, 0, 0, 0)\" }
      while: [\"exists at(box_1)\"]
  - told:
      action: arm/move_to
      in: { joints: \"joints(0, 0, 0, 0, 0, 0, 0)\" }
      effects: { success: [\"arm_at(arm) = home\"], aborted: [\"arm_at(arm) = beside\"] }
  - nowhere:
      action: arm/move_to
      in: { joints: \"joints(0, 0, 0, 0, 0, 0, 0)\" }
      effects: []
";
    let effects = |state: &str| {
        let program = program(states);
        let found = program.states.iter().find(|known| known.path == state).unwrap();
        let texts = |effects: &Vec<_>| effects.iter().map(ToString::to_string).collect::<Vec<String>>();
        found.annotations.effects.iter().map(|(outcome, effects)| (outcome.clone(), texts(effects))).collect::<Vec<_>>()
    };
    let of = |outcome: &str, effect: &str| (outcome.to_owned(), vec![effect.to_owned()]);
    let deleted = |outcome: &str| of(outcome, "delete arm_at(arm)");
    let zero = "set arm_at(arm) = joints(0, 0, 0, 0, 0, 0, 0)";
    assert_eq!(
        effects("watched"),
        [deleted("aborted"), deleted("preempted"), of("success", zero), deleted("violated")]
    );
    let beside = of("aborted", "set arm_at(arm) = beside");
    assert_eq!(effects("told"), [beside, deleted("preempted"), of("success", "set arm_at(arm) = home")]);
    // What success does not change, and so says nothing of: it adds to the action's.
    assert_eq!(effects("nowhere"), [deleted("aborted"), deleted("preempted"), of("success", zero)]);
}

#[test]
fn what_is_said_of_an_input_stands_in_place_where_a_state_gives_it() {
    let grasp = |hand: &str| {
        let state = format!(
            "  - grasp: {{ action: gripper/grasp, in: {{ object: box_1, expected: \"pose(0, 0, 0.02)\"{hand} }} }}\n"
        );
        let task = format!("task: t\nworld: [\"hand_empty(right)\", \"hand_empty(gripper)\"]\nstates:\n{state}");
        let loaded = load(&task, "t.yaml", &Catalogue::standard()).unwrap();
        assert_eq!(loaded.warnings.len(), 0, "{:#?}", loaded.warnings);
        let lines = in_force(&loaded.program).remove(0).lines;
        let of = |key: &str| lines.iter().find(|line| line.key == key).unwrap().text.clone();
        [of("requires"), of("effects"), of("reads")]
    };
    let own = "set in_gripper(box_1) = pose(0, 0, 0.02); delete hand_empty(gripper)";
    assert_eq!(grasp(""), ["hand_empty(gripper)", own, "at(base); at(box_1)"]);
    assert_eq!(grasp(", hand: null"), grasp(""));
    let right = "set in_gripper(box_1, right) = pose(0, 0, 0.02); delete hand_empty(right)";
    assert_eq!(grasp(", hand: right"), ["hand_empty(right)", right, "at(base); at(box_1)"]);
}

#[test]
fn what_an_action_says_of_an_output_that_the_state_does_not_take_is_not_in_force() {
    let task = "task: t\nstates:\n  - where: { action: arm/where, out: {} }\n";
    let loaded = load(task, "t.yaml", &Catalogue::standard()).unwrap();
    let told: Vec<&str> = loaded.warnings.iter().map(|warning| warning.rule.as_ref()).collect();
    assert!(told.contains(&"annotation-not-in-force"), "{:#?}", loaded.warnings);
    assert!(!loaded.program.states[1].annotations.effects.contains_key("success"), "it may change everything");
}

const EYE: &str = "[resources.Eye]\nclass = \"module\"\ncount = 1\n[providers.eye]\nresource = \"Eye\"\n[providers.eye.actions.look]\n\
    inputs = { times = \"int\" }\noptional = { at = \"string\" }\noutputs = {}\n";

#[test]
fn variables_inside_of_an_input_are_none_of_the_annotation_that_it_stands_in() {
    let requires = "annotations = { resources = [\"Eye\"], requires = [\"len(find(?x, at(?x), $times > 1)) > 0\"] }\n";
    let catalogue = Catalogue::from_toml(&format!("{EYE}{requires}")).unwrap();
    let task = "task: t\nworld: [at(a) = 1, at(b) = 2]\nstates:\n  - look: { action: eye/look, in: { times: \"len(find(?x, at(?x)))\" } }\n";
    let program = load(task, "t.yaml", &catalogue).unwrap().program;
    let told = in_force(&program);
    let required = told[0].lines.iter().find(|line| line.key == "requires").unwrap();
    // There are two, whatever ?x is outside.
    assert_eq!(required.text, "len(find(?x, at(?x), len(find(?x of times, at(?x of times))) > 1)) > 0");
}

#[test]
fn an_input_that_is_null_is_not_given() {
    let reads = "annotations = { resources = [\"Eye\"], reads = [\"at($at)\"] }\n";
    let catalogue = Catalogue::from_toml(&format!("{EYE}{reads}")).unwrap();
    let task = "task: t\nstates:\n  - look: { action: eye/look, in: { times: 1, at: null } }\n";
    let loaded = load(task, "t.yaml", &catalogue).unwrap();
    let told: Vec<&str> = loaded.warnings.iter().map(|warning| warning.rule.as_ref()).collect();
    assert!(told.contains(&"annotation-not-in-force"), "{:#?}", loaded.warnings);
    assert_eq!(loaded.program.states[1].annotations.reads, None, "it may read everything");
}

#[test]
fn a_catalogue_whose_annotations_do_not_read_is_refused_with_action_key_and_text() {
    let refused = |annotations: &str| {
        let text = format!(
            "[resources.Eye]\nclass = \"module\"\ncount = 1\n[providers.eye]\nresource = \"Eye\"\n[providers.eye.actions.look]\n\
             inputs = {{ at = \"pose\" }}\noutputs = {{ seen = \"bool\" }}\nannotations = {{ {annotations} }}\n"
        );
        Catalogue::from_toml(&text).unwrap_err().to_string()
    };
    let port = refused("reads = [\"at($too)\"]");
    assert!(
        port.contains("eye/look") && port.contains("`reads: at($too)`") && port.contains("no input `too`"),
        "{port}"
    );
    let state = refused("effects = [\"seen(box) = plan.end\"]");
    assert!(state.contains("an action knows no states"), "{state}");
    let both = refused("computes = true, effects = [\"seen(box)\"]");
    assert!(both.contains("what only computes has no effects"), "{both}");
    let other = refused("resources = [\"Arm\"]");
    assert!(other.contains("lacks `Eye`"), "{other}");
    let predicate = refused("unknown_after_failure = [\"arm_at(arm)\"]");
    assert!(predicate.contains("write its name alone"), "{predicate}");
    let required = refused("given = { at = { reads = [] } }");
    assert!(required.contains("no optional input"), "{required}");
}

#[test]
fn the_digest_of_a_task_covers_what_its_actions_say() {
    let task = "task: t\nstates:\n  - feel: { action: gripper/feel }\n";
    let mut other = Catalogue::standard();
    let feel = other.providers.get_mut("gripper").unwrap().actions.get_mut("feel").unwrap();
    feel.annotations.duration = Some("3".to_owned());
    let digest = |catalogue: &Catalogue| load(task, "t.yaml", catalogue).unwrap().program.digest;
    assert_ne!(digest(&Catalogue::standard()), digest(&other));
    // One that says all of it itself is the same, whatever the catalogue says.
    let whole = "task: t\nstates:\n  - feel: { action: gripper/feel, reads: [], effects: [], resources: [Gripper], duration: 1 }\n";
    let digest = |catalogue: &Catalogue| load(whole, "t.yaml", catalogue).unwrap().program.digest;
    assert_eq!(digest(&Catalogue::standard()), digest(&other));
}

#[test]
fn what_is_in_force_of_an_action_is_so_item_by_item() {
    // The effect that needs `expected` is one that the state says itself; that the hand is not empty any more holds all the same.
    let task = "task: t\nworld: [\"hand_empty(gripper)\", \"at(cup) = pose(0.8, 0, 0.7)\"]\nstates:\n  - grasp: { action: gripper/grasp, in: { object: cup }, effects: [\"in_gripper(cup) = pose(0, 0, 0)\"] }\n";
    let loaded = load(task, "t.yaml", &Catalogue::standard()).unwrap();
    assert!(loaded.warnings.is_empty(), "{:?}", loaded.warnings);
    let effects = &loaded.program.states[1].annotations.effects["success"];
    let effects: Vec<String> = effects.iter().map(ToString::to_string).collect();
    assert_eq!(effects.len(), 2, "{effects:?}");
    // An effect that the state neither has what it needs for nor says itself is told of.
    let task = "task: t\nworld: [\"hand_empty(gripper)\", \"at(cup) = pose(0.8, 0, 0.7)\"]\nstates:\n  - grasp: { action: gripper/grasp, in: { object: cup }, effects: [\"tried(cup)\"] }\n";
    let loaded = load(task, "t.yaml", &Catalogue::standard()).unwrap();
    assert_eq!(loaded.warnings.len(), 1, "{:?}", loaded.warnings);
    assert_eq!(loaded.warnings[0].rule, "annotation-not-in-force");
}

#[test]
fn each_requirement_stands_for_itself_and_no_effects_are_something_said() {
    let mut catalogue = Catalogue::standard();
    let grasp = catalogue.providers.get_mut("gripper").unwrap().actions.get_mut("grasp").unwrap();
    grasp.annotations.requires.push("$expected.z < 0.1".to_owned());
    let task = "task: t\nworld: [\"hand_empty(gripper)\"]\nstates:\n  - grasp: { action: gripper/grasp, in: { object: cup }, effects: [\"in_gripper(cup) = pose(0, 0, 0)\"] }\n";
    let loaded = load(task, "t.yaml", &catalogue).unwrap();
    let required: Vec<String> = loaded.program.states[1].annotations.requires.iter().map(ToString::to_string).collect();
    assert_eq!(required, ["hand_empty(gripper)"]);
    assert_eq!(loaded.warnings.len(), 1, "{:?}", loaded.warnings);
    let task = "task: t\nstates:\n  - look: { action: camera/capture, effects: { aborted: [] } }\n";
    let loaded = load(task, "t.yaml", &Catalogue::standard()).unwrap();
    let effects = &loaded.program.states[1].annotations.effects;
    assert!(effects["success"].is_empty() && effects["aborted"].is_empty());
}

/// What an action says is read with what the state gives its inputs in it: neither may make something boundless of the other.
#[test]
fn what_an_action_says_of_large_inputs_has_a_bound() {
    let ports = vec!["len($a)"; 100].join(" + ");
    let catalogue = format!(
        "[resources]\nBrain = {{ class = \"process\", count = 1 }}\n[providers.brain]\nresource = \"Brain\"\n\
         [providers.brain.actions.think]\noptional = {{ a = \"any\" }}\n\
         annotations = {{ computes = true, reads = [], requires = [\"{ports} > 0\", \"{ports} >= 0\"], resources = [\"Brain\"] }}\n"
    );
    let catalogue = Catalogue::from_toml(&catalogue).unwrap();
    let found = |items: usize| {
        let list = vec!["$n"; items].join(", ");
        let task = format!(
            "task: t\nvariables: {{ n: 1 }}\nstates:\n  - think: {{ action: brain/think, in: {{ a: '[{list}]' }} }}\n"
        );
        load(&task, "t.yaml", &catalogue).err().map(|found| found[0].to_string())
    };
    assert_eq!(found(18), None);
    let refused = found(50).unwrap_or_default();
    assert!(refused.contains("with what the state gives its inputs, this has more than 2000 parts"), "{refused}");
}
