//! The client side: the calls of all tasks share one stream.
//!
//! The stream is opened with the first call, and again with the first call after it broke; calls under way then fail as where a connection
//! breaks, whatever the server gave as the reason. A call does not wait for the other side's answer to the opening: many servers send that with their first message, which is the
//! answer to a call. A call that is dropped before the stream is open is not sent: its caller may have done something else since.

use super::Protocol;
use crate::panic::exit_on_panic;
use crate::trace;
use std::collections::BTreeMap;
use std::pin::Pin;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::task::{Context, Poll};
use tokio::sync::{mpsc, oneshot};
use tokio_stream::Stream as Incoming;
use tonic::{Code, Response, Status, Streaming};

/// Maximum number of requests that wait for the connection; further callers wait.
const OUTGOING: usize = 1_024;
/// Maximum number of intermediate answers that wait for a caller; a caller that falls further behind misses some.
const PROGRESS: usize = 64;

/// What opens a stream: a method of a generated client.
type Opened<P> = Result<Response<Streaming<<P as Protocol>::Response>>, Status>;
type LastAnswer<P> = oneshot::Sender<Result<<P as Protocol>::Answer, Status>>;

/// A stream that is opened on demand. Clones share it.
pub(crate) struct Multiplexer<P: Protocol> {
    stream: Arc<Mutex<Option<Stream<P>>>>,
}

/// An open stream.
struct Stream<P: Protocol> {
    requests: mpsc::Sender<Sent<P>>,
    calls: Arc<Mutex<Calls<P>>>,
}

/// A request to be sent.
struct Sent<P: Protocol> {
    /// The id of the call, which is sent only while its caller waits for the answer; `None` for the message that a call was dropped.
    call: Option<u64>,
    request: P::Request,
}

/// The requests of a stream, in order.
pub(crate) struct Outgoing<P: Protocol> {
    requests: mpsc::Receiver<Sent<P>>,
    calls: Arc<Mutex<Calls<P>>>,
}

impl<P: Protocol> Incoming for Outgoing<P> {
    type Item = P::Request;

    fn poll_next(self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<P::Request>> {
        let Outgoing { requests, calls } = self.get_mut();
        loop {
            match requests.poll_recv(context) {
                Poll::Ready(Some(Sent { call, request })) => {
                    let calls = calls.lock().unwrap_or_else(PoisonError::into_inner);
                    if call.is_none_or(|id| calls.waiting.contains_key(&id)) {
                        return Poll::Ready(Some(request));
                    }
                }
                Poll::Ready(None) => return Poll::Ready(None),
                Poll::Pending => return Poll::Pending,
            }
        }
    }
}

/// The calls under way.
struct Calls<P: Protocol> {
    last_id: u64,
    waiting: BTreeMap<u64, Waiting<P>>,
    /// The reason why no answer will come any more.
    broken: Option<Status>,
}

/// Where the answers to a call are sent.
struct Waiting<P: Protocol> {
    progress: Option<mpsc::Sender<P::Answer>>,
    last: LastAnswer<P>,
}

impl<P: Protocol> Multiplexer<P> {
    /// Makes a call with one answer; `open` is called if there is no stream.
    pub(crate) async fn call<F>(&self, open: impl FnOnce(Outgoing<P>) -> F, call: P::Call) -> Result<P::Answer, Status>
    where
        F: Future<Output = Opened<P>> + Send + 'static,
    {
        self.open(open).call(call, None, |_| {}).await
    }

    /// As [`Multiplexer::call`]; if the call is dropped, this completes the message that tells the other side.
    pub(crate) async fn call_dropped_with<F>(
        &self,
        open: impl FnOnce(Outgoing<P>) -> F,
        call: P::Call,
        when_dropped: impl FnOnce(&mut P::Call),
    ) -> Result<P::Answer, Status>
    where
        F: Future<Output = Opened<P>> + Send + 'static,
    {
        self.open(open).call(call, None, when_dropped).await
    }

    /// Makes a call that may have intermediate answers before the last one.
    pub(crate) async fn call_with_progress<F>(
        &self,
        open: impl FnOnce(Outgoing<P>) -> F,
        call: P::Call,
        mut on_progress: impl FnMut(P::Answer),
    ) -> Result<P::Answer, Status>
    where
        F: Future<Output = Opened<P>> + Send + 'static,
    {
        let stream = self.open(open);
        let (progress, mut heard) = mpsc::channel(PROGRESS);
        let listened = async {
            while let Some(answer) = heard.recv().await {
                on_progress(answer);
            }
        };
        // The receiver of the progress is dropped before the last answer is handed over.
        let (last, ()) = tokio::join!(stream.call(call, Some(progress), |_| {}), listened);
        last
    }

    /// Whether a call is under way.
    pub(crate) fn is_used(&self) -> bool {
        self.kept().as_ref().is_some_and(|stream| !stream.calls().waiting.is_empty())
    }

