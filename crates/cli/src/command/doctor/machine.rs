//! Checks of this machine: directories and disk space, limits of this user, cgroups, memory.

use super::Findings;
use crate::system::config::SystemConfig;
use crate::system::variable;
use nix::sys::resource::{Resource, getrlimit};
use nix::sys::statvfs::statvfs;
use nix::unistd::{AccessFlags, access, geteuid};
use ratn_daemon::process_manager::{GroupsV1, ProcessManagerConfig, tracking};
use ratn_daemon::{resource_manager, world_pool};
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

const MIB: u64 = 1 << 20;
/// With less free space a state, a log or an event log soon cannot be written any more.
const LITTLE_ROOM: u64 = 100 * MIB;
const SOME_ROOM: u64 = 1_024 * MIB;
/// Open files of a daemon apart from those for its workers and clients.
const OWN_FILES: u64 = 256;
/// Open files of a process manager per worker: pipes, log, pidfd, connections.
const FILES_PER_WORKER: u64 = 12;
/// Assumed length of a worker's socket name in a runtime directory. The longest possible one is `/` and 48 + 48 bytes and `-999@.notify`;
/// this is a usual one.
const SOCKET_NAME_BYTES: usize = 24;
/// Maximum length of a socket path: it has to fit into `sockaddr_un`, with its final zero.
const MAX_SOCKET_PATH_BYTES: usize = 107;

pub(super) fn check(findings: &mut Findings, config: &SystemConfig, directory: &Path) {
    runtime_directory(findings, directory);
    room(findings, "runtime directory", directory);
    for (role, storage) in
        [(resource_manager::ROLE, &config.resource_manager.storage), (world_pool::ROLE, &config.world_pool.storage)]
    {
        let elsewhere = || ["RATN_STATE_DIR", "STATE_DIRECTORY"].iter().find_map(|name| variable(name));
        let place = storage.directory.clone().or_else(|| elsewhere().map(|parent| parent.join(role)));
        if let Some(place) = place {
            room(findings, &format!("state of the {role}"), &place);
        }
    }
    if let Some(file) = &config.service.audit_file {
        room(findings, "audit log", file.parent().unwrap_or(file));
    }
    let workers = config.process_manager.templates.iter().map(|template| u64::from(template.max_workers())).sum();
    files(findings, workers);
    groups(findings, &config.process_manager);
    memory(findings, &config.process_manager);
}

fn runtime_directory(findings: &mut Findings, directory: &Path) {
    let about = format!("runtime directory {}", directory.display());
    match std::fs::metadata(directory) {
        Ok(there) if !there.is_dir() => {
            findings.problem(about, "is no directory", "say another one with --runtime-dir")
        }
        Ok(there) if there.uid() != geteuid().as_raw() && !geteuid().is_root() => findings.problem(
            about,
            format!("belongs to user {}, not to you ({})", there.uid(), geteuid()),
            "run as that user, or say another one with --runtime-dir",
        ),
        Ok(there) if there.mode() & 0o022 != 0 => findings.problem(
            about,
            format!("others may write to it (mode {:o})", there.mode() & 0o777),
            "chmod 700: who can write there can stand in for a daemon",
        ),
        Ok(_) => findings.ok(about, "is there, and yours"),
        Err(_) if nearest(directory).is_some_and(|parent| access(&parent, AccessFlags::W_OK).is_ok()) => {
            findings.ok(about, "is not there yet, and can be made");
        }
        Err(error) => findings.problem(about, format!("cannot be made: {error}"), "say another one with --runtime-dir"),
    }
    let length = directory.as_os_str().len();
    if length + SOCKET_NAME_BYTES > MAX_SOCKET_PATH_BYTES {
        findings.problem(
            "sockets",
            format!("the path of the runtime directory has {length} bytes; a socket in it may have {MAX_SOCKET_PATH_BYTES} in all"),
            "say a shorter one with --runtime-dir",
        );
    }
}

/// The directory, or its nearest existing ancestor.
fn nearest(directory: &Path) -> Option<PathBuf> {
    directory.ancestors().find(|place| place.is_dir()).map(Path::to_owned)
}

fn room(findings: &mut Findings, what: &str, directory: &Path) {
    let Some(place) = nearest(directory) else { return };
    let about = format!("room for the {what} ({})", place.display());
    let free = match statvfs(&place) {
        Ok(there) => there.blocks_available() * there.fragment_size(),
        Err(error) => {
            return findings.warning(about, format!("is not known: {error}"), "look whether the disk is well");
        }
    };
    let found = format!("{} MiB free", free / MIB);
    let help = "make room: a daemon whose disk is full refuses every change";
    match free {
        0..LITTLE_ROOM => findings.problem(about, found, help),
        LITTLE_ROOM..SOME_ROOM => findings.warning(about, found, help),
        _ => findings.ok(about, found),
    }
    if access(&place, AccessFlags::W_OK).is_err() {
        findings.problem(
            format!("{what} ({})", place.display()),
            "you may not write there",
            "run as its owner, or name another place",
        );
    }
}

