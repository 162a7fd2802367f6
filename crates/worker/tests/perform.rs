//! A client's stream of goals, question by question.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

mod common;

use common::{Provider, goal, provider, provider_with};
use ratn_proto::v1::action_service_client::ActionServiceClient;
use ratn_proto::v1::execute_response::Kind as Told;
use ratn_proto::v1::perform_request::Kind as Asked;
use ratn_proto::v1::perform_response::Kind as Heard;
use ratn_proto::v1::{ExecuteRequest, LeaveRequest, PerformRequest, PerformResponse};
use ratn_worker::endpoint::connect;
use ratn_worker::tls::ClientTls;
use std::time::Duration;
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use tonic::{Code, Streaming};

/// The stream of one client.
struct Line {
    questions: mpsc::Sender<PerformRequest>,
    heard: Streaming<PerformResponse>,
}

impl Line {
    async fn open(provider: &Provider) -> Line {
        let (questions, outgoing) = mpsc::channel(8);
        let mut client = ActionServiceClient::new(connect(&provider.endpoint, &ClientTls::none()).await.unwrap());
        let heard = client.perform(ReceiverStream::new(outgoing)).await.unwrap().into_inner();
        Line { questions, heard }
    }

    async fn ask(&self, id: u64, kind: Option<Asked>) {
        self.questions.send(PerformRequest { id, kind, traceparent: String::new() }).await.unwrap();
    }

    async fn give(&self, id: u64, action: &str) {
        self.ask(id, Some(Asked::Execute(execute(id, action)))).await;
    }

    async fn hear(&mut self) -> (u64, Heard) {
        let heard = self.heard.message().await.unwrap().unwrap();
        (heard.id, heard.kind.unwrap())
    }

    async fn refusal(&mut self) -> (u64, Code, String) {
        match self.hear().await {
            (id, Heard::Failure(failure)) => (id, Code::from(failure.code), failure.message),
            (id, other) => panic!("{id} is not refused but {other:?}"),
        }
    }

    /// The outcome of an execute, its progress left out.
    async fn outcome(&mut self) -> (u64, String) {
        loop {
            match self.hear().await {
                (_, Heard::Progress(_)) => {}
                (id, Heard::Result(result)) => return (id, result.outcome),
                (id, other) => panic!("{id} has not ended but {other:?}"),
            }
        }
    }
}

fn execute(id: u64, action: &str) -> ExecuteRequest {
    ExecuteRequest { goal: Some(goal(&format!("goal-{id}"), action, id).into()) }
}

#[tokio::test]
async fn goals_come_one_after_the_other_over_one_stream() {
    let provider = provider(None).await;
    let mut line = Line::open(&provider).await;
    for id in 1..=3 {
        line.give(id, "double").await;
        assert!(
            matches!(line.hear().await, (of, Heard::Progress(said)) if of == id && said.message == format!("run {id}"))
        );
        assert_eq!(line.outcome().await, (id, "success".to_owned()));
    }
}

#[tokio::test]
async fn what_is_refused_does_not_end_the_stream() {
    let provider = provider(None).await;
    let mut line = Line::open(&provider).await;
    line.give(1, "wait").await;
    assert!(matches!(line.hear().await, (1, Heard::Progress(_))));
    line.give(1, "double").await;
    assert!(matches!(line.refusal().await, (1, Code::InvalidArgument, message) if message.contains("under way")));
    line.ask(2, None).await;
    assert!(matches!(line.refusal().await, (2, Code::InvalidArgument, message) if message.contains("kind")));
    line.give(3, "no_such").await;
    assert!(matches!(line.refusal().await, (3, Code::InvalidArgument, message) if message.contains("no_such")));
    // A newer lease takes over.
    line.give(4, "double").await;
    assert_eq!(line.outcome().await, (1, "aborted".to_owned()));
    assert_eq!(line.outcome().await, (4, "success".to_owned()));
}

#[tokio::test]
async fn who_leaves_an_execute_is_not_told_of_its_end_and_the_goal_stops() {
    let provider = provider(None).await;
    let mut line = Line::open(&provider).await;
    line.give(1, "wait").await;
    assert!(matches!(line.hear().await, (1, Heard::Progress(_))));
    line.ask(1, Some(Asked::Leave(LeaveRequest {}))).await;
    provider.ended.notified().await;
    // Unknown ones are left at any time.
    line.ask(9, Some(Asked::Leave(LeaveRequest {}))).await;
    line.give(2, "double").await;
    assert_eq!(line.outcome().await, (2, "success".to_owned()));
}

#[tokio::test]
async fn whose_stream_breaks_has_left_every_execute() {
    let provider = provider(None).await;
    let mut line = Line::open(&provider).await;
    line.give(1, "wait").await;
    assert!(matches!(line.hear().await, (1, Heard::Progress(_))));
    drop(line);
    provider.ended.notified().await;
}

#[tokio::test]
async fn a_provider_that_drains_says_how_goals_end_and_then_that_it_ends() {
    let provider = provider_with(None, Duration::from_secs(60)).await;
    let (mut line, mut idle) = (Line::open(&provider).await, Line::open(&provider).await);
    line.give(1, "wait").await;
    assert!(matches!(line.hear().await, (1, Heard::Progress(_))));
    provider.shutdown.cancel();
    assert_eq!(idle.heard.message().await.unwrap_err().code(), Code::Unavailable);
    assert!(provider.client.cancel(&provider.endpoint, "goal-1").await.is_err(), "nothing new is taken");
    provider.server.cancel("goal-1");
    assert_eq!(line.outcome().await, (1, "preempted".to_owned()));
    assert_eq!(line.heard.message().await.unwrap_err().code(), Code::Unavailable);
}

#[tokio::test]
async fn an_execute_of_its_own_is_accepted_tells_its_progress_and_ends_with_its_result() {
    let provider = provider(None).await;
    let mut client = ActionServiceClient::new(connect(&provider.endpoint, &ClientTls::none()).await.unwrap());
    let mut told = client.execute(execute(1, "double")).await.unwrap().into_inner();
    let mut next = async || told.message().await.unwrap().and_then(|message| message.kind);
    assert!(matches!(next().await, Some(Told::Accepted(accepted)) if !accepted.joined));
    assert!(matches!(next().await, Some(Told::Progress(_))));
    assert!(matches!(next().await, Some(Told::Result(result)) if result.outcome == "success"));
    assert_eq!(next().await, None);
    assert_eq!(client.execute(execute(1, "no_such")).await.unwrap_err().code(), Code::InvalidArgument);
}
