//! Task control: the shell around the executive. Performs its commands over gRPC and brings the answers back as events.

pub(crate) mod log;
