//! What a worker says of itself, over a real socket.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

use ratn_model::catalogue::WorkerDescription;
use ratn_worker::action::ActionServer;
use ratn_worker::client::{ActionClient, Channels, DescribeError};
use ratn_worker::endpoint::Endpoint;
use ratn_worker::prelude::*;
use ratn_worker::server::{Exposure, Services, Serving, bind_as};
use ratn_worker::testing::performed;
use ratn_worker::tls::ClientTls;
use std::time::Duration;
use tokio_util::sync::CancellationToken;

/// An action with a signature, and so many annotations beside.
struct Talker(Option<Signature>, usize);

#[async_trait]
impl Action for Talker {
    fn name(&self) -> &str {
        "talk"
    }

    fn signature(&self) -> Option<Signature> {
        let mut said = self.0.clone()?;
        for number in 0..self.1 {
            said = said.reads(&format!("fact_{number}({}?)", "?, ".repeat(100)));
        }
        Some(said)
    }

    async fn execute(&self, goal: GoalContext) -> ActionResult {
        Ok(GoalOutcome::success().with_output("twice", Value::Int(2 * goal.input_int("n")?)))
    }
}

async fn described(services: Services) -> Result<WorkerDescription, DescribeError> {
    let bound = bind_as(&Endpoint::loopback(), &Exposure::default()).await.unwrap();
    let (endpoint, shutdown) = (bound.endpoint().clone(), CancellationToken::new());
    let serving = tokio::spawn(bound.serve_as(services, Serving::default(), shutdown.clone()));
    let client = ActionClient::new(Channels::new(&ClientTls::none()));
    let description = client.description(&endpoint, Duration::from_secs(10)).await;
    shutdown.cancel();
    serving.await.unwrap().unwrap();
    description
}

async fn says(action: Talker) -> Result<WorkerDescription, DescribeError> {
    let server = ActionServer::builder("").provides("talkers", "Talker").action(action);
    described(Services::new().with(server.build().into_service())).await
}

fn signature() -> Signature {
    Signature::new().with_default("n", Type::Int, Value::Int(21)).output("twice", Type::Int).computes()
}

#[tokio::test]
async fn a_worker_says_what_its_actions_say_and_an_old_one_their_names() {
    let said = says(Talker(Some(signature()), 1)).await.unwrap();
    assert_eq!((said.provider.as_str(), said.kind.as_str()), ("talkers", "Talker"));
    let talk = said.actions["talk"].as_ref().unwrap();
    assert_eq!((talk.optional["n"].clone(), talk.defaults["n"].as_str()), (Type::Int, "21"));
    assert!(talk.annotations.computes && talk.annotations.reads.as_ref().is_some_and(|reads| reads.len() == 1));
    assert_eq!(says(Talker(None, 0)).await.unwrap().actions["talk"], None);
    assert!(matches!(described(Services::new()).await, Err(DescribeError::Unanswered(_))), "no action service at all");
}

#[tokio::test]
async fn a_description_beyond_the_bounds_is_refused_whatever_its_worker_is() {
    let many = says(Talker(Some(signature()), 127)).await.unwrap_err();
    assert!(matches!(&many, DescribeError::Refused(why) if why.contains("annotations of action `talk`")), "{many}");
    let long = says(Talker(Some(signature()), 1_000)).await.unwrap_err();
    assert_eq!(long, DescribeError::Refused("it has more than 65536 bytes".to_owned()));
}

/// As much as 128 annotations and a description may be, which together is too much.
struct Wordy(usize, String);

#[async_trait]
impl Action for Wordy {
    fn name(&self) -> &str {
        "word"
    }

    fn description(&self) -> &str {
        &self.1
    }

    fn signature(&self) -> Option<Signature> {
        Some((0..self.0).fold(Signature::new(), |signature, _| signature.reads(&format!("{}()", "x".repeat(510)))))
    }

    async fn execute(&self, _: GoalContext) -> ActionResult {
        Ok(GoalOutcome::success())
    }
}

#[tokio::test]
async fn what_nobody_would_believe_is_refused_where_the_worker_starts() {
    let refused = |action: Result<(), ratn_model::catalogue::DescriptionError>| action.unwrap_err().to_string();
    let wordy = |annotations| ActionServer::builder("").action(Wordy(annotations, "x".repeat(2_048))).check();
    assert_eq!(wordy(120), Ok(()));
    let long = refused(wordy(128));
    assert!(long.starts_with("it has 6") && long.ends_with("bytes: at most 65536 are taken"), "{long}");
    let defaulted = |of, value| Talker(Some(Signature::new().with_default("n", of, value)), 0);
    let words = "action `talk`: the default of port `n` is `fast`, which is no int";
    let wrong = || defaulted(Type::Int, Value::String("fast".to_owned()));
    assert_eq!(refused(ActionServer::builder("").action(wrong()).check()), words);
    assert_eq!(performed(wrong(), []).await.unwrap_err(), words);
    let unread = Talker(Some(Signature::new().requires("hand_empty($hand)")), 0);
    let why = "action `talk`: `requires: hand_empty($hand)`: the action has no input `hand`";
    assert_eq!(refused(ActionServer::builder("").action(unread).check()), why);
    // What is not told by its text, either.
    let pose = defaulted(Type::Joints, Value::Pose(ratn_model::pose::Pose::at(1.0, 0.0, 0.0)));
    assert!(refused(ActionServer::builder("").action(pose).check()).contains("which is no joints"));
    assert_eq!(ActionServer::builder("").action(defaulted(Type::Int, Value::Null)).check(), Ok(()));
}

#[tokio::test]
async fn goals_are_as_the_signature_says_with_its_defaults() {
    let talk = || Talker(Some(signature()), 0);
    assert_eq!(performed(talk(), []).await.unwrap().outputs["twice"], Value::Int(42));
    assert_eq!(performed(talk(), [("n", Value::Int(2))]).await.unwrap().outputs["twice"], Value::Int(4));
    let reason = performed(talk(), [("m", Value::Int(2))]).await.unwrap().reason;
    assert_eq!(reason, "`talk` has no input `m`; it has n");
    let other = Talker(Some(signature().output("thrice", Type::Int)), 0);
    let outcome = performed(other, []).await.unwrap();
    assert_eq!(outcome.outcome, "aborted");
    assert!(outcome.reason.contains("its output `thrice` is missing"), "{}", outcome.reason);
}
