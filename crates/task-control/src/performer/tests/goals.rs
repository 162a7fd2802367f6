//! Goals of the run: what they wait for, and what waits for their end.

use super::*;
use ratn_model::catalogue::ActionSignature;
use ratn_model::value::{Type, Value};
use tokio::sync::Notify;

/// `move` brakes, once it was told to stop, until it may stand.
struct Braking(Arc<Notify>);

#[tonic::async_trait]
impl Action for Braking {
    fn name(&self) -> &str {
        "move"
    }

    async fn execute(&self, goal: GoalContext) -> ActionResult {
        goal.cancelled.cancelled().await;
        self.0.notified().await;
        Err(goal.stopped())
    }
}

/// `pick` has another provider do something.
struct Calling;

#[tonic::async_trait]
impl Action for Calling {
    fn name(&self) -> &str {
        "pick"
    }

    async fn execute(&self, goal: GoalContext) -> ActionResult {
        goal.call("Tool", "follow", BTreeMap::new()).await?;
        Ok(GoalOutcome::success())
    }
}

/// Serves an action at a socket of this name.
async fn serve(bench: &Bench, name: &str, action: impl Action) -> anyhow::Result<(ActionServer, String)> {
    let server = ActionServer::builder("").one_at_a_time().action(action).build();
    let bound = bind(&Endpoint::Unix(bench._place.path().join(name))).await?;
    let endpoint = bound.endpoint().to_string();
    tokio::spawn(bound.serve(Services::new().with(server.clone().into_service()), CancellationToken::new()));
    Ok((server, endpoint))
}

#[tokio::test]
async fn a_goal_that_acts_waits_for_every_earlier_one_that_acts_and_was_told_to_stop() -> anyhow::Result<()> {
    let mut bench = Bench::new().await?;
    let (_arm, endpoint) = serve_arm(&mut bench).await?;
    let may_stand = Arc::new(Notify::new());
    let (other, at) = serve(&bench, "other.sock", Braking(Arc::clone(&may_stand))).await?;
    let [moves, plans, next] = [1, 2, 3].map(InstanceId);
    bench.performer.only_looks.insert("r/plan".to_owned());
    bench.performer.paths.insert(plans, "r[2]/plan".to_owned());
    // Another arm, under another lease.
    let Command::Start { instance, attempt, mut goal } = start(moves, 1, "move", LeaseId(1), &at) else {
        bail!("it is a start")
    };
    goal.lease.iter_mut().for_each(|lease| lease.resources[0].id = "other".to_owned());
    bench.performer.perform(Command::Start { instance, attempt, goal })?;
    while other.running() == 0 {
        tokio::task::yield_now().await;
    }
    // In one step it is told to stop, and what follows begins.
    bench.performer.perform(Command::Cancel { instance: moves, attempt: 1 })?;
    bench.performer.perform(start(next, 1, "work", LeaseId(2), &endpoint))?;
    bench.performer.perform(start(plans, 1, "work", LeaseId(3), &endpoint))?;
    let event = bench.event().await;
    assert!(matches!(&event, Some(Event::Finished { instance, .. }) if *instance == plans), "{event:?}");
    let early = tokio::time::timeout(Duration::from_millis(100), bench.event()).await;
    assert!(early.is_err(), "it moves beside what still moves: {early:?}");
    may_stand.notify_one();
    let event = bench.event().await;
    assert!(matches!(&event, Some(Event::Finished { instance, .. }) if *instance == next), "{event:?}");
    assert_eq!(other.running(), 0);
    bench.performer.closed().await
}

/// A bench with an arm that needs up to a minute to stand still, leased to an instance; and the client of its provider.
async fn with_slow_arm(instance: InstanceId) -> anyhow::Result<(Bench, Lease, ResourceClient)> {
    let mut bench = Bench::new().await?;
    let channels = Channels::new(&ClientTls::none());
    let provider = ResourceClient::new(&channels, &bench.endpoints.resource_manager, bench._robot.id())?;
    let arm = Resource::new("slow-arm", ResourceClass::Module, "SlowArm").with_standstill(Duration::from_secs(60));
    provider.create(arm).await?;
    let requirements = vec![Requirement::new(ResourceOperation::Block, "SlowArm")];
    bench.performer.perform(Command::Acquire { instance, requirements, priority: 0 })?;
    match bench.event().await {
        Some(Event::Granted { lease, .. }) => Ok((bench, lease, provider)),
        other => bail!("{other:?}"),
    }
}

