//! Every text of every request of every service, walked by the schema: what a terminal would obey and what is too long is refused
//! with its field, wherever it is.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

#[path = "../../proto/tests/support/mod.rs"]
mod messages;
mod support;

use bytes::{Buf, BufMut};
use messages::{Schema, spelt};
use prost::Message;
use ratn_proto::MAX_MESSAGE_BYTES;
use ratn_worker::action::ActionServer;
use ratn_worker::endpoint::Endpoint;
use ratn_worker::safety::Safety;
use ratn_worker::server::{Services, bind};
use ratn_worker::trace::Traced;
use std::collections::BTreeMap;
use std::time::Duration;
use support::{TestSystem, in_time};
use tokio_util::sync::CancellationToken;
use tonic::codec::{Codec, DecodeBuf, Decoder, EncodeBuf, Encoder};
use tonic::codegen::http::uri::PathAndQuery;
use tonic::{Code, Request, Status};

/// Texts that say what they like: data of a task, and what the standard wants ignored when it is bad.
const FREE: [(&str, &str); 4] = [
    ("text", ".ratn.v1.Value"),
    ("traceparent", ".ratn.v1.CallsRequest"),
    ("traceparent", ".ratn.v1.SessionRequest"),
    ("traceparent", ".ratn.v1.PerformRequest"),
];

/// Streams that carry calls.
const CARRIERS: [&str; 3] =
    ["/ratn.v1.ResourceService/Session", "/ratn.v1.ActionService/Perform", "/ratn.v1.WorldPoolService/Calls"];

/// A refusal waits for nothing.
const PATIENCE: Duration = Duration::from_secs(2);

/// Messages as they are.
#[derive(Default)]
struct Plain;

impl Codec for Plain {
    type Encode = Vec<u8>;
    type Decode = Vec<u8>;
    type Encoder = Plain;
    type Decoder = Plain;

    fn encoder(&mut self) -> Plain {
        Plain
    }

    fn decoder(&mut self) -> Plain {
        Plain
    }
}

impl Encoder for Plain {
    type Item = Vec<u8>;
    type Error = Status;

    fn encode(&mut self, message: Vec<u8>, buffer: &mut EncodeBuf<'_>) -> Result<(), Status> {
        buffer.put_slice(&message);
        Ok(())
    }
}

impl Decoder for Plain {
    type Item = Vec<u8>;
    type Error = Status;

    fn decode(&mut self, buffer: &mut DecodeBuf<'_>) -> Result<Option<Vec<u8>>, Status> {
        let bytes = buffer.copy_to_bytes(buffer.remaining());
        Ok(Some(bytes.to_vec()))
    }
}

/// How a call with this as its only message ends: with what is said of it, or with an answer.
async fn call(channel: &Traced, path: &str, message: Vec<u8>) -> Result<Vec<u8>, Status> {
    let mut client = tonic::client::Grpc::new(channel.clone());
    client.ready().await.unwrap();
    let path: PathAndQuery = path.parse().unwrap();
    let request = Request::new(tokio_stream::once(message));
    let mut answers = client.streaming(request, path, Plain).await?.into_inner();
    answers.message().await?.ok_or_else(|| Status::ok("no answer"))
}

/// What a stream of calls says of one that it carries.
fn failure(path: &str, answer: &[u8]) -> Option<Status> {
    use ratn_proto::v1::{CallsResponse, PerformResponse, SessionResponse};
    use ratn_proto::v1::{calls_response, perform_response, session_response};
    let failure = match path.rsplit('/').next()? {
        "Perform" => match PerformResponse::decode(answer).ok()?.kind? {
            perform_response::Kind::Failure(failure) => failure,
            _ => return None,
        },
        "Calls" => match CallsResponse::decode(answer).ok()?.kind? {
            calls_response::Kind::Failure(failure) => failure,
            _ => return None,
        },
        _ => match SessionResponse::decode(answer).ok()?.kind? {
            session_response::Kind::Failure(failure) => failure,
            _ => return None,
        },
    };
    Some(Status::new(Code::from(failure.code), failure.message))
}

/// Whose texts their own tests refuse.
const ELSEWHERE: [&str; 2] = ["CellService", "RunService"];

