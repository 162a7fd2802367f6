//! Logs of a daemon: to standard error, filtered by `RATN_LOG` (as `info,ratn_daemon=debug`), by default `info`.

use tracing_subscriber::EnvFilter;

/// The environment variable with the filter.
pub const FILTER_VARIABLE: &str = "RATN_LOG";

/// Starts logging for the process; a second call does nothing.
pub fn start() {
    let filter = EnvFilter::try_from_env(FILTER_VARIABLE).unwrap_or_else(|_| EnvFilter::new("info"));
    let subscriber = tracing_subscriber::fmt().with_env_filter(filter).with_writer(std::io::stderr).with_ansi(false);
    // It would say on the same standard error, and panic, that nothing can be written there.
    let subscriber = subscriber.log_internal_errors(false);
    // Fails only where logging was started before: then that one stays.
    let _ = subscriber.try_init();
}
