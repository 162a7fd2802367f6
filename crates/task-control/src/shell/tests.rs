//! Task control with a real resource manager and world pool, without any providers.

use super::*;
use crate::task_for_tests::{FETCH_BOXES, program};
use ratn_daemon::resource_manager::{self, ResourceManagerConfig};
use ratn_daemon::world_pool::{self, WorldPoolConfig};
use ratn_executive::protocol::{LogEntry, LogLine};
use ratn_model::fact::{Change, FactKey, Term};
use ratn_worker::runtime_directory::RuntimeDirectory;
use std::time::Duration;
use tokio_util::sync::{CancellationToken, DropGuard};

const READY: Duration = Duration::from_secs(5);

struct Bench {
    place: Place,
    run: Run,
    directory: tempfile::TempDir,
    _shutdown: DropGuard,
}

impl Bench {
    async fn new(change: impl FnOnce(&mut Program)) -> anyhow::Result<Bench> {
        let directory = tempfile::tempdir()?;
        let runtime = RuntimeDirectory::create(directory.path())?;
        let shutdown = CancellationToken::new();
        tokio::spawn(resource_manager::run(ResourceManagerConfig::default(), runtime.clone(), shutdown.clone()));
        tokio::spawn(world_pool::run(WorldPoolConfig::default(), runtime.clone(), shutdown.clone()));
        let endpoints = Endpoints {
            resource_manager: runtime.wait_for(resource_manager::ROLE, READY).await?,
            world_pool: runtime.wait_for(world_pool::ROLE, READY).await?,
        };
        let catalogue = Catalogue::standard();
        let mut program = program(FETCH_BOXES);
        change(&mut program);
        let run = Run {
            parameters: program.bind_parameters(&[])?,
            program: Arc::new(program),
            from: None,
            file: String::new(),
            mode: Mode::Cdtn,
            seed: 1,
            learned: Learned::default(),
            log: directory.path().join("log.jsonl"),
            breakpoints: Vec::new(),
            quiet: true,
            checkpoint_every: 0,
        };
        let place = Place {
            endpoints,
            tls: ratn_worker::tls::ClientTls::none(),
            directory: directory.path().to_owned(),
            catalogue: Arc::new(catalogue),
            robot: String::new(),
            speed: 10.0,
            messages: Messages::nowhere(),
            alone: false,
            urgency: Urgency::Normal,
            standing: ratn_worker::session::Standing::default(),
        };
        Ok(Bench { place, run, directory, _shutdown: shutdown.drop_guard() })
    }

    fn lines(&self) -> anyhow::Result<Vec<LogLine>> {
        Ok(ratn_event_log::read(&self.directory.path().join("log.jsonl"))?.lines)
    }
}

#[tokio::test]
async fn a_task_ends_at_its_deadline_although_nobody_answers() -> anyhow::Result<()> {
    let bench = Bench::new(|program| program.deadline_s = Some(2.0)).await?;
    let ended = run(bench.run.clone(), &bench.place, &Interrupt::new().1).await?;
    assert_eq!(ended.outcome, "aborted");
    assert!((2.0..20.0).contains(&ended.makespan_s), "{ended:?}");
    let woken = |line: &LogLine| line.entry == LogEntry::Event(Event::Woken) && line.at >= Timestamp::from_seconds(2.0);
    assert!(bench.lines()?.iter().any(woken));
    Ok(())
}

#[tokio::test]
async fn what_the_log_has_no_room_for_is_not_done() -> anyhow::Result<()> {
    let mut bench = Bench::new(|_| {}).await?;
    bench.run.log = "/dev/full".into();
    let failed = run(bench.run.clone(), &bench.place, &Interrupt::new().1).await.expect_err("it has no log");
    assert!(format!("{failed:#}").contains("No space left"), "{failed:#}");
    let channels = ratn_worker::client::Channels::new(&bench.place.tls);
    let world = ratn_worker::client::WorldClient::new(&channels, &bench.place.endpoints.world_pool)?;
    assert!(world.root().await?.1.is_empty(), "its initial world was written all the same");
    Ok(())
}