/// How many leases that have ended the slow arm waits for, when the run does not hold it any more.
async fn ending(provider: &ResourceClient) -> anyhow::Result<usize> {
    loop {
        let arm = provider.get("slow-arm").await?;
        if arm.holdings.is_empty() {
            return Ok(arm.ending.len());
        }
        tokio::time::sleep(Duration::from_millis(5)).await;
    }
}

#[tokio::test]
async fn a_lease_under_which_something_may_still_move_is_free_when_that_has_stopped() -> anyhow::Result<()> {
    for is_lost in [false, true] {
        let (mut bench, mut lease, provider) = with_slow_arm(InstanceId(1)).await?;
        serve_arm(&mut bench).await?;
        let (_server, endpoint) = serve(&bench, "picker.sock", Calling).await?;
        let (tool, at) = serve(&bench, "tool.sock", Follow).await?;
        // The goal of the worker calls another one, which is there or not.
        let at = if is_lost { "unix:/nowhere/tool.sock".to_owned() } else { at };
        let resource = |kind: &str, endpoint: &str| LeasedResource {
            id: kind.to_lowercase(),
            kind: kind.to_owned(),
            endpoint: endpoint.to_owned(),
            superclasses: Vec::new(),
        };
        lease.resources.extend([resource("Arm", &endpoint), resource("Tool", &at)]);
        let Command::Start { instance, attempt, mut goal } = start(InstanceId(1), 1, "pick", lease.id, "") else {
            bail!("it is a start")
        };
        goal.lease = Some(lease.clone());
        bench.performer.perform(Command::Start { instance, attempt, goal })?;
        let event = bench.event().await;
        let expected = if is_lost { "aborted" } else { SUCCESS };
        assert!(matches!(&event, Some(Event::Finished { outcome, .. }) if outcome == expected), "{event:?}");
        bench.goes_on(InstanceId(1), lease.id, None)?;
        assert_eq!(ending(&provider).await?, usize::from(is_lost));
        assert_eq!(tool.running(), 0);
        bench.performer.closed().await?;
    }
    Ok(())
}

/// `follow` ends at once.
struct Follow;

#[tonic::async_trait]
impl Action for Follow {
    fn name(&self) -> &str {
        "follow"
    }

    async fn execute(&self, _: GoalContext) -> ActionResult {
        Ok(GoalOutcome::success())
    }
}

#[tokio::test]
async fn who_comes_back_gives_back_at_rest_what_nothing_was_begun_under() -> anyhow::Result<()> {
    let instance = InstanceId(1);
    for is_given_back in [false, true] {
        let (bench, lease, provider) = with_slow_arm(instance).await?;
        let run = bench.performer.run.clone();
        let requirements = vec![Requirement::new(ResourceOperation::Block, "SlowArm")];
        let mut ledger = ledger(&run, &[]);
        ledger.command(&Command::Acquire { instance, requirements, priority: 0 });
        let release = Command::Release { instance, lease: Some(lease.id), projection: None };
        ledger.event(Timestamp(0), &Event::Granted { instance, lease });
        // Task control is killed before it has given back what the log says, or before it has decided to.
        if is_given_back {
            ledger.command(&release);
        }
        ledger.event(Timestamp(0), &Event::Resumed { share: None });
        let mut bench = bench.comes_back(true).await?;
        bench.takes_up(ledger, &World::default()).await?;
        if !is_given_back {
            bench.performer.perform(release)?;
        }
        assert_eq!(ending(&provider).await?, 0);
        bench.performer.closed().await?;
    }
    Ok(())
}

