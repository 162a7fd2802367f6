//! The config section `[service.otlp]`.

use hyper::Uri;
use hyper::header::{HeaderName, HeaderValue};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// Where spans are sent. All keys are optional; without `endpoint` nothing is recorded.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct OtlpConfig {
    /// The collector, for example `http://host:4318`; `/v1/traces` is appended.
    pub endpoint: Option<String>,
    /// Headers of every request, for example `authorization = "Bearer …"`.
    pub headers: BTreeMap<String, String>,
    /// Time limit of a request, in milliseconds.
    pub timeout_ms: u64,
}

/// A fault in the section.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Fault {
    /// The key, relative to `[service]`.
    pub key: String,
    /// The rule that it breaks, and what to write.
    pub rule: String,
}

/// The collector's address in the form in which it is used.
#[derive(Debug, Clone)]
pub(crate) struct Target {
    pub(crate) uri: Uri,
    pub(crate) host: String,
    pub(crate) port: u16,
    pub(crate) headers: Vec<(HeaderName, HeaderValue)>,
}

const PORT: u16 = 4318;

impl Default for OtlpConfig {
    fn default() -> Self {
        OtlpConfig { endpoint: None, headers: BTreeMap::new(), timeout_ms: 2_000 }
    }
}

impl OtlpConfig {
    /// The first fault of the config, if any.
    pub fn fault(&self) -> Option<Fault> {
        self.target().err()
    }

    /// The collector's address; `None` if sending is off.
    pub(crate) fn target(&self) -> Result<Option<Target>, Fault> {
        let fault = |key: String, rule: &str| Fault { key, rule: rule.to_owned() };
        if !(1..=60_000).contains(&self.timeout_ms) {
            let rule = "from 1 ms to a minute: leave it out for 2000";
            return Err(fault("otlp.timeout_ms".to_owned(), rule));
        }
        let mut headers = Vec::new();
        for (name, value) in &self.headers {
            let key = || format!("otlp.headers.{name}");
            let rule = "a header's name, of letters, digits and `-`: as `authorization`";
            let header = HeaderName::try_from(name).map_err(|_| fault(key(), rule))?;
            if ["host", "content-type", "content-length", "transfer-encoding", "connection"].contains(&header.as_str())
            {
                return Err(fault(key(), "none of those that every request has anyway: leave it out"));
            }
            let rule = "a header's value, of visible ASCII characters and spaces";
            let mut value = HeaderValue::from_str(value).map_err(|_| fault(key(), rule))?;
            value.set_sensitive(true);
            headers.push((header, value));
        }
        let Some(endpoint) = &self.endpoint else {
            let rule =
                "only with otlp.endpoint: say where the collector is, as \"http://127.0.0.1:4318\", or leave it out";
            return if headers.is_empty() { Ok(None) } else { Err(fault("otlp.headers".to_owned(), rule)) };
        };
        let wrong = |why: &str| {
            let rule =
                format!("the address of a collector (OTLP/HTTP), as \"http://127.0.0.1:4318\"; `{endpoint}` {why}");
            Fault { key: "otlp.endpoint".to_owned(), rule }
        };
        if endpoint.starts_with("https://") {
            return Err(wrong("is https, which is not spoken here: name a collector of this host, which sends it on"));
        }
        let base: Uri = endpoint.parse().map_err(|_| wrong("is no address"))?;
        if base.scheme_str() != Some("http") {
            return Err(wrong("does not begin with http://"));
        }
        let authority = base.authority().filter(|authority| !authority.host().is_empty());
        let authority = authority.ok_or_else(|| wrong("has no host"))?;
        if authority.as_str().contains('@') {
            return Err(wrong("names a user: give it in otlp.headers, as authorization = \"Basic …\""));
        }
        if base.query().is_some() {
            return Err(wrong("has a query: leave it out"));
        }
        let path = base.path().trim_end_matches('/');
        let path = if path.ends_with("/v1/traces") { path.to_owned() } else { format!("{path}/v1/traces") };
        let host = authority.host().trim_start_matches('[').trim_end_matches(']').to_owned();
        let port = authority.port_u16().unwrap_or(PORT);
        let uri = Uri::builder().scheme("http").authority(authority.clone()).path_and_query(path).build();
        let uri = uri.map_err(|_| wrong("is no address"))?;
        Ok(Some(Target { uri, host, port, headers }))
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;

    fn of(endpoint: &str) -> OtlpConfig {
        OtlpConfig { endpoint: Some(endpoint.to_owned()), ..OtlpConfig::default() }
    }

    #[test]
    fn an_endpoint_is_taken_with_and_without_port_and_path() {
        for (endpoint, uri, port) in [
            ("http://host", "http://host/v1/traces", 4318),
            ("http://host:80/", "http://host:80/v1/traces", 80),
            ("http://host:4318/otel", "http://host:4318/otel/v1/traces", 4318),
            ("http://[::1]:4318/v1/traces", "http://[::1]:4318/v1/traces", 4318),
        ] {
            let target = of(endpoint).target().unwrap().unwrap();
            assert_eq!((target.uri.to_string().as_str(), target.port), (uri, port));
        }
        assert!(OtlpConfig::default().target().unwrap().is_none());
    }

    #[test]
    fn what_cannot_be_used_is_refused_with_its_key_and_what_to_write() {
        for endpoint in
            ["", "host:4318", "https://host:4318", "http://", "ftp://host", "http://a:b@host", "http://h/?q"]
        {
            let fault = of(endpoint).fault().unwrap();
            assert!(fault.key == "otlp.endpoint" && fault.rule.contains("http://127.0.0.1:4318"), "{fault:?}");
        }
        let slow = OtlpConfig { timeout_ms: 0, ..of("http://host") };
        assert_eq!(slow.fault().unwrap().key, "otlp.timeout_ms");
        let with = |name: &str, value: &str| {
            OtlpConfig { headers: [(name.to_owned(), value.to_owned())].into(), ..of("http://host") }.fault()
        };
        assert_eq!(with("authorization", "Bearer x"), None);
        for (name, value) in [("a b", "x"), ("x", "a\nb"), ("Host", "x")] {
            assert!(with(name, value).unwrap().key.starts_with("otlp.headers."), "{name}");
        }
        let nowhere = OtlpConfig { headers: [("a".to_owned(), "b".to_owned())].into(), ..OtlpConfig::default() };
        assert_eq!(nowhere.fault().unwrap().key, "otlp.headers");
    }
}
