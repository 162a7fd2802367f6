//! From facts to shapes in their places.

#![allow(clippy::unwrap_used, reason = "a test may panic")]

use ratn_model::fact::{Change, FactKey, FactPattern, Term};
use ratn_model::pose::Pose;
use ratn_model::value::Value;
use ratn_world::scene::{Placement, Scene, SceneError, Shape};
use ratn_world::world::World;

fn key(predicate: &str, individual: &str) -> FactKey {
    FactKey { predicate: predicate.to_owned(), arguments: vec![Term::Name(individual.to_owned())] }
}

fn set(predicate: &str, individual: &str, value: Value) -> Change {
    Change::Set { fact: key(predicate, individual), value }
}

fn world() -> World {
    let mut world = World::default();
    world
        .apply(&[
            set("at", "base", Value::Pose(Pose::at(1.0, 0.0, 0.0))),
            set("at", "box", Value::Pose(Pose::at(0.5, 0.0, 0.75))),
            set("shape", "box", Shape::Box { size: [0.1, 0.2, 0.3] }.to_value()),
            set("shape", "nowhere", Shape::Cylinder { radius: 0.1, length: 0.2 }.to_value()),
            set("at", "slot_1", Value::Pose(Pose::IDENTITY)),
        ])
        .unwrap();
    world
}

#[test]
fn an_object_needs_a_shape_and_a_place() {
    let scene = Scene::of(&world()).unwrap();
    assert_eq!(scene.base, Pose::at(1.0, 0.0, 0.0));
    let names: Vec<&str> = scene.objects.iter().map(|object| object.name.as_str()).collect();
    assert_eq!(names, ["box"]);
    assert_eq!(scene.objects[0].shape, Shape::Box { size: [0.1, 0.2, 0.3] });
}

#[test]
fn a_held_object_is_where_the_gripper_is_until_it_is_let_go() {
    let mut world = world();
    world.apply(&[set("in_gripper", "box", Value::Pose(Pose::at(0.0, 0.0, 0.02)))]).unwrap();
    let placement = Scene::of(&world).unwrap().objects[0].placement.clone();
    assert_eq!(placement, Placement::Gripper(Pose::at(0.0, 0.0, 0.02)));
    world.apply(&[Change::Delete { pattern: FactPattern::of(&key("in_gripper", "box")) }]).unwrap();
    assert_eq!(Scene::of(&world).unwrap().objects[0].placement, Placement::World(Pose::at(0.5, 0.0, 0.75)));
}

#[test]
fn of_several_arms_the_fact_says_whose_hand_it_is_in() {
    let mut world = world();
    let by = |arm: &str| FactKey {
        predicate: "in_gripper".to_owned(),
        arguments: ["box", arm].map(|name| Term::Name(name.to_owned())).to_vec(),
    };
    let placed = |world: &World| Scene::of(world).unwrap().objects[0].placement.clone();
    let held = Pose::at(0.0, 0.0, 0.02);
    world.apply(&[Change::Set { fact: by("right"), value: Value::Pose(held) }]).unwrap();
    assert_eq!(placed(&world), Placement::Hand { arm: "right".to_owned(), pose: held });
    // Who does not say whose hand it is says that of the arm that is planned for, as ever.
    world.apply(&[set("in_gripper", "box", Value::Pose(held))]).unwrap();
    assert_eq!(placed(&world), Placement::Gripper(held));
    world.apply(&[Change::Delete { pattern: FactPattern::of(&key("in_gripper", "box")) }]).unwrap();
    world.apply(&[Change::Delete { pattern: FactPattern::of(&by("right")) }]).unwrap();
    assert_eq!(placed(&world), Placement::World(Pose::at(0.5, 0.0, 0.75)));
    world.apply(&[Change::Set { fact: by("left"), value: Value::Int(3) }]).unwrap();
    let error = Scene::of(&world).unwrap_err();
    assert!(matches!(&error, SceneError::Malformed { fact, .. } if fact == "in_gripper(box, left)"), "{error}");
}

#[test]
fn a_shape_that_is_none_is_named_with_its_fact() {
    let mut world = world();
    world.apply(&[set("shape", "box", Value::map([("type", Value::String("blob".to_owned()))]))]).unwrap();
    let error = Scene::of(&world).unwrap_err();
    assert!(matches!(&error, SceneError::Malformed { fact, .. } if fact == "shape(box)"), "{error}");
}
