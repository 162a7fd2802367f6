//! The actor with a list of blobs as its state: what it does when it panics, is superseded, or has a slow disk.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

use super::journal::MOST_WAITING_BYTES;
use super::slow_disk::SlowDisk;
use super::{Core, Handle, Journal, JournalError, Journaled, TurnContext, start};
use crate::config::StorageConfig;
use bytes::Bytes;
use ratn_model::time::Timestamp;
use ratn_storage::{MakeSnapshot, Recovered, Store};
use ratn_worker::vitals::{CoreFailure, EXIT_CODE_FENCED, EXIT_CODE_PANICKED, Vitals};
use std::future::Future;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Duration;
use tokio::sync::{oneshot, watch};
use tokio::task::JoinHandle;
use tokio_util::sync::CancellationToken;
use tonic::{Code, Status};

const DEADLINE: Duration = Duration::from_secs(20);

/// Lengths of the blobs.
#[derive(Debug, Default)]
struct Blobs {
    lengths: Vec<usize>,
    entry: Option<Vec<u8>>,
}

type Answer<T> = oneshot::Sender<Result<T, Status>>;

enum Message {
    Add(usize, Answer<usize>),
    Count(Answer<usize>),
    /// Answered as soon as the actor takes it, whatever the disk does.
    Taken(oneshot::Sender<()>),
    /// Number of pings that were taken.
    Pings(oneshot::Sender<usize>),
    /// Sets a deadline after this time.
    Alarm(Duration),
    /// Takes this long.
    Work(Duration),
    /// Something is sent when it is on the disk, and taken back then.
    Say,
    /// Whether the deadline of `Alarm` has come.
    Rung(oneshot::Sender<bool>),
    Panic,
}

#[derive(Default)]
struct BlobCore {
    blobs: Blobs,
    pings: usize,
    alarm: Option<Timestamp>,
    rung: bool,
    /// How often the state was read from the journal again.
    restored: Arc<AtomicUsize>,
    /// Something is still to be sent.
    says: bool,
}

/// A change that sending causes, like giving back a grant whose client is gone.
struct TakenBack;

impl BlobCore {
    fn add(&mut self, length: usize) {
        self.blobs.lengths.push(length);
        self.blobs.entry = Some(vec![7; length]);
    }
}

impl Journaled for Blobs {
    fn take_entry(&mut self) -> Option<Vec<u8>> {
        self.entry.take()
    }

    fn snapshot(&self) -> MakeSnapshot {
        let lengths = format!("{:?}", self.lengths);
        Box::new(move || Bytes::from(lengths))
    }
}

impl Core for BlobCore {
    type State = Blobs;
    type Message = Message;
    type Urgent = oneshot::Sender<()>;
    type Said = TakenBack;
    type Update = ();
    type Signal = ();

    fn state(&mut self) -> &mut Blobs {
        &mut self.blobs
    }

    fn restore(&mut self, _: &Journal, _: &TurnContext<Self>) -> Result<(), JournalError> {
        self.restored.fetch_add(1, Ordering::SeqCst);
        Ok(())
    }

    fn next_deadline(&self, _: &TurnContext<Self>) -> Option<Timestamp> {
        self.alarm
    }

    fn advance(&mut self, context: &mut TurnContext<Self>) {
        if self.alarm.take_if(|at| *at <= context.now()).is_some() {
            self.rung = true;
        }
    }

    fn receive(&mut self, message: Message, context: &mut TurnContext<Self>) {
        match message {
            Message::Add(length, answer) => {
                self.add(length);
                context.reply(answer, Ok(self.blobs.lengths.len()));
            }
            Message::Count(answer) => context.reply(answer, Ok(self.blobs.lengths.len())),
            Message::Taken(answer) => drop(answer.send(())),
            Message::Pings(answer) => drop(answer.send(self.pings)),
            Message::Alarm(after) => self.alarm = Some(context.now() + after),
            Message::Work(time) => std::thread::sleep(time),
            Message::Say => {
                self.add(1);
                self.says = true;
            }
            Message::Rung(answer) => drop(answer.send(self.rung)),
            Message::Panic => panic!("a defect"),
        }
    }

    fn receive_urgent(&mut self, ping: oneshot::Sender<()>, _: &mut TurnContext<Self>) {
        self.pings += 1;
        let _ = ping.send(());
    }

