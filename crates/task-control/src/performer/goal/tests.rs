use super::*;
use futures::Stream;
use ratn_model::id::FencingToken;
use ratn_model::resource::Lease;
use ratn_proto::v1;
use ratn_proto::v1::action_service_server::{ActionService, ActionServiceServer};
use ratn_proto::v1::{
    AttachRequest, CancelRequest, CancelResponse, DescribeRequest, DescribeResponse, ExecuteRequest, ExecuteResponse,
    GoalResult, PerformRequest, PerformResponse, execute_response,
};
use ratn_worker::action::{Action, ActionResult, ActionServer, GoalContext};
use ratn_worker::server::{Services, bind};
use ratn_worker::tls::ClientTls;
use std::collections::HashMap;
use std::pin::Pin;
use std::sync::Arc;
use std::sync::atomic::AtomicU32;
use tokio_util::sync::DropGuard;
use tonic::{Code, Request, Response, Status, Streaming};
use tonic_types::{ErrorDetails, StatusExt};

/// `work` ends at once. `hang` never ends unless cancelled. `better` gives intermediate results, not each of which is better.
struct Named(&'static str);

#[tonic::async_trait]
impl Action for Named {
    fn name(&self) -> &str {
        self.0
    }

    async fn execute(&self, goal: GoalContext) -> ActionResult {
        if self.0 == "hang" {
            goal.cancelled.cancelled().await;
            return Err(goal.stopped());
        }
        if self.0 == "endless" {
            goal.improved(BTreeMap::new(), 5.0)?;
            goal.cancelled.cancelled().await;
            return Err(goal.stopped());
        }
        if self.0 == "better" {
            for cost_s in [5.0, 7.0, 4.0, 4.0].into_iter().chain((0..400).map(|n| 3.0 - f64::from(n) * 0.001)) {
                goal.improved(BTreeMap::new(), cost_s)?;
                tokio::task::yield_now().await;
            }
        }
        Ok(GoalOutcome::success())
    }
}

struct Bench {
    endpoint: Endpoint,
    server: ActionServer,
    resources: ResourceClient,
    events: mpsc::Sender<Answer>,
    answers: mpsc::Receiver<Answer>,
    _place: tempfile::TempDir,
    _shutdown: DropGuard,
}

impl Bench {
    async fn new() -> anyhow::Result<Bench> {
        let place = tempfile::tempdir()?;
        let server = ActionServer::builder("")
            .action(Named("work"))
            .action(Named("hang"))
            .action(Named("better"))
            .action(Named("endless"))
            .build();
        let bound = bind(&Endpoint::Unix(place.path().join("provider.sock"))).await?;
        let (endpoint, shutdown) = (bound.endpoint().clone(), CancellationToken::new());
        tokio::spawn(bound.serve(Services::new().with(server.clone().into_service()), shutdown.clone()));
        let (events, answers) = mpsc::channel(8);
        let resources = ResourceClient::new(&Channels::new(&ClientTls::none()), &endpoint, "")?;
        Ok(Bench { endpoint, server, resources, events, answers, _place: place, _shutdown: shutdown.drop_guard() })
    }

    fn performing(&self, action: &str, timeout_s: Option<f64>, grace_ms: u64) -> Performing {
        Performing {
            instance: InstanceId(1),
            attempt: 1,
            before: Vec::new(),
            endpoint: Ok(self.endpoint.clone()),
            source: "worker-1".to_owned(),
            timeout_s,
            speed: 10.0,
            actions: ActionClient::new(Channels::new(&ClientTls::none())),
            channels: Channels::new(&ClientTls::none()),
            resources: self.resources.clone(),
            events: self.events.clone(),
            stop: CancellationToken::new(),
            results: Mutex::default(),
            outputs: Vec::new(),
            safe: None,
            sees: None,
            over: CancellationToken::new(),
            told: Told::new("run"),
            may_move: AtomicBool::new(false),
            doubtful: Doubtful::default(),
            goal: Goal {
                id: format!("run/1/{action}"),
                action: action.to_owned(),
                deadline_ms: deadline_ms(timeout_s, 10.0),
                grace_ms,
                ..Goal::default()
            },
        }
    }

    async fn event(&mut self) -> Option<Event> {
        match self.answers.recv().await? {
            Answer::Event { event, .. } => Some(*event),
            Answer::World(_) | Answer::Wanted(_) => None,
        }
    }
}

#[tokio::test]
async fn the_future_of_a_goal_is_small() -> anyhow::Result<()> {
    let bench = Bench::new().await?;
    let bytes = size_of_val(&bench.performing("work", None, 0).perform(Given::Now));
    assert!(bytes <= 8 << 10, "{bytes} bytes are copied again and again");
    Ok(())
}

#[tokio::test]
async fn a_worker_that_hangs_ends_at_the_goals_timeout() -> anyhow::Result<()> {
    let mut bench = Bench::new().await?;
    bench.performing("hang", Some(0.5), GRACE_MS).perform(Given::Now).await;
    let event = bench.event().await;
    assert!(
        matches!(&event, Some(Event::Finished { outcome, reason, .. })
            if outcome == ABORTED && reason == "took longer than 0.5 s"),
        "{event:?}"
    );
    Ok(())
}

#[tokio::test]
async fn the_timeout_of_a_goal_does_not_count_before_it_is_given() -> anyhow::Result<()> {
    let mut bench = Bench::new().await?;
    // Nothing is before it.
    bench.performing("work", Some(5.0), 0).perform(Given::Now).await;
    assert!(matches!(bench.event().await, Some(Event::Finished { .. })));
    // The log, a goal that was told to stop, and what was decided and is not in the root yet.
    let (earlier, root) = (CancellationToken::new(), watch::channel(Confirmed::default()));
    let (disk, slow) = Mark::not_yet();
    let mut performing = bench.performing("hang", Some(5.0), 0);
    performing.safe = Some(slow);
    performing.before.push(earlier.clone());
    performing.sees = Some((root.1, Revision(3)));
    let performed = tokio::spawn(performing.perform(Given::Now));
    assert!(matches!(bench.event().await, Some(Event::Delayed { instance: InstanceId(1), attempt: 1 })));
    disk.send_replace(1);
    earlier.cancel();
    tokio::task::yield_now().await;
    assert!(bench.answers.try_recv().is_err(), "the root is not there yet");
    root.0.send_replace(Confirmed { commit: Revision(3), ..Confirmed::default() });
    assert!(matches!(bench.event().await, Some(Event::Given { instance: InstanceId(1), attempt: 1 })));
    assert!(matches!(bench.event().await, Some(Event::Finished { .. })));
    Ok(performed.await?)
}

#[tokio::test]
async fn a_goal_of_before_is_found_and_not_given_again() -> anyhow::Result<()> {
    let mut bench = Bench::new().await?;
    // The goal was never given: its fate is unknown, and it is not begun.
    bench.performing("work", None, 0).perform(Given::Before).await;
    let event = bench.event().await;
    assert!(
        matches!(&event, Some(Event::Crashed { reason, unknown: true, .. }) if reason.contains("not known here")),
        "{event:?}"
    );
    // It has ended since.
    bench.performing("work", None, 0).perform(Given::Now).await;
    bench.event().await;
    bench.performing("work", None, 0).perform(Given::Before).await;
    let event = bench.event().await;
    assert!(matches!(&event, Some(Event::Finished { outcome, .. }) if outcome == "success"), "{event:?}");
    // Nobody listened to it.
    let left = tokio::spawn(bench.performing("hang", None, 0).perform(Given::Now));
    while bench.server.running() == 0 {
        tokio::task::yield_now().await;
    }
    left.abort();
    while bench.server.running() > 0 {
        tokio::task::yield_now().await;
    }
    bench.performing("hang", None, 0).perform(Given::Before).await;
    let event = bench.event().await;
    assert!(
        matches!(&event, Some(Event::Crashed { reason, unknown: true, .. }) if reason.contains("nobody listened")),
        "{event:?}"
    );
    Ok(())
}

#[tokio::test]
async fn a_goal_that_only_improves_its_result_ends_when_there_are_other_runs() -> anyhow::Result<()> {
    let mut bench = Bench::new().await?;
    let mut performing = bench.performing("endless", None, 0);
    performing.goal.improves = Some(Vec::new());
    let told = performing.told.clone();
    let ended = tokio::spawn(performing.perform(Given::Now));
    assert!(matches!(bench.event().await, Some(Event::Improved { .. })));
    tokio::time::sleep(Duration::from_millis(100)).await;
    assert!(!ended.is_finished(), "alone it goes on");
    told.beside_others(true);
    let event = bench.event().await;
    assert!(matches!(&event, Some(Event::Finished { outcome, .. }) if outcome == PREEMPTED), "{event:?}");
    Ok(())
}

#[tokio::test]
async fn a_goal_that_was_told_to_stop_before_it_left_is_never_given() -> anyhow::Result<()> {
    let mut bench = Bench::new().await?;
    let performing = bench.performing("hang", None, 0);
    performing.stop.cancel();
    performing.perform(Given::Now).await;
    // Nor is one given that waits for the disk when the run is over.
    let mut performing = bench.performing("hang", None, 0);
    let ((_disk, slow), over) = (Mark::not_yet(), performing.over.clone());
    performing.safe = Some(slow);
    let waits = tokio::spawn(performing.perform(Given::Now));
    over.cancel();
    waits.await?;
    bench.performing("hang", None, 0).perform(Given::Before).await;
    let event = bench.event().await;
    let is_unknown = |reason: &str| reason.contains("not known here");
    assert!(matches!(&event, Some(Event::Crashed { reason, .. }) if is_unknown(reason)), "{event:?}");
    Ok(())
}

/// A provider that goals reach late: it refuses the first goal temporarily, and a goal that it accepts is under way a while later.
struct Late {
    refuses: AtomicU32,
    begun: AtomicU32,
    stop: CancellationToken,
}

type Answers<T> = Pin<Box<dyn Stream<Item = Result<T, Status>> + Send>>;

#[tonic::async_trait]
impl ActionService for Late {
    type ExecuteStream = Answers<ExecuteResponse>;
    type AttachStream = Answers<ExecuteResponse>;
    type PerformStream = Answers<PerformResponse>;

    async fn execute(&self, _: Request<ExecuteRequest>) -> Result<Response<Self::ExecuteStream>, Status> {
        if self.refuses.fetch_sub(1, Ordering::SeqCst) > 0 {
            let details = ErrorDetails::with_error_info("MANAGER_UNHEARD", "ratn", HashMap::new());
            return Err(Status::with_error_details(Code::Unavailable, "not now", details));
        }
        tokio::time::sleep(Duration::from_millis(200)).await;
        self.begun.fetch_add(1, Ordering::SeqCst);
        self.stop.cancelled().await;
        Err(Status::aborted("stopped"))
    }

    async fn attach(&self, _: Request<AttachRequest>) -> Result<Response<Self::AttachStream>, Status> {
        Err(Status::unimplemented(""))
    }

    async fn perform(&self, _: Request<Streaming<PerformRequest>>) -> Result<Response<Self::PerformStream>, Status> {
        Err(Status::unimplemented(""))
    }

    async fn cancel(&self, _: Request<CancelRequest>) -> Result<Response<CancelResponse>, Status> {
        let under_way = self.begun.load(Ordering::SeqCst) > 0;
        if under_way {
            self.stop.cancel();
        }
        Ok(Response::new(CancelResponse { under_way }))
    }

    async fn describe(&self, _: Request<DescribeRequest>) -> Result<Response<DescribeResponse>, Status> {
        Err(Status::unimplemented(""))
    }
}

async fn told_to_stop_at_once(refuses: u32) -> anyhow::Result<Arc<Late>> {
    let bench = Bench::new().await?;
    let late = Late { refuses: refuses.into(), begun: 0.into(), stop: CancellationToken::new() };
    let late = Arc::new(late);
    let bound = bind(&Endpoint::Unix(bench._place.path().join("late.sock"))).await?;
    let mut performing = bench.performing("hang", None, 0);
    performing.endpoint = Ok(bound.endpoint().clone());
    let services = Services::new().with(ActionServiceServer::from_arc(late.clone()));
    tokio::spawn(bound.serve(services, CancellationToken::new()));
    let stop = performing.stop.clone();
    let performed = tokio::spawn(performing.perform(Given::Now));
    tokio::time::sleep(Duration::from_millis(100)).await;
    stop.cancel();
    performed.await?;
    Ok(late)
}

#[tokio::test]
async fn a_cancel_that_comes_before_its_goal_comes_again() -> anyhow::Result<()> {
    let late = told_to_stop_at_once(0).await?;
    assert!(late.begun.load(Ordering::SeqCst) == 1 && late.stop.is_cancelled());
    Ok(())
}

#[tokio::test]
async fn a_goal_that_was_refused_for_now_is_not_given_again_once_it_was_told_to_stop() -> anyhow::Result<()> {
    let late = told_to_stop_at_once(1).await?;
    tokio::time::sleep(Duration::from_millis(500)).await;
    assert_eq!(late.begun.load(Ordering::SeqCst), 0);
    Ok(())
}

/// A provider in another implementation: this is its answer to every goal.
struct Elsewhere(Result<GoalResult, Status>);

#[tonic::async_trait]
impl ActionService for Elsewhere {
    type ExecuteStream = Answers<ExecuteResponse>;
    type AttachStream = Answers<ExecuteResponse>;
    type PerformStream = Answers<PerformResponse>;

    async fn execute(&self, _: Request<ExecuteRequest>) -> Result<Response<Self::ExecuteStream>, Status> {
        let answer = ExecuteResponse { kind: Some(execute_response::Kind::Result(self.0.clone()?)) };
        Ok(Response::new(Box::pin(futures::stream::iter([Ok(answer)]))))
    }

    async fn attach(&self, _: Request<AttachRequest>) -> Result<Response<Self::AttachStream>, Status> {
        Err(Status::unimplemented(""))
    }

    async fn perform(&self, _: Request<Streaming<PerformRequest>>) -> Result<Response<Self::PerformStream>, Status> {
        Err(Status::unimplemented(""))
    }

    async fn cancel(&self, _: Request<CancelRequest>) -> Result<Response<CancelResponse>, Status> {
        Ok(Response::new(CancelResponse { under_way: false }))
    }

    async fn describe(&self, _: Request<DescribeRequest>) -> Result<Response<DescribeResponse>, Status> {
        Err(Status::unimplemented(""))
    }
}

#[tokio::test]
async fn an_answer_that_means_nothing_ends_its_goal_and_is_no_crash() -> anyhow::Result<()> {
    let mut bench = Bench::new().await?;
    let number = |x: f64| BTreeMap::from([("x".to_owned(), v1::Value::from(Value::Float(x)))]);
    let success = || GoalResult { outcome: "success".into(), ..GoalResult::default() };
    let answers = [
        (GoalResult { outputs: number(f64::NAN), ..success() }, "outputs[x].number: is NaN"),
        (GoalResult { outputs: number(f64::INFINITY), ..success() }, "outputs[x].number: is inf"),
        (GoalResult { outcome: "\u{1b}[2J".into(), ..success() }, "outcome: holds control characters"),
        (GoalResult { outcome: ABORTED.into(), reason: "no \u{1b}[2J".repeat(9_999), ..success() }, "no \\u{1b}[2Jno "),
    ];
    for (number, (answer, expected)) in answers.into_iter().enumerate() {
        let bound = bind(&Endpoint::Unix(bench._place.path().join(format!("elsewhere-{number}.sock")))).await?;
        let mut performing = bench.performing("work", None, 0);
        performing.endpoint = Ok(bound.endpoint().clone());
        let services = Services::new().with(ActionServiceServer::new(Elsewhere(Ok(answer))));
        tokio::spawn(bound.serve(services, CancellationToken::new()));
        performing.perform(Given::Now).await;
        let event = bench.event().await;
        let Some(Event::Finished { outcome, reason, .. }) = event else { anyhow::bail!("{expected}: {event:?}") };
        assert!(outcome == ABORTED && reason.contains(expected), "{outcome}: {reason}");
        assert!(reason.len() < 40_000 && !reason.contains('\u{1b}'), "{reason}");
    }
    Ok(())
}

#[tokio::test]
async fn it_is_known_that_nothing_moves_where_a_goal_was_refused_or_its_end_was_heard() -> anyhow::Result<()> {
    let bench = Bench::new().await?;
    let ended = |may_move| Ok(GoalResult { outcome: ABORTED.into(), may_move, ..GoalResult::default() });
    let answers = [
        (ended(false), false),
        (ended(true), true),
        (Err(Status::invalid_argument("no such action")), false),
        (Err(Status::failed_precondition("the lease is over")), false),
        // What cannot be read may be the answer to a goal that is under way.
        (Ok(GoalResult { outcome: "\u{1b}[2J".into(), ..GoalResult::default() }), true),
    ];
    for (number, (answer, may_move)) in answers.into_iter().enumerate() {
        let bound = bind(&Endpoint::Unix(bench._place.path().join(format!("elsewhere-{number}.sock")))).await?;
        let mut performing = bench.performing("work", None, 0);
        performing.endpoint = Ok(bound.endpoint().clone());
        let lease = LeaseId(7);
        let (token, resources, consumed) = (FencingToken(7), Vec::new(), Vec::new());
        performing.goal.lease = Some(Lease { id: lease, token, resources, consumed });
        let doubtful = performing.doubtful.clone();
        let said = format!("{answer:?}");
        let services = Services::new().with(ActionServiceServer::new(Elsewhere(answer)));
        tokio::spawn(bound.serve(services, CancellationToken::new()));
        performing.perform(Given::Now).await;
        assert_eq!(doubtful.has(lease), may_move, "{said}");
        assert_eq!(doubtful.goes_back_at_rest(lease), !may_move);
    }
    Ok(())
}

#[tokio::test]
async fn a_goal_of_before_that_a_provider_started_again_refuses_may_have_been_begun() -> anyhow::Result<()> {
    let bench = Bench::new().await?;
    for (code, reason) in [(Code::FailedPrecondition, "LEASE_REFUTED"), (Code::ResourceExhausted, "BUSY")] {
        let bound = bind(&Endpoint::Unix(bench._place.path().join(format!("{reason}.sock")))).await?;
        let endpoint = bound.endpoint().clone();
        let details = ErrorDetails::with_error_info(reason, "ratn", HashMap::<String, String>::new());
        let status = Status::with_error_details(code, "granted before this process was started", details);
        let services = Services::new().with(ActionServiceServer::new(Elsewhere(Err(status))));
        tokio::spawn(bound.serve(services, CancellationToken::new()));
        for (given, may_move) in [(Given::Before, true), (Given::Now, false)] {
            let performing = bench.performing("work", None, 0);
            performing.may_move.store(true, Ordering::Release);
            let event = performing.given(&endpoint, given).await;
            assert!(matches!(event, Event::Crashed { .. }), "{event:?}");
            assert_eq!(performing.may_move.load(Ordering::Acquire), may_move, "{reason}: {given:?}");
        }
    }
    Ok(())
}

#[tokio::test]
async fn a_worker_that_still_runs_anothers_goal_is_kept_for_a_while_and_not_asked_thrice_at_once() -> anyhow::Result<()>
{
    let mut bench = Bench::new().await?;
    let bound = bind(&Endpoint::Unix(bench._place.path().join("stuck.sock"))).await?;
    let mut performing = bench.performing("work", None, 0);
    performing.endpoint = Ok(bound.endpoint().clone());
    let details = ErrorDetails::with_error_info(STILL_RUNNING, "ratn", HashMap::<String, String>::new());
    let refused = Status::with_error_details(tonic::Code::ResourceExhausted, "goal a still runs", details);
    let services = Services::new().with(ActionServiceServer::new(Elsewhere(Err(refused))));
    tokio::spawn(bound.serve(services, CancellationToken::new()));
    let began = std::time::Instant::now();
    performing.perform(Given::Now).await;
    assert!(began.elapsed() >= STILL_RUNNING_PAUSE, "{:?}", began.elapsed());
    let Some(Event::Crashed { reason, .. }) = bench.event().await else { anyhow::bail!("no crash") };
    assert!(reason.contains("goal a still runs"), "{reason}");
    Ok(())
}

#[tokio::test]
async fn a_goal_that_is_refused_because_its_lease_is_over_was_not_begun() -> anyhow::Result<()> {
    let mut bench = Bench::new().await?;
    for (reason, expected) in [("LEASE_REFUTED", true), ("LEASE_FENCED", true), ("LEASE_UNKNOWN", false)] {
        let bound = bind(&Endpoint::Unix(bench._place.path().join(format!("{reason}.sock")))).await?;
        let mut performing = bench.performing("work", None, 0);
        performing.endpoint = Ok(bound.endpoint().clone());
        let details = ErrorDetails::with_error_info(reason, "ratn", HashMap::<String, String>::new());
        let status = Status::with_error_details(Code::FailedPrecondition, "lease-1 is over", details);
        let services = Services::new().with(ActionServiceServer::new(Elsewhere(Err(status))));
        tokio::spawn(bound.serve(services, CancellationToken::new()));
        performing.perform(Given::Now).await;
        let Some(Event::Crashed { refused, .. }) = bench.event().await else { anyhow::bail!("no crash: {reason}") };
        assert_eq!(refused, expected, "{reason}");
    }
    Ok(())
}

#[tokio::test]
async fn who_comes_back_to_a_goal_hears_of_the_result_that_it_has_given() -> anyhow::Result<()> {
    let mut bench = Bench::new().await?;
    let endless = |bench: &Bench| {
        let mut performing = bench.performing("endless", None, 5_000);
        performing.goal.improves = Some(Vec::new());
        performing
    };
    let left = tokio::spawn(endless(&bench).perform(Given::Now));
    assert!(matches!(bench.event().await, Some(Event::Improved { .. })));
    left.abort();
    let again = endless(&bench);
    let stop = again.stop.clone();
    let again = tokio::spawn(again.perform(Given::Before));
    assert!(matches!(bench.event().await, Some(Event::Improved { .. })));
    stop.cancel();
    Ok(again.await?)
}

#[tokio::test]
async fn of_the_results_before_the_end_those_are_taken_that_are_better_and_so_many_at_the_most() -> anyhow::Result<()> {
    let mut results = Results::default();
    assert!(results.takes(5.0) && !results.takes(7.0) && results.takes(4.0) && !results.takes(4.0));
    let mut bench = Bench::new().await?;
    let mut performing = bench.performing("better", None, 0);
    performing.goal.improves = Some(Vec::new());
    let (events, mut answers) = mpsc::channel(1_024);
    performing.events = events;
    performing.perform(Given::Now).await;
    let mut costs = Vec::new();
    while let Some(Answer::Event { event, .. }) = answers.recv().await {
        match *event {
            Event::Improved { cost_s, .. } => costs.push(cost_s),
            Event::Finished { .. } => break,
            _ => {}
        }
    }
    assert!(costs.windows(2).all(|pair| pair[1] < pair[0]), "{costs:?}");
    assert!(costs.len() > 2 && costs.len() <= MOST_RESULTS as usize, "{}", costs.len());
    // A goal that must not give any ends with its own outcome: the attempt is an error of the action.
    let mut performing = bench.performing("better", None, 0);
    performing.goal.id.push_str("/again");
    performing.perform(Given::Now).await;
    let event = bench.event().await;
    assert!(matches!(&event, Some(Event::Finished { outcome, .. }) if outcome == ABORTED), "{event:?}");
    Ok(())
}

#[tokio::test]
async fn a_goal_of_before_is_not_begun_again_by_a_worker_that_keeps_none_of_its_goals() -> anyhow::Result<()> {
    let mut bench = Bench::new().await?;
    let begun = Arc::new(Late { refuses: 0.into(), begun: 0.into(), stop: CancellationToken::new() });
    let bound = bind(&Endpoint::Unix(bench._place.path().join("plain.sock"))).await?;
    let mut performing = bench.performing("work", None, 0);
    performing.endpoint = Ok(bound.endpoint().clone());
    let services = Services::new().with(ActionServiceServer::from_arc(begun.clone()));
    tokio::spawn(bound.serve(services, CancellationToken::new()));
    // It was given before, and is under way or has ended: the worker tells neither.
    begun.begun.store(1, Ordering::SeqCst);
    performing.perform(Given::Before).await;
    let event = bench.event().await;
    assert!(
        matches!(&event, Some(Event::Crashed { reason, unknown: true, .. }) if reason.contains("Attach")),
        "{event:?}"
    );
    assert!(begun.begun.load(Ordering::SeqCst) == 1 && begun.stop.is_cancelled(), "it is told to stop");
    Ok(())
}
