//! The worker SDK: serve the action protocol, fence by lease token, cancel.
