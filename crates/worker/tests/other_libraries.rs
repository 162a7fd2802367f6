//! What servers and clients of other gRPC libraries do by default, and ours do not.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

mod common;

use common::{goal, provider};
use ratn_model::value::Value;
use ratn_proto::types::{Goal, GoalOutcome};
use ratn_proto::v1::action_service_server::{ActionService, ActionServiceServer};
use ratn_proto::v1::perform_request::Kind as Asked;
use ratn_proto::v1::perform_response::Kind as Heard;
use ratn_proto::v1::{
    AttachRequest, CancelRequest, CancelResponse, DescribeRequest, DescribeResponse, ExecuteRequest, ExecuteResponse,
    GoalResult, PerformRequest, PerformResponse, execute_response,
};
use ratn_worker::client::{ActionClient, Channels, ResourceClient};
use ratn_worker::endpoint::Endpoint;
use ratn_worker::server::{Services, bind};
use ratn_worker::tls::ClientTls;
use std::collections::BTreeMap;
use std::path::Path;
use std::pin::Pin;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{UnixListener, UnixStream};
use tokio_stream::{Stream, StreamExt};
use tokio_util::sync::CancellationToken;
use tonic::{Request, Response, Status, Streaming};

type Answers<T> = Pin<Box<dyn Stream<Item = Result<T, Status>> + Send>>;

const SETTINGS: u8 = 4;
const PING: u8 = 6;
const ACK: u8 = 1;

/// A worker of another library: it answers the opening of a stream with its first message, and knows `Perform` or not.
struct Other {
    knows_perform: bool,
}

fn result() -> GoalResult {
    GoalOutcome::success().with_output("y", Value::Float(42.0)).into()
}

#[tonic::async_trait]
impl ActionService for Other {
    type ExecuteStream = Answers<ExecuteResponse>;
    type AttachStream = Answers<ExecuteResponse>;
    type PerformStream = Answers<PerformResponse>;

    async fn execute(&self, _: Request<ExecuteRequest>) -> Result<Response<Self::ExecuteStream>, Status> {
        let kind = Some(execute_response::Kind::Result(result()));
        Ok(Response::new(Box::pin(tokio_stream::once(Ok(ExecuteResponse { kind })))))
    }

    async fn attach(&self, _: Request<AttachRequest>) -> Result<Response<Self::AttachStream>, Status> {
        Err(Status::unimplemented("Method not implemented!"))
    }

    async fn perform(
        &self,
        requests: Request<Streaming<PerformRequest>>,
    ) -> Result<Response<Self::PerformStream>, Status> {
        if !self.knows_perform {
            return Err(Status::unimplemented("Method not implemented!"));
        }
        let mut requests = requests.into_inner();
        let first = requests.message().await?.unwrap();
        let answers = tokio_stream::once(Ok(first)).chain(requests).filter_map(|asked| {
            let PerformRequest { id, kind, .. } = asked.ok()?;
            let answer = || PerformResponse { id, kind: Some(Heard::Result(result())) };
            matches!(kind, Some(Asked::Execute(_))).then(answer).map(Ok)
        });
        Ok(Response::new(Box::pin(answers)))
    }

    async fn cancel(&self, _: Request<CancelRequest>) -> Result<Response<CancelResponse>, Status> {
        Err(Status::unimplemented("Method not implemented!"))
    }

    async fn describe(&self, _: Request<DescribeRequest>) -> Result<Response<DescribeResponse>, Status> {
        Err(Status::unimplemented("Method not implemented!"))
    }
}

async fn performed_by(other: Other) {
    let bound = bind(&Endpoint::loopback()).await.unwrap();
    let endpoint = bound.endpoint().clone();
    let end = CancellationToken::new();
    let services = Services::new().with(ActionServiceServer::new(other));
    let served = tokio::spawn(bound.serve(services, end.clone()));
    let client = ActionClient::new(Channels::new(&ClientTls::none()));
    for number in 0..3 {
        let goal = Goal { id: format!("g{number}"), inputs: BTreeMap::new(), ..goal("a", "double", 1) };
        let outcome = client.execute(&endpoint, goal, |_, _| {}).await.unwrap();
        assert_eq!(outcome.outputs, BTreeMap::from([("y".to_owned(), Value::Float(42.0))]));
    }
    end.cancel();
    served.await.unwrap().unwrap();
}

