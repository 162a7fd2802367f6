//! The scene that follows its world is the one that is made anew; a delta leads from any scene to any other.

#![allow(clippy::unwrap_used, reason = "a test may panic")]

use proptest::prelude::*;
use ratn_model::fact::{Change, FactKey, FactPattern, Term};
use ratn_model::pose::Pose;
use ratn_model::value::Value;
use ratn_world::scene::delta::{DeltaError, SceneDelta, Scenes};
use ratn_world::scene::live::LiveScene;
use ratn_world::scene::{MAX_STACK, Placement, Scene, SceneError, Shape};
use ratn_world::world::World;

fn key(predicate: &str, arguments: &[&str]) -> FactKey {
    let arguments = arguments.iter().map(|name| Term::Name((*name).to_owned())).collect();
    FactKey { predicate: predicate.to_owned(), arguments }
}

fn set(predicate: &str, arguments: &[&str], value: Value) -> Change {
    Change::Set { fact: key(predicate, arguments), value }
}

fn pose(x: f64, y: f64, z: f64) -> Value {
    Value::Pose(Pose::at(x, y, z))
}

fn cube() -> Value {
    Shape::Box { size: [0.1; 3] }.to_value()
}

/// A tray on the table, a cup on the tray, a spoon in the cup.
fn breakfast() -> World {
    let mut world = World::default();
    let changes = [
        set("shape", &["tray"], cube()),
        set("at", &["tray"], pose(1.0, 0.0, 0.5)),
        set("on", &["tray", "table"], Value::Bool(true)),
        set("shape", &["cup"], cube()),
        set("at", &["cup"], pose(1.1, 0.0, 0.6)),
        set("on", &["cup", "tray"], Value::Bool(true)),
        set("shape", &["spoon"], cube()),
        set("on", &["spoon", "cup"], pose(0.0, 0.0, 0.05)),
    ];
    world.apply(&changes).unwrap();
    world
}

fn placement(world: &World, name: &str) -> Placement {
    Scene::of(world).unwrap().objects.into_iter().find(|object| object.name == name).unwrap().placement
}

fn near(found: Placement, expected: Placement) {
    let close = |p: &Pose, q: &Pose| p.distance(q) < 1e-9 && p.angle(q) < 1e-6;
    let same = match (&found, &expected) {
        (Placement::World(p), Placement::World(q)) | (Placement::Gripper(p), Placement::Gripper(q)) => close(p, q),
        (Placement::Hand { arm, pose: p }, Placement::Hand { arm: other, pose: q }) => arm == other && close(p, q),
        _ => false,
    };
    assert!(same, "{found:?} instead of {expected:?}");
}

#[test]
fn what_stands_on_a_held_thing_is_held_with_it_and_let_go_with_it() {
    let mut world = breakfast();
    near(placement(&world, "cup"), Placement::World(Pose::at(1.1, 0.0, 0.6)));
    near(placement(&world, "spoon"), Placement::World(Pose::at(1.1, 0.0, 0.65)));
    world.apply(&[set("in_gripper", &["tray"], pose(0.0, 0.0, 0.02))]).unwrap();
    near(placement(&world, "tray"), Placement::Gripper(Pose::at(0.0, 0.0, 0.02)));
    near(placement(&world, "cup"), Placement::Gripper(Pose::at(0.1, 0.0, 0.12)));
    near(placement(&world, "spoon"), Placement::Gripper(Pose::at(0.1, 0.0, 0.17)));
    world.apply(&[Change::Delete { pattern: FactPattern::of(&key("in_gripper", &["tray"])) }]).unwrap();
    near(placement(&world, "cup"), Placement::World(Pose::at(1.1, 0.0, 0.6)));
    world.apply(&[set("in_gripper", &["tray", "left"], pose(0.0, 0.0, 0.02))]).unwrap();
    let held = |z: f64| Placement::Hand { arm: "left".to_owned(), pose: Pose::at(0.1, 0.0, z) };
    near(placement(&world, "cup"), held(0.12));
    near(placement(&world, "spoon"), held(0.17));
}

#[test]
fn a_circle_and_a_stack_that_is_too_high_are_named() {
    let mut world = breakfast();
    world
        .apply(&[set("on", &["tray", "spoon"], Value::Bool(true)), set("on", &["tray", "table"], Value::Bool(false))])
        .unwrap();
    assert!(matches!(Scene::of(&world), Err(SceneError::Circle { .. })));
    assert!(matches!(LiveScene::of(&world), Err(SceneError::Circle { .. })));
    let name = |i: usize| format!("plate_{i:03}");
    let stack: Vec<Change> = (0..=MAX_STACK + 1)
        .flat_map(|i| [set("shape", &[&name(i)], cube()), set("on", &[&name(i), &name(i + 1)], pose(0.0, 0.0, 0.1))])
        .collect();
    let stacked = World::default().project(&stack).unwrap();
    let error = Scene::of(&stacked).unwrap_err();
    assert!(matches!(&error, SceneError::Circle { individual } if individual.starts_with("plate_")), "{error}");
}

#[test]
fn a_change_that_makes_no_geometry_leaves_the_scene_as_it_was() {
    let world = breakfast();
    let mut scene = LiveScene::of(&world).unwrap();
    let before = scene.clone();
    let changes = [set("at", &["cup"], pose(0.0, 0.0, 0.0)), set("at", &["tray"], Value::Int(3))];
    let after = world.project(&changes).unwrap();
    assert!(matches!(scene.update(&world, &after, &changes), Err(SceneError::Malformed { .. })));
    assert_eq!((&scene, scene.digest()), (&before, before.digest()));
}

