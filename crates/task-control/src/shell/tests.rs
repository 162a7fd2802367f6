//! Task control with a real resource manager and world pool, and nobody who would do anything.

use super::*;
use crate::task_for_tests::{FETCH_BOXES, program};
use ratn_daemon::resource_manager::{self, ResourceManagerConfig};
use ratn_daemon::world_pool::{self, WorldPoolConfig};
use ratn_executive::protocol::{LogEntry, LogLine};
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
            file: String::new(),
            mode: Mode::Cdtn,
            seed: 1,
            learned: Learned::default(),
            log: directory.path().join("log.jsonl"),
            quiet: true,
            checkpoint_every: 0,
        };
        let place = Place {
            endpoints,
            tls: ratn_worker::tls::ClientTls::none(),
            directory: directory.path().to_owned(),
            catalogue: Arc::new(catalogue),
            speed: 10.0,
            messages: Messages::nowhere(),
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
async fn a_run_is_told_to_end_over_its_socket() -> anyhow::Result<()> {
    use crate::control::{Word, tell};
    let bench = Bench::new(|_| {}).await?;
    let (_asks, interrupt) = Interrupt::new();
    let running = run(bench.run.clone(), &bench.place, &interrupt);
    let telling = async {
        while tell(&bench.place.directory, Word::Abort).await.is_err() {
            tokio::task::yield_now().await;
        }
    };
    let (ended, ()) = tokio::join!(running, telling);
    assert_eq!(ended?.outcome, "preempted");
    // Nobody listens there any more.
    assert!(tell(&bench.place.directory, Word::Abort).await.is_err());
    Ok(())
}
