//! Rendering of what a depth camera sees, and detection of objects in it.
//!
//! Two halves that share only the camera model and the shapes of objects ([`model`]). [`render`] casts rays through a list of bodies and [`noise`] adds the
//! errors of a real sensor: the cell uses them. [`shapes`] and [`sensor`] do the same, but harder for the detector: objects with details that no model has, and
//! noise with tails, correlated neighbours and flying pixels. [`detection`] goes from a depth image back to objects on a supporting surface: the detector uses
//! it. It gets only the image, the camera's pose, the robot's own body ([`mask`]) and a rough idea of where to look, never the ground truth. [`picture`] and
//! [`photograph`] make PNG files to look at, [`trial`] random tables for measurements. Everything is a pure function of its arguments, seeds included.

pub mod calibration;
pub mod camera;
pub mod detection;
pub mod mask;
pub mod model;
pub mod noise;
pub mod photograph;
pub mod picture;
pub mod render;
pub mod sensor;
pub mod shapes;
pub mod trial;

mod cluster;
mod edge;
mod fit;
mod flying;
mod level;
mod normal;
mod plane;
mod quantile;
mod rectangle;
mod silhouette;
mod vector;
mod view;
