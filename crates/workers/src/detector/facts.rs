//! The facts about detected objects that a goal writes into the world: measured values, each with its uncertainty.
//!
//! The goal's input `measures` names the predicates, because its state declares them as effects: `at`, the pose with its covariance, and
//! `shape`, with the confidence that the object is of the class whose shape it is.

use ratn_model::fact::{FactKey, Term};
use ratn_model::measurement::Certainty;
use ratn_model::value::Value;
use ratn_perception::detection::{Detection, Model};
use ratn_worker::action::{ActionFailure, GoalContext, GoalOutcome};
use ratn_world::scene::Shape;

/// A predicate that can be written.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Fact {
    At,
    Shape,
}

/// The predicates that a goal writes.
#[derive(Debug, Clone, Default)]
pub(super) struct Facts(Vec<Fact>);

impl Facts {
    /// The predicates in the goal's input; none without it.
    pub(super) fn of(goal: &GoalContext) -> Result<Facts, ActionFailure> {
        let Some(port) = goal.port("measures").optional() else { return Ok(Facts::default()) };
        let names = port.list()?.iter().map(|name| name.string()).collect::<Result<Vec<_>, _>>()?;
        Facts::named(&names)
    }

    fn named(names: &[&str]) -> Result<Facts, ActionFailure> {
        let known = |name: &&str| match *name {
            "at" => Ok(Fact::At),
            "shape" => Ok(Fact::Shape),
            other => {
                Err(ActionFailure::aborted(format!("input `measures` has `{other}`: what is measured is at and shape")))
            }
        };
        names.iter().map(known).collect::<Result<_, _>>().map(Facts)
    }

    /// Adds the measured facts of an object to the outcome.
    pub(super) fn write(&self, outcome: GoalOutcome, id: &str, object: &Detection) -> GoalOutcome {
        self.0.iter().fold(outcome, |outcome, fact| {
            let key = |predicate: &str| FactKey {
                predicate: predicate.to_owned(),
                arguments: vec![Term::Name(id.to_owned())],
            };
            match fact {
                Fact::At => {
                    let covariance = Certainty::Covariance(object.covariance.into_iter().flatten().collect());
                    outcome.with_certain(key("at"), Value::Pose(object.pose), covariance)
                }
                Fact::Shape => {
                    let confidence = Certainty::Confidence(object.confidence.clamp(0.0, 1.0));
                    outcome.with_certain(key("shape"), shape(&object.model).to_value(), confidence)
                }
            }
        })
    }
}

/// The shape that a planner avoids. For a hollow or thin object it is the enclosing shape.
fn shape(model: &Model) -> Shape {
    match *model {
        Model::Round { radius, height, .. } => Shape::Cylinder { radius, length: height },
        Model::Box { .. } | Model::Fork { .. } => Shape::Box { size: model.size() },
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;
    use ratn_model::pose::Pose;
    use ratn_perception::model::Round;

    #[test]
    fn what_is_asked_for_is_measured_with_its_certainty_and_nothing_else() {
        let mut covariance = [[0.0; 6]; 6];
        covariance[0][1] = 2e-6;
        let model = Model::Round { kind: Round::Cup, radius: 0.04, height: 0.1 };
        let object = Detection { model, pose: Pose::at(0.8, 0.1, 0.75), covariance, confidence: 0.9 };
        let written = |names: &[&str]| Facts::named(names).unwrap().write(GoalOutcome::success(), "cup_1", &object);
        assert_eq!(written(&[]), GoalOutcome::success());
        let outcome = written(&["at", "shape"]);
        let [(at, pose), (_, around)] = &outcome.measured[..] else { panic!("{outcome:?}") };
        assert_eq!((at.to_string().as_str(), pose), ("at(cup_1)", &Value::Pose(object.pose)));
        assert_eq!(around, &Shape::Cylinder { radius: 0.04, length: 0.1 }.to_value());
        let certainties: Vec<_> =
            outcome.evidence.iter().map(|(_, measured)| measured.certainty.clone().unwrap()).collect();
        let Certainty::Covariance(entries) = &certainties[0] else { panic!("{certainties:?}") };
        assert_eq!((entries.len(), entries[1]), (36, 2e-6));
        assert_eq!(certainties[1], Certainty::Confidence(0.9));
        assert!(matches!(Facts::named(&["colour"]), Err(ActionFailure::Aborted(why)) if why.contains("colour")));
    }
}
