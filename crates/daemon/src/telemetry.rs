//! Logs of a process: to standard error or the journal, as text or as JSON, filtered by `RATN_LOG` (as `info,ratn_daemon=debug`) or
//! else by the config; and the audit log, in a file of its own.
//!
//! [`Logs::reload`] changes the filter and opens the audit file again (it may have been moved away), nothing else.

use crate::audit;
use serde::{Deserialize, Serialize};
use std::fs::{File, OpenOptions};
use std::io;
use std::os::unix::fs::OpenOptionsExt;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use tracing_subscriber::fmt::MakeWriter;
use tracing_subscriber::layer::SubscriberExt;
use tracing_subscriber::util::SubscriberInitExt;
use tracing_subscriber::{EnvFilter, Layer, Registry, filter, reload};

/// The environment variable with the filter.
pub const FILTER_VARIABLE: &str = "RATN_LOG";

/// The section `[service.log]`. All keys are optional.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct LogConfig {
    /// As `info,ratn_daemon=debug`; `RATN_LOG` overrides it.
    pub filter: String,
    /// How a line looks on standard error.
    pub format: LogFormat,
    /// Where to.
    pub to: LogPlace,
}

/// How a line looks.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum LogFormat {
    /// For people.
    #[default]
    Text,
    /// One object a line.
    Json,
}

/// Where logs go.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum LogPlace {
    /// The journal where standard error is the journal's (a unit of systemd), else standard error.
    #[default]
    Auto,
    /// Standard error.
    Stderr,
    /// systemd's journal, every field for itself.
    Journald,
}

/// Logs that cannot be written as wanted.
#[derive(Debug, thiserror::Error)]
pub enum LogError {
    /// The filter is none.
    #[error("`{filter}` is no log filter; as `info,ratn_daemon=debug`")]
    Filter {
        /// As written.
        filter: String,
        /// Why.
        #[source]
        source: filter::ParseError,
    },
    /// The audit file cannot be opened.
    #[error("cannot append to the audit log {}", file.display())]
    Audit {
        /// Which.
        file: PathBuf,
        /// Why.
        #[source]
        source: io::Error,
    },
    /// There is no journal.
    #[error("cannot write to the journal; `log.to = \"stderr\"` needs none")]
    Journal(#[source] io::Error),
}

/// The logs of this process, once started.
#[derive(Debug)]
pub struct Logs {
    filter: reload::Handle<EnvFilter, Registry>,
    audit: Option<AuditFile>,
}

#[derive(Debug, Clone)]
struct AuditFile {
    path: PathBuf,
    file: Arc<Mutex<File>>,
}

impl Default for LogConfig {
    fn default() -> Self {
        LogConfig { filter: "info".to_owned(), format: LogFormat::Text, to: LogPlace::Auto }
    }
}

/// Starts logging for a process without a config of its own; a second call does nothing.
pub fn start() {
    let started = start_as(&LogConfig::default(), None);
    debug_assert!(started.is_ok() || std::env::var_os(FILTER_VARIABLE).is_some(), "{started:?}");
}

/// Starts logging for a process; where it was started before, that one stays.
///
/// # Errors
/// [`LogError`].
pub fn start_as(config: &LogConfig, audit_file: Option<&Path>) -> Result<Logs, LogError> {
    type Boxed = Box<dyn Layer<Registry> + Send + Sync>;
    let (filter, handle) = reload::Layer::new(filter_of(config)?);
    // It would say on the same standard error, and panic, that nothing can be written there.
    let text = tracing_subscriber::fmt::layer().with_writer(io::stderr).with_ansi(false).log_internal_errors(false);
    let to = match config.to {
        LogPlace::Auto if stderr_is_the_journals() => LogPlace::Journald,
        LogPlace::Auto => LogPlace::Stderr,
        said => said,
    };
    let main: Boxed = match (to, config.format) {
        (LogPlace::Journald, _) => tracing_journald::layer().map_err(LogError::Journal)?.with_filter(filter).boxed(),
        (_, LogFormat::Text) => text.with_filter(filter).boxed(),
        (_, LogFormat::Json) => text.json().flatten_event(true).with_filter(filter).boxed(),
    };
    let audit = audit_file.map(AuditFile::open).transpose()?;
    let audit_layer = audit.clone().map(|file| -> Boxed {
        let only = filter::filter_fn(|metadata| metadata.target() == audit::TARGET);
        let json = tracing_subscriber::fmt::layer().json().flatten_event(true).with_current_span(false);
        let json = json.with_span_list(false).with_target(false).with_level(false).log_internal_errors(false);
        json.with_writer(file).with_filter(only).boxed()
    });
    let layers: Vec<Boxed> = [Some(main), audit_layer].into_iter().flatten().collect();
    // Fails only where logging was started before: then that one stays.
    let _ = tracing_subscriber::registry().with(layers).try_init();
    Ok(Logs { filter: handle, audit })
}

impl Logs {
    /// Takes over the filter, and opens the audit file again.
    ///
    /// # Errors
    /// [`LogError`]; what could not be changed stays as it was.
    pub fn reload(&self, config: &LogConfig) -> Result<(), LogError> {
        // Fails only where logging was started before: then these logs are nobody's.
        let _ = self.filter.reload(filter_of(config)?);
        match &self.audit {
            Some(audit) => audit.open_again(),
            None => Ok(()),
        }
    }
}

/// systemd says in `JOURNAL_STREAM` which file (device and inode) is the journal's: it may be inherited by who writes elsewhere.
fn stderr_is_the_journals() -> bool {
    let said = std::env::var("JOURNAL_STREAM").unwrap_or_default();
    let there = nix::sys::stat::fstat(io::stderr()).map(|file| format!("{}:{}", file.st_dev, file.st_ino));
    there.is_ok_and(|there| there == said)
}

/// Mutations are not in the log unless it is asked for them by name.
fn filter_of(config: &LogConfig) -> Result<EnvFilter, LogError> {
    let text = std::env::var(FILTER_VARIABLE).ok().filter(|text| !text.is_empty());
    let mut text = text.unwrap_or_else(|| config.filter.clone());
    if !text.split(',').any(|directive| directive.trim().starts_with(audit::TARGET)) {
        text = format!("{text},{}=off", audit::TARGET);
    }
    EnvFilter::try_new(&text).map_err(|source| LogError::Filter { filter: text, source })
}

/// Whether a filter is one.
pub(crate) fn is_filter(text: &str) -> bool {
    EnvFilter::try_new(text).is_ok()
}

impl AuditFile {
    fn open(path: &Path) -> Result<AuditFile, LogError> {
        let file = Arc::new(Mutex::new(append(path)?));
        Ok(AuditFile { path: path.to_owned(), file })
    }

    fn open_again(&self) -> Result<(), LogError> {
        *self.file.lock().unwrap_or_else(PoisonError::into_inner) = append(&self.path)?;
        Ok(())
    }
}

fn append(path: &Path) -> Result<File, LogError> {
    let opened = OpenOptions::new().append(true).create(true).mode(0o600).open(path);
    opened.map_err(|source| LogError::Audit { file: path.to_owned(), source })
}

/// A line goes out in one write, before the call is answered.
struct AuditLine<'a>(MutexGuard<'a, File>);

impl io::Write for AuditLine<'_> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.0.write(bytes)
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

impl<'a> MakeWriter<'a> for AuditFile {
    type Writer = AuditLine<'a>;

    fn make_writer(&'a self) -> AuditLine<'a> {
        AuditLine(self.file.lock().unwrap_or_else(PoisonError::into_inner))
    }
}
