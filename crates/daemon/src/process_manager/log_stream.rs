//! A worker's log for a client: in pieces, as it is written, until its worker has ended and all of it was sent.

use super::log_file::LogReader;
use crate::details::status;
use ratn_proto::v1::ReadLogResponse;
use std::future::Future;
use std::time::Duration;
use tokio::sync::{OwnedSemaphorePermit, mpsc};
use tonic::{Code, Status};

/// How often a log that is followed is looked at.
const LOOK_INTERVAL: Duration = Duration::from_millis(100);
/// Pieces that wait for a client; a slow one is waited for.
const BUFFER: usize = 4;

/// What a client gets.
pub(super) type Pieces = mpsc::Receiver<Result<ReadLogResponse, Status>>;

/// Sends a log; `lives` says whether its worker does. Without it the log is sent as it is now.
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
                    // Asked before the last look: what it wrote until its end is read all the same.
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
