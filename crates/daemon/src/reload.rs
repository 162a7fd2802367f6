//! Reloading the config at SIGHUP: which settings change without a restart, and which do not.

/// Keys of a config that a running daemon reloads, with all keys below them.
const LIVE: [&str; 6] = [
    "service.log.filter",
    "service.access",
    "resource-manager.limits",
    "resource-manager.max_session_ttl_ms",
    "resource-manager.max_wait_ms",
    "resource-manager.max_watchers",
];

/// Keys that differ and need a restart, sorted. Tables are compared key by key, everything else as a whole. A table that only one
/// config has, and in which some keys can be reloaded, is compared key by key, too.
pub fn need_a_restart(running: &toml::Table, wanted: &toml::Table) -> Vec<String> {
    let mut different = Vec::new();
    compare("", running, wanted, &mut different);
    different.retain(|key| !LIVE.iter().any(|live| is_within(key, live)));
    different
}

fn is_within(key: &str, whole: &str) -> bool {
    key.strip_prefix(whole).is_some_and(|rest| rest.is_empty() || rest.starts_with('.'))
}

/// Whether a running daemon reloads any key of a table.
fn has_live(table: &str) -> bool {
    LIVE.iter().any(|live| is_within(live, table))
}

fn compare(path: &str, running: &toml::Table, wanted: &toml::Table, different: &mut Vec<String>) {
    let mut keys: Vec<&String> = running.keys().chain(wanted.keys()).collect();
    keys.sort();
    keys.dedup();
    for key in keys {
        let path = if path.is_empty() { key.clone() } else { format!("{path}.{key}") };
        let none = toml::Table::new();
        match (running.get(key), wanted.get(key)) {
            (Some(toml::Value::Table(running)), Some(toml::Value::Table(wanted))) => {
                compare(&path, running, wanted, different);
            }
            (Some(toml::Value::Table(running)), None) if has_live(&path) => compare(&path, running, &none, different),
            (None, Some(toml::Value::Table(wanted))) if has_live(&path) => compare(&path, &none, wanted, different),
            (running, wanted) if running != wanted => different.push(path),
            _ => {}
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;

    fn check(running: &str, wanted: &str, expect: &[&str]) {
        assert_eq!(need_a_restart(&running.parse().unwrap(), &wanted.parse().unwrap()), expect);
    }

    #[test]
    fn what_is_taken_over_needs_no_restart_and_all_else_is_named() {
        let running = "[service]\ninsecure = false\nlog = {filter = 'info', format = 'text'}\n[resource-manager]\nlisten = 'local'";
        check(running, running, &[]);
        check(
            running,
            "[service]\ninsecure = true\nlog = {filter = 'debug', format = 'json'}\n[resource-manager]\nlisten = 'local'",
            &["service.insecure", "service.log.format"],
        );
        check("", "[resource-manager.limits]\nsessions = 3", &[]);
        check("[resource-manager.limits]\nsessions = 3", "", &[]);
        check("", "[resource-manager]\nlisten = 'local'\nlimits.sessions = 3", &["resource-manager.listen"]);
        check("[resource-manager.limits]\nsessions = 2", "[resource-manager.limits]\nsessions = 3", &[]);
        check(
            "resource-manager.max_wait_ms = 2",
            "resource-manager.max_wait_ms_ = 3",
            &["resource-manager.max_wait_ms_"],
        );
    }

    #[test]
    fn what_is_no_longer_there_is_a_difference() {
        check("[cell]\nboxes = 3", "[cell]", &["cell.boxes"]);
        check("[service]", "[service.tls]\ncert = 'a'", &["service.tls"]);
    }
}
