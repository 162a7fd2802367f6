//! The smallest worker: `--tiny MIB` takes so much memory, says that it is ready as `sd_notify(3)` has it, and ends with its standard
//! input; with `staying` after a while.

use std::io::Read;
use std::os::unix::net::UnixDatagram;
use std::time::Duration;

const PAGE: usize = 4_096;
const STAY: Duration = Duration::from_secs(120);

pub(crate) fn work(mib: &str, stays: bool) {
    let mut memory = vec![0_u8; mib.parse::<usize>().unwrap() << 20];
    memory.iter_mut().step_by(PAGE).for_each(|byte| *byte = 1);
    let socket = std::env::var_os("NOTIFY_SOCKET").unwrap();
    let ready = format!("READY=1\nMAINPID={}", std::process::id());
    UnixDatagram::unbound().unwrap().send_to(ready.as_bytes(), socket).unwrap();
    let _ = std::io::stdin().read_to_end(&mut Vec::new());
    if stays {
        std::thread::sleep(STAY);
    }
    drop(std::hint::black_box(memory));
}