#[test]
fn a_goal_in_a_scene_of_a_thousand_objects_is_sent_what_moved() {
    let name = |i: usize| format!("box_{i:04}");
    let all: Vec<Change> = (0..1000)
        .flat_map(|i| [set("shape", &[&name(i)], cube()), set("at", &[&name(i)], pose(i as f64, 0.0, 0.0))])
        .collect();
    let world = World::default().project(&all).unwrap();
    let known = LiveScene::of(&world).unwrap();
    let mut next = known.clone();
    let changes = [
        set("in_gripper", &[&name(7)], pose(0.0, 0.0, 0.1)),
        set("on", &[&name(8), &name(7)], pose(0.0, 0.0, 0.1)),
        Change::Delete { pattern: FactPattern::of(&key("shape", &[&name(9)])) },
        set("weight", &[&name(10)], Value::Int(3)),
        set("at", &["base"], pose(0.5, 0.0, 0.0)),
    ];
    let after = world.project(&changes).unwrap();
    assert_eq!(next.update(&world, &after, &changes).unwrap(), 4, "two boxes, one that is gone, and the base");
    let delta = SceneDelta::between(&known, &next);
    assert_eq!((delta.gone.len(), delta.changed.len()), (1, 2));
    let mut worker = Scenes::new(2);
    assert!(matches!(worker.apply(&delta), Err(DeltaError::OtherBase { .. })), "it knows none yet");
    assert_eq!(worker.apply(&SceneDelta::whole(&known)).unwrap().objects.len(), 1000);
    assert_eq!(*worker.apply(&delta).unwrap(), Scene::of(&after).unwrap());
    assert_eq!(worker.get(known.digest()).unwrap().objects.len(), 1000);
    assert_eq!(worker.digests().collect::<Vec<_>>(), [known.digest(), next.digest()]);
    let forged = SceneDelta { to: known.digest(), from: Some(next.digest()), ..delta };
    assert!(matches!(forged.apply(&next), Err(DeltaError::OtherResult { .. })));
}

fn name() -> impl Strategy<Value = &'static str> {
    prop_oneof![Just("a"), Just("b"), Just("c"), Just("d"), Just("base")]
}

fn change() -> impl Strategy<Value = Change> {
    let coordinate = || (0_i32..3).prop_map(f64::from);
    let place = || (coordinate(), coordinate()).prop_map(|(x, y)| pose(x, y, 0.0));
    prop_oneof![
        2 => (name(), 1_u8..4).prop_map(|(o, i)| set("shape", &[o], Shape::Box { size: [f64::from(i); 3] }.to_value())),
        4 => (name(), place()).prop_map(|(o, p)| set("at", &[o], p)),
        2 => (name(), place()).prop_map(|(o, p)| set("in_gripper", &[o], p)),
        2 => (name(), prop_oneof![Just("left"), Just("right")], place()).prop_map(|(o, arm, p)| set("in_gripper", &[o, arm], p)),
        3 => (name(), name()).prop_filter("no circles", |(o, c)| o < c).prop_map(|(o, c)| set("on", &[o, c], Value::Bool(true))),
        2 => (name(), name(), place()).prop_filter("no circles", |(o, c, _)| o < c).prop_map(|(o, c, p)| set("on", &[o, c], p)),
        1 => (name(), name()).prop_map(|(o, c)| set("on", &[o, c], Value::Bool(false))),
        1 => name().prop_map(|o| set("weight", &[o], Value::Int(1))),
        2 => (prop_oneof![Just("at"), Just("in_gripper"), Just("shape")], prop::option::of(name())).prop_map(|(p, o)| {
            let argument = o.map(|o| Term::Name(o.to_owned()));
            Change::Delete { pattern: FactPattern { predicate: p.to_owned(), arguments: vec![argument] } }
        }),
        1 => (prop::option::of(name()), prop::option::of(Just("left"))).prop_map(|(o, arm)| {
            let arguments = [o, arm].map(|name| name.map(|name| Term::Name(name.to_owned()))).to_vec();
            Change::Delete { pattern: FactPattern { predicate: "in_gripper".to_owned(), arguments } }
        }),
        1 => (prop::option::of(name()), prop::option::of(name())).prop_map(|(o, c)| {
            let arguments = [o, c].map(|name| name.map(|name| Term::Name(name.to_owned()))).to_vec();
            Change::Delete { pattern: FactPattern { predicate: "on".to_owned(), arguments } }
        }),
    ]
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 400, ..ProptestConfig::default() })]

    #[test]
    fn following_every_change_comes_to_the_scene_made_anew(
        lists in prop::collection::vec(prop::collection::vec(change(), 0..5), 1..10),
        commits in any::<[bool; 10]>(),
    ) {
        let mut world = World::default();
        let mut scene = LiveScene::default();
        let mut versions = vec![scene.clone()];
        for (changes, commit) in lists.iter().zip(commits) {
            let before = world.clone();
            if commit {
                world.apply(changes).unwrap();
            } else {
                world = world.project(changes).unwrap();
            }
            scene.update(&before, &world, changes).unwrap();
            let anew = LiveScene::of(&world).unwrap();
            prop_assert_eq!(&scene, &anew);
            prop_assert_eq!(scene.digest(), anew.digest());
            prop_assert_eq!(scene.scene(), Scene::of(&world).unwrap());
            versions.push(scene.clone());
        }
        for from in &versions {
            for to in &versions {
                prop_assert_eq!(from.digest() == to.digest(), from == to);
                let delta = SceneDelta::between(from, to);
                prop_assert_eq!(delta.is_empty(), from.scene().objects == to.scene().objects);
                prop_assert_eq!(&delta.apply(from).unwrap(), to);
            }
            prop_assert_eq!(&SceneDelta::whole(from).apply(&versions[0]).unwrap(), from);
        }
    }
}
