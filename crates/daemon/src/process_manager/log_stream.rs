//! Streams a worker's log to a client: in pieces, as it is written, until the worker has ended and everything
//! was sent.

use super::log_file::LogReader;
use crate::details::status;
use ratn_proto::v1::ReadLogResponse;
use std::future::Future;
use std::time::Duration;
use tokio::sync::{OwnedSemaphorePermit, mpsc};
use tonic::{Code, Status};

/// Interval at which a followed log is read.
const LOOK_INTERVAL: Duration = Duration::from_millis(100);
/// Pieces that may wait for a client; then reading waits for the client.
const BUFFER: usize = 4;

/// The stream of a client.
pub(super) type Pieces = mpsc::Receiver<Result<ReadLogResponse, Status>>;

/// Sends a log; `lives` says whether its worker is alive. Without `lives` the log is sent as it is now.
pub(super) fn send<F>(
    reader: LogReader,
    mut lives: Option<impl FnMut() -> F + Send + 'static>,
    place: OwnedSemaphorePermit,
) -> Pieces
where
    F: Future<Output = bool> + Send,
{
    let (pieces, received) = mpsc::channel(BUFFER);
    tokio::spawn(async move {
        let _place = place;
        let mut reader = reader;
        let mut ends = lives.is_none();
        loop {
            let read = tokio::task::spawn_blocking(move || {
                let read = reader.read();
                (reader, read)
            });
            let Ok((back, read)) = read.await else { return };
            reader = back;
            let piece = match read {
                Ok(chunk) if chunk.is_empty() && ends => return,
                Ok(chunk) if chunk.is_empty() => {
                    // Asked before the last read, so that everything the worker wrote until its end is sent.
                    if let Some(lives) = &mut lives {
                        ends = !lives().await;
                    }
                    tokio::select! {
                        () = tokio::time::sleep(LOOK_INTERVAL) => continue,
                        () = pieces.closed() => return,
                    }
                }
                Ok(chunk) => Ok(ReadLogResponse { chunk }),
                Err(error) => Err(status(Code::Internal, "LOG_UNREADABLE", format!("the log cannot be read: {error}"))),
            };
            let failed = piece.is_err();
            if pieces.send(piece).await.is_err() || failed {
                return;
            }
        }
    });
    received
}
