//! What a run that comes back has created, deleted and used up, and of which resources.

use super::*;

#[tokio::test]
async fn what_was_used_up_for_good_is_not_used_up_again_with_a_new_session() -> anyhow::Result<()> {
    let mut bench = Bench::new().await?;
    let run = bench.performer.run.clone();
    let channels = Channels::new(&ClientTls::none());
    let offering = ResourceClient::new(&channels, &bench.endpoints.resource_manager, bench._robot.id())?;
    let of = |kind: &str| Resource::new(kind, ResourceClass::System, kind).with_capacity(3);
    offering.create(of("Glue").non_renewable()).await?;
    offering.create(of("Battery")).await?;
    let consume = |kind: &str| Requirement::new(ResourceOperation::Consume, kind);
    let operations = [consume("Glue"), consume("Battery"), create("Screws", 3), consume("Screws")];
    let operations = operations.map(|operation| operate(1, operation));
    for command in operations.clone() {
        bench.performer.perform(command)?;
    }
    let session = bench.performer.number;
    let mut ledger = Ledger { session, ..ledger(&run, &operations) };
    while ledger.recorded < 4 {
        let done = bench.any_event().await.context("no word")?;
        ledger.event(Timestamp(0), &done);
    }
    let left = async |bench: &Bench| {
        let there = bench.performer.resources.list(&["Glue", "Battery", "Screws"]).await?;
        anyhow::Ok(there.into_iter().map(|one| (one.kind, one.free.units())).collect::<BTreeMap<String, u32>>())
    };
    let expected = ["Battery", "Glue", "Screws"].map(|kind| (kind.to_owned(), 2)).into();
    assert_eq!(left(&bench).await?, expected);
    let mut bench = bench.comes_back(false).await?;
    bench.takes_up(ledger, &World::default()).await?;
    assert_eq!(left(&bench).await?, expected);
    bench.performer.closed().await
}

/// A hierarchy of two kinds.
fn glue_is_an_adhesive() -> ResourceManagerConfig {
    let kinds = BTreeMap::from([("Glue".to_owned(), vec!["Adhesive".to_owned()])]);
    ResourceManagerConfig { kinds, ..ResourceManagerConfig::default() }
}

/// A run that operates, and its log.
struct Operating {
    bench: Bench,
    operator: ResourceClient,
    ledger: Ledger,
}

impl Operating {
    async fn new(config: ResourceManagerConfig) -> anyhow::Result<Operating> {
        let bench = Bench::new_with_both(config, WorldPoolConfig::default()).await?;
        let operator = ResourceClient::new(&Channels::new(&ClientTls::none()), &bench.endpoints.resource_manager, "")?;
        let run = &bench.performer.run;
        let ledger = Ledger { session: bench.performer.number, ..ledger(run, &[]) };
        Ok(Operating { bench, operator, ledger })
    }

    /// An operator creates a resource.
    async fn there_is(&self, id: &str, kind: &str, capacity: u32) -> anyhow::Result<()> {
        let resource = Resource::new(id, ResourceClass::System, kind).with_capacity(capacity);
        self.operator.create(resource.non_renewable()).await?;
        Ok(())
    }

    /// The operation is done, and the run's log says so.
    async fn does(&mut self, operation: Requirement) -> anyhow::Result<()> {
        let done = self.does_unheard(operation).await?;
        self.ledger.event(Timestamp(0), &done);
        Ok(())
    }

    /// The operation is done, and the run is killed before it has heard of it.
    async fn does_unheard(&mut self, operation: Requirement) -> anyhow::Result<Event> {
        self.decides(operation.clone());
        self.bench.performer.perform(operate(1, operation))?;
        let done = self.bench.any_event().await.context("no word")?;
        assert!(matches!(done, Event::Recorded { .. }), "{done:?}");
        Ok(done)
    }

    /// The run is killed before it has requested the operation.
    fn decides(&mut self, operation: Requirement) {
        self.ledger.command(&operate(1, operation));
    }

    /// Resumes the run after its session has ended; returns the events for the log.
    async fn comes_back(&mut self) -> anyhow::Result<Vec<Event>> {
        let before = self.ledger.session;
        let run = self.bench.performer.run.clone();
        let (events, answers) = mpsc::channel(8);
        let again = connect_as(&self.bench.endpoints, "next", None, "task", mpsc::channel(1).0).await?;
        std::mem::replace(&mut self.bench.performer, again).session.close().await;
        self.bench.performer = connect_as(&self.bench.endpoints, &run, Some(before), "task", events).await?;
        self.bench.answers = answers;
        let mut told = Vec::new();
        let open = self.ledger.clone();
        match self.bench.takes_up_saying(open, &World::default(), |event| told.push(event.clone())).await {
            Ok(more) => Ok(told.into_iter().chain(more).collect()),
            Err(refused) => {
                told.iter().for_each(|event| self.ledger.event(Timestamp(0), event));
                Err(refused)
            }
        }
    }

