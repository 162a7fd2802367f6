//! What is computed for several configurations at once: collision of straight motions ([`sweep`]) by postures along them ([`kernel`]), with clouds
//! of points too ([`cloud`]), nearest neighbours ([`nearest`]). [`lanes`] has the vectors and picks the instructions at run time.

mod cloud;
mod kernel;
mod lanes;
mod nearest;
mod sweep;

pub(crate) use cloud::{Cloud, Filling, Layout};
pub(crate) use kernel::{Among, Compiled, DEPTH, Edge, Frame, Group, Obstacle, Rigid, Row, Scratch, SelfPair};
pub(crate) use lanes::Block;
#[allow(unreachable_pub, reason = "`space` makes it public")]
pub use lanes::Isa;
pub(crate) use sweep::Spans;
