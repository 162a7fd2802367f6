//! Robot kinematics, collision, path planning and time parameterisation.
//!
//! A pure library: no clock, no threads, no ambient randomness. The caller says through a callback when time is up, and
//! hands in the seed.

pub mod aimm;
pub mod arm;
pub mod base;
mod branches;
pub mod cloud;
mod collada;
pub mod collision;
pub mod connect;
pub mod constrained;
mod cubic;
pub mod depth;
pub mod drive;
mod elbow;
mod ellipsoid;
pub mod exact;
mod frame;
pub mod geometry;
pub mod heightfield;
pub mod inside;
pub mod line;
pub mod mechanism;
pub mod mesh;
pub mod mesh_files;
mod obj;
mod occupied;
pub mod pace;
pub mod plan;
pub mod point_files;
pub mod problems;
pub mod reach;
pub mod refine;
mod request;
pub mod robot;
pub mod rrt_star;
mod simd;
pub mod simplify;
mod sobol;
pub mod space;
pub mod spheres;
mod spherical;
pub mod surface;
pub mod surroundings;
pub mod timing;
pub mod trajectory;
mod tree;
pub mod trial;
mod urdf;
mod urdf_faults;
pub mod validate;
