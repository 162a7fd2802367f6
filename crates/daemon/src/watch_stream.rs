//! The end of a watch's stream.

use crate::details::ending;
use futures::stream::BoxStream;
use futures::{Stream, StreamExt, future, stream};
use tokio_util::sync::CancellationToken;
use tonic::Status;

/// The messages up to the first refusal, the shutdown or the end of the updates. Then the stream says why it ends: `cut_off` where no
/// shutdown has begun, for the actor ends the updates of a watcher that is too slow.
pub(crate) fn ended<T: Send + 'static>(
    messages: impl Stream<Item = Result<T, Status>> + Send + 'static,
    shutdown: CancellationToken,
    cut_off: Status,
) -> BoxStream<'static, Result<T, Status>> {
    // After a message that does not fit nothing follows: the client would miss it.
    let messages = messages.scan(false, |over, message| {
        let before = std::mem::replace(over, message.is_err());
        future::ready((!before).then_some(message))
    });
    let shut_down = shutdown.clone();
    let last = stream::once(async move { Err(if shut_down.is_cancelled() { ending() } else { cut_off }) });
    messages.take_until(shutdown.cancelled_owned()).chain(last).boxed()
}