    fn open<F>(&self, open: impl FnOnce(Outgoing<P>) -> F) -> Stream<P>
    where
        F: Future<Output = Opened<P>> + Send + 'static,
    {
        let mut kept = self.kept();
        if let Some(stream) = kept.as_ref().filter(|stream| stream.calls().broken.is_none()) {
            return stream.clone();
        }
        let (requests, outgoing) = mpsc::channel(OUTGOING);
        let calls = Arc::new(Mutex::new(Calls { last_id: 0, waiting: BTreeMap::new(), broken: None }));
        let opened = open(Outgoing { requests: outgoing, calls: Arc::clone(&calls) });
        tokio::spawn(exit_on_panic("the reader of a stream of calls", read(opened, Arc::clone(&calls))));
        kept.insert(Stream { requests, calls }).clone()
    }

    fn kept(&self) -> MutexGuard<'_, Option<Stream<P>>> {
        self.stream.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl<P: Protocol> Stream<P> {
    async fn call(
        &self,
        call: P::Call,
        progress: Option<mpsc::Sender<P::Answer>>,
        when_dropped: impl FnOnce(&mut P::Call),
    ) -> Result<P::Answer, Status> {
        let (last, answered) = oneshot::channel();
        let id = self.calls().begin(Waiting { progress, last })?;
        let told = P::when_dropped(id, &call).map(|(id, call)| (id, call, when_dropped));
        let mut under_way = UnderWay { stream: self, id, when_dropped: told };
        let traceparent = trace::current().map_or_else(String::new, |context| context.to_string());
        // If sending fails, the stream has broken, and `answered` returns the reason.
        let _ = self.requests.send(Sent { call: Some(id), request: P::request(id, call, traceparent) }).await;
        let answer = answered.await;
        under_way.when_dropped = None;
        answer.unwrap_or_else(|_| Err(closed()))
    }

    fn calls(&self) -> MutexGuard<'_, Calls<P>> {
        self.calls.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl<P: Protocol> Calls<P> {
    fn begin(&mut self, waiting: Waiting<P>) -> Result<u64, Status> {
        if let Some(broken) = &self.broken {
            return Err(broken.clone());
        }
        self.last_id += 1;
        self.waiting.insert(self.last_id, waiting);
        Ok(self.last_id)
    }

    /// Hands an answer to its caller, unless the caller has dropped the call.
    fn answered(&mut self, id: u64, answer: Result<P::Answer, Status>) {
        match answer {
            Ok(answer) if !P::is_last(&answer) => {
                if let Some(progress) = self.waiting.get(&id).and_then(|waiting| waiting.progress.as_ref()) {
                    let sent = progress.try_send(answer);
                    if let Err(mpsc::error::TrySendError::Full(answer)) = sent
                        && !P::may_be_missed(&answer)
                    {
                        let progress = progress.clone();
                        tokio::spawn(async move { progress.send(answer).await });
                    }
                }
            }
            last => self.ended(id, last),
        }
    }

    fn ended(&mut self, id: u64, answer: Result<P::Answer, Status>) {
        let Some(Waiting { progress, last }) = self.waiting.remove(&id) else { return };
        drop(progress);
        let _ = last.send(answer);
    }
}

/// A call under way.
struct UnderWay<'a, P: Protocol, F: FnOnce(&mut P::Call)> {
    stream: &'a Stream<P>,
    id: u64,
    /// The message that tells the other side that the call was dropped, and the function that completes it.
    when_dropped: Option<(u64, P::Call, F)>,
}

impl<P: Protocol, F: FnOnce(&mut P::Call)> Drop for UnderWay<'_, P, F> {
    fn drop(&mut self) {
        self.stream.calls().waiting.remove(&self.id);
        let Some((id, mut call, complete)) = self.when_dropped.take() else { return };
        complete(&mut call);
        let told = Sent { call: None, request: P::request(id, call, String::new()) };
        if let Err(mpsc::error::TrySendError::Full(told)) = self.stream.requests.try_send(told) {
            let requests = self.stream.requests.clone();
            tokio::spawn(async move { requests.send(told).await });
        }
    }
}

/// Hands out the answers until the stream ends.
async fn read<P: Protocol>(opened: impl Future<Output = Opened<P>>, calls: Arc<Mutex<Calls<P>>>) {
    let lock = || calls.lock().unwrap_or_else(PoisonError::into_inner);
    let broken = match opened.await {
        Err(status) => end_of_opening(status),
        Ok(opened) => {
            let mut responses = opened.into_inner();
            loop {
                match responses.message().await {
                    Ok(Some(response)) => {
                        let (id, answer) = P::answer(response);
                        lock().answered(id, answer);
                    }
                    Ok(None) => break closed(),
                    Err(status) => break end_of_stream(status),
                }
            }
        }
    };
    let mut calls = lock();
    while let Some((&id, _)) = calls.waiting.first_key_value() {
        calls.ended(id, Err(broken.clone()));
    }
    calls.broken = Some(broken);
}

fn closed() -> Status {
    Status::unavailable("the stream was closed")
}

/// The end of a stream that was open is no answer to a call: what was called may be under way. So a refusal (the caller has lost a role, or a quota is
/// reached) counts as a broken connection. What cannot be read, and a method that is not there, stay what they are.
pub(crate) fn end_of_stream(status: Status) -> Status {
    use Code::{Cancelled, DataLoss, Internal, OutOfRange, Unavailable, Unimplemented, Unknown};
    match status.code() {
        OutOfRange | Unimplemented | Internal | Unknown | Cancelled | DataLoss => status,
        Unavailable if status.details().is_empty() => status,
        // Made on this side.
        _ if std::error::Error::source(&status).is_some() => status,
        _ => Status::unavailable(format!("it has ended the stream: {}", status.message())),
    }
}

/// The stream was not opened. A server of this system refuses that before it takes a call, and says why in details. Others may open it with their first
/// answer, so this may be the end of a stream on which calls are under way.
fn end_of_opening(status: Status) -> Status {
    match status.code() {
        Code::PermissionDenied | Code::Unauthenticated => status,
        _ if !status.details().is_empty() => status,
        _ => end_of_stream(status),
    }
}

impl<P: Protocol> Clone for Multiplexer<P> {
    fn clone(&self) -> Self {
        Multiplexer { stream: Arc::clone(&self.stream) }
    }
}

impl<P: Protocol> Clone for Stream<P> {
    fn clone(&self) -> Self {
        Stream { requests: self.requests.clone(), calls: Arc::clone(&self.calls) }
    }
}

impl<P: Protocol> Default for Multiplexer<P> {
    fn default() -> Self {
        Multiplexer { stream: Arc::default() }
    }
}

impl<P: Protocol> std::fmt::Debug for Multiplexer<P> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Multiplexer").finish_non_exhaustive()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::client::CallError;
    use crate::endpoint::Endpoint;
    use crate::multiplex::WorldCalls;
    use futures::{FutureExt, StreamExt};
    use ratn_proto::v1::WorldPoolServiceReleaseRequest;
    use ratn_proto::v1::calls_request::Kind;
    use tonic_types::{ErrorDetails, StatusExt};

