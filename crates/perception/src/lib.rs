//! What a depth camera sees, and what can be told from it.
//!
//! Two halves that share only the camera model. [`render`] casts rays through a list of bodies and [`noise`] spoils the
//! result as a real sensor would: the cell uses them. [`detection`] goes from a depth image back to boxes on a supporting
//! plane: the detector uses it. Detection gets nothing but the image, the camera's pose and a rough idea of where to look;
//! ground truth never enters. Everything is a pure function of its arguments, seeds included.

pub mod camera;
pub mod detection;
pub mod noise;
pub mod render;

mod cluster;
mod fit;
mod plane;
mod rectangle;
mod vector;