fn files(findings: &mut Findings, workers: u64) {
    let needed = OWN_FILES + FILES_PER_WORKER * workers;
    // A process manager raises its limit to the hard limit.
    let Ok((_, hard)) = getrlimit(Resource::RLIMIT_NOFILE) else { return };
    let found = format!("{hard} may be open at once; a process manager of {workers} workers needs some {needed}");
    if hard < needed {
        findings.problem("open files", found, format!("ulimit -Hn {needed}, or LimitNOFILE={needed} in its unit"));
    } else {
        findings.ok("open files", found);
    }
    let Ok((soft, _)) = getrlimit(Resource::RLIMIT_NPROC) else { return };
    if soft < workers * 16 {
        let found = format!("{soft} processes and threads; {workers} workers with some 16 threads each need more");
        findings.warning("processes", found, format!("ulimit -u {}", workers * 16));
    }
}

fn groups(findings: &mut Findings, config: &ProcessManagerConfig) {
    let limited: Vec<&str> = config
        .templates
        .iter()
        .filter(|template| template.limits.cpus.is_some() || template.limits.processes.is_some())
        .map(|template| template.name.as_str())
        .collect();
    let about = "cgroup";
    let v1 = [("memory", &config.cgroup_v1.memory), ("cpu", &config.cgroup_v1.cpu), ("pids", &config.cgroup_v1.pids)];
    for (controller, place) in v1 {
        let Some(place) = place else { continue };
        let (about, shown) = (format!("cgroup v1, {controller}"), place.display());
        if !place.join("cgroup.procs").is_file() {
            findings.problem(about, format!("{shown} is no group"), "make it (mkdir below /sys/fs/cgroup)");
        } else if access(place, AccessFlags::W_OK).is_err() {
            findings.problem(
                about,
                format!("{shown}: you may not make groups there"),
                "chown it to who runs the process manager",
            );
        } else {
            findings.ok(about, format!("{shown} is writable"));
        }
    }
    let Some(place) = &config.cgroup else {
        if config.cgroup_v1 != GroupsV1::default() {
            return;
        }
        match limited.as_slice() {
            [] => match tracking::here(config) {
                Ok(place) => findings.ok(about, format!("none is named; started from here, workers are tracked by groups below {place}")),
                Err(why) => findings.warning(
                    about,
                    format!("started from here, workers are tracked by their environment alone: {why}"),
                    "Delegate=yes in the process manager's unit, or name a directory of cgroup v2 in [process-manager] `cgroup`",
                ),
            },
            names => findings.warning(
                about,
                format!("none is named: `cpus` and `processes` of {} are not in force", names.join(", ")),
                "name a directory of cgroup v2 that is the process manager's to divide: `cgroup` in [process-manager], Delegate=yes \
                 in its unit",
            ),
        }
        return;
    };
    let shown = place.display();
    let Ok(on) = std::fs::read_to_string(place.join("cgroup.subtree_control")) else {
        return findings.problem(
            about,
            format!("{shown} is no group of cgroup v2"),
            "make it (mkdir below /sys/fs/cgroup), or name the one of its unit",
        );
    };
    let missing: Vec<&str> = ["memory", "cpu", "pids"]
        .into_iter()
        .filter(|name| on.split_whitespace().all(|there| there != *name))
        .collect();
    if access(place, AccessFlags::W_OK).is_err() {
        findings.problem(
            about,
            format!("{shown}: you may not make groups there"),
            "Delegate=yes in its unit, or chown it",
        );
    } else if !missing.is_empty() {
        let missing = missing.join(", ");
        let help = format!("echo '+{}' > {shown}/cgroup.subtree_control", missing.replace(", ", " +"));
        findings.problem(about, format!("{shown} does not control {missing}"), help);
    } else {
        findings.ok(about, format!("{shown} is writable and controls memory, cpu and pids"));
    }
}

fn memory(findings: &mut Findings, config: &ProcessManagerConfig) {
    let promised: u64 = config
        .templates
        .iter()
        .filter_map(|template| Some(template.limits.memory_mib? * u64::from(template.max_workers())))
        .sum();
    let text = std::fs::read_to_string("/proc/meminfo").unwrap_or_default();
    let there =
        text.lines().find_map(|line| line.strip_prefix("MemTotal:")?.split_whitespace().next()?.parse::<u64>().ok());
    let Some(there_mib) = there.map(|kib| kib / 1_024) else { return };
    if promised > there_mib {
        findings.warning(
            "memory",
            format!("all workers together may use {promised} MiB, and there are {there_mib}"),
            "lower `memory_mib` or `max`: beyond what there is the kernel chooses whom it kills",
        );
    } else {
        findings.ok("memory", format!("{there_mib} MiB; the workers' limits come to {promised}"));
    }
}
