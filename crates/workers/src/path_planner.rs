//! The path planner worker (being written).
