//! The action protocol over real sockets.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

mod common;

use common::{Provider, RESOURCE, begin, goal, lease, provider};
use ratn_model::value::Value;
use ratn_proto::MAX_PORTS_BYTES;
use ratn_proto::types::{Goal, GoalOutcome};
use ratn_worker::client::CallError;
use ratn_worker::endpoint::Endpoint;
use ratn_worker::trace::{self, TraceContext};
use std::sync::atomic::Ordering;
use tonic::Code;

async fn run(provider: &Provider, goal: Goal) -> Result<GoalOutcome, CallError> {
    provider.client.execute(&provider.endpoint, goal, |_, _| {}).await
}

#[tokio::test]
async fn a_goal_is_accepted_tells_its_progress_and_ends_with_its_result() {
    for listen in [None, Some(Endpoint::loopback())] {
        let provider = provider(listen).await;
        let mut heard = Vec::new();
        let outcome = provider
            .client
            .execute(&provider.endpoint, goal("a", "double", 1), |message, _| heard.push(message))
            .await
            .unwrap();
        assert_eq!(outcome, GoalOutcome::success().with_output("y", Value::Float(42.0)));
        assert_eq!(heard, ["run 1"]);
    }
}

#[tokio::test]
async fn a_cancelled_goal_ends_preempted() {
    let provider = provider(None).await;
    let waiting = begin(&provider, goal("a", "wait", 1)).await;
    assert!(provider.client.cancel(&provider.endpoint, "a").await.unwrap());
    assert_eq!(waiting.await.unwrap().unwrap().outcome, "preempted");
    assert!(!provider.client.cancel(&provider.endpoint, "a").await.unwrap());
}

#[tokio::test]
async fn a_goal_beyond_its_deadline_ends_preempted() {
    let provider = provider(None).await;
    let outcome = run(&provider, Goal { deadline_ms: 1, ..goal("a", "wait", 1) }).await.unwrap();
    assert_eq!(outcome, GoalOutcome::preempted("the goal's deadline was over"));
}

#[tokio::test]
async fn an_older_token_than_one_seen_is_refused() {
    let provider = provider(None).await;
    run(&provider, goal("a", "double", 7)).await.unwrap();
    let error = run(&provider, goal("b", "double", 6)).await.unwrap_err();
    assert_eq!(error.code(), Some(Code::FailedPrecondition));
    assert!(error.to_string().contains("token-7 was seen since"), "{error}");
    assert_eq!(provider.runs.load(Ordering::SeqCst), 1);
}

#[tokio::test]
async fn a_goal_without_a_lease_of_the_provider_is_refused() {
    let provider = provider(None).await;
    for lease in [None, Some(lease(1, &[("somebody-else", "Tester", "")]))] {
        let error = run(&provider, Goal { lease, ..goal("a", "double", 1) }).await.unwrap_err();
        assert_eq!(error.code(), Some(Code::FailedPrecondition));
        assert!(error.to_string().contains(RESOURCE), "{error}");
    }
}

#[tokio::test]
async fn a_newer_lease_takes_over_and_the_older_goal_ends_aborted() {
    let provider = provider(None).await;
    let older = begin(&provider, goal("a", "wait", 1)).await;
    let newer = run(&provider, goal("b", "double", 2)).await.unwrap();
    assert!(newer.is_success());
    let older = older.await.unwrap().unwrap();
    assert_eq!((older.outcome.as_str(), older.reason.contains("newer lease")), ("aborted", true));
}

#[tokio::test]
async fn a_goal_goes_on_for_its_grace_when_its_client_leaves() {
    let provider = provider(None).await;
    let patient = |id, grace_ms| Goal { grace_ms, ..goal(id, "wait", 1) };
    begin(&provider, patient("a", 60_000)).await.abort();
    // Who comes back hears how it ends.
    let (client, endpoint) = (provider.client.clone(), provider.endpoint.clone());
    let back = tokio::spawn(async move { client.attach(&endpoint, goal("a", "wait", 1), |_, _| {}).await });
    while !provider.client.cancel(&provider.endpoint, "a").await.unwrap() {}
    let fate = back.await.unwrap().unwrap();
    assert_eq!((fate.outcome.outcome.as_str(), fate.orphaned), ("preempted", false));
    provider.ended.notified().await;

    // Nobody comes back: it ends by itself, and says whose doing that was.
    begin(&provider, patient("b", 20)).await.abort();
    provider.ended.notified().await;
    let fate = provider.client.attach(&provider.endpoint, goal("b", "wait", 1), |_, _| {}).await.unwrap();
    assert_eq!((fate.outcome.outcome.as_str(), fate.orphaned), ("preempted", true));
}

#[tokio::test]
async fn attaching_to_a_goal_that_was_never_given_does_not_begin_it() {
    let provider = provider(None).await;
    let attached = provider.client.attach(&provider.endpoint, goal("a", "double", 1), |_, _| {}).await;
    assert_eq!(attached.unwrap_err().code(), Some(Code::NotFound));
    assert_eq!(provider.runs.load(Ordering::SeqCst), 0);
}