    fn signal(&mut self, (): &(), _: &mut TurnContext<Self>) {}

    fn collect(&mut self, context: &mut TurnContext<Self>) {
        if std::mem::take(&mut self.says) {
            context.say(TakenBack);
        }
    }

    fn hand_out(&mut self, TakenBack: TakenBack, _: &mut TurnContext<Self>) {
        self.add(2);
    }

    fn refuse(message: Message, status: &Status) -> Option<Message> {
        match message {
            Message::Add(_, answer) => {
                let _ = answer.send(Err(status.clone()));
                None
            }
            message => Some(message),
        }
    }

    fn is_large(_: &Message) -> bool {
        true
    }
}

fn begin(place: &Path, disk: &SlowDisk) -> (Handle<BlobCore>, Vitals) {
    let running = run(place, disk);
    (running.handle, running.vitals)
}

struct Running {
    handle: Handle<BlobCore>,
    vitals: Vitals,
    restored: Arc<AtomicUsize>,
    over: CancellationToken,
    ended: JoinHandle<()>,
}

fn run(place: &Path, disk: &SlowDisk) -> Running {
    let config = StorageConfig { compact_bytes: u64::MAX / 2, ..StorageConfig::default() };
    let log = Journal::log(&config, place).on(disk.files());
    let restore = |recovered: Recovered| -> Result<Blobs, std::fmt::Error> {
        let lengths = recovered.records.iter().map(|record| record.payload.len()).collect();
        Ok(Blobs { lengths, entry: None })
    };
    let (blobs, journal) = Journal::open("blobs", &config, Arc::new(log), restore).unwrap();
    let vitals = Vitals::default();
    let signals = watch::Sender::new(()).subscribe();
    let (never, over) = (CancellationToken::new(), CancellationToken::new());
    let restored = Arc::<AtomicUsize>::default();
    let core = BlobCore { blobs, restored: restored.clone(), ..BlobCore::default() };
    let (handle, ended) = start(core, journal, signals, vitals.clone(), never, over.clone()).unwrap();
    Running { handle, vitals, restored, over, ended }
}

async fn in_time<T>(future: impl Future<Output = T>) -> T {
    tokio::time::timeout(DEADLINE, future).await.expect("in time")
}

#[tokio::test]
async fn an_actor_that_panics_is_the_end_of_its_process() {
    let place = tempfile::tempdir().unwrap();
    let (handle, vitals) = begin(place.path(), &SlowDisk::default());
    assert_eq!(in_time(handle.request(Message::Count)).await.unwrap(), 0);
    handle.send(Message::Panic).await.unwrap();
    let failure = in_time(vitals.failed()).await;
    assert_eq!(failure, CoreFailure::Panicked { part: "the actor".to_owned(), what: "a defect".to_owned() });
    assert_eq!(failure.exit_code(), EXIT_CODE_PANICKED);
    let beats = vitals.beats();
    assert!(handle.request(Message::Count).await.is_err());
    assert_eq!(vitals.beats(), beats, "the watchdog hears nothing more");
}

#[tokio::test]
async fn whoever_was_got_past_says_nothing_more_and_ends() {
    let place = tempfile::tempdir().unwrap();
    let (handle, vitals) = begin(place.path(), &SlowDisk::default());
    assert_eq!(in_time(handle.request(|answer| Message::Add(1, answer))).await.unwrap(), 1);
    std::fs::remove_file(place.path().join("writer.lock")).unwrap();
    let (successor, _) = begin(place.path(), &SlowDisk::default());
    assert_eq!(in_time(successor.request(Message::Count)).await.unwrap(), 1);
    let failure = in_time(vitals.failed()).await;
    assert!(matches!(failure, CoreFailure::Fenced { .. }), "{failure}");
    assert_eq!(failure.exit_code(), EXIT_CODE_FENCED);
    assert!(in_time(handle.request(Message::Count)).await.is_err(), "also what is only read");
    assert_eq!(in_time(successor.request(Message::Count)).await.unwrap(), 1);
}

