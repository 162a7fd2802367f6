//! Robot kinematics, collision, path planning and time parameterisation.
