//! The audit log, as in every server ([`ratn_worker::audit`]); here a file of a daemon's config is written.

pub use ratn_worker::audit::*;
