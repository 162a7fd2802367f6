//! The marker in the environment of a worker's processes: it names their process manager and their worker. A process inherits it from its
//! parent. Processes of other users are left alone, whatever they carry, and so are this process and its ancestors.

use std::collections::BTreeSet;
use std::ffi::OsString;
use std::os::unix::ffi::{OsStrExt, OsStringExt};
use std::os::unix::fs::{FileExt, MetadataExt};

/// The variable. A process manager that is itself a worker's process appends its own marker: `OUTER/planner-1@a,INNER/planner-1@b`.
const VARIABLE: &str = "RATN_WORKER_OF";
const BETWEEN: u8 = b',';

/// The marker of a worker of this process manager.
pub(super) fn of(instance: &str, id: &str) -> (OsString, OsString) {
    let outer = std::env::var_os(VARIABLE).filter(|outer| !outer.is_empty());
    let mut value = outer.map(|outer| [outer.as_bytes(), &[BETWEEN]].concat()).unwrap_or_default();
    value.extend(format!("{instance}/{id}").bytes());
    (VARIABLE.into(), OsString::from_vec(value))
}

/// Whether the text can be the name of a process manager in a marker.
pub(super) fn is_name(text: &str) -> bool {
    !text.is_empty() && text.bytes().all(|byte| byte.is_ascii_alphanumeric() || byte == b'-')
}

/// Result of a scan of this machine's processes.
pub(super) struct Carriers {
    /// Processes that carry the marker of a wanted worker.
    pub(super) found: Vec<u32>,
    /// Processes whose marker cannot be read yet: they are changing their program (`execve`), or ending.
    pub(super) unknown: Vec<u32>,
}

/// The processes of these users that carry the marker of a worker of this process manager for which `wanted` holds.
pub(super) fn carriers(instance: &str, users: &BTreeSet<u32>, wanted: impl Fn(&str) -> bool) -> Carriers {
    let own = ancestry();
    let mut carriers = Carriers { found: Vec::new(), unknown: Vec::new() };
    let entries = std::fs::read_dir("/proc").into_iter().flatten().flatten();
    let pids = entries.filter_map(|entry| {
        let pid: u32 = entry.file_name().to_str()?.parse().ok()?;
        (!own.contains(&pid) && users.contains(&entry.metadata().ok()?.uid())).then_some(pid)
    });
    for pid in pids {
        match environment_of(pid) {
            Environment::Known(environment) if worker_in(&environment, instance).is_some_and(|id| wanted(&id)) => {
                carriers.found.push(pid);
            }
            Environment::Known(_) => {}
            Environment::NotYet => carriers.unknown.push(pid),
        }
    }
    carriers
}

/// The environment of a process, as far as the kernel shows it.
enum Environment {
    /// Empty for a process that has ended, that has none, or that may not be read.
    Known(Vec<u8>),
    /// The kernel shows no environment while a process changes its program, although it will have one.
    NotYet,
}

fn environment_of(pid: u32) -> Environment {
    match read_at_once(&format!("/proc/{pid}/environ")) {
        Ok(empty) if empty.is_empty() && is_to_come(pid) => Environment::NotYet,
        shown => Environment::Known(shown.unwrap_or_default()),
    }
}

/// Reads a whole file in one system call: a read in parts would break off when the process changes its program in between.
fn read_at_once(path: &str) -> std::io::Result<Vec<u8>> {
    let file = std::fs::File::open(path)?;
    let mut content = vec![0; 16 << 10];
    loop {
        let length = file.read_at(&mut content, 0)?;
        if length < content.len() {
            content.truncate(length);
            return Ok(content);
        }
        content.resize(2 * length, 0);
    }
}

/// Whether a process that just showed no environment will show one: by fields 3, 9, 26, 50 and 51 of `proc_pid_stat(5)`. A program that was
/// started with an empty environment has begun, and its environment has length zero. A process that changes its program has no program yet,
/// or shows an environment by now.
fn is_to_come(pid: u32) -> bool {
    const KERNEL_THREAD: u64 = 0x0020_0000;
    let Ok(stat) = std::fs::read_to_string(format!("/proc/{pid}/stat")) else { return false };
    let Some((_, after_name)) = stat.rsplit_once(')') else { return false };
    let fields: Vec<&str> = after_name.split_whitespace().collect();
    let number = |field: usize| fields.get(field - 3).and_then(|text| text.parse::<u64>().ok());
    let has_ended = matches!(fields.first(), Some(&"Z" | &"X"));
    let is_kernels = number(9).is_none_or(|flags| flags & KERNEL_THREAD != 0);
    let has_no_program = number(26) == Some(0);
    !has_ended && !is_kernels && (has_no_program || number(50) != number(51))
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

/// This process and all its ancestors.
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
        let found = |users: &[u32], wanted: &str| {
            carriers(&instance, &users.iter().copied().collect(), |id| id == wanted).found
        };
        assert_eq!(found(&[uid], "a-1@here"), [child.id()]);
        assert!(found(&[uid], "a-2@here").is_empty());
        assert!(found(&[uid + 1], "a-1@here").is_empty());
        assert!(ancestry().contains(&std::process::id()));
        child.kill().unwrap();
        child.wait().unwrap();
        assert!(found(&[uid], "a-1@here").is_empty());
    }
    #[test]
    fn a_process_that_changes_its_program_again_and_again_is_never_taken_for_somebody_elses() {
        let instance = format!("pm-exec-{}", std::process::id());
        let (name, value) = of(&instance, "a-1@here");
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(file.path(), "exec sh \"$0\"").unwrap();
        let mut child = Command::new("sh").arg(file.path()).env(name, value).spawn().unwrap();
        let looks: Vec<bool> = (0..20_000)
            .filter_map(|_| match environment_of(child.id()) {
                Environment::Known(shown) => Some(worker_in(&shown, &instance).is_some()),
                Environment::NotYet => None,
            })
            // Before its first program it has the environment of this process.
            .skip_while(|carries| !carries)
            .collect();
        child.kill().unwrap();
        child.wait().unwrap();
        assert!(looks.len() > 1_000, "{} looks have shown something", looks.len());
        assert!(looks.iter().all(|carries| *carries));
    }

    #[test]
    fn one_without_an_environment_and_one_that_has_ended_are_nobodys_at_the_first_look() {
        let (input, output) = (Stdio::piped(), Stdio::piped());
        let mut child = Command::new("cat").env_clear().stdin(input).stdout(output).spawn().unwrap();
        child.stdin.as_mut().unwrap().write_all(b"\n").unwrap();
        child.stdout.as_mut().unwrap().read_exact(&mut [0]).unwrap();
        let is_nobodys = |pid| matches!(environment_of(pid), Environment::Known(shown) if shown.is_empty());
        assert!(is_nobodys(child.id()));
        // Closes its standard input, which ends it; it is waited for only afterwards.
        drop(child.stdin.take());
        assert_eq!(child.stdout.as_mut().unwrap().read(&mut [0]).unwrap(), 0);
        std::thread::sleep(std::time::Duration::from_millis(100));
        assert!(is_nobodys(child.id()));
        child.wait().unwrap();
    }
}