#[tokio::test]
async fn a_run_is_told_to_end_over_its_socket() -> anyhow::Result<()> {
    use crate::control::{Word, tell};
    let bench = Bench::new(|_| {}).await?;
    let (_asks, interrupt) = Interrupt::new();
    let running = run(bench.run.clone(), &bench.place, &interrupt);
    let telling = async {
        while tell(&bench.place.directory, ANY_RUN, Word::Abort).await.is_err() {
            tokio::task::yield_now().await;
        }
    };
    let (ended, ()) = tokio::join!(running, telling);
    assert_eq!(ended?.outcome, "preempted");
    // Nobody listens there any more.
    assert!(tell(&bench.place.directory, ANY_RUN, Word::Abort).await.is_err());
    Ok(())
}

const WAITING: &str = "
task: hand_over
variables: { order: null }
outputs: { order: $order, answer: really.answer }
states:
  - next: { wait: { signal: order }, assign: { order: value } }
  - really: { ask: { question: Really?, choices: [so, not_so] } }
  - later: { wait: { signal: later } }
";

/// Sends a message as soon as a run listens; returns the answer.
async fn sent(place: &Place, message: Message) -> Result<String, String> {
    loop {
        match crate::control::send(&place.directory, &message).await {
            Err(error) if crate::control::is_nobody(&error) => tokio::task::yield_now().await,
            sent => return sent.map_err(|error| error.to_string()),
        }
    }
}

fn signal(name: &str, value: Value) -> Message {
    Message::Signal { run: ANY_RUN.to_owned(), signal: name.to_owned(), value }
}

fn answer(run: &str, state: Option<&str>, choice: &str) -> Message {
    Message::Answer { run: run.to_owned(), state: state.map(str::to_owned), choice: choice.to_owned() }
}

/// Waits until the run reports that this state waits.
async fn waits(place: &Place, path: &str) {
    let is_it = |status: &RunStatus| status.awaits.iter().any(|awaiting| awaiting.path == path);
    while !crate::control::status(&place.directory, ANY_RUN).await.ok().flatten().is_some_and(|status| is_it(&status)) {
        tokio::task::yield_now().await;
    }
}

/// A gRPC client sees the waits, and is refused like everybody.
async fn over_grpc(place: &Place) {
    use ratn_proto::v1;
    let runtime = RuntimeDirectory::at(&place.directory);
    let endpoint = runtime.wait_for(crate::control::ROLE, READY).await.expect("it is served");
    let channel = ratn_worker::client::Channels::new(&place.tls).get(&endpoint).expect("a channel");
    let mut client = v1::run_service_client::RunServiceClient::new(channel);
    let waits = client.get_waits(v1::GetWaitsRequest::default()).await.expect("it says").into_inner();
    let awaited = Some(v1::wait::Awaited::Signal("order".to_owned()));
    let wait = v1::Wait { path: "next".to_owned(), until_s: None, awaited };
    assert_eq!((waits.task.as_str(), waits.waits), ("hand_over", vec![wait]));
    let answer = v1::SendAnswerRequest { choice: "so".to_owned(), ..Default::default() };
    let refused = client.send_answer(answer).await.expect_err("nothing is asked");
    assert_eq!((refused.code(), refused.message()), (tonic::Code::FailedPrecondition, "no state asks anything now"));
    for bad in ["a\u{1b}[31m".to_owned(), "a".repeat(2_000)] {
        let request = |run: &str, signal: &str| v1::SendSignalRequest {
            run: run.to_owned(),
            signal: signal.to_owned(),
            value: None,
        };
        for (request, field) in [(request(&bad, "later"), "run"), (request("", &bad), "signal")] {
            let refused = client.send_signal(request).await.expect_err("it is no name");
            assert!(refused.code() == tonic::Code::InvalidArgument && refused.message().contains(field), "{refused}");
        }
        let of_state = v1::SendAnswerRequest { state: bad.clone(), ..Default::default() };
        let of_choice = v1::SendAnswerRequest { choice: bad, ..Default::default() };
        for (request, field) in [(of_state, "state"), (of_choice, "choice")] {
            let refused = client.send_answer(request).await.expect_err("it is no name");
            assert!(refused.code() == tonic::Code::InvalidArgument && refused.message().contains(field), "{refused}");
        }
    }
    let again = v1::SendSignalRequest { signal: "later".to_owned(), ..Default::default() };
    let said = client.send_signal(again).await.expect("it is kept").into_inner().said;
    assert_eq!(said, "it is kept for the next state that waits for `later`");
}