/// A daemon of each kind but the cell and a run.
async fn channels(system: &TestSystem) -> (BTreeMap<&'static str, Traced>, Vec<support::Daemon>, CancellationToken) {
    let (manager, pool, processes) =
        (system.resource_manager().await, system.world_pool(4).await, system.process_manager(Vec::new()).await);
    let (end, bound) = (CancellationToken::new(), bind(&system.directory.socket("provider")).await.unwrap());
    let provider = bound.endpoint().clone();
    let actions =
        Services::new().with(ActionServer::builder("").build().into_service()).with(Safety::default().into_service());
    tokio::spawn(bound.serve(actions, end.clone()));
    let channel = |endpoint: &Endpoint| system.channels.get(endpoint).unwrap();
    let channels = BTreeMap::from([
        ("ResourceService", channel(&manager.endpoint)),
        ("WorldPoolService", channel(&pool.endpoint)),
        ("ProcessService", channel(&processes.endpoint)),
        ("ActionService", channel(&provider)),
        ("SafetyService", channel(&provider)),
    ]);
    (channels, vec![manager, pool, processes], end)
}

/// What a refusal names a place by: the key of a map by its map, and that of a map in a value by being a name.
fn named(place: &[String]) -> &str {
    if place.last().unwrap() == "key@.ratn.v1.ValueMap.FieldsEntry" {
        return "name";
    }
    let mut fields = place.iter().rev().filter_map(|step| step.split('@').next());
    fields.find(|field| !["key", "value"].contains(field)).unwrap()
}

fn service_of(path: &str) -> &str {
    path.trim_start_matches("/ratn.v1.").split('/').next().unwrap()
}

#[tokio::test]
async fn control_characters_and_texts_without_end_are_refused_in_every_field_of_every_request() {
    let system = TestSystem::new();
    let (channels, daemons, end) = channels(&system).await;
    let schema = Schema::read();
    let (mut walked, mut wrong) = (0, Vec::new());
    for (path, request, _) in schema.methods.iter().filter(|(path, ..)| !ELSEWHERE.contains(&service_of(path))) {
        for place in schema.texts(request) {
            let last = place.last().unwrap();
            if FREE.iter().any(|(field, message)| *last == format!("{field}@{message}")) {
                continue;
            }
            let channel = channels.get(service_of(path)).unwrap_or_else(|| panic!("{path} has texts: serve it here"));
            for bad in ["a\u{1b}[31m", &"a".repeat(2_000)] {
                let message = schema.with_text(request, &place, bad);
                let said = match tokio::time::timeout(PATIENCE, call(channel, path, message)).await {
                    Ok(Ok(answer)) => failure(path, &answer).ok_or_else(|| format!("{} bytes of answer", answer.len())),
                    Ok(Err(status)) => Ok(status),
                    Err(_) => Err("taken, and nothing said".to_owned()),
                };
                walked += 1;
                let field = named(&place);
                let refused = said
                    .as_ref()
                    .is_ok_and(|status| status.code() == Code::InvalidArgument && status.message().contains(field));
                let reason = said.as_ref().is_ok_and(|status| {
                    status.message().contains("control character") || status.message().contains("at most")
                });
                if !refused || !reason {
                    wrong.push(format!("{path} {}: {said:?}", spelt(&place)));
                }
            }
        }
    }
    assert!(wrong.is_empty(), "{} of {walked}:\n{}", wrong.len(), wrong.join("\n"));
    assert!(walked > 100, "only {walked} were found: is the schema read?");
    for daemon in daemons {
        daemon.end().await;
    }
    end.cancel();
}

#[tokio::test]
async fn a_message_beyond_the_limit_is_refused_by_every_service() {
    let system = TestSystem::new();
    let (channels, daemons, end) = channels(&system).await;
    let mut carriers = 0;
    for (path, _, streamed) in Schema::read().methods {
        let carries = CARRIERS.contains(&path.as_str());
        carriers += usize::from(carries);
        let Some(channel) = channels.get(service_of(&path)).filter(|_| !streamed || carries) else { continue };
        let refused = in_time(call(channel, &path, vec![0; MAX_MESSAGE_BYTES + 1])).await.unwrap_err();
        assert_eq!(refused.code(), Code::OutOfRange, "{path}: {refused:?}");
    }
    assert_eq!(carriers, CARRIERS.len());
    for daemon in daemons {
        daemon.end().await;
    }
    end.cancel();
}
