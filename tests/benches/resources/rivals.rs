//! Other supervisors with the smallest worker: how soon one that was killed is there again.
//!
//! supervisord where it is on the PATH. systemd as the manager of a user, in namespaces of its own (root), so that nothing of the
//! machine's is touched: this program starts itself again there (`--systemd`), and prints the median.

use crate::process::Process;
use crate::restart::{KILLS, Notified, end};
use crate::times::Times;
use std::path::Path;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

pub(crate) fn measure(directory: &Path, note: &mut impl FnMut(String, f64)) {
    if let Some(ms) = supervisord(directory) {
        note("supervisord_restart_0_p50_ms".to_owned(), ms);
    }
    let program = std::env::current_exe().unwrap();
    let apart = Command::new("unshare")
        .args(["--mount", "--pid", "--fork", "--mount-proc", "--kill-child"])
        .arg(program)
        .arg("--systemd")
        .stderr(Stdio::inherit())
        .output();
    let said = apart.map(|output| String::from_utf8_lossy(&output.stdout).trim().to_owned()).unwrap_or_default();
    match said.parse() {
        Ok(ms) => note("systemd_restart_0_p50_ms".to_owned(), ms),
        Err(_) => eprintln!("systemd cannot be started here: it is left out"),
    }
}

/// The worker as they start it, whose standard input says nothing of whether anybody is there.
fn staying() -> String {
    format!("{} --tiny 0 staying", std::env::current_exe().unwrap().display())
}

fn supervisord(directory: &Path) -> Option<f64> {
    let socket = Notified::bind(&directory.join("supervisord.notify"));
    let config = directory.join("supervisord.conf");
    let at = directory.display();
    let text = format!(
        "[supervisord]\nnodaemon=true\nlogfile=/dev/null\nlogfile_maxbytes=0\npidfile={at}/supervisord.pid\n\
         [program:tiny]\ncommand={}\nenvironment=NOTIFY_SOCKET=\"{}\"\nautorestart=true\nstartsecs=0\n\
         stdout_logfile=/dev/null\nstdout_logfile_maxbytes=0\n",
        staying(),
        socket.path().display()
    );
    std::fs::write(&config, text).unwrap();
    let started = Command::new("supervisord").arg("-c").arg(config).stdout(Stdio::null()).stderr(Stdio::null()).spawn();
    let started =
        started.inspect_err(|error| eprintln!("supervisord cannot be started here ({error}): it is left out"));
    let _process = Process::of(started.ok()?);
    // A second for each.
    Some(killed(&socket, KILLS / 6))
}

/// Inside the namespaces, of which this is the first process.
pub(crate) fn systemd() {
    let quiet = |program: &str, arguments: &[&str]| {
        let mut command = Command::new(program);
        command.args(arguments).stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null());
        command.envs([("XDG_RUNTIME_DIR", "/run/user"), ("HOME", "/run/home")]);
        command
    };
    assert!(quiet("mount", &["-t", "tmpfs", "none", "/run"]).status().unwrap().success());
    std::fs::create_dir_all("/run/systemd/system").unwrap();
    std::fs::create_dir_all("/run/user").unwrap();
    std::fs::create_dir_all("/run/home/.config/systemd/user").unwrap();
    let socket = Notified::bind(Path::new("/run/tiny.notify"));
    let unit = format!(
        "[Unit]\nStartLimitIntervalSec=0\n[Service]\nExecStart={}\nEnvironment=NOTIFY_SOCKET={}\nRestart=always\nRestartSec=0\n",
        staying(),
        socket.path().display()
    );
    std::fs::write("/run/home/.config/systemd/user/tiny.service", unit).unwrap();
    let Ok(_manager) = quiet("/lib/systemd/systemd", &["--user"]).spawn() else { return };
    let began = Instant::now();
    while !Path::new("/run/user/systemd/private").exists() {
        if began.elapsed() > Duration::from_secs(10) {
            return;
        }
        std::thread::sleep(Duration::from_millis(20));
    }
    if quiet("systemctl", &["--user", "start", "tiny.service"]).status().is_ok_and(|status| status.success()) {
        println!("{}", killed(&socket, KILLS));
    }
    // Whatever runs here ends with its first process.
}

fn killed(socket: &Notified, kills: usize) -> f64 {
    let mut pid = socket.next();
    let mut times = Times::default();
    for _ in 0..kills {
        std::thread::sleep(Duration::from_millis(20));
        let began = Instant::now();
        end(pid);
        pid = socket.next();
        times.add(began);
    }
    times.at(0.5) / 1e3
}
