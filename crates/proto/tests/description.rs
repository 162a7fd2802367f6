//! What a worker says of itself, on the wire: within the bounds, or refused by name.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

use prost::Message;
use ratn_model::catalogue::{ActionSignature, Annotations, WorkerDescription};
use ratn_proto::v1;

fn signature() -> ActionSignature {
    let port = |name: &str, of_type: &str| [(name.to_owned(), of_type.parse().unwrap())].into();
    ActionSignature {
        inputs: port("at", "pose"),
        optional: port("tries", "int"),
        outputs: port("text", "list<string>"),
        outcomes: vec!["unreadable".to_owned()],
        defaults: [("tries".to_owned(), "3".to_owned())].into(),
        annotations: Annotations { computes: true, reads: Some(vec!["at(?)".to_owned()]), ..Annotations::default() },
        ..ActionSignature::default()
    }
}

fn said(name: &str, description: &str) -> v1::ActionDescription {
    v1::ActionDescription {
        name: name.to_owned(),
        description: description.to_owned(),
        cancel_when_abandoned: true,
        signature: Some(signature().into()),
    }
}

#[test]
fn a_description_comes_back_the_same() {
    let response = v1::DescribeResponse {
        resource_id: "labels-1@compute".to_owned(),
        actions: vec![said("read", ""), v1::ActionDescription { signature: None, ..said("old", "") }],
        provider: "labels".to_owned(),
        kind: "LabelReader".to_owned(),
    };
    let described = WorkerDescription::try_from(response).unwrap();
    assert_eq!((described.provider.as_str(), described.kind.as_str()), ("labels", "LabelReader"));
    assert_eq!(described.actions["read"], Some(signature()));
    assert_eq!(described.actions["old"], None);
}

#[test]
fn a_hostile_description_is_refused_by_name() {
    let refused = |action: v1::ActionDescription| {
        let response = v1::DescribeResponse { actions: vec![action], ..v1::DescribeResponse::default() };
        WorkerDescription::try_from(response).unwrap_err().to_string()
    };
    let with = |edit: fn(&mut v1::ActionSignature)| {
        let mut action = said("read", "");
        edit(action.signature.as_mut().unwrap());
        refused(action)
    };
    assert!(with(|s| s.inputs[0].r#type = "list<".repeat(9_000)).starts_with("action `read`: port `at`: `list<list<"));
    assert!(with(|s| s.inputs.push(s.inputs[0].clone())).contains("`at` twice"));
    assert!(
        with(|s| s.outputs[0].name = "\u{1b}[2J".to_owned()).contains("its port `?[2J` of action `read` is no name")
    );
    assert!(with(|s| s.outcomes = vec!["x".to_owned(); 200]).contains("at most 128"));
    assert!(refused(said(&"x".repeat(65), "")).contains("is no name"));
    assert!(refused(said("read", "two\nlines")).contains("its description of action `read`"));
    // Whatever the bytes are, there is an answer.
    for seed in 0..2_000_u32 {
        let bytes: Vec<u8> = (0..64).map(|i| (seed.wrapping_mul(2_654_435_761).rotate_left(i) >> 7) as u8).collect();
        if let Ok(response) = v1::DescribeResponse::decode(bytes.as_slice()) {
            let _ = WorkerDescription::try_from(response);
        }
    }
}
