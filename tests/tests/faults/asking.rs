//! One call over a bad line: answered, refused, or nobody knows; and asking again until it is known.

use super::line::Line;
use std::future::Future;
use std::time::Duration;
use tonic::transport::{Channel, Endpoint};
use tonic::{Code, Status};

/// A connection that is not there after this long is tried again.
const CONNECT_WITHIN: Duration = Duration::from_millis(200);
/// Between two attempts.
const AGAIN: Duration = Duration::from_millis(4);

/// What became of a call.
#[derive(Debug, Clone)]
pub(crate) enum Answer<T> {
    Yes(T),
    /// The daemon's own refusal.
    No(Code, String),
    /// No answer: it may have been done.
    Unknown,
}

/// A channel over a line.
pub(crate) fn channel(line: &Line) -> anyhow::Result<Channel> {
    Ok(Endpoint::from_shared(line.endpoint.to_string())?
        .connect_timeout(CONNECT_WITHIN)
        .tcp_nodelay(true)
        .connect_lazy())
}

/// Asks once, and waits for so long.
pub(crate) async fn once<T>(
    patience: Duration,
    call: impl Future<Output = Result<tonic::Response<T>, Status>>,
) -> Answer<T> {
    match tokio::time::timeout(patience, call).await {
        Ok(Ok(answer)) => Answer::Yes(answer.into_inner()),
        Ok(Err(status)) if is_refusal(&status) => Answer::No(status.code(), status.message().to_owned()),
        Ok(Err(_)) | Err(_) => Answer::Unknown,
    }
}

/// The codes with which the daemons say no; all others may come from the connection, or say that the disk failed.
fn is_refusal(status: &Status) -> bool {
    use std::error::Error;
    let codes = [
        Code::FailedPrecondition,
        Code::NotFound,
        Code::DeadlineExceeded,
        Code::InvalidArgument,
        Code::AlreadyExists,
        Code::ResourceExhausted,
        Code::PermissionDenied,
        Code::OutOfRange,
    ];
    codes.contains(&status.code()) && status.source().is_none()
}

/// Asks until it is known; and whether an attempt got no answer.
pub(crate) async fn known<T, F: Future<Output = Answer<T>>>(mut ask: impl FnMut() -> F) -> (Answer<T>, bool) {
    let mut lost = false;
    loop {
        match ask().await {
            Answer::Unknown => lost = true,
            answer => return (answer, lost),
        }
        tokio::time::sleep(AGAIN).await;
    }
}
