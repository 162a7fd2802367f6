//! Access control: roles as in every server ([`ratn_worker::access`]), and what a daemon's config and its resource pool add
//! to them.

pub use ratn_worker::access::*;

use crate::config::{Check, ConfigError, rule};
use ratn_resources::Speaker;

impl Check for AccessConfig {
    fn check(&self) -> Result<(), ConfigError> {
        self.fault().map_or(Ok(()), |(key, broken)| rule(key, false, broken))
    }
}

/// The caller as the resource pool knows it.
pub(crate) fn speaker(caller: &Caller) -> Speaker {
    Speaker { name: caller.name.clone(), for_anybody: caller.is_operator() }
}
