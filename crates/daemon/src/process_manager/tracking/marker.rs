//! The marker in the environment of a worker's processes: of which process manager and of which worker they are. A process inherits it from
//! whoever started it. Processes of another user are left alone, whatever they carry, and so are this process and whoever started it.

use std::collections::BTreeSet;
use std::ffi::OsString;
use std::os::unix::ffi::{OsStrExt, OsStringExt};
use std::os::unix::fs::MetadataExt;

/// The variable. A process manager that is itself a worker's process adds its own behind that one's: `OUTER/planner-1@a,INNER/planner-1@b`.
const VARIABLE: &str = "RATN_WORKER_OF";
const BETWEEN: u8 = b',';

/// Of a worker of this process manager.
pub(super) fn of(instance: &str, id: &str) -> (OsString, OsString) {
    let outer = std::env::var_os(VARIABLE).filter(|outer| !outer.is_empty());
    let mut value = outer.map(|outer| [outer.as_bytes(), &[BETWEEN]].concat()).unwrap_or_default();
    value.extend(format!("{instance}/{id}").bytes());
    (VARIABLE.into(), OsString::from_vec(value))
}

/// Whether it can be the name of a process manager in a marker.
pub(super) fn is_name(text: &str) -> bool {
    !text.is_empty() && text.bytes().all(|byte| byte.is_ascii_alphanumeric() || byte == b'-')
}

/// The processes of these users that carry the marker of a worker of this process manager for which `wanted` holds.
pub(super) fn carriers(instance: &str, users: &BTreeSet<u32>, wanted: impl Fn(&str) -> bool) -> Vec<u32> {
    let own = ancestry();
    let Ok(entries) = std::fs::read_dir("/proc") else { return Vec::new() };
    let pids = entries.flatten().filter_map(|entry| {
        let pid: u32 = entry.file_name().to_str()?.parse().ok()?;
        (!own.contains(&pid) && users.contains(&entry.metadata().ok()?.uid())).then_some(pid)
    });
    // Of one that has ended nothing is read any more.
    pids.filter(|pid| {
        let environment = std::fs::read(format!("/proc/{pid}/environ")).unwrap_or_default();
        worker_in(&environment, instance).is_some_and(|id| wanted(&id))
    })
    .collect()
}

/// The worker of this process manager that an environment names.
fn worker_in(environment: &[u8], instance: &str) -> Option<String> {
    let value = environment
        .split(|byte| *byte == 0)
        .find_map(|entry| entry.strip_prefix(VARIABLE.as_bytes()).and_then(|rest| rest.strip_prefix(b"=")))?;
    value.split(|byte| *byte == BETWEEN).find_map(|marker| {
        let id = marker.strip_prefix(instance.as_bytes())?.strip_prefix(b"/")?;
        String::from_utf8(id.to_vec()).ok()
    })
}

/// This process, its parent, and so on.
fn ancestry() -> BTreeSet<u32> {
    let mut found = BTreeSet::from([std::process::id()]);
    let mut next = Some(std::process::id());
    while let Some(parent) = next.and_then(super::orphans::parent_of).filter(|parent| *parent > 1) {
        next = found.insert(parent).then_some(parent);
    }
    found
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;
    use std::io::{Read, Write};
    use std::process::{Command, Stdio};

    #[test]
    fn a_marker_names_the_worker_of_one_process_manager_and_of_one_inside_it() {
        let environment = b"PATH=/bin\0RATN_WORKER_OF=pm-1/planner-1@a,pm-2/x-7@b\0HOME=/\0";
        assert_eq!(worker_in(environment, "pm-1").as_deref(), Some("planner-1@a"));
        assert_eq!(worker_in(environment, "pm-2").as_deref(), Some("x-7@b"));
        assert_eq!(worker_in(environment, "pm"), None);
        assert_eq!(worker_in(b"NOT_RATN_WORKER_OF=pm-1/a\0", "pm-1"), None);
        assert_eq!(of("pm-1", "planner-1@a"), ("RATN_WORKER_OF".into(), "pm-1/planner-1@a".into()));
        assert!(is_name("pm-1f-2a-0") && !is_name("") && !is_name("a/b") && !is_name("a,b"));
    }

    #[test]
    fn only_processes_of_the_users_that_are_named_are_found_and_never_this_one() {
        let instance = format!("pm-test-{}", std::process::id());
        let (name, value) = of(&instance, "a-1@here");
        let (input, output) = (Stdio::piped(), Stdio::piped());
        let mut child = Command::new("cat").env(name, value).stdin(input).stdout(output).spawn().unwrap();
        // A process has its environment a little after it was started: `cat` answers when it has.
        child.stdin.as_mut().unwrap().write_all(b"\n").unwrap();
        child.stdout.as_mut().unwrap().read_exact(&mut [0]).unwrap();
        let uid = nix::unistd::geteuid().as_raw();
        let found =
            |users: &[u32], wanted: &str| carriers(&instance, &users.iter().copied().collect(), |id| id == wanted);
        assert_eq!(found(&[uid], "a-1@here"), [child.id()]);
        assert!(found(&[uid], "a-2@here").is_empty());
        assert!(found(&[uid + 1], "a-1@here").is_empty());
        assert!(ancestry().contains(&std::process::id()));
        child.kill().unwrap();
        child.wait().unwrap();
        assert!(found(&[uid], "a-1@here").is_empty());
    }
}