#[tokio::test]
async fn who_comes_back_tells_a_goal_to_stop_that_may_not_have_been_told() -> anyhow::Result<()> {
    let mut bench = Bench::new().await?;
    let (routine, motion) = (InstanceId(1), InstanceId(2));
    bench.ask(routine)?;
    let lease = bench.granted(routine).await?;
    let (arm, endpoint) = serve_arm(&mut bench).await?;
    let started = start(motion, 1, "brake", lease, &endpoint);
    bench.performer.perform(started.clone())?;
    while arm.running() == 0 {
        tokio::task::yield_now().await;
    }
    // Task control is killed when it has logged the cancel and before it has sent it to the arm.
    let run = bench.performer.run.clone();
    let acquire = Command::Acquire { instance: routine, requirements: self::arm(), priority: 0 };
    let mut ledger = ledger(&run, &[]);
    ledger.command(&acquire);
    let resource =
        LeasedResource { id: "arm".into(), kind: "Arm".into(), endpoint: endpoint.clone(), superclasses: Vec::new() };
    let held = Lease { id: lease, token: FencingToken(1), resources: vec![resource], consumed: Vec::new() };
    ledger.event(Timestamp(0), &Event::Granted { instance: routine, lease: held });
    ledger.command(&started);
    ledger.command(&Command::Cancel { instance: motion, attempt: 1 });
    ledger.event(Timestamp(0), &Event::Resumed { share: None });
    let catalogue = bench.performer.catalogue.clone();
    let mut bench = bench.comes_back(true).await?;
    bench.performer.catalogue = catalogue;
    bench.takes_up(ledger, &World::default()).await?;
    // The next goal of that arm is sent when the arm stands still.
    bench.performer.perform(start(InstanceId(3), 1, "work", lease, &endpoint))?;
    let event = bench.event().await;
    assert!(matches!(&event, Some(Event::Finished { outcome, .. }) if outcome == SUCCESS), "{event:?}");
    assert_eq!(arm.running(), 0);
    bench.performer.closed().await
}

#[tokio::test]
async fn a_lease_goes_back_when_every_goal_under_it_has_ended() -> anyhow::Result<()> {
    let mut bench = Bench::new().await?;
    let (routine, motion, other) = (InstanceId(1), InstanceId(2), InstanceId(3));
    let (events, mut answers) = mpsc::channel(8);
    let mut second = connect(&bench.endpoints, "second", events).await?;
    bench.ask(routine)?;
    let lease = bench.granted(routine).await?;
    let (arm, endpoint) = serve_arm(&mut bench).await?;
    // A motion of the routine loses a race: it is cancelled, its projection goes back, and the routine ends.
    bench.performer.perform(start(motion, 1, "brake", lease, &endpoint))?;
    while arm.running() == 0 {
        tokio::task::yield_now().await;
    }
    second.perform(Command::Acquire { instance: other, requirements: self::arm(), priority: 0 })?;
    let projection = Some(ProjectionId(999));
    for command in [
        Command::Cancel { instance: motion, attempt: 1 },
        Command::Release { instance: motion, lease: None, projection },
        Command::Release { instance: routine, lease: Some(lease), projection: None },
    ] {
        bench.performer.perform(command)?;
    }
    granted_after(&mut second, &mut answers).await?;
    assert_eq!(arm.running(), 0, "whoever gets the arm finds it idle");
    second.closed().await?;
    bench.performer.closed().await
}

#[tokio::test]
async fn a_goal_waits_for_one_of_the_same_resource_that_was_told_to_stop() -> anyhow::Result<()> {
    let mut bench = Bench::new().await?;
    let (arm, endpoint) = serve_arm(&mut bench).await?;
    let start = |instance, attempt, action: &str| start(instance, attempt, action, LeaseId(1), &endpoint);
    for round in 0..20 {
        let (first, second, third) = (InstanceId(3 * round + 1), InstanceId(3 * round + 2), InstanceId(3 * round + 3));
        bench.performer.perform(start(first, 1, "hang"))?;
        while arm.running() == 0 {
            tokio::task::yield_now().await;
        }
        // A goal that a limit cuts short, and a goal on the way out, which is cut short in turn and tried again.
        bench.performer.perform(Command::Cancel { instance: first, attempt: 1 })?;
        bench.performer.perform(start(second, 1, "hang"))?;
        bench.performer.perform(Command::Cancel { instance: second, attempt: 1 })?;
        bench.performer.perform(start(second, 2, "work"))?;
        let event = bench.event().await;
        assert!(
            matches!(&event, Some(Event::Finished { instance, attempt: 2, outcome, .. })
                if *instance == second && outcome == SUCCESS),
            "round {round}: {event:?}"
        );
        bench.performer.perform(start(third, 1, "work"))?;
        let event = bench.event().await;
        assert!(matches!(&event, Some(Event::Finished { outcome, .. }) if outcome == SUCCESS), "{event:?}");
    }
    bench.performer.closed().await
}