/// A gRPC client sets, lists and removes breakpoints.
async fn breakpoints_over_grpc(place: &Place) {
    use ratn_proto::v1;
    let runtime = RuntimeDirectory::at(&place.directory);
    let endpoint = runtime.wait_for(crate::control::ROLE, READY).await.expect("it is served");
    let channel = ratn_worker::client::Channels::new(&place.tls).get(&endpoint).expect("a channel");
    let mut client = v1::run_service_client::RunServiceClient::new(channel);
    let there = async |client: &mut v1::run_service_client::RunServiceClient<_>| {
        let there = client.get_breakpoints(v1::GetBreakpointsRequest::default()).await.expect("it says").into_inner();
        assert_eq!((there.task.as_str(), there.run.is_empty()), ("two", false));
        (there.states, there.paused)
    };
    let named = |states: &[&str]| states.iter().map(|state| (*state).to_owned()).collect::<Vec<_>>();
    assert_eq!(there(&mut client).await, (named(&["first"]), true));
    let set = |run: &str, state: &str| v1::SetBreakpointRequest { run: run.to_owned(), state: state.to_owned() };
    let clear = |run: &str, state: &str| v1::ClearBreakpointRequest { run: run.to_owned(), state: state.to_owned() };
    let said = client.set_breakpoint(set("two", "second[3]/inner")).await.expect("it is taken").into_inner().said;
    assert_eq!(said, "the run pauses before first, second/inner");
    client.set_breakpoint(set("", "second/inner")).await.expect("it is taken again");
    assert_eq!(there(&mut client).await, (named(&["first", "second/inner"]), true));
    let gone = client.clear_breakpoint(clear("", "second/inner")).await.expect("it is taken").into_inner().said;
    assert_eq!(gone, "the run pauses before first");
    let unknown = client.set_breakpoint(set("", "secnod")).await.expect_err("there is none");
    assert!(unknown.code() == tonic::Code::FailedPrecondition && unknown.message().contains("did you mean `second`?"));
    let quiet = client.set_breakpoint(set("", "name")).await.expect_err("it never stops there");
    assert_eq!(quiet.code(), tonic::Code::FailedPrecondition);
    let none = client.clear_breakpoint(clear("", "second/inner")).await.expect_err("it was taken away");
    assert_eq!(none.code(), tonic::Code::FailedPrecondition);
    let other = client.set_breakpoint(set("fetch", "first")).await.expect_err("there is no such run");
    assert_eq!(other.code(), tonic::Code::FailedPrecondition);
    let long = "a".repeat(2_000);
    for (run, state) in [("", ""), ("", "a\u{1b}[31m"), ("a\nb", "first"), ("", long.as_str())] {
        let refused = client.set_breakpoint(set(run, state)).await.expect_err("it is no name");
        assert_eq!(refused.code(), tonic::Code::InvalidArgument, "{run:?} {state:?}: {refused}");
        if !state.is_empty() {
            let refused = client.clear_breakpoint(clear(run, state)).await.expect_err("it is no name");
            assert_eq!(refused.code(), tonic::Code::InvalidArgument, "{run:?} {state:?}: {refused}");
        }
    }
    assert_eq!(there(&mut client).await, (named(&["first"]), true), "what was refused has changed nothing");
}

