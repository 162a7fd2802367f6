//! The window of task node instances, and the sequential interpreter.
