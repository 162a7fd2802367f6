//! The bundled workers: path planner and detector.

pub mod detector;
pub mod path_planner;