fn breakpoint(state: Option<&str>, set: bool) -> Message {
    Message::Breakpoint { run: ANY_RUN.to_owned(), state: state.map(str::to_owned), set }
}

#[tokio::test]
async fn a_run_stops_at_its_breakpoints_until_it_is_let_go() -> anyhow::Result<()> {
    use crate::control::{Word, tell};
    const TWO: &str = "
task: two
states:
  - first: { wait: { seconds: 0.1 } }
  - second: { states: [{ inner: { wait: { seconds: 0.1 } } }] }
  - name: { condition: true, then: [], else: [] }
";
    let mut bench = Bench::new(|two| *two = program(TWO)).await?;
    bench.run.breakpoints = breakpoints(&bench.run.program, &["first".to_owned()]).map_err(anyhow::Error::msg)?;
    let place = &bench.place;
    let (_asks, interrupt) = Interrupt::new();
    let stopped = async |ended: u64| loop {
        let status = crate::control::status(&place.directory, ANY_RUN).await.ok().flatten();
        if status.is_some_and(|status| status.paused && status.ended >= ended) {
            break;
        }
        tokio::task::yield_now().await;
    };
    let telling = async {
        stopped(0).await;
        breakpoints_over_grpc(place).await;
        let unknown = sent(place, breakpoint(Some("secnod"), true)).await.expect_err("there is none");
        assert!(unknown.contains("two has no state `secnod`: did you mean `second`?"), "{unknown}");
        let quiet = sent(place, breakpoint(Some("name"), true)).await.expect_err("it never stops there");
        assert!(quiet.contains("`name` changes nothing"), "{quiet}");
        let set = sent(place, breakpoint(Some("second[3]/inner"), true)).await;
        assert_eq!(set, Ok("the run pauses before first, second/inner".to_owned()));
        assert_eq!(
            sent(place, breakpoint(Some("first"), false)).await,
            Ok("the run pauses before second/inner".to_owned())
        );
        tell(&place.directory, ANY_RUN, Word::Resume).await.expect("it listens");
        stopped(1).await;
        let none = sent(place, breakpoint(Some("first"), false)).await.expect_err("it was taken away");
        assert!(none.contains("no breakpoint at `first`: there is second/inner"), "{none}");
        assert_eq!(sent(place, breakpoint(None, false)).await, Ok("no breakpoints are set any more".to_owned()));
        tell(&place.directory, ANY_RUN, Word::Resume).await.expect("it listens");
    };
    let (ended, ()) = tokio::join!(run(bench.run.clone(), place, &interrupt), telling);
    assert_eq!(ended?.outcome, SUCCESS);
    Ok(())
}

async fn resumption_of(run: &Run) -> anyhow::Result<Resumption> {
    // Threads of dropped runs hold the log a moment longer.
    let log = loop {
        match LogWriter::go_on(&run.log) {
            Err(ratn_event_log::LogError::UnderWay { .. }) => tokio::task::yield_now().await,
            opened => break opened?,
        }
    };
    let history = crate::history::History::of(&log, Messages::nowhere())?;
    Ok(Resumption::new((*run.program).clone(), history, log, 1)?)
}

