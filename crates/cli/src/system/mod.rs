//! A whole system on this machine: its config, its processes, its endpoint files.
