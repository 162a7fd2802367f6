//! Any text as the section of any daemon: taken, or refused with a reason.
#![no_main]

use libfuzzer_sys::fuzz_target;
use ratn_cell::config::CellConfig;
use ratn_daemon::config::Check;
use ratn_daemon::process_manager::ProcessManagerConfig;
use ratn_daemon::resource_manager::ResourceManagerConfig;
use ratn_daemon::service::ServiceConfig;
use ratn_daemon::world_pool::WorldPoolConfig;
use serde::de::DeserializeOwned;

fn read<C: DeserializeOwned>(text: &str, check: impl FnOnce(&C) -> Result<(), String>) {
    if let Err(reason) = toml::from_str(text).map_err(|error| error.to_string()).and_then(|config| check(&config)) {
        assert!(!reason.is_empty());
    }
}

fn of_a_daemon<C: DeserializeOwned + Check>(text: &str) {
    read::<C>(text, |config| config.check().map_err(|error| error.to_string()));
}

fuzz_target!(|text: &str| {
    of_a_daemon::<ResourceManagerConfig>(text);
    of_a_daemon::<WorldPoolConfig>(text);
    of_a_daemon::<ProcessManagerConfig>(text);
    of_a_daemon::<ServiceConfig>(text);
    read::<CellConfig>(text, |config| config.check().map_err(|error| error.to_string()));
});