#[tokio::test]
async fn of_a_run_that_was_killed_behind_its_end_the_rest_is_done_once() -> anyhow::Result<()> {
    const NOTED: &str = "
task: note
states:
  - part: { effects: [noted(desk)], resources: [{ create: Note, class: task }], states: [{ moment: { wait: { seconds: 0.1 } } }] }
";
    let bench = Bench::new(|note| *note = program(NOTED)).await?;
    let (place, (_asks, interrupt)) = (&bench.place, Interrupt::new());
    let outcome = run(bench.run.clone(), place, &interrupt).await?.outcome;
    assert_eq!(outcome, SUCCESS);
    let nothing = Box::pin(resume(resumption_of(&bench.run).await?, place, &interrupt)).await;
    let ended = || replay::ReplayError::Ended { outcome: outcome.clone() };
    assert_eq!(nothing.err().and_then(|error| error.downcast().ok()), Some(ended()));
    // A world pool that has not received the last commit.
    let runtime = RuntimeDirectory::create(bench.directory.path().join("other"))?;
    let shutdown = CancellationToken::new();
    tokio::spawn(world_pool::run(WorldPoolConfig::default(), runtime.clone(), shutdown.clone()));
    let _shutdown = shutdown.drop_guard();
    let world_pool = runtime.wait_for(world_pool::ROLE, READY).await?;
    let place = &Place { endpoints: Endpoints { world_pool, ..place.endpoints.clone() }, ..place.clone() };
    let finished = Box::pin(resume(resumption_of(&bench.run).await?, place, &interrupt)).await?;
    assert_eq!(finished.outcome, SUCCESS);
    let channels = ratn_worker::client::Channels::new(&place.tls);
    let world = ratn_worker::client::WorldClient::new(&channels, &place.endpoints.world_pool)?;
    let (_, facts) = world.root().await?;
    assert_eq!(facts.iter().map(|fact| fact.key.to_string()).collect::<Vec<_>>(), ["noted(desk)"]);
    let nothing = Box::pin(resume(resumption_of(&bench.run).await?, place, &interrupt)).await;
    assert_eq!(nothing.err().and_then(|error| error.downcast().ok()), Some(ended()));
    Ok(())
}

#[tokio::test]
async fn an_operation_in_front_of_which_the_log_was_cut_is_done_once() -> anyhow::Result<()> {
    const NOTING: &str = "
task: note
states:
  - part: { effects: [noted(desk)], resources: [{ create: Note, class: task }], states: [{ moment: { wait: { seconds: 0.1 } } }] }
  - next: { wait: { signal: go } }
  - done: { effects: [noted(chair)], resources: [{ create: Done, class: task }], states: [{ moment: { wait: { seconds: 0.1 } } }] }
  - last: { wait: { signal: end } }
";
    let bench = Bench::new(|note| *note = program(NOTING)).await?;
    let (place, log, (_asks, interrupt)) = (&bench.place, &bench.run.log, Interrupt::new());
    let whole = async {
        waits(place, "next").await;
        loop {
            match std::fs::read_to_string(log) {
                Ok(text) if text.contains("\"operate\"") => break,
                _ => tokio::task::yield_now().await,
            }
        }
    };
    tokio::select! {
        ended = run(bench.run.clone(), place, &interrupt) => panic!("it ended: {ended:?}"),
        () = whole => {}
    }
    // Nobody writes there any more.
    drop(resumption_of(&bench.run).await?);
    let text = std::fs::read_to_string(log)?;
    let cut: String = text.split_inclusive('\n').take_while(|line| !line.contains("\"operate\"")).collect();
    std::fs::write(log, cut)?;
    let channels = ratn_worker::client::Channels::new(&place.tls);
    let resources = ratn_worker::client::ResourceClient::new(&channels, &place.endpoints.resource_manager, "")?;
    let goes_on = async {
        sent(place, signal("go", Value::Null)).await.expect("it waits");
        // What comes after the operation is done after it.
        while resources.list(&["Done"]).await.is_ok_and(|there| there.is_empty()) {
            tokio::task::yield_now().await;
        }
        let notes = resources.list(&["Note"]).await.map(|notes| notes.len());
        sent(place, signal("end", Value::Null)).await.expect("it waits");
        notes
    };
    let (ended, notes) = tokio::join!(resume(resumption_of(&bench.run).await?, place, &interrupt), goes_on);
    assert_eq!((ended?.outcome.as_str(), notes?), (SUCCESS, 1));
    Ok(())
}