#[tokio::test]
async fn a_goal_without_a_projection_begins_when_what_was_decided_before_it_is_in_the_root() -> anyhow::Result<()> {
    let mut bench = Bench::new().await?;
    let [first, second, third] = [1, 2, 3].map(InstanceId);
    bench.ask(first)?;
    let lease = bench.granted(first).await?;
    let (_arm, endpoint) = serve_arm(&mut bench).await?;
    let work = |instance| start(instance, 1, "work", lease, &endpoint);
    let world = WorldClient::new(&Channels::new(&ClientTls::none()), &bench.endpoints.world_pool)?;
    // The commit is under way for long.
    let (disk, slow) = Mark::not_yet();
    let commit = Command::Commit {
        instance: first,
        writer: "place[1]".into(),
        evidence: Vec::new(),
        changes: done(),
        revision: Revision(1),
    };
    bench.performer.perform_when(Some(slow), commit)?;
    bench.performer.perform(work(first))?;
    // A goal that is cancelled meanwhile is never given; a goal with a projection does not wait.
    bench.performer.perform(work(second))?;
    bench.performer.perform(Command::Cancel { instance: second, attempt: 1 })?;
    let Command::Start { instance, attempt, mut goal } = work(third) else { bail!("it is a start") };
    goal.projection = Some(ProjectionId(999));
    bench.performer.perform(Command::Start { instance, attempt, goal })?;
    let event = bench.event().await;
    assert!(matches!(&event, Some(Event::Finished { instance, .. }) if *instance == third), "{event:?}");
    let early = tokio::time::timeout(Duration::from_millis(200), bench.event()).await;
    assert!(early.is_err(), "{early:?}");
    assert_eq!(world.root().await?.0, Revision(0));
    disk.send_replace(1);
    let event = bench.event().await;
    assert!(matches!(&event, Some(Event::Finished { instance, .. }) if *instance == first), "{event:?}");
    assert_eq!(world.root().await?.1.len(), 1);
    bench.performer.closed().await
}

#[tokio::test]
async fn a_goal_of_before_that_was_never_given_waits_for_what_was_decided_before_it() -> anyhow::Result<()> {
    let mut bench = Bench::new().await?;
    let (first, second) = (InstanceId(1), InstanceId(2));
    let (_arm, endpoint) = serve_arm(&mut bench).await?;
    // The arm is offered in a session with a short time to live, which soon proves whether it is the same.
    let channels = Channels::new(&ClientTls::none());
    let manager = bench.endpoints.resource_manager.clone();
    let robot = Session::open(&channels, &manager, "brief", Duration::from_secs(1));
    robot.alive(SESSION_DEADLINE).await?;
    let offering = ResourceClient::new(&channels, &manager, robot.id())?;
    offering.create(Resource::new("brief-arm", ResourceClass::Module, "BriefArm")).await?;
    let requirements = vec![Requirement::new(ResourceOperation::Block, "BriefArm")];
    bench.performer.perform(Command::Acquire { instance: first, requirements, priority: 0 })?;
    let lease = bench.granted(first).await?;
    let goal = |instance| {
        let Command::Start { mut goal, .. } = start(instance, 1, "work", lease, &endpoint) else {
            unreachable!("it is a start")
        };
        if let Some(lease) = &mut goal.lease {
            lease.resources[0].id = "brief-arm".to_owned();
        }
        *goal
    };
    // The commit is under way for long; the log says that both goals were given, and the provider knows neither.
    let (disk, slow) = Mark::not_yet();
    bench.performer.perform_when(Some(slow), commits(1, 1))?;
    bench.performer.start(first, 1, goal(first), Given::Before, None);
    bench.performer.start(second, 1, Goal { reads_nothing: true, ..goal(second) }, Given::Before, None);
    let event = bench.event().await;
    assert!(matches!(&event, Some(Event::Finished { instance, .. }) if *instance == second), "{event:?}");
    let early = tokio::time::timeout(Duration::from_secs(1), bench.event()).await;
    assert!(early.is_err(), "{early:?}");
    disk.send_replace(1);
    let event = bench.event().await;
    assert!(matches!(&event, Some(Event::Finished { instance, .. }) if *instance == first), "{event:?}");
    bench.performer.closed().await
}

