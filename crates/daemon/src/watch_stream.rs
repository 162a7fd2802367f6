//! The end of a watch's stream.

use crate::details::ending;
use futures::stream::BoxStream;
use futures::{Stream, StreamExt, future, stream};
use tokio_util::sync::CancellationToken;
use tonic::Status;

/// The messages up to the first refusal, the shutdown or the end of the updates. Then the stream ends with a reason: `cut_off` unless
/// a shutdown has begun, because the actor ends the updates of a watcher that is too slow.
pub(crate) fn ended<T: Send + 'static>(
    messages: impl Stream<Item = Result<T, Status>> + Send + 'static,
    shutdown: CancellationToken,
    cut_off: Status,
) -> BoxStream<'static, Result<T, Status>> {
    // Nothing follows a message that was refused: the client would miss that message.
    let messages = messages.scan(false, |over, message| {
        let before = std::mem::replace(over, message.is_err());
        future::ready((!before).then_some(message))
    });
    let shut_down = shutdown.clone();
    let last = stream::once(async move { Err(if shut_down.is_cancelled() { ending() } else { cut_off }) });
    messages.take_until(shutdown.cancelled_owned()).chain(last).boxed()
}
