//! The resource pool as a state machine: operations, leases, wait queue.
