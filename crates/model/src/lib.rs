//! The task model: what a task program *is*.
//!
//! Owns the values that flow between states, the expression grammar, the tree of states with its annotations
//! ([`program::Program`]), the catalogue of what a system offers, loading from YAML and the rules of `check`.
//! It deliberately knows no clock, no socket, no process and no world: facts are named here, kept in `ratn-world`.

pub mod catalogue;
pub(crate) mod check;
pub mod condition;
pub mod diagnostic;
pub mod expression;
pub mod fact;
pub mod grasp;
pub mod guard;
pub mod id;
pub mod in_force;
pub mod list;
pub mod load;
pub mod measurement;
pub mod name;
pub mod ontology;
pub mod parameters;
pub mod pose;
pub mod program;
pub mod readable;
pub mod resource;
pub mod slot;
pub mod time;
pub mod tolerance;
pub mod value;
pub mod versioned;
pub mod wait;
