//! The client's end of a session's stream: one question at a time, or many ahead.

use ratn_proto::v1::resource_service_client::ResourceServiceClient;
use ratn_proto::v1::session_request::Kind as Asked;
use ratn_proto::v1::session_response::Kind as Answered;
use ratn_proto::v1::{self, SessionRequest};
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use tonic::Streaming;
use tonic::transport::Channel;

/// What a holder is called, about as long as in a real run.
const HOLDER: &str = "fetch_boxes/place_all[2]/plan_transfer";

/// A block of one of each of these kinds.
pub(crate) fn requirement(kind: &str) -> v1::Requirement {
    v1::Requirement {
        operation: v1::ResourceOperation::Block.into(),
        kind: kind.to_owned(),
        count: 1.0,
        ..Default::default()
    }
}

pub(crate) fn block(session: &str, kind: &str, number: usize) -> v1::BlockRequest {
    v1::BlockRequest {
        request_id: format!("{session}/{kind}/{number}"),
        session_id: session.to_owned(),
        requirement: Some(requirement(kind)),
        priority: 0,
        deadline_ms: 10_000,
        holder: HOLDER.to_owned(),
    }
}

pub(crate) fn release(session: &str, lease: u64) -> v1::ResourceServiceReleaseRequest {
    v1::ResourceServiceReleaseRequest {
        request_id: format!("{session}/release/{lease}"),
        session_id: session.to_owned(),
        lease_id: lease,
        note: String::new(),
        at_rest: true,
    }
}

pub(crate) async fn create(client: &mut ResourceServiceClient<Channel>, session: &str, kind: &str) {
    let resource = v1::Resource {
        id: format!("{kind}-1"),
        class: v1::ResourceClass::Module.into(),
        kind: kind.to_owned(),
        capacity: 1.0,
        ..Default::default()
    };
    let request_id = format!("create/{kind}");
    let session_id = session.to_owned();
    client.create(v1::CreateRequest { request_id, session_id, resource: Some(resource) }).await.unwrap();
}

pub(crate) async fn exists(channel: &Channel, kind: &str) -> bool {
    let question = v1::ExistsRequest { requirement: Some(requirement(kind)) };
    ResourceServiceClient::new(channel.clone()).exists(question).await.unwrap().into_inner().exists
}

pub(crate) struct Line {
    session: String,
    questions: mpsc::Sender<SessionRequest>,
    answers: Streaming<v1::SessionResponse>,
    next: u64,
}

impl Line {
    pub(crate) async fn open(channel: Channel, session: &str) -> Line {
        let (questions, outgoing) = mpsc::channel(256);
        let ping = v1::KeepAliveRequest {
            session_id: session.to_owned(),
            ttl_ms: 60_000,
            client: "bench".to_owned(),
            ..Default::default()
        };
        let first = SessionRequest { id: 0, kind: Some(Asked::KeepAlive(ping)), ..Default::default() };
        questions.send(first).await.unwrap();
        let mut client = ResourceServiceClient::new(channel);
        let mut answers = client.session(ReceiverStream::new(outgoing)).await.unwrap().into_inner();
        answers.message().await.unwrap().unwrap();
        Line { session: session.to_owned(), questions, answers, next: 1 }
    }

    async fn ask(&mut self, kind: Asked) -> Answered {
        let id = self.next;
        self.next += 1;
        self.questions.send(SessionRequest { id, kind: Some(kind), ..Default::default() }).await.unwrap();
        let answer = self.answers.message().await.unwrap().unwrap();
        assert_eq!(answer.id, id, "one question at a time");
        answer.kind.unwrap()
    }

    /// The id of the lease.
    pub(crate) async fn block(&mut self, kind: &str, number: usize) -> u64 {
        let question = block(&self.session, kind, number);
        lease(self.ask(Asked::Block(question)).await)
    }

    /// One of each kind, or none.
    pub(crate) async fn acquire(&mut self, kinds: &[&str], number: usize) -> u64 {
        let question = v1::AcquireRequest {
            request_id: format!("{}/all/{number}", self.session),
            session_id: self.session.clone(),
            requirements: kinds.iter().map(|kind| requirement(kind)).collect(),
            priority: 0,
            deadline_ms: 10_000,
            holder: HOLDER.to_owned(),
            ..Default::default()
        };
        lease(self.ask(Asked::Acquire(question)).await)
    }

    pub(crate) async fn release(&mut self, lease: u64) {
        let question = release(&self.session, lease);
        let answered = self.ask(Asked::Release(question)).await;
        assert!(matches!(answered, Answered::Release(_)), "not released but {answered:?}");
    }

    /// Blocks and releases each kind so many times; all kinds at once.
    pub(crate) async fn work(mut self, kinds: &[String], times: usize) {
        let mut rounds = vec![0; kinds.len()];
        for (lane, kind) in kinds.iter().enumerate() {
            self.say(lane, Asked::Block(block(&self.session, kind, 0))).await;
        }
        let mut left = kinds.len();
        while left > 0 {
            let answer = self.answers.message().await.unwrap().unwrap();
            let lane = answer.id as usize;
            match answer.kind.unwrap() {
                Answered::Release(_) => {
                    rounds[lane] += 1;
                    if rounds[lane] == times {
                        left -= 1;
                        continue;
                    }
                    self.say(lane, Asked::Block(block(&self.session, &kinds[lane], rounds[lane]))).await;
                }
                granted => self.say(lane, Asked::Release(release(&self.session, lease(granted)))).await,
            }
        }
    }

    /// Asks without waiting for the answer.
    pub(crate) async fn say(&self, lane: usize, kind: Asked) {
        self.questions.send(SessionRequest { id: lane as u64, kind: Some(kind), ..Default::default() }).await.unwrap();
    }
}

fn lease(answered: Answered) -> u64 {
    match answered {
        Answered::Block(granted) => granted.lease.unwrap().id,
        Answered::Acquire(granted) => granted.lease.unwrap().id,
        other => panic!("no lease but {other:?}"),
    }
}
