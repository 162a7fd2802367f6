//! The task model: what a task program *is*.
//!
//! Contains the values that flow between states, the expression grammar, the tree of states with its annotations
//! ([`program::Program`]), the catalogue of a system, loading from YAML and the rules of `check`. It has no clock,
//! socket, process or world: facts are only named here; they are stored in `ratn-world`.

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