    /// The free units of each resource of a kind; `own` is a resource that the run has created.
    async fn free(&self, kind: &str) -> anyhow::Result<Vec<(String, u32)>> {
        let run = &self.bench.performer.run;
        let there = self.operator.list(&[kind]).await?.into_iter();
        let name = |one: &Resource| if one.session == *run { "own".to_owned() } else { one.id.clone() };
        let mut free: Vec<_> = there.map(|one| (name(&one), one.free.units())).collect();
        free.sort();
        Ok(free)
    }
}

fn consume(kind: &str) -> Requirement {
    Requirement::new(ResourceOperation::Consume, kind)
}

#[tokio::test]
async fn what_a_run_deleted_of_its_own_is_what_the_manager_took_when_it_comes_back() -> anyhow::Result<()> {
    let mut run = Operating::new(ResourceManagerConfig::default()).await?;
    let red = BTreeMap::from([("colour".to_owned(), Value::String("red".into()))]);
    run.does(Requirement { attributes: red.clone(), ..create("Box", 1) }).await?;
    run.does(create("Box", 1)).await?;
    run.does(delete("Box")).await?;
    let there = |boxes: Vec<Resource>| boxes.into_iter().map(|one| one.attributes).collect::<Vec<_>>();
    assert_eq!(
        there(run.operator.list(&["Box"]).await?),
        std::slice::from_ref(&red),
        "the one that is like fewer others"
    );
    run.comes_back().await?;
    assert_eq!(there(run.operator.list(&["Box"]).await?), [red]);
    run.bench.performer.closed().await
}

#[tokio::test]
async fn a_deletion_of_a_run_of_its_own_that_nobody_heard_of_takes_nothing_of_others() -> anyhow::Result<()> {
    let mut run = Operating::new(glue_is_an_adhesive()).await?;
    run.does(create("Glue", 1)).await?;
    run.there_is("operators", "Glue", 1).await?;
    run.does_unheard(delete("Adhesive")).await?;
    assert_eq!(run.free("Glue").await?, of(&[("operators", 1)]), "its own first");
    run.comes_back().await?;
    assert_eq!(run.free("Glue").await?, of(&[("operators", 1)]));
    run.bench.performer.closed().await
}

#[tokio::test]
async fn a_deletion_of_more_than_a_run_has_created_is_done_when_it_comes_back() -> anyhow::Result<()> {
    let mut run = Operating::new(ResourceManagerConfig::default()).await?;
    run.there_is("operators", "Box", 2).await?;
    run.does(create("Box", 1)).await?;
    run.decides(Requirement { count: 2.into(), ..delete("Box") });
    run.comes_back().await?;
    assert_eq!(run.free("Box").await?, of(&[("operators", 1)]));
    run.bench.performer.closed().await
}

#[tokio::test]
async fn what_was_made_anew_and_deleted_is_not_made_anew_where_the_next_operation_was_refused() -> anyhow::Result<()> {
    let mut run = Operating::new(ResourceManagerConfig::default()).await?;
    run.there_is("operators", "Box", 1).await?;
    run.does(create("Box", 2)).await?;
    run.decides(Requirement { count: 2.into(), ..delete("Box") });
    run.decides(consume("Glue"));
    let refused = run.comes_back().await.err().context("there is no glue")?;
    assert!(refused.to_string().contains("cannot be done now"), "{refused}");
    run.there_is("glue", "Glue", 1).await?;
    run.comes_back().await?;
    assert_eq!((run.free("Box").await?, run.free("Glue").await?), (of(&[("operators", 1)]), of(&[("glue", 0)])));
    run.bench.performer.closed().await
}

#[tokio::test]
async fn what_takes_away_and_nobody_heard_of_is_done_once_and_refused_where_the_manager_has_forgotten_it()
-> anyhow::Result<()> {
    for (operation, remembered) in
        [(delete("Box"), true), (consume("Box"), true), (delete("Box"), false), (consume("Box"), false)]
    {
        let mut config = ResourceManagerConfig::default();
        config.limits.remembered_requests = 4;
        let mut run = Operating::new(config).await?;
        run.there_is("operators", "Box", 3).await?;
        run.does_unheard(operation.clone()).await?;
        assert_eq!(run.free("Box").await?, of(&[("operators", 2)]));
        let others = if remembered { 1 } else { 8 };
        for number in 0..others {
            run.there_is(&format!("other{number}"), "Other", 1).await?;
        }
        let told = run.comes_back().await;
        assert_eq!(run.free("Box").await?, of(&[("operators", 2)]), "{operation}, {told:?}");
        assert_eq!(told.is_ok(), remembered, "{operation}: {told:?}");
        if let Err(refused) = told {
            assert!(refused.to_string().contains(&format!("whether `{operation}` was done is not known")), "{refused}");
        }
        run.bench.performer.session.close().await;
    }
    Ok(())
}

