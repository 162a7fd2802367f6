//! Sends one request to a collector, over a connection of its own.

use super::config::Target;
use bytes::Bytes;
use http_body_util::Full;
use hyper::header::{CONNECTION, CONTENT_TYPE, HOST, HeaderValue};
use hyper::{Method, Request, StatusCode};
use hyper_util::rt::TokioIo;
use std::io;
use tokio::net::TcpStream;

/// Why a collector did not accept a request.
#[derive(Debug, thiserror::Error)]
pub(crate) enum PostError {
    #[error("cannot connect: {0}")]
    Connect(io::Error),
    #[error("the connection broke: {0}")]
    Broken(hyper::Error),
    #[error("it answered {0}")]
    Refused(StatusCode),
    #[error("the request cannot be made: {0}")]
    Malformed(hyper::http::Error),
    #[error("no answer within {0} ms")]
    Late(u64),
}

pub(crate) async fn post(target: &Target, body: Vec<u8>) -> Result<(), PostError> {
    let connection = TcpStream::connect((target.host.as_str(), target.port)).await.map_err(PostError::Connect)?;
    let (mut requests, connection) =
        hyper::client::conn::http1::handshake(TokioIo::new(connection)).await.map_err(PostError::Broken)?;
    let path = target.uri.path_and_query().map_or("/", |path| path.as_str());
    let authority = target.uri.authority().map_or("", |authority| authority.as_str());
    let mut request = Request::builder()
        .method(Method::POST)
        .uri(path)
        .header(HOST, authority)
        .header(CONTENT_TYPE, HeaderValue::from_static("application/x-protobuf"))
        .header(CONNECTION, HeaderValue::from_static("close"));
    for (name, value) in &target.headers {
        request = request.header(name, value);
    }
    let request = request.body(Full::new(Bytes::from(body))).map_err(PostError::Malformed)?;
    // The connection is driven concurrently, and dropped with this request.
    let answered = async {
        let answer = requests.send_request(request).await.map_err(PostError::Broken)?;
        if answer.status().is_success() { Ok(()) } else { Err(PostError::Refused(answer.status())) }
    };
    tokio::pin!(answered);
    tokio::select! {
        biased;
        answer = &mut answered => answer,
        ended = connection => match ended {
            Ok(()) => answered.await,
            Err(broken) => Err(PostError::Broken(broken)),
        }
    }
}
