//! What is computed for several configurations at once: collision of postures along an edge ([`kernel`]), with clouds of points too
//! ([`cloud`]), nearest neighbours ([`nearest`]). [`lanes`] has the vectors and picks the instructions at run time.

mod cloud;
mod kernel;
mod lanes;
mod nearest;

pub(crate) use cloud::{Cloud, Filling, Layout};
pub(crate) use kernel::{Compiled, Edge, Frame, Group, Obstacle, Rigid, Row, Scratch, SelfPair};
pub(crate) use lanes::Block;
#[allow(unreachable_pub, reason = "`space` makes it public")]
pub use lanes::Isa;