#[tokio::test]
async fn what_was_used_up_for_good_is_not_used_up_twice_where_a_run_creates_the_same_kind() -> anyhow::Result<()> {
    let mut run = Operating::new(ResourceManagerConfig::default()).await?;
    run.there_is("operators", "Glue", 3).await?;
    run.does(consume("Glue")).await?;
    run.does(create("Glue", 2)).await?;
    run.comes_back().await?;
    assert_eq!(run.free("Glue").await?, of(&[("operators", 2), ("own", 2)]));
    run.bench.performer.closed().await
}

#[tokio::test]
async fn what_was_used_up_for_good_of_a_kind_below_is_not_used_up_twice() -> anyhow::Result<()> {
    let mut run = Operating::new(glue_is_an_adhesive()).await?;
    run.there_is("operators", "Glue", 3).await?;
    run.does(consume("Adhesive")).await?;
    run.does_unheard(consume("Adhesive")).await?;
    run.comes_back().await?;
    assert_eq!(run.free("Glue").await?, of(&[("operators", 1)]));
    run.bench.performer.closed().await
}

#[tokio::test]
async fn what_a_run_used_up_that_came_back_is_used_up_of_the_same_resources_when_it_comes_back() -> anyhow::Result<()> {
    let mut run = Operating::new(ResourceManagerConfig::default()).await?;
    // The manager gives the first of equal resources.
    for (id, renewable) in [("b", true), ("c", false)] {
        let resource = Resource::new(id, ResourceClass::System, "Power").with_capacity(3);
        run.operator.create(if renewable { resource } else { resource.non_renewable() }).await?;
    }
    run.does(Requirement { count: 5.into(), ..consume("Power") }).await?;
    let before = run.free("Power").await?;
    run.comes_back().await?;
    assert_eq!(run.free("Power").await?, before);
    run.bench.performer.closed().await
}

#[tokio::test]
async fn a_run_that_is_killed_whenever_it_comes_back_makes_all_of_it_so_again_once() -> anyhow::Result<()> {
    let mut run = Operating::new(ResourceManagerConfig::default()).await?;
    run.there_is("operators", "Box", 9).await?;
    run.does(create("Box", 3)).await?;
    run.does(consume("Box")).await?;
    run.does_unheard(Requirement { count: 4.into(), ..delete("Box") }).await?;
    let there = run.free("Box").await?;
    for heard in [false, true, false, true] {
        let told = run.comes_back().await?;
        assert_eq!(run.free("Box").await?, there, "{told:?}");
        if heard {
            told.iter().for_each(|event| run.ledger.event(Timestamp(0), event));
            assert_eq!(run.ledger.session, run.bench.performer.number);
        }
    }
    run.bench.performer.closed().await
}

#[tokio::test]
async fn what_a_grant_had_used_up_that_nobody_heard_of_comes_back() -> anyhow::Result<()> {
    let mut bench = Bench::new().await?;
    let (run, instance) = (bench.performer.run.clone(), InstanceId(1));
    let channels = Channels::new(&ClientTls::none());
    let offering = ResourceClient::new(&channels, &bench.endpoints.resource_manager, bench._robot.id())?;
    let glue = Resource::new("glue", ResourceClass::System, "Glue").with_capacity(3);
    offering.create(glue.non_renewable()).await?;
    let mut requirements = arm();
    requirements.push(Requirement::new(ResourceOperation::Consume, "Glue"));
    let acquire = Command::Acquire { instance, requirements, priority: 0 };
    bench.performer.perform(acquire.clone())?;
    while bench.answers.is_empty() {
        tokio::time::sleep(Duration::from_millis(5)).await;
    }
    // Task control is killed before it hears of the grant, and had withdrawn many other requests before.
    let mut ledger = ledger(&run, &[acquire]);
    ledger.withdrawn.splice(0..0, (0..2_000).map(|number| format!("{run}/i9/{number}")));
    let mut bench = bench.comes_back(true).await?;
    bench.takes_up(ledger, &World::default()).await?;
    tokio::time::timeout(SESSION_DEADLINE, bench.granted(instance)).await.context("the arm is held")??;
    let glue = bench.performer.resources.list(&["Glue"]).await?;
    assert_eq!(glue.iter().map(|one| one.free.units()).collect::<Vec<_>>(), [2], "it was used up once");
    bench.performer.closed().await
}
