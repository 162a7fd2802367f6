//! The audit log, as in every server ([`ratn_worker::audit`]); a daemon writes it to the file that its
//! config names.

pub use ratn_worker::audit::*;
