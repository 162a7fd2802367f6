//! Where a worker sends its spans: as `[service.otlp]` of its system's config says, the file of which its callers' roles are.

use crate::access::ACCESS_VARIABLE;
use ratn_otlp::OtlpConfig;
use serde::Deserialize;
use std::path::{Path, PathBuf};

/// What of a system's config is read here.
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

/// Starts the sender of the process, where the config says so. One that cannot be used costs the worker its spans, and it says so.
pub(crate) fn start(config: Option<&Path>, id: &str) {
    let from_environment = || std::env::var_os(ACCESS_VARIABLE).filter(|value| !value.is_empty()).map(PathBuf::from);
    let Some(file) = config.map(Path::to_owned).or_else(from_environment) else { return };
    // A file that cannot be read is refused for its roles.
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