    fn release(projection_id: u64) -> Kind {
        Kind::Release(WorldPoolServiceReleaseRequest { projection_id })
    }

    #[tokio::test]
    async fn a_call_that_is_given_up_before_the_stream_is_there_is_not_sent() {
        let multiplexer = Multiplexer::<WorldCalls>::default();
        let (connected, is_connected) = oneshot::channel::<()>();
        let (told, sent) = oneshot::channel();
        let open = |mut requests: Outgoing<WorldCalls>| async move {
            let _ = is_connected.await;
            let mut all = Vec::new();
            while let Some(Some(request)) = requests.next().now_or_never() {
                all.push(WorldCalls::parts(request).1);
            }
            let _ = told.send(all);
            Err(Status::unavailable("enough"))
        };
        let again = |_: Outgoing<WorldCalls>| std::future::ready(Err(Status::unavailable("another stream")));
        let mut given_up = Box::pin(multiplexer.call(open, release(1)));
        assert!(given_up.as_mut().now_or_never().is_none());
        let mut waits = Box::pin(multiplexer.call(again, release(2)));
        assert!(waits.as_mut().now_or_never().is_none());
        drop(given_up);
        let _ = connected.send(());
        assert_eq!(sent.await.unwrap_or_default(), [Some(release(2))]);
        assert_eq!(waits.await.map_err(|status| status.message().to_owned()), Err("enough".to_owned()));
    }

    #[test]
    fn the_end_of_a_stream_is_no_refusal_of_a_call_and_the_refusal_to_open_it_is() {
        let endpoint = Endpoint::Unix("/here".into());
        let is_refused = |status| !CallError::from_status(&endpoint, &status).is_crash();
        let with_details = |code| {
            let details = ErrorDetails::with_error_info("NOT_AT_REST", "ratn", []);
            Status::with_error_details(code, "why", details)
        };
        let codes = [Code::PermissionDenied, Code::ResourceExhausted, Code::FailedPrecondition, Code::Unavailable];
        for code in codes {
            let status = with_details(code);
            assert!(is_refused(status.clone()) && is_refused(end_of_opening(status.clone())), "{code}");
            assert!(!is_refused(end_of_stream(status)), "{code}");
        }
        // The server of another library, for one request that is too long, with others under way.
        assert!(!is_refused(end_of_opening(Status::resource_exhausted("larger than max"))));
        assert!(is_refused(end_of_opening(Status::permission_denied("viewers look"))));
        let unreadable = CallError::from_status(&endpoint, &end_of_stream(Status::out_of_range("too long")));
        assert!(unreadable.is_unreadable());
        assert_eq!(end_of_stream(Status::unimplemented("no such method")).code(), Code::Unimplemented);
    }
}
