//! The bundled workers: path planner and detector.