#[tokio::test]
async fn a_copy_in_the_place_of_the_segment_is_noticed_without_a_write_and_ends_the_process() {
    let place = tempfile::tempdir().unwrap();
    let (handle, vitals) = begin(place.path(), &SlowDisk::default());
    assert_eq!(in_time(handle.request(|answer| Message::Add(1, answer))).await.unwrap(), 1);
    let files = std::fs::read_dir(place.path()).unwrap().map(|entry| entry.unwrap().path());
    for segment in files.filter(|path| path.extension().is_some_and(|extension| extension == "log")) {
        let copy = segment.with_extension("copy");
        std::fs::copy(&segment, &copy).unwrap();
        std::fs::rename(&copy, &segment).unwrap();
    }
    let failure = in_time(vitals.failed()).await;
    assert_eq!(failure.exit_code(), EXIT_CODE_FENCED, "{failure}");
    assert!(in_time(handle.request(Message::Count)).await.is_err());
}

#[tokio::test]
async fn a_state_directory_that_cannot_be_looked_at_makes_the_daemon_silent_and_unwell_until_it_can() {
    let directory = tempfile::tempdir().unwrap();
    let (real, link) = (directory.path().join("real"), directory.path().join("state"));
    std::fs::create_dir(&real).unwrap();
    std::os::unix::fs::symlink(&real, &link).unwrap();
    let (handle, vitals) = begin(&link, &SlowDisk::default());
    assert_eq!(in_time(handle.request(|answer| Message::Add(1, answer))).await.unwrap(), 1);
    assert_eq!(vitals.condition().borrow().unwell, None);
    // A symbolic link to itself cannot be followed, not even by root.
    std::fs::remove_file(&link).unwrap();
    std::os::unix::fs::symlink(&link, &link).unwrap();
    let mut condition = vitals.condition();
    let unwell = in_time(condition.wait_for(|condition| condition.unwell.is_some())).await.unwrap().unwell.clone();
    let why = unwell.unwrap();
    assert!(
        why.contains("it cannot be seen who has the state (cannot look at") && why.contains("writer.lock"),
        "{why}"
    );
    // No deadline comes meanwhile, though the actor takes turns.
    handle.send(Message::Alarm(Duration::from_millis(50))).await.unwrap();
    tokio::time::sleep(Duration::from_millis(500)).await;
    assert!(!in_time(handle.ask(Message::Rung)).await.unwrap());
    let ((answer, mut counted), (answer_to_add, mut added)) = (oneshot::channel(), oneshot::channel());
    let (later, taken) = oneshot::channel();
    handle.send(Message::Count(answer)).await.unwrap();
    handle.send(Message::Add(1, answer_to_add)).await.unwrap();
    handle.send(Message::Taken(later)).await.unwrap();
    in_time(taken).await.unwrap();
    assert!(counted.try_recv().is_err() && added.try_recv().is_err(), "nothing is said");
    std::fs::remove_file(&link).unwrap();
    std::os::unix::fs::symlink(&real, &link).unwrap();
    in_time(condition.wait_for(|condition| condition.unwell.is_none())).await.unwrap();
    assert_eq!(in_time(counted).await.unwrap().unwrap(), 1, "what was held back leaves");
    assert_eq!(in_time(added).await.unwrap().unwrap(), 2, "and what was written meanwhile");
    assert_eq!(condition.borrow().failure, None);
    while !in_time(handle.ask(Message::Rung)).await.unwrap() {
        tokio::task::yield_now().await;
    }
}

#[tokio::test]
async fn a_disk_that_is_behind_refuses_what_is_new_and_takes_it_again_when_it_has_caught_up() {
    let place = tempfile::tempdir().unwrap();
    let disk = SlowDisk::default();
    let (handle, vitals) = begin(place.path(), &disk);
    assert_eq!(in_time(handle.request(|answer| Message::Add(1, answer))).await.unwrap(), 1);
    let hangs = disk.hang();
    let mut waiting = Vec::new();
    let refused = loop {
        let (answer, mut answered) = oneshot::channel();
        let (later, taken) = oneshot::channel();
        handle.send(Message::Add(14 << 20, answer)).await.unwrap();
        handle.send(Message::Taken(later)).await.unwrap();
        in_time(taken).await.unwrap();
        match answered.try_recv() {
            Ok(refused) => break refused.unwrap_err(),
            Err(_) => waiting.push(answered),
        }
        assert!(waiting.len() < 30, "it is never refused");
    };
    assert_eq!(refused.code(), Code::ResourceExhausted);
    assert!(refused.message().contains(&MOST_WAITING_BYTES.to_string()), "{}", refused.message());
    assert!(waiting.len() > MOST_WAITING_BYTES / (14 << 20), "as many as are allowed: {}", waiting.len());
    assert!(vitals.condition().borrow().unwell.is_none(), "a slow disk is not a dead one");
    drop(hangs);
    let count = waiting.len();
    for (index, answered) in waiting.into_iter().enumerate() {
        assert_eq!(in_time(answered).await.unwrap().unwrap(), index + 2, "nothing that was taken on is lost");
    }
    let added = in_time(handle.request(|answer| Message::Add(1, answer))).await.unwrap();
    assert_eq!(added, count + 2, "what was refused has changed nothing");
    assert_eq!(vitals.condition().borrow().unwell, None);
}