#[tokio::test]
async fn what_is_due_when_a_resumption_says_that_the_session_is_lost_is_done() -> anyhow::Result<()> {
    const MOMENTS: &str = "
task: moments
states:
  - first: { wait: { seconds: 100 } }
  - second: { effects: [noted(desk)], states: [{ moment: { wait: { seconds: 1 } } }] }
  - third: { wait: { seconds: 1 } }
";
    let bench = Bench::new(|moments| *moments = program(MOMENTS)).await?;
    let (_asks, interrupt) = Interrupt::new();
    tokio::select! {
        ended = run(bench.run.clone(), &bench.place, &interrupt) => panic!("it ended: {ended:?}"),
        () = waits(&bench.place, "first") => {}
    }
    // A resource manager that does not know the session.
    let runtime = RuntimeDirectory::create(bench.directory.path().join("other"))?;
    let shutdown = CancellationToken::new();
    tokio::spawn(resource_manager::run(ResourceManagerConfig::default(), runtime.clone(), shutdown.clone()));
    let _shutdown = shutdown.drop_guard();
    let resource_manager = runtime.wait_for(resource_manager::ROLE, READY).await?;
    let endpoints = Endpoints { resource_manager, ..bench.place.endpoints.clone() };
    // While the world pool is asked for the run's commits, many seconds of the robot's time pass.
    let place = &Place { endpoints, speed: 1e5, ..bench.place.clone() };
    let resumed = Box::pin(resume(resumption_of(&bench.run).await?, place, &interrupt));
    let resumed = tokio::time::timeout(READY, resumed).await;
    let lines = bench.lines()?;
    let is_lost = |line: &LogLine| matches!(line.entry, LogEntry::Event(Event::SessionLost { .. }));
    let behind = lines.iter().skip_while(|line| !is_lost(line)).skip(1);
    let commands = behind.map_while(|line| match &line.entry {
        LogEntry::Command(command) => Some(command),
        LogEntry::Event(_) => None,
    });
    assert!(
        commands.into_iter().any(|command| matches!(command, Command::Commit { .. })),
        "nothing became due meanwhile"
    );
    assert_eq!(resumed.context("it waits for a timer that nobody has set")??.outcome, SUCCESS);
    let channels = ratn_worker::client::Channels::new(&place.tls);
    let world = ratn_worker::client::WorldClient::new(&channels, &place.endpoints.world_pool)?;
    let (_, facts) = world.root().await?;
    assert_eq!(facts.iter().map(|fact| fact.key.to_string()).collect::<Vec<_>>(), ["noted(desk)"]);
    Ok(())
}

#[tokio::test]
async fn what_is_due_when_a_run_is_resumed_is_decided_on_the_world_as_it_has_become() -> anyhow::Result<()> {
    const DOOR: &str = "
task: door
outcomes: [too_late]
states:
  - opens: { wait: { for: open(door), timeout: 300 }, transitions: { timeout: too_late } }
";
    let bench = Bench::new(|door| *door = program(DOOR)).await?;
    let (_asks, interrupt) = Interrupt::new();
    tokio::select! {
        ended = run(bench.run.clone(), &bench.place, &interrupt) => panic!("it ended: {ended:?}"),
        () = waits(&bench.place, "opens") => {}
    }
    let channels = ratn_worker::client::Channels::new(&bench.place.tls);
    let world = ratn_worker::client::WorldClient::new(&channels, &bench.place.endpoints.world_pool)?;
    let fact = FactKey { predicate: "open".to_owned(), arguments: vec![Term::Name("door".to_owned())] };
    world.commit("other/i1/1", vec![Change::Set { fact, value: Value::Bool(true) }], None).await?;
    // The deadline of the wait has passed long before the run is resumed.
    let place = &Place { speed: 1e6, ..bench.place.clone() };
    let ended = Box::pin(resume(resumption_of(&bench.run).await?, place, &interrupt)).await?;
    let (lines, now) = (bench.lines()?, Timestamp::from_seconds(300.0));
    assert!(lines.last().is_some_and(|line| line.at > now), "nothing was due when it was resumed");
    assert_eq!(ended.outcome, SUCCESS, "the door is open");
    Ok(())
}

