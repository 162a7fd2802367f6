//! This process's own cgroup (v2), and a group below it. A systemd unit with `Delegate=yes` has a cgroup that it may divide, and so
//! do root without systemd and most containers.

use std::path::{Path, PathBuf};

/// Makes a group of this name below this process's group. Groups below it are the caller's.
///
/// # Errors
/// Why that is not possible, for people.
pub(super) fn make(name: &str) -> Result<PathBuf, String> {
    let read = |file: &str| std::fs::read_to_string(file).map_err(|error| format!("{file}: {error}"));
    let own = place(&read("/proc/self/mountinfo")?, &read("/proc/self/cgroup")?)
        .ok_or("cgroup v2 is not mounted where this process has its group")?;
    let group = own.join(name);
    std::fs::create_dir(&group).or_else(|error| match error.kind() {
        std::io::ErrorKind::AlreadyExists => Ok(()),
        _ => Err(format!("{}: {error}", group.display())),
    })?;
    let missing = ["cgroup.procs", "cgroup.kill"].into_iter().find(|file| !writable(&group.join(file)));
    match missing {
        None => Ok(group),
        Some(file) => {
            let _ = std::fs::remove_dir(&group);
            Err(format!("{} cannot be written (Linux 5.14 has it)", group.join(file).display()))
        }
    }
}

fn writable(file: &Path) -> bool {
    std::fs::OpenOptions::new().write(true).open(file).is_ok()
}

/// The directory of the group in `/proc/self/cgroup`, by the mounts in `/proc/self/mountinfo`.
fn place(mounts: &str, groups: &str) -> Option<PathBuf> {
    let own = groups.lines().find_map(|line| line.strip_prefix("0::"))?;
    mounts.lines().find_map(|line| {
        let (mount, kind) = line.split_once(" - ")?;
        (kind.split(' ').next() == Some("cgroup2")).then_some(())?;
        let mut fields = mount.split(' ').skip(3);
        let (root, place) = (fields.next()?, fields.next()?);
        // Only part of the hierarchy may be mounted.
        let below = Path::new(own).strip_prefix(root).ok()?;
        Some(Path::new(place).join(below))
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_own_group_is_found_in_every_kind_of_mount() {
        let unified = "30 23 0:26 / /sys/fs/cgroup rw,nosuid - cgroup2 cgroup2 rw,nsdelegate\n";
        let hybrid = "31 30 0:27 / /sys/fs/cgroup rw - tmpfs tmpfs rw\n42 31 0:29 / /sys/fs/cgroup/unified rw - cgroup2 cgroup2 rw\n";
        let part = "30 23 0:26 /docker/7 /sys/fs/cgroup ro - cgroup2 cgroup rw\n";
        let of = |mounts, groups| place(mounts, groups).map(|place| place.display().to_string());
        assert_eq!(
            of(unified, "0::/system.slice/a.service\n").as_deref(),
            Some("/sys/fs/cgroup/system.slice/a.service")
        );
        assert_eq!(of(hybrid, "9:pids:/\n0::/\n").as_deref(), Some("/sys/fs/cgroup/unified/"));
        assert_eq!(of(part, "0::/docker/7/x\n").as_deref(), Some("/sys/fs/cgroup/x"));
        assert_eq!(of(part, "0::/other\n"), None);
        assert_eq!(of("31 30 0:27 / /sys/fs/cgroup/pids rw - cgroup cgroup rw,pids\n", "9:pids:/\n"), None);
    }
}
