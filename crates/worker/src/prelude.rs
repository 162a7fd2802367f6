//! The names that a worker needs: `use ratn_worker::prelude::*`.

pub use crate::action::{Action, ActionFailure, ActionResult, GoalContext, GoalOutcome, Signature};
pub use crate::arguments::{ArgumentError, Arguments};
pub use crate::worker::{Worker, WorkerError};
pub use ratn_model::fact::{FactPattern, Term};
pub use ratn_model::pose::Pose;
pub use ratn_model::value::{Type, Value};
pub use tonic::async_trait;
