//! A bare tonic echo, unary and over a stream, with the messages of a block and of a projection: what the transport alone costs.

use futures::{Stream, StreamExt};
use ratn_proto::v1::{BlockRequest, BlockResponse, Lease, ProjectRequest, ProjectResponse};
use std::convert::Infallible;
use std::future::Future;
use std::pin::Pin;
use std::task::{Context, Poll};
use tokio::net::TcpListener;
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use tonic::body::Body;
use tonic::codegen::http::{self, uri::PathAndQuery};
use tonic::server::{Grpc, NamedService, StreamingService, UnaryService};
use tonic::transport::{Channel, Server, server::TcpIncoming};
use tonic::{Request, Response, Status, Streaming};
use tonic_prost::ProstCodec;

const UNARY: &str = "/bench.Echo/Unary";
const PROJECT: &str = "/bench.Echo/Project";
const STREAM: &str = "/bench.Echo/Stream";

/// Says where it listens on its standard output and serves until it is killed.
pub(crate) async fn serve() {
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    println!("http://{}", listener.local_addr().unwrap());
    let incoming = TcpIncoming::from(listener).with_nodelay(Some(true));
    Server::builder().add_service(Echo).serve_with_incoming(incoming).await.unwrap();
}

fn granted(request: &BlockRequest) -> BlockResponse {
    BlockResponse {
        lease: Some(Lease {
            id: request.deadline_ms,
            token: 1,
            resources: Vec::new(),
            session_id: String::new(),
            consumed: Vec::new(),
        }),
    }
}

#[derive(Clone)]
struct Echo;

impl NamedService for Echo {
    const NAME: &'static str = "bench.Echo";
}

type Boxed<T> = Pin<Box<dyn Future<Output = T> + Send>>;

impl tower_service::Service<http::Request<Body>> for Echo {
    type Response = http::Response<Body>;
    type Error = Infallible;
    type Future = Boxed<Result<Self::Response, Infallible>>;

    fn poll_ready(&mut self, _: &mut Context<'_>) -> Poll<Result<(), Infallible>> {
        Poll::Ready(Ok(()))
    }

    fn call(&mut self, request: http::Request<Body>) -> Self::Future {
        Box::pin(async move {
            if request.uri().path() == PROJECT {
                let mut grpc = Grpc::new(ProstCodec::<ProjectResponse, ProjectRequest>::default());
                return Ok(grpc.unary(Projected, request).await);
            }
            let mut grpc = Grpc::new(ProstCodec::<BlockResponse, BlockRequest>::default());
            Ok(match request.uri().path() {
                UNARY => grpc.unary(Unary, request).await,
                _ => grpc.streaming(Streamed, request).await,
            })
        })
    }
}

struct Unary;

impl UnaryService<BlockRequest> for Unary {
    type Response = BlockResponse;
    type Future = Boxed<Result<Response<BlockResponse>, Status>>;

    fn call(&mut self, request: Request<BlockRequest>) -> Self::Future {
        Box::pin(async move { Ok(Response::new(granted(request.get_ref()))) })
    }
}

struct Projected;

impl UnaryService<ProjectRequest> for Projected {
    type Response = ProjectResponse;
    type Future = Boxed<Result<Response<ProjectResponse>, Status>>;

    fn call(&mut self, request: Request<ProjectRequest>) -> Self::Future {
        Box::pin(async move {
            Ok(Response::new(ProjectResponse { projection_id: request.get_ref().base_revision, promised: Vec::new() }))
        })
    }
}

struct Streamed;

impl StreamingService<BlockRequest> for Streamed {
    type Response = BlockResponse;
    type ResponseStream = Pin<Box<dyn Stream<Item = Result<BlockResponse, Status>> + Send>>;
    type Future = Boxed<Result<Response<Self::ResponseStream>, Status>>;

    fn call(&mut self, request: Request<Streaming<BlockRequest>>) -> Self::Future {
        let answers = request.into_inner().map(|question| question.map(|question| granted(&question)));
        Box::pin(async move { Ok(Response::new(Box::pin(answers) as Self::ResponseStream)) })
    }
}

/// Calls the echo.
pub(crate) struct Client(tonic::client::Grpc<Channel>);

impl Client {
    pub(crate) fn new(channel: Channel) -> Client {
        Client(tonic::client::Grpc::new(channel))
    }

    pub(crate) async fn unary(&mut self, request: BlockRequest) -> BlockResponse {
        self.0.ready().await.unwrap();
        let codec = ProstCodec::<BlockRequest, BlockResponse>::default();
        let path = PathAndQuery::from_static(UNARY);
        self.0.unary(Request::new(request), path, codec).await.unwrap().into_inner()
    }

    pub(crate) async fn project(&mut self, request: ProjectRequest) -> ProjectResponse {
        self.0.ready().await.unwrap();
        let codec = ProstCodec::<ProjectRequest, ProjectResponse>::default();
        let path = PathAndQuery::from_static(PROJECT);
        self.0.unary(Request::new(request), path, codec).await.unwrap().into_inner()
    }
}

/// One stream to the echo.
pub(crate) struct Line {
    questions: mpsc::Sender<BlockRequest>,
    answers: Streaming<BlockResponse>,
}

impl Line {
    pub(crate) async fn open(channel: Channel) -> Line {
        let (questions, outgoing) = mpsc::channel(16);
        let mut grpc = tonic::client::Grpc::new(channel);
        grpc.ready().await.unwrap();
        let codec = ProstCodec::<BlockRequest, BlockResponse>::default();
        let path = PathAndQuery::from_static(STREAM);
        let request = Request::new(ReceiverStream::new(outgoing));
        let answers = grpc.streaming(request, path, codec).await.unwrap().into_inner();
        Line { questions, answers }
    }

    pub(crate) async fn ask(&mut self, question: BlockRequest) -> BlockResponse {
        self.questions.send(question).await.unwrap();
        self.answers.message().await.unwrap().unwrap()
    }
}
