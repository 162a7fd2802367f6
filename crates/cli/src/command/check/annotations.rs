//! `ratn check --annotations`: the annotations in force for each state, and their origin.

use crate::failure::Failure;
use crate::output;
use ratn_model::in_force::{InForce, in_force};
use ratn_model::program::{Origin, Program};

/// Prints them, as JSON where requested.
pub(super) fn print(program: &Program, json: bool) -> Result<(), Failure> {
    let states = in_force(program);
    let text = match json {
        true => serde_json::to_string_pretty(&states)?,
        false => states.iter().map(shown).collect::<Vec<_>>().join("\n\n"),
    };
    output::result(text).map_err(Failure::from)
}

/// ```text
/// grasp: gripper/grasp
///   reads      at($box.id)        (gripper/grasp)
/// ```
fn shown(state: &InForce) -> String {
    let line = |line: &ratn_model::in_force::Line| {
        let from = match line.from {
            Some(Origin::State) => "this state".to_owned(),
            Some(Origin::Action) => state.action.clone(),
            Some(Origin::Both) => format!("this state, and {}", state.action),
            Some(Origin::Reads) => "for what it reads".to_owned(),
            None => "nobody says otherwise".to_owned(),
        };
        format!("  {:<10} {}  ({from})", line.key, line.text)
    };
    let lines: Vec<String> = state.lines.iter().map(line).collect();
    format!("{}: {}\n{}", state.state, state.action, lines.join("\n"))
}
