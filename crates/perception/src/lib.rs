//! Depth rendering, segmentation and pose estimation.
