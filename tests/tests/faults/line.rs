//! A line between a client and a daemon that can be made bad: a TCP port on loopback in front of the daemon's socket.
//!
//! Bytes of each direction are held back (for ever or for a while), connections are cut at any time or after a request was delivered,
//! so that the answer is lost. Within a connection nothing is reordered or repeated, as TCP promises: requests are reordered by two
//! lines of different delays, and repeated by asking twice with one request id.

use ratn_worker::endpoint::Endpoint;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;
use tokio::io::{AsyncRead, AsyncReadExt, AsyncWrite, AsyncWriteExt};
use tokio::net::{TcpListener, TcpStream, UnixStream};
use tokio::sync::watch;
use tokio::task::AbortHandle;
use tokio_util::sync::CancellationToken;

/// Bytes that are under way in each direction of a connection.
const UNDER_WAY: usize = 64 * 1024;
/// From the delivery of a request to the cut: long enough to be answered in most cases.
const ANSWERED_WITHIN: Duration = Duration::from_millis(25);

/// Towards the daemon, and back.
pub(crate) const UP: usize = 0;
pub(crate) const DOWN: usize = 1;

/// What is bad about a line.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(crate) struct Trouble {
    /// No byte of the direction arrives.
    pub(crate) held: [bool; 2],
    /// Every byte of the direction takes so long.
    pub(crate) delay: [Duration; 2],
    /// How often all connections have been cut.
    pub(crate) cuts: u64,
}

/// See the module.
#[derive(Debug)]
pub(crate) struct Line {
    pub(crate) endpoint: Endpoint,
    trouble: watch::Sender<Trouble>,
    loses_answer: Arc<AtomicBool>,
    accepting: AbortHandle,
}

impl Line {
    /// A line to the daemon that listens at a socket, now or later.
    pub(crate) async fn to(socket: PathBuf) -> anyhow::Result<Line> {
        let listener = TcpListener::bind("127.0.0.1:0").await?;
        let endpoint = format!("http://{}", listener.local_addr()?).parse()?;
        let trouble = watch::Sender::new(Trouble::default());
        let loses_answer = Arc::new(AtomicBool::new(false));
        let (heard, loses) = (trouble.subscribe(), loses_answer.clone());
        let accepting = tokio::spawn(async move {
            while let Ok((client, _)) = listener.accept().await {
                tokio::spawn(connection(client, socket.clone(), heard.clone(), loses.clone()));
            }
        });
        Ok(Line { endpoint, trouble, loses_answer, accepting: accepting.abort_handle() })
    }

    pub(crate) fn change(&self, change: impl FnOnce(&mut Trouble)) {
        self.trouble.send_modify(change);
    }

    /// The next request is delivered, and its answer is not.
    pub(crate) fn lose_answer(&self) {
        self.loses_answer.store(true, Ordering::SeqCst);
    }

    /// Everything that is held back goes on.
    pub(crate) fn heal(&self) {
        self.loses_answer.store(false, Ordering::SeqCst);
        self.change(|trouble| *trouble = Trouble { cuts: trouble.cuts, ..Trouble::default() });
    }
}

impl Drop for Line {
    fn drop(&mut self) {
        self.accepting.abort();
    }
}

async fn connection(
    client: TcpStream,
    socket: PathBuf,
    mut trouble: watch::Receiver<Trouble>,
    loses_answer: Arc<AtomicBool>,
) {
    let _ = client.set_nodelay(true);
    // Nobody listens there now: the client sees its connection end.
    let Ok(daemon) = UnixStream::connect(socket).await else { return };
    let (from_client, to_client) = client.into_split();
    let (from_daemon, to_daemon) = daemon.into_split();
    let over = CancellationToken::new();
    let cuts = trouble.borrow().cuts;
    let losing = Losing { armed: loses_answer, muted: Arc::default(), over: over.clone() };
    let up = pump(from_client, to_daemon, UP, trouble.clone(), losing.clone());
    let down = pump(from_daemon, to_client, DOWN, trouble.clone(), losing);
    tokio::select! {
        () = over.cancelled() => {}
        _ = trouble.wait_for(|trouble| trouble.cuts != cuts) => {}
        () = async { tokio::join!(up, down); } => {}
    }
}

/// How a connection loses an answer.
#[derive(Debug, Clone)]
struct Losing {
    /// The next request that is delivered is the last.
    armed: Arc<AtomicBool>,
    /// Nothing comes back any more.
    muted: Arc<AtomicBool>,
    over: CancellationToken,
}

async fn pump(
    mut from: impl AsyncRead + Unpin,
    mut to: impl AsyncWrite + Unpin,
    direction: usize,
    mut trouble: watch::Receiver<Trouble>,
    losing: Losing,
) {
    let mut bytes = vec![0; UNDER_WAY];
    while let Ok(count) = from.read(&mut bytes).await {
        if count == 0 {
            break;
        }
        let delay = trouble.borrow().delay[direction];
        if !delay.is_zero() {
            tokio::time::sleep(delay).await;
        }
        if trouble.wait_for(|trouble| !trouble.held[direction]).await.is_err() {
            return;
        }
        if direction == DOWN && losing.muted.load(Ordering::SeqCst) {
            continue;
        }
        if to.write_all(&bytes[..count]).await.is_err() {
            break;
        }
        if direction == UP && losing.armed.swap(false, Ordering::SeqCst) {
            losing.muted.store(true, Ordering::SeqCst);
            tokio::time::sleep(ANSWERED_WITHIN).await;
            losing.over.cancel();
        }
    }
    // One direction that ended ends the other after what is under way: as a process that is killed does.
    let _ = to.shutdown().await;
    losing.over.cancel();
}