#[tokio::test]
async fn a_motion_that_reads_nothing_does_not_wait_for_what_was_decided_before_it() -> anyhow::Result<()> {
    let mut bench = Bench::new().await?;
    let (first, second) = (InstanceId(1), InstanceId(2));
    bench.ask(first)?;
    let lease = bench.granted(first).await?;
    let (_arm, endpoint) = serve_arm(&mut bench).await?;
    let (disk, slow) = Mark::not_yet();
    bench.performer.perform_when(Some(slow), commits(1, 1))?;
    for (instance, reads_nothing) in [(first, false), (second, true)] {
        let Command::Start { attempt, goal, .. } = start(instance, 1, "work", lease, &endpoint) else {
            bail!("it is a start")
        };
        let goal = Box::new(Goal { reads_nothing, ..*goal });
        bench.performer.perform(Command::Start { instance, attempt, goal })?;
    }
    for expected in [second, first] {
        let event = bench.event().await;
        assert!(matches!(&event, Some(Event::Finished { instance, .. }) if *instance == expected), "{event:?}");
        disk.send_replace(1);
    }
    bench.performer.closed().await
}

#[tokio::test]
async fn a_goal_that_reads_nothing_is_shown_no_facts() -> anyhow::Result<()> {
    let mut bench = Bench::new().await?;
    let instance = InstanceId(1);
    bench.ask(instance)?;
    let lease = bench.granted(instance).await?;
    let (_arm, endpoint) = serve_arm(&mut bench).await?;
    for (attempt, reads_nothing) in [(1, false), (2, true)] {
        let Command::Start { goal, .. } = start(instance, attempt, "look", lease, &endpoint) else {
            bail!("it is a start")
        };
        let goal = Box::new(Goal { reads_nothing, ..*goal });
        bench.performer.perform(Command::Start { instance, attempt, goal })?;
        let Some(Event::Finished { outcome, reason, .. }) = bench.event().await else { bail!("it has not ended") };
        assert_eq!(outcome == SUCCESS, !reads_nothing, "{outcome}: {reason}");
        assert_eq!(reason.contains("reads: []"), reads_nothing, "{reason}");
    }
    bench.performer.closed().await
}

#[tokio::test]
async fn an_int_for_a_float_port_reaches_the_provider_as_a_float() -> anyhow::Result<()> {
    let mut bench = Bench::new().await?;
    let action = ActionSignature { inputs: [("exposure_s".to_owned(), Type::Float)].into(), ..Default::default() };
    let actions = [("photo".to_owned(), action)].into();
    let provider = Provider { resource: "Arm".to_owned(), joints: None, chain: None, actions };
    bench.performer.catalogue =
        Arc::new(Catalogue { providers: [("arm".to_owned(), provider)].into(), ..Catalogue::default() });
    let Command::Start { mut goal, .. } = start(InstanceId(1), 1, "photo", LeaseId(1), "") else {
        bail!("it is a start")
    };
    goal.inputs = [("exposure_s".to_owned(), Value::Int(2))].into();
    let (inputs, _) = bench.performer.ports_of(&goal);
    assert_eq!(inputs, [("exposure_s".to_owned(), Value::Float(2.0))].into());
    bench.performer.closed().await
}