#[tokio::test]
async fn a_run_that_waits_has_what_it_was_sent_also_after_it_was_killed() -> anyhow::Result<()> {
    let mut bench = Bench::new(|waiting| *waiting = program(WAITING)).await?;
    bench.run.checkpoint_every = 1;
    let place = &bench.place;
    let (_asks, interrupt) = Interrupt::new();
    let killed = async {
        waits(place, "next").await;
        let said = sent(place, signal("later", Value::Null)).await;
        assert_eq!(said, Ok("it is kept for the next state that waits for `later`".to_owned()));
        over_grpc(place).await;
        let refused = sent(place, signal("odrer", Value::Null)).await;
        let help = "no state of hand_over waits for a signal `odrer`: did you mean `order`?";
        assert_eq!(refused, Err(help.to_owned()));
        assert_eq!(sent(place, answer("-", None, "so")).await, Err("no state asks anything now".to_owned()));
        let said = sent(place, signal("order", Value::Int(7))).await;
        assert_eq!(said, Ok("next has waited for it and goes on".to_owned()));
    };
    tokio::select! {
        ended = run(bench.run.clone(), place, &interrupt) => panic!("it ended: {ended:?}"),
        () = killed => {}
    }
    let resumption = resumption_of(&bench.run).await?;
    let resumed = resume(resumption, place, &interrupt);
    let asked = async {
        waits(place, "really").await;
        let wrong = sent(place, answer("hand_over", None, "maybe")).await;
        assert_eq!(wrong, Err("`maybe` is no answer to really: there is so, not_so".to_owned()));
        let wrong = sent(place, answer("-", Some("next"), "so")).await;
        assert_eq!(wrong, Err("next asks nothing now; these do: really (Really?)".to_owned()));
        let other = sent(place, answer("fetch", None, "so")).await;
        assert!(other.is_err_and(|why| why.starts_with("no run `fetch` is under way here")));
        let said = sent(place, answer("hand_over", Some("really"), "so")).await;
        assert_eq!(said, Ok("really is answered: so".to_owned()));
    };
    let (ended, ()) = tokio::join!(resumed, asked);
    let ended = ended?;
    assert_eq!(ended.outcome, "success", "{ended:?}");
    let outputs: BTreeMap<String, Value> =
        [("answer".to_owned(), Value::String("so".to_owned())), ("order".to_owned(), Value::Int(7))].into();
    assert_eq!(ended.outputs, outputs, "the signal that was kept before it was killed has ended the last wait");
    Ok(())
}

#[tokio::test]
async fn a_share_that_is_given_to_a_resumption_is_that_of_the_next_one_too() -> anyhow::Result<()> {
    let mut bench = Bench::new(|waiting| *waiting = program(WAITING)).await?;
    let (_asks, interrupt) = Interrupt::new();
    bench.place.standing.share = 2.0;
    tokio::select! {
        ended = run(bench.run.clone(), &bench.place, &interrupt) => panic!("it ended: {ended:?}"),
        () = waits(&bench.place, "next") => {}
    }
    for (had, has) in [(2.0, 2.0), (2.0, 5.0), (5.0, 1.0)] {
        let resumption = resumption_of(&bench.run).await?;
        assert_eq!(resumption.share(), Some(had));
        bench.place.standing.share = has;
        let is_up = async {
            loop {
                let status = crate::control::status(&bench.place.directory, ANY_RUN).await.ok().flatten();
                if status.is_some_and(|status| !status.awaits.is_empty() && status.share == has) {
                    break;
                }
                tokio::task::yield_now().await;
            }
        };
        tokio::select! {
            ended = resume(resumption, &bench.place, &interrupt) => panic!("it ended: {ended:?}"),
            () = is_up => {}
        }
    }
    assert_eq!(resumption_of(&bench.run).await?.share(), Some(1.0), "the usual one, too");
    let lines = bench.lines()?;
    let resumed = lines.iter().filter_map(|line| match &line.entry {
        LogEntry::Event(Event::Resumed { share }) => Some(*share),
        _ => None,
    });
    assert_eq!(resumed.collect::<Vec<_>>(), [None, Some(5.0), Some(1.0)]);
    Ok(())
}
