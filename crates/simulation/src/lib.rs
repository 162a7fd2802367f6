//! All cores together in virtual time: the executive, the resource pool and the world, with providers that answer after as
//! many virtual seconds as an [`run::Oracle`] decides.
//!
//! Nothing here waits, opens a socket or reads a clock: the same program, oracle and seed give exactly the same events.
//! [`tables`] replays the paper's tables in this way; the property tests compare the two modes.

pub mod activities;
pub mod dice;
pub mod jobshop;
pub mod psplib;
pub mod run;
pub mod sequential;
pub mod several;
pub mod tables;
pub mod timed;
