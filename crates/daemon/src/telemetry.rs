//! Logs of a process: to standard error or the journal, as text or as JSON, filtered by `RATN_LOG` (such as
//! `info,ratn_daemon=debug`) or else by the config; and the audit log, in a separate file.
//!
//! [`Logs::reload`] changes the filter and reopens the audit file (it may have been rotated), nothing else.

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
    /// Such as `info,ratn_daemon=debug`; `RATN_LOG` overrides it.
    pub filter: String,
    /// Format of a line on standard error.
    pub format: LogFormat,
    /// Destination of the log.
    pub to: LogPlace,
}

/// Format of a line.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum LogFormat {
    /// For people.
    #[default]
    Text,
    /// One JSON object per line.
    Json,
}

/// Destination of logs.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum LogPlace {
    /// The journal where standard error is connected to it (in a systemd unit), else standard error.
    #[default]
    Auto,
    /// Standard error.
    Stderr,
    /// systemd's journal, with separate fields.
    Journald,
}

/// Why logs cannot be written as configured.
#[derive(Debug, thiserror::Error)]
pub enum LogError {
    /// The filter is not valid.
    #[error("`{filter}` is no log filter; as `info,ratn_daemon=debug`")]
    Filter {
        /// The filter as written.
        filter: String,
        /// The reason.
        #[source]
        source: filter::ParseError,
    },
    /// The audit file cannot be opened.
    #[error("cannot append to the audit log {}", file.display())]
    Audit {
        /// The file.
        file: PathBuf,
        /// The reason.
        #[source]
        source: io::Error,
    },
    /// There is no journal on this machine.
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

/// Starts logging for a process. If logging was started before, that logger stays.
///
/// # Errors
/// [`LogError`].
pub fn start_as(config: &LogConfig, audit_file: Option<&Path>) -> Result<Logs, LogError> {
    type Boxed = Box<dyn Layer<Registry> + Send + Sync>;
    let (filter, handle) = reload::Layer::new(filter_of(config)?);
    // An internal error would be printed to the same standard error that cannot be written, and panic.
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
    // Fails only where logging was started before: then that logger stays.
    let _ = tracing_subscriber::registry().with(layers).try_init();
    Ok(Logs { filter: handle, audit })
}

impl Logs {
    /// Sets the filter, and opens the audit file again.
    ///
    /// # Errors
    /// [`LogError`]; a setting that could not be changed stays as it was.
    pub fn reload(&self, config: &LogConfig) -> Result<(), LogError> {
        // Fails only where another logger was started before: then this filter is not in use.
        let _ = self.filter.reload(filter_of(config)?);
        match &self.audit {
            Some(audit) => audit.open_again(),
            None => Ok(()),
        }
    }
}

/// `JOURNAL_STREAM` names the file (device and inode) of the journal. The variable may be inherited by a process that writes
/// elsewhere, so the file is compared.
fn stderr_is_the_journals() -> bool {
    let said = std::env::var("JOURNAL_STREAM").unwrap_or_default();
    let there = nix::sys::stat::fstat(io::stderr()).map(|file| format!("{}:{}", file.st_dev, file.st_ino));
    there.is_ok_and(|there| there == said)
}

/// The audit log's records stay out of the log unless the filter names their target.
fn filter_of(config: &LogConfig) -> Result<EnvFilter, LogError> {
    let text = std::env::var(FILTER_VARIABLE).ok().filter(|text| !text.is_empty());
    let mut text = text.unwrap_or_else(|| config.filter.clone());
    if !text.split(',').any(|directive| directive.trim().starts_with(audit::TARGET)) {
        text = format!("{text},{}=off", audit::TARGET);
    }
    EnvFilter::try_new(&text).map_err(|source| LogError::Filter { filter: text, source })
}

/// Whether the text is a valid filter.
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

/// A line is written in one write, before the call is answered.
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
