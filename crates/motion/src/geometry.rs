//! Primitive shapes, and their conversion to parry3d.

use parry3d::shape::SharedShape;
use ratn_model::pose::Pose;

/// A primitive shape fixed to a link.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Body {
    /// Its pose in the link's frame.
    pub pose: Pose,
    /// Its shape.
    pub geometry: Geometry,
}

/// A primitive, centred at the origin, with its axis along z. In metres.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Geometry {
    /// A cuboid.
    Box {
        /// Half of the edge lengths along x, y, z.
        half: [f64; 3],
    },
    /// A cylinder.
    Cylinder {
        /// Radius.
        radius: f64,
        /// Half of its length.
        half_length: f64,
    },
    /// A cylinder with half spheres at both ends.
    Capsule {
        /// Radius.
        radius: f64,
        /// Half of the distance between the centres of the half spheres.
        half_length: f64,
    },
    /// A sphere.
    Sphere {
        /// Radius.
        radius: f64,
    },
}

impl Body {
    /// Its pose with the axis along z, for cylinders too.
    pub fn upright(&self) -> Pose {
        self.pose.compose(&self.geometry.turn().inverse())
    }
}

impl Geometry {
    /// The shape for parry3d, grown by `padding` metres on every side.
    pub fn shape(&self, padding: f64) -> SharedShape {
        match *self {
            Geometry::Box { half } => {
                let [x, y, z] = half.map(|h| (h + padding) as f32);
                SharedShape::cuboid(x, y, z)
            }
            Geometry::Cylinder { radius, half_length } => {
                // parry's cylinder is along y; `turn` rotates ours to it.
                SharedShape::cylinder((half_length + padding) as f32, (radius + padding) as f32)
            }
            Geometry::Capsule { radius, half_length } => {
                SharedShape::capsule_z(half_length as f32, (radius + padding) as f32)
            }
            Geometry::Sphere { radius } => SharedShape::ball((radius + padding) as f32),
        }
    }

    /// The geometry grown by `padding` metres on every side.
    pub(crate) fn grown(&self, padding: f64) -> Geometry {
        match *self {
            Geometry::Box { half } => Geometry::Box { half: half.map(|h| h + padding) },
            Geometry::Cylinder { radius, half_length } => {
                Geometry::Cylinder { radius: radius + padding, half_length: half_length + padding }
            }
            Geometry::Capsule { radius, half_length } => Geometry::Capsule { radius: radius + padding, half_length },
            Geometry::Sphere { radius } => Geometry::Sphere { radius: radius + padding },
        }
    }

    /// The rotation from this primitive's frame to the frame of its shape.
    fn turn(&self) -> Pose {
        match self {
            Geometry::Cylinder { .. } => Pose::from_rpy([0.0; 3], std::f64::consts::FRAC_PI_2, 0.0, 0.0),
            _ => Pose::IDENTITY,
        }
    }

    /// A body of this geometry whose centre is at `pose`, axes along z.
    pub fn at(self, pose: Pose) -> Body {
        Body { pose: pose.compose(&self.turn()), geometry: self }
    }

    /// How far the shape extends from its centre along the axes of the world, at this pose, with its axis along z.
    pub(crate) fn extents(&self, pose: &Pose) -> [f64; 3] {
        let axes = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]].map(|axis| pose.rotate(axis));
        std::array::from_fn(|i| {
            let [x, y, z] = axes.map(|axis| axis[i].abs());
            let disc = x.hypot(y);
            match *self {
                Geometry::Box { half } => x * half[0] + y * half[1] + z * half[2],
                Geometry::Cylinder { radius, half_length } => disc * radius + z * half_length,
                Geometry::Capsule { radius, half_length } => radius + z * half_length,
                Geometry::Sphere { radius } => radius,
            }
        })
    }

    /// The radius of the sphere about the centre that contains the shape.
    pub fn radius(&self) -> f64 {
        match *self {
            Geometry::Box { half: [x, y, z] } => (x * x + y * y + z * z).sqrt(),
            Geometry::Cylinder { radius, half_length } => radius.hypot(half_length),
            Geometry::Capsule { radius, half_length } => radius + half_length,
            Geometry::Sphere { radius } => radius,
        }
    }
}

impl From<&ratn_world::scene::Shape> for Geometry {
    fn from(shape: &ratn_world::scene::Shape) -> Geometry {
        match *shape {
            ratn_world::scene::Shape::Box { size } => Geometry::Box { half: size.map(|s| s / 2.0) },
            ratn_world::scene::Shape::Cylinder { radius, length } => {
                Geometry::Cylinder { radius, half_length: length / 2.0 }
            }
        }
    }
}
