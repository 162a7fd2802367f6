//! The daemons: resource manager, world pool, process manager.