#[tokio::test]
async fn a_worker_that_answers_with_its_first_message_only_is_given_goals() {
    performed_by(Other { knows_perform: true }).await;
}

#[tokio::test]
async fn a_worker_that_only_knows_execute_is_given_goals() {
    performed_by(Other { knows_perform: false }).await;
}

/// Type and flags of the next frame.
async fn frame(connection: &mut UnixStream) -> (u8, u8) {
    let mut header = [0; 9];
    connection.read_exact(&mut header).await.unwrap();
    let length = u32::from_be_bytes([0, header[0], header[1], header[2]]);
    let mut payload = vec![0; usize::try_from(length).unwrap()];
    connection.read_exact(&mut payload).await.unwrap();
    (header[3], header[4])
}

/// The first connection to a server that answers nothing.
async fn silent_server(path: &Path) -> (UnixStream, UnixListener) {
    let listener = UnixListener::bind(path).unwrap();
    let (mut connection, _) = listener.accept().await.unwrap();
    connection.write_all(&[0, 0, 0, SETTINGS, 0, 0, 0, 0, 0]).await.unwrap();
    connection.read_exact(&mut [0; 24]).await.unwrap();
    (connection, listener)
}

async fn pinged(connection: &mut UnixStream) {
    while frame(connection).await != (PING, 0) {}
}

#[tokio::test]
async fn a_provider_is_not_pinged_and_a_daemon_is() {
    let place = tempfile::tempdir().unwrap();
    let [daemon, provider] = ["daemon", "provider"].map(|name| place.path().join(name));
    let channels = Channels::new(&ClientTls::none());
    // The provider first: it would be pinged first.
    let give = {
        let (client, endpoint) = (ActionClient::new(channels.clone()), Endpoint::Unix(provider.clone()));
        tokio::spawn(async move { client.execute(&endpoint, goal("a", "double", 1), |_, _| {}).await })
    };
    let (mut at_provider, _listens) = silent_server(&provider).await;
    let ask = {
        let client = ResourceClient::new(&channels, &Endpoint::Unix(daemon.clone()), "").unwrap();
        tokio::spawn(async move { client.delete("x").await })
    };
    let (mut at_daemon, _listens_too) = silent_server(&daemon).await;
    tokio::select! {
        biased;
        () = pinged(&mut at_provider) => panic!("the provider is pinged"),
        () = pinged(&mut at_daemon) => {}
    }
    give.abort();
    ask.abort();
}

/// A field with a name of the static table, by its place there.
fn field(first: &[u8], value: &str) -> Vec<u8> {
    [first, &[u8::try_from(value.len()).unwrap()], value.as_bytes()].concat()
}

#[tokio::test]
async fn a_client_that_names_the_server_by_its_socket_is_answered() {
    let place = tempfile::tempdir().unwrap();
    let path = place.path().join("x.sock");
    let served = provider(Some(Endpoint::Unix(path.clone()))).await;
    let mut connection = UnixStream::connect(&path).await.unwrap();
    let name = path.display().to_string().replace('/', "%2F");
    let block = [
        vec![0x83, 0x86],
        field(&[0x44], "/grpc.health.v1.Health/Check"),
        field(&[&[0x40, 10], &b":authority"[..]].concat(), &name),
        field(&[0x0f, 0x10], "application/grpc"),
        field(&[0x40, 2, b't', b'e'], "trailers"),
    ]
    .concat();
    let frame_of = |kind: u8, flags: u8, stream: u8, payload: &[u8]| {
        let length = u8::try_from(payload.len()).unwrap();
        [&[0, 0, length, kind, flags, 0, 0, 0, stream][..], payload].concat()
    };
    let (headers, data, reset) = (1, 0, 3);
    let said = [
        b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n".to_vec(),
        frame_of(SETTINGS, 0, 0, &[]),
        frame_of(headers, 4, 1, &block),
        frame_of(data, ACK, 1, &[0; 5]),
    ]
    .concat();
    connection.write_all(&said).await.unwrap();
    loop {
        match frame(&mut connection).await.0 {
            kind if kind == data => break,
            kind => assert_ne!(kind, reset, "the call is refused"),
        }
    }
    drop(served);
}