#[tokio::test]
async fn the_same_goal_twice_runs_once() {
    let provider = provider(None).await;
    let first = run(&provider, goal("a", "double", 1)).await.unwrap();
    let again = run(&provider, goal("a", "double", 1)).await.unwrap();
    assert_eq!(first, again);
    assert_eq!(provider.runs.load(Ordering::SeqCst), 1);

    let one = begin(&provider, goal("b", "wait", 1)).await;
    let client = (provider.client.clone(), provider.endpoint.clone());
    let other = tokio::spawn(async move { client.0.execute(&client.1, goal("b", "wait", 1), |_, _| {}).await });
    tokio::task::yield_now().await;
    assert!(provider.server.cancel("b"));
    assert_eq!(one.await.unwrap().unwrap(), other.await.unwrap().unwrap());
    assert_eq!(provider.server.running(), 0);
}

#[tokio::test]
async fn a_second_goal_of_a_busy_provider_is_refused() {
    let provider = provider(None).await;
    let _waiting = begin(&provider, goal("a", "wait", 1)).await;
    let error = run(&provider, goal("b", "double", 1)).await.unwrap_err();
    assert_eq!(error.code(), Some(Code::ResourceExhausted));
    assert!(error.to_string().contains("busy with goal a"), "{error}");
}

#[tokio::test]
async fn a_goal_whose_client_leaves_is_stopped_where_the_action_says_so() {
    let provider = provider(None).await;
    let waiting = begin(&provider, goal("a", "wait", 1)).await;
    waiting.abort();
    provider.ended.notified().await;

    let staying = begin(&provider, goal("b", "stay", 2)).await;
    staying.abort();
    assert!(staying.await.unwrap_err().is_cancelled());
    // The goal still runs: whoever gives it again joins it.
    let joined = begin_silent(&provider, goal("b", "stay", 2));
    assert!(provider.client.cancel(&provider.endpoint, "b").await.unwrap());
    assert_eq!(joined.await.unwrap().unwrap().outcome, "preempted");
}

fn begin_silent(provider: &Provider, goal: Goal) -> tokio::task::JoinHandle<Result<GoalOutcome, CallError>> {
    let (client, endpoint) = (provider.client.clone(), provider.endpoint.clone());
    tokio::spawn(async move { client.execute(&endpoint, goal, |_, _| {}).await })
}

#[tokio::test]
async fn an_unknown_action_is_refused_with_those_that_there_are() {
    let provider = provider(None).await;
    let error = run(&provider, goal("a", "fly", 1)).await.unwrap_err();
    assert_eq!(error.code(), Some(Code::InvalidArgument));
    assert!(
        error
            .to_string()
            .contains("no action `fly`: there are ask, double, end, fill, panic, relay, stay, trace, wait"),
        "{error}"
    );
    assert!(!error.is_crash());
}

#[tokio::test]
async fn a_wrong_input_and_a_panic_end_the_goal_aborted_with_the_reason() {
    let provider = provider(None).await;
    let inputs = [("x".to_owned(), Value::String("many".to_owned()))].into();
    let outcome = run(&provider, Goal { inputs, ..goal("a", "double", 1) }).await.unwrap();
    assert_eq!(outcome, GoalOutcome::aborted("input `x` of `double` is a string: expected a number"));
    let outcome = run(&provider, goal("b", "panic", 1)).await.unwrap();
    assert_eq!(outcome, GoalOutcome::aborted("the action panicked: on purpose"));
    // What it moved may still move.
    let performed = provider.client.execute_hearing(&provider.endpoint, goal("c", "panic", 1), || true, |_| {});
    assert!(performed.await.unwrap().may_move);
}

#[tokio::test]
async fn an_action_has_another_provider_of_its_lease_help() {
    let (helper, provider) = (provider(None).await, provider(None).await);
    let at = helper.endpoint.to_string();
    // The helper is the same resource, here of kind Doubler.
    let lease = lease(1, &[(RESOURCE, "Doubler", &at)]);
    let outcome = run(&provider, Goal { lease: Some(lease), ..goal("a", "relay", 1) }).await.unwrap();
    assert_eq!(outcome.outputs["y"], Value::Float(42.0));
    let outcome = run(&provider, goal("b", "relay", 1)).await.unwrap();
    assert!(outcome.reason.contains("holds no Doubler"), "{}", outcome.reason);
}

#[tokio::test]
async fn an_action_whose_helper_is_stopped_or_preempted_ends_as_that_and_else_aborted() {
    let (helper, provider) = (provider(None).await, provider(None).await);
    let at = helper.endpoint.to_string();
    for (outcome, own) in
        [("stopped", "stopped"), ("preempted", "preempted"), ("aborted", "aborted"), ("lost", "aborted")]
    {
        let lease = Some(lease(1, &[(RESOURCE, "Ender", &at)]));
        let inputs = [("outcome".to_owned(), Value::String(outcome.to_owned()))].into();
        let ended = run(&provider, Goal { lease, inputs, ..goal(outcome, "ask", 1) }).await.unwrap();
        assert_eq!(
            (ended.outcome.as_str(), ended.reason),
            (own, format!("asked in vain: Ender/end was {outcome}: so"))
        );
    }
}

