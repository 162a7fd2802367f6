//! Where a worker sends its spans: as `[service.otlp]` says in its system's config, the file with the roles of its callers.

use crate::access::ACCESS_VARIABLE;
use ratn_otlp::OtlpConfig;
use serde::Deserialize;
use std::path::{Path, PathBuf};

/// The part of a system's config that is read here.
#[derive(Debug, Default, Deserialize)]
#[serde(default)]
struct SystemFile {
    service: ServiceSection,
}

#[derive(Debug, Default, Deserialize)]
#[serde(default)]
struct ServiceSection {
    otlp: OtlpConfig,
}

/// Starts the process's sender of spans, if the config asks for it. With an invalid config the worker sends no spans and logs that.
pub(crate) fn start(config: Option<&Path>, id: &str) {
    let from_environment = || std::env::var_os(ACCESS_VARIABLE).filter(|value| !value.is_empty()).map(PathBuf::from);
    let Some(file) = config.map(Path::to_owned).or_else(from_environment) else { return };
    // An unreadable file is refused where the roles are read.
    let Ok(text) = ratn_regular_file::read_text(&file, ratn_regular_file::USUAL) else { return };
    let file = file.display();
    let config = match toml::from_str::<SystemFile>(&text) {
        Ok(system) => system.service.otlp,
        Err(error) => return tracing::warn!(%error, "no spans are sent: {file} has no [service.otlp] that can be used"),
    };
    let resource = vec![("service.name", "ratn-worker".to_owned()), ("service.instance.id", id.to_owned())];
    if let Err(fault) = ratn_otlp::start(&config, resource, |said| tracing::warn!("{said}")) {
        tracing::warn!("no spans are sent: {file}: `service.{}`: {}", fault.key, fault.rule);
    }
}
