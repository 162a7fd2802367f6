//! An example task, checked against the standard catalogue, for tests.

use ratn_model::catalogue::Catalogue;
use ratn_model::program::Program;

pub(crate) const FETCH_BOXES: &str = include_str!("../../../examples/fetch_boxes.yaml");

/// Loads a task, which must be valid.
pub(crate) fn program(text: &str) -> Program {
    match ratn_model::load::load(text, "fetch_boxes.yaml", &Catalogue::standard()) {
        Ok(loaded) => loaded.program,
        Err(findings) => panic!("{findings:?}"),
    }
}