#[tokio::test]
async fn a_provider_that_shuts_down_is_a_crash_and_not_an_outcome() {
    let mut provider = provider(None).await;
    let staying = begin(&provider, goal("a", "stay", 1)).await;
    provider.server.shut_down().await;
    let error = staying.await.unwrap().unwrap_err();
    assert!(error.is_crash() && error.to_string().contains("shuts down"), "{error}");

    provider.shutdown.cancel();
    (&mut provider.serving).await.unwrap();
    let error = run(&provider, goal("b", "double", 1)).await.unwrap_err();
    assert!(error.is_crash() && error.code().is_none(), "{error}");
}

#[tokio::test]
async fn a_provider_describes_what_it_performs() {
    let provider = provider(None).await;
    let info = provider.client.describe(&provider.endpoint).await.unwrap();
    assert_eq!(info.resource, RESOURCE);
    let double = info.actions.iter().find(|action| action.name == "double").unwrap();
    assert_eq!(double.description, "twice as much");
    assert!(double.cancel_when_abandoned);
    assert!(!info.actions.iter().find(|action| action.name == "stay").unwrap().cancel_when_abandoned);
}

#[tokio::test]
async fn a_goal_is_of_the_trace_of_whoever_gave_it() {
    let provider = provider(None).await;
    let context = TraceContext::fresh();
    let trace_of = async |id: &str| {
        let outcome = provider.client.execute(&provider.endpoint, goal(id, "trace", 1), |_, _| {}).await.unwrap();
        let Some(Value::String(trace)) = outcome.outputs.get("trace").cloned() else { panic!("{outcome:?}") };
        trace
    };
    let there: TraceContext = trace::within(context, trace_of("a")).await.parse().unwrap();
    assert_eq!(there.trace_id().to_string(), context.trace_id().to_string());
    // Another span of it.
    assert_ne!(there.span_id().to_string(), context.span_id().to_string());
    // Who is part of none makes none.
    assert_eq!(trace_of("b").await, "");
}

/// The bytes of a text under the name `text`, beside which there is nothing else, with which ports have as many as they may.
fn largest_text(beside: Option<f64>) -> usize {
    let with = |bytes: usize| {
        let text = ("text".to_owned(), Value::String("x".repeat(bytes)));
        let ports = beside.map(|x| ("x".to_owned(), Value::Float(x))).into_iter().chain([text]).collect();
        ratn_proto::convert::ports_bytes(&ratn_proto::convert::wire_ports(ports))
    };
    // Near the edge the length of a text takes as many bytes as at the edge.
    let near = MAX_PORTS_BYTES - 1_000;
    near + (MAX_PORTS_BYTES - with(near))
}

#[tokio::test]
async fn the_inputs_and_the_outputs_of_a_goal_at_their_edge_and_one_byte_past_it() {
    let provider = provider(None).await;
    let largest_output = largest_text(None);
    let largest_input = |output: usize| largest_text(Some(output as f64));
    for (number, (input, output, is_refused)) in [
        (0, largest_output, None),
        (0, largest_output + 1, Some("aborted")),
        (largest_input(1), 1, None),
        (largest_input(1) + 1, 1, Some("INVALID_ARGUMENT")),
        (largest_input(largest_output), largest_output, None),
    ]
    .into_iter()
    .enumerate()
    {
        let text = Value::String("x".repeat(input));
        let inputs = [("x".to_owned(), Value::Float(output as f64)), ("text".to_owned(), text)].into();
        let ended = run(&provider, Goal { inputs, ..goal(&format!("g{number}"), "fill", 1) }).await;
        let says = format!("at most {MAX_PORTS_BYTES}");
        match (is_refused, ended) {
            (None, Ok(outcome)) => {
                assert!(outcome.is_success(), "{input} {output}: {}", outcome.reason);
                assert_eq!(outcome.reason, input.to_string());
                let Some(Value::String(text)) = outcome.outputs.get("text") else { panic!("no text") };
                assert_eq!(text.len(), output);
            }
            (Some("aborted"), Ok(outcome)) => {
                assert_eq!(outcome.outcome, "aborted");
                assert!(outcome.reason.contains(&says) && outcome.outputs.is_empty(), "{}", outcome.reason);
            }
            (Some(_), Err(refused)) => {
                assert_eq!(refused.code(), Some(Code::InvalidArgument));
                assert!(refused.to_string().contains(&says), "{refused}");
            }
            (expected, ended) => panic!("{input} {output}: {expected:?}, and it was {:?}", ended.map(|o| o.outcome)),
        }
    }
}
