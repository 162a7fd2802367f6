//! The arguments of a worker process, as a template of the process manager passes them: `--id {id} --endpoint-file {endpoint_file}`, others of
//! the table below, and options of the worker's own.
//!
//! | | |
//! |---|---|
//! | `--id` | the id of its resource |
//! | `--endpoint-file` | the file into which the worker writes its endpoint |
//! | `--listen` | the address that it listens on; unless given, a socket that its process manager has named, or `127.0.0.1:0` |
//! | `--kind`, `--host` | kind and host of its resource, where the worker offers that itself |
//! | `--resource-manager` | the resource manager at which the worker offers its resource itself; not for a pooled worker |
//! | `--config` | the system's config, with the roles of callers |
//! | `--exit-with-parent` | the worker ends when its standard input is closed; a pooled worker always does |
//! | `--insecure` | it may listen beyond loopback without TLS |

use crate::endpoint::EndpointError;
use crate::pooled::{self, PROVIDER_SESSION_VARIABLE};
use crate::server::Exposure;
use crate::tls;
use crate::worker::{Worker, WorkerOptions};
use std::collections::BTreeMap;
use std::str::FromStr;

/// Options without a value.
const FLAGS: [&str; 2] = ["--exit-with-parent", "--insecure"];
/// The other options, which every worker has.
const OPTIONS: [&str; 7] =
    ["--id", "--endpoint-file", "--listen", "--kind", "--host", "--resource-manager", "--config"];

/// The arguments that a worker process was started with. Take your own options out ([`Arguments::take`]) before [`Arguments::worker`].
#[derive(Debug, Clone)]
pub struct Arguments {
    given: BTreeMap<String, String>,
    pooled: bool,
    known: Vec<String>,
}

/// Why a worker cannot be started with these arguments.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum ArgumentError {
    /// An option without its value.
    #[error("{option} needs a value")]
    NoValue {
        /// The option.
        option: String,
    },
    /// An option was given twice.
    #[error("{option} is given twice")]
    Twice {
        /// The option.
        option: String,
    },
    /// The value of an option cannot be read.
    #[error("{option} is `{value}`: {why}")]
    Value {
        /// The option.
        option: String,
        /// The value as given.
        value: String,
        /// What is wrong with it.
        why: String,
    },
    /// The worker has no such option.
    #[error("there is no option `{option}`; there are {known}")]
    Unknown {
        /// The option as given.
        option: String,
        /// The options that it has.
        known: String,
    },
    /// An argument is not UTF-8.
    #[error("an argument is not UTF-8: {shown}")]
    NoText {
        /// The argument, with its unreadable bytes replaced.
        shown: String,
    },
}

impl Arguments {
    /// The arguments of this process.
    ///
    /// # Errors
    /// [`ArgumentError`].
    pub fn of_process() -> Result<Arguments, ArgumentError> {
        let text = |argument: std::ffi::OsString| {
            argument.into_string().map_err(|odd| ArgumentError::NoText { shown: odd.to_string_lossy().into_owned() })
        };
        let arguments = std::env::args_os().skip(1).map(text).collect::<Result<Vec<_>, _>>()?;
        let pooled = std::env::var_os(PROVIDER_SESSION_VARIABLE).is_some_and(|session| !session.is_empty());
        Arguments::of(arguments, pooled)
    }

    /// Reads these arguments, without the program's name. A `pooled` worker ends with its process manager, whatever they say.
    ///
    /// # Errors
    /// [`ArgumentError`].
    pub fn of(arguments: Vec<String>, pooled: bool) -> Result<Arguments, ArgumentError> {
        let mut given = BTreeMap::new();
        let mut arguments = arguments.into_iter();
        while let Some(argument) = arguments.next() {
            let (option, value) = match argument.split_once('=') {
                Some((option, value)) if option.starts_with("--") => (option.to_owned(), Some(value.to_owned())),
                _ => (argument, None),
            };
            let value = match value {
                // `--insecure=false` must not be read as `--insecure`.
                Some(value) if FLAGS.contains(&option.as_str()) => {
                    let why = "it stands without a value: leave it out, or give it alone".to_owned();
                    return Err(ArgumentError::Value { option, value, why });
                }
                Some(value) => value,
                None if FLAGS.contains(&option.as_str()) => String::new(),
                // An argument that looks like an option is reported as unknown, not as a missing value.
                None if !option.starts_with("--") => return Err(unknown(&option, &[])),
                None => arguments.next().ok_or_else(|| ArgumentError::NoValue { option: option.clone() })?,
            };
            if given.insert(option.clone(), value).is_some() {
                return Err(ArgumentError::Twice { option });
            }
        }
        Ok(Arguments { given, pooled, known: Vec::new() })
    }

    /// Takes out an option of the worker's own, for example `--speed`. Returns its value, or `None` if it was not given.
    ///
    /// # Errors
    /// [`ArgumentError::Value`] if the value cannot be read as a `T`.
    pub fn take<T: FromStr>(&mut self, option: &str) -> Result<Option<T>, ArgumentError>
    where
        T::Err: std::fmt::Display,
    {
        self.known.push(option.to_owned());
        let Some(value) = self.given.remove(option) else { return Ok(None) };
        let wrong = |why: T::Err| ArgumentError::Value {
            option: option.to_owned(),
            value: value.clone(),
            why: why.to_string(),
        };
        value.parse().map(Some).map_err(wrong)
    }

    /// A worker with these options, without actions.
    ///
    /// # Errors
    /// [`ArgumentError`], also for an argument that neither [`Arguments::take`] nor the table above knows.
    pub fn worker(self) -> Result<Worker, ArgumentError> {
        Ok(Worker::new(self.options()?))
    }

    /// The options that [`Arguments::worker`] makes a worker with.
    ///
    /// # Errors
    /// As [`Arguments::worker`].
    pub fn options(mut self) -> Result<WorkerOptions, ArgumentError> {
        let own = std::mem::take(&mut self.known);
        let defaults = WorkerOptions::default();
        let endpoint = |error: EndpointError| crate::client::chain(&error);
        let mut parsed = |option: &str| match self.given.remove(option) {
            None => Ok(None),
            Some(value) => match value.parse() {
                Ok(parsed) => Ok(Some(parsed)),
                Err(error) => Err(ArgumentError::Value { option: option.to_owned(), value, why: endpoint(error) }),
            },
        };
        let (listen, resource_manager) = (parsed("--listen")?, parsed("--resource-manager")?);
        let mut text = |option: &str| self.given.remove(option);
        let options = WorkerOptions {
            id: text("--id").unwrap_or_default(),
            kind: text("--kind").unwrap_or_default(),
            host: text("--host").unwrap_or_default(),
            endpoint_file: text("--endpoint-file").map(Into::into),
            access: text("--config").map(Into::into),
            listen: listen.unwrap_or_else(|| if self.pooled { pooled::listen() } else { defaults.listen }),
            resource_manager,
            exit_with_parent: text("--exit-with-parent").is_some() || self.pooled,
            exposure: Exposure {
                tls: tls::server_from_environment().map(Into::into),
                insecure: text("--insecure").is_some(),
                ..Exposure::default()
            },
            tls: None,
        };
        match self.given.into_keys().next() {
            Some(option) => Err(unknown(&option, &own)),
            None => Ok(options),
        }
    }
}

fn unknown(option: &str, own: &[String]) -> ArgumentError {
    let known: Vec<&str> = OPTIONS.iter().chain(&FLAGS).copied().chain(own.iter().map(String::as_str)).collect();
    ArgumentError::Unknown { option: option.to_owned(), known: known.join(", ") }
}
