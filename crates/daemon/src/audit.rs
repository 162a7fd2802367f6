//! The audit log, as in every server ([`ratn_worker::audit`]); this module also writes it to the file that
//! a daemon's config names.

pub use ratn_worker::audit::*;
