//! What a depth camera sees, and what can be told from it.
//!
//! Two halves that share only the camera model and the shapes of things ([`model`]). [`render`] casts rays through a list of
//! bodies and [`noise`] spoils the result as a real sensor would: the cell uses them. [`shapes`] and [`sensor`] do the same with less
//! in the detector's favour: things with details that no model has, and noise with tails, neighbours alike and flying pixels. [`detection`] goes from a depth image
//! back to objects on a supporting surface: the detector uses it. Detection gets nothing but the image, the camera's pose, the
//! robot's own body ([`mask`]) and a rough idea of where to look; ground truth never enters. [`picture`] and [`photograph`] make PNG files to
//! look at, [`trial`] random tables to measure by. Everything is a pure function of its arguments, seeds included.

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
mod rectangle;
mod silhouette;
mod vector;
mod view;
