//! The simulated cell: robot, table, boxes, sensors and controllers.
