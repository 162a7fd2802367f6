//! The simplest robot, for tests whose answers are known: a ball that slides along the axes. It is text, for tests within the crate, too.

/// Of the ball, in metres.
pub(crate) const RADIUS: f64 = 0.05;

/// The robot in URDF, with the first axes of the world, from -2 to 2 m each.
pub(crate) fn urdf(axes: usize) -> String {
    let mut urdf = String::from("<robot name='ball'><link name='l0'/>");
    for (i, axis) in ["1 0 0", "0 1 0", "0 0 1"].iter().enumerate().take(axes) {
        let shape = if i + 1 == axes {
            format!("<collision><geometry><sphere radius='{RADIUS}'/></geometry></collision>")
        } else {
            String::new()
        };
        urdf += &format!(
            "<link name='l{}'>{shape}</link><joint name='j{i}' type='prismatic'><parent link='l{i}'/>\
             <child link='l{}'/><axis xyz='{axis}'/><limit lower='-2' upper='2' effort='1' velocity='1'/></joint>",
            i + 1,
            i + 1
        );
    }
    urdf + "</robot>"
}