#[tokio::test]
async fn a_disk_that_fails_makes_the_daemon_unwell_and_what_was_not_on_it_is_refused() {
    let place = tempfile::tempdir().unwrap();
    let disk = SlowDisk::default();
    let (handle, vitals) = begin(place.path(), &disk);
    assert_eq!(in_time(handle.request(|answer| Message::Add(1, answer))).await.unwrap(), 1);
    disk.fail();
    let refused = in_time(handle.request(|answer| Message::Add(1, answer))).await.unwrap_err();
    assert_eq!(refused.code(), Code::Unavailable);
    let unwell = vitals.condition().borrow().unwell.clone();
    assert!(unwell.is_some_and(|why| why.contains("the disk is gone")), "health says so");
    assert_eq!(vitals.condition().borrow().failure, None, "what is on the disk can still be read");
    assert!(in_time(handle.request(Message::Count)).await.is_ok());
}

#[tokio::test]
async fn a_message_is_taken_among_pings_without_end() {
    let place = tempfile::tempdir().unwrap();
    let (handle, _) = begin(place.path(), &SlowDisk::default());
    let (clients, pings) = (500, 100);
    let pinging = (0..clients).map(|_| {
        let handle = handle.clone();
        tokio::spawn(async move {
            for _ in 0..pings {
                handle.ask_urgently(|ping| ping).await.unwrap();
            }
        })
    });
    let pinging: Vec<_> = pinging.collect();
    in_time(handle.ask_urgently(|ping| ping)).await.unwrap();
    let taken = in_time(handle.ask(Message::Pings)).await.unwrap();
    assert!(taken < clients * pings / 2, "{taken} pings were taken first");
    for client in pinging {
        in_time(client).await.unwrap();
    }
    assert_eq!(in_time(handle.ask(Message::Pings)).await.unwrap(), clients * pings + 1, "and no ping is forgotten");
}

#[tokio::test]
async fn an_actor_that_works_through_a_batch_is_seen_to_take_its_turns() {
    let place = tempfile::tempdir().unwrap();
    let (handle, vitals) = begin(place.path(), &SlowDisk::default());
    assert_eq!(in_time(handle.request(Message::Count)).await.unwrap(), 0);
    // They are taken as one batch.
    let before = vitals.beats().unwrap();
    let messages = 32;
    for _ in 0..messages {
        handle.send_later(Message::Work(Duration::from_millis(5)));
    }
    in_time(handle.ask(Message::Taken)).await.unwrap();
    let beats = vitals.beats().unwrap() - before;
    assert!(beats >= messages, "{beats} signs of life in {messages} messages");
}

#[tokio::test]
async fn what_is_taken_back_while_the_state_is_closed_is_written_and_nothing_is_read_for_that() {
    let place = tempfile::tempdir().unwrap();
    let disk = SlowDisk::default();
    let Running { handle, vitals, restored, over, ended } = run(place.path(), &disk);
    assert_eq!(in_time(handle.request(|answer| Message::Add(3, answer))).await.unwrap(), 1);
    let hangs = disk.hang();
    handle.send(Message::Say).await.unwrap();
    in_time(handle.ask(Message::Taken)).await.unwrap();
    over.cancel();
    for _ in 0..10 {
        tokio::task::yield_now().await;
    }
    drop(hangs);
    in_time(ended).await.unwrap();
    assert_eq!(restored.load(Ordering::SeqCst), 0, "the log was read");
    assert_eq!(vitals.condition().borrow().unwell, None);
    let read = Journal::log(&StorageConfig::default(), place.path()).read().unwrap();
    let lengths: Vec<usize> = read.records.iter().map(|record| record.payload.len()).collect();
    assert_eq!(lengths, [3, 1, 2]);
}
