//! The log in etcd: what every log promises, and what an etcd does that a disk does not.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

mod common;

use common::cluster::{Cluster, Proxy, is_there};
use common::etcd::{options, store};
use common::{append_durably, payloads, promises};
use ratn_storage::etcd::Bounds;
use ratn_storage::{Etcd, Fault, OpenError, Position, ReadError, Store, Writer, transfer, transfer_running};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::{Duration, Instant};

/// A log of these bounds for each name.
fn with_logs(bounds: Bounds, test: impl Fn(promises::Make<'_>)) {
    if !is_there() {
        return;
    }
    let cluster = Cluster::start(1, &[]);
    let make = |name: &str| -> Box<dyn Store> {
        let options = options(cluster.endpoints(), &format!("/test/{name}"), "test");
        Box::new(Etcd::new(ratn_storage::EtcdOptions { bounds: bounds.clone(), ..options }).unwrap())
    };
    test(&make);
}

#[test]
fn a_cluster_whose_ports_somebody_else_has_taken_begins_at_other_ones() {
    if !is_there() {
        return;
    }
    // Nobody answers at the first; at the second another cluster does, in good health.
    let taken = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let other = Cluster::start(1, &[]);
    let port = |address: &str| address.rsplit(':').next().unwrap().parse::<u16>().unwrap();
    let free = || std::net::TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
    let mut clients = vec![port(&other.members[0].client), taken.local_addr().unwrap().port()];
    let pick = || (clients.pop().unwrap_or_else(free), free());
    let cluster = Cluster::start_at(1, &[], pick);
    assert!(!other.endpoints().contains(&cluster.members[0].client));
    assert_ne!(port(&cluster.members[0].client), taken.local_addr().unwrap().port());
    for one in [&cluster, &other] {
        assert!(one.ctl(&["put", "key", &one.members[0].client]).status.success());
    }
    let held = cluster.ctl(&["get", "--print-value-only", "key"]).stdout;
    assert_eq!(String::from_utf8(held).unwrap().trim(), cluster.members[0].client);
}

/// So that most records need several transactions.
fn tiny() -> Bounds {
    Bounds { part: 100, ..Bounds::default() }
}

#[test]
fn a_second_writer_is_refused_until_the_first_is_gone() {
    with_logs(Bounds::default(), promises::a_second_writer_is_refused_until_the_first_is_gone);
}

#[test]
fn many_restarts_keep_every_record() {
    with_logs(Bounds::default(), promises::many_restarts_keep_every_record);
}

#[test]
fn compaction_beside_appends_loses_nothing() {
    with_logs(Bounds::default(), promises::compaction_beside_appends_loses_nothing);
}

#[test]
fn a_waiter_hears_when_the_writer_is_gone() {
    with_logs(Bounds::default(), promises::a_waiter_hears_when_the_writer_is_gone);
}

#[test]
fn a_log_is_a_vector() {
    with_logs(Bounds::default(), |make| promises::a_log_is_a_vector(make, 8, 60, 60));
    with_logs(tiny(), |make| promises::a_log_is_a_vector(make, 8, 60, 500));
}

#[test]
fn a_copy_that_was_interrupted_is_not_opened() {
    with_logs(Bounds::default(), promises::a_copy_that_was_interrupted_is_not_opened);
}

#[test]
fn a_copy_that_was_interrupted_when_its_source_was_marked_is_finished_by_the_same_copy() {
    with_logs(
        Bounds::default(),
        promises::a_copy_that_was_interrupted_when_its_source_was_marked_is_finished_by_the_same_copy,
    );
}

#[test]
fn what_was_moved_is_opened_only_where_it_is_now() {
    with_logs(Bounds::default(), promises::what_was_moved_is_opened_only_where_it_is_now);
}

#[test]
fn a_copy_of_what_another_writer_has_taken_meanwhile_is_not_opened() {
    if !is_there() {
        return;
    }
    let cluster = Cluster::start(1, &[]);
    let make =
        |name: &str| -> Box<dyn Store> { Box::new(store(cluster.endpoints(), &format!("/test/{name}"), "test")) };
    // Somebody else has had the place, and has left.
    let take = |name: &str| assert!(cluster.ctl(&["del", &format!("/test/{name}/leader")]).status.success());
    promises::a_copy_of_what_another_writer_has_taken_meanwhile_is_not_opened(&make, &take);
}

#[test]
fn what_is_moved_while_somebody_takes_its_place_is_not_taken() {
    if !is_there() {
        return;
    }
    let cluster = Arc::new(Cluster::start(1, &[]));
    let (_, mut writer) = store(cluster.endpoints(), "/test/late-mark", "first").open().unwrap();
    append_durably(&mut *writer, b"moved");
    writer.close().unwrap();
    let proxy = Proxy::to(&cluster.members[0].client);
    // Behind its last look, and before it takes the place: the mark of a copier that was suspended until now.
    let marking = cluster.clone();
    proxy.before("\"about\":\"second\"", move || {
        assert!(marking.ctl(&["put", "/test/late-mark/moved", "elsewhere"]).status.success());
    });
    let next = store(vec![proxy.address.clone()], "/test/late-mark", "second");
    assert!(next.open().is_err(), "two go on with one state");
    let leader = String::from_utf8(cluster.ctl(&["get", "/test/late-mark/leader"]).stdout).unwrap();
    assert!(leader.contains("\"holder\":null"), "{leader}");
    let error = next.open().map(drop).unwrap_err();
    assert!(matches!(error, OpenError::Read(ReadError::Moved { .. })), "{error}");
}

#[test]
fn a_copy_to_what_another_writer_has_taken_meanwhile_leaves_it_alone() {
    if !is_there() {
        return;
    }
    let cluster = Cluster::start(1, &[]);
    let make =
        |name: &str| -> Box<dyn Store> { Box::new(store(cluster.endpoints(), &format!("/test/{name}"), "test")) };
    let take = |name: &str| assert!(cluster.ctl(&["del", &format!("/test/{name}/leader")]).status.success());
    promises::a_copy_to_what_another_writer_has_taken_meanwhile_leaves_it_alone(&make, &take);
}

#[test]
fn a_member_that_was_made_anew_as_a_cluster_of_its_own_begins_no_second_log() {
    if !is_there() {
        return;
    }
    let (mut ours, other) = (Cluster::start(1, &[]), Cluster::start(1, &[]));
    let anew = other.endpoints().remove(0);
    let proxy = Proxy::to(&ours.members[0].client);
    let nobody = "http://127.0.0.1:1".to_owned();
    let refused = |endpoints: &[&String], why: &str| {
        let log = store(endpoints.iter().map(|&endpoint| endpoint.clone()).collect(), "/test/anew", "refused");
        let error = log.open().map(drop).unwrap_err();
        assert!(matches!(error, OpenError::Read(ReadError::Remote { .. })), "{error}");
        assert!(error.to_string().contains(why), "{error}");
    };
    // Nobody can say whose log it would be.
    refused(&[&anew, &proxy.address], "several clusters");
    // Most of them say nothing, or one of two.
    refused(&[&anew, &nobody], "only 1 of 2 members answer");
    refused(&[&anew, &nobody, &nobody], "only 1 of 3 members answer");
    let (_, mut writer) = store(ours.endpoints(), "/test/anew", "first").open().unwrap();
    append_durably(&mut *writer, b"ours");
    writer.close().unwrap();
    // The one that has the log counts, whoever is asked first.
    let log = store(vec![anew.clone(), proxy.address.clone()], "/test/anew", "second");
    let (recovered, mut writer) = log.open().unwrap();
    assert_eq!(payloads(&recovered.records), [b"ours"]);
    // Where only the other one answers, nothing is known, and nothing is lost.
    proxy.lose_all(true);
    for _ in 0..3 {
        assert!(matches!(writer.place().check(), Err(Fault::Remote { .. })));
    }
    proxy.lose_all(false);
    until("it does not find its cluster again", || writer.place().check().is_ok());
    append_durably(&mut *writer, b"more");
    writer.close().unwrap();
    // Nor does one that stood by begin another log there.
    let (_, writer) = log.open().unwrap();
    let standby = store(vec![anew.clone(), proxy.address.clone(), nobody.clone()], "/test/anew", "standby");
    assert!(matches!(standby.open(), Err(OpenError::Held { .. })));
    drop(writer);
    ours.kill(0);
    for _ in 0..3 {
        let error = standby.open().map(drop).unwrap_err();
        assert!(matches!(error, OpenError::Read(ReadError::Remote { .. }) | OpenError::Restored { .. }), "{error:?}");
    }
    ours.run(0);
    ours.await_health();
    let begin = Instant::now();
    let (recovered, writer) = loop {
        match standby.open() {
            Ok(opened) => break opened,
            Err(error) => assert!(begin.elapsed() < Duration::from_secs(30), "{error}"),
        }
    };
    assert_eq!(payloads(&recovered.records), [&b"ours"[..], b"more"]);
    drop(writer);
    let keys = other.ctl(&["get", "--prefix", "/test/anew", "--keys-only"]);
    assert!(keys.stdout.is_empty(), "something was written there: {keys:?}");
}

#[test]
fn a_writer_whose_owner_hangs_loses_the_place_and_one_whose_owner_takes_turns_keeps_it() {
    if !is_there() {
        return;
    }
    let cluster = Cluster::start(1, &[]);
    let (taken, hangs) = (Arc::new(AtomicU64::new(0)), Arc::new(AtomicBool::new(false)));
    let (_, mut old) = store(cluster.endpoints(), "/test/hangs", "first").open().unwrap();
    let (turns, hung) = (taken.clone(), hangs.clone());
    old.attend(Arc::new(move || {
        let hangs = hung.load(Ordering::SeqCst);
        Some(turns.fetch_add(u64::from(!hangs), Ordering::SeqCst)).filter(|taken| *taken > 0)
    }));
    let next = store(cluster.endpoints(), "/test/hangs", "second");
    let begin = Instant::now();
    while begin.elapsed() < Duration::from_secs(3) {
        assert!(matches!(next.open(), Err(OpenError::Held { .. })), "it takes its turns");
    }
    hangs.store(true, Ordering::SeqCst);
    let hung = Instant::now();
    let (_, _new) = open(&next);
    assert!(hung.elapsed() >= Duration::from_secs(2), "a turn may be long: {:?}", hung.elapsed());
    // It goes on taking turns, and hears what has become of the place.
    hangs.store(false, Ordering::SeqCst);
    until("it does not hear that it was got past", || matches!(old.place().check(), Err(Fault::Deposed { .. })));
}

/// Waits until this holds.
fn until(what: &str, holds: impl Fn() -> bool) {
    let begin = Instant::now();
    while !holds() {
        assert!(begin.elapsed() < Duration::from_secs(30), "{what}");
        std::thread::sleep(Duration::from_millis(5));
    }
}

fn open(store: &Etcd) -> (ratn_storage::Recovered, Box<dyn Writer>) {
    let begin = Instant::now();
    loop {
        match store.open() {
            Ok(opened) => return opened,
            Err(OpenError::Held { .. }) => assert!(begin.elapsed() < Duration::from_secs(30), "it stays held"),
            Err(error) => panic!("{error}"),
        }
    }
}

#[test]
fn a_writer_that_says_nothing_for_a_second_is_got_past_and_writes_nothing_more() {
    if !is_there() {
        return;
    }
    let cluster = Cluster::start(1, &[]);
    let proxy = Proxy::to(&cluster.members[0].client);
    let cut_off = store(vec![proxy.address.clone()], "/test/got-past", "first");
    let (first, mut old) = cut_off.open().unwrap();
    append_durably(&mut *old, b"old");
    proxy.lose_all(true);
    let cut = Instant::now();
    let lost = old.append(b"lost").unwrap();
    let next = store(cluster.endpoints(), "/test/got-past", "second");
    let (second, mut new) = open(&next);
    assert!(cut.elapsed() >= Duration::from_millis(750), "taken after {:?}", cut.elapsed());
    assert!(second.epoch > first.epoch);
    assert_eq!(payloads(&second.records), [b"old"]);
    append_durably(&mut *new, b"new");
    assert!(matches!(old.place().check(), Err(Fault::Remote { .. })), "nothing is known while it is cut off");
    proxy.lose_all(false);
    assert!(matches!(old.durable().wait_blocking(lost), Err(Fault::Deposed { .. })));
    assert!(matches!(old.place().check(), Err(Fault::Deposed { .. })));
    drop(old);
    append_durably(&mut *new, b"newer");
    drop(new);
    assert_eq!(payloads(&next.read().unwrap().records), [&b"old"[..], b"new", b"newer"]);
}

#[test]
fn a_writer_that_hears_no_answers_does_not_keep_the_place() {
    if !is_there() {
        return;
    }
    let cluster = Cluster::start(1, &[]);
    let proxy = Proxy::to(&cluster.members[0].client);
    let deaf = store(vec![proxy.address.clone()], "/test/deaf", "first");
    let (_, mut old) = deaf.open().unwrap();
    append_durably(&mut *old, b"old");
    // All that it asks goes on arriving.
    proxy.lose_answers(true);
    let (_, mut new) = open(&store(cluster.endpoints(), "/test/deaf", "second"));
    append_durably(&mut *new, b"new");
    proxy.lose_answers(false);
    until("it does not hear that it was got past", || matches!(old.place().check(), Err(Fault::Deposed { .. })));
}

#[test]
fn a_transaction_whose_answer_is_lost_is_there_once() {
    if !is_there() {
        return;
    }
    let cluster = Cluster::start(1, &[]);
    let proxy = Proxy::to(&cluster.members[0].client);
    let lossy = store(vec![proxy.address.clone()], "/test/lost", "test");
    let (_, mut writer) = lossy.open().unwrap();
    for round in 0..5_u8 {
        proxy.lose_answers(true);
        let position = writer.append(&[round]).unwrap();
        // Delivered, and not answered.
        let direct = store(cluster.endpoints(), "/test/lost", "reader");
        until("it is not delivered", || direct.read().unwrap().last() >= position);
        assert!(!writer.durable().reached(position).unwrap(), "nobody can know that yet");
        proxy.lose_answers(false);
        writer.durable().wait_blocking(position).unwrap();
    }
    writer.close().unwrap();
    let read = store(cluster.endpoints(), "/test/lost", "reader").read().unwrap();
    assert_eq!(payloads(&read.records), (0..5_u8).map(|round| vec![round]).collect::<Vec<_>>());
}

#[test]
fn copies_of_transactions_that_arrive_late_change_nothing() {
    if !is_there() {
        return;
    }
    const LATEST: Duration = Duration::from_millis(550);
    let cluster = Cluster::start(3, &[]);
    // Every way is slow now and then, so that most transactions are asked for once more over another way, and arrive twice.
    let proxies: Vec<Proxy> = cluster.endpoints().iter().map(|member| Proxy::to(member)).collect();
    let addresses: Vec<String> = proxies.iter().map(|proxy| proxy.address.clone()).collect();
    let direct = store(cluster.endpoints(), "/test/late", "reader");
    let mut model: Vec<Vec<u8>> = Vec::new();
    for (round, bursts) in [(0_u8, 4), (1, 1)] {
        // Small parts: a record needs several transactions.
        let bounds = Bounds { part: 400, ..Bounds::default() };
        let options = options(addresses.clone(), "/test/late", "test");
        let log = Etcd::new(ratn_storage::EtcdOptions { bounds, ..options }).unwrap();
        let (recovered, mut writer) = open(&log);
        let through = recovered.snapshot.as_ref().map_or(0, |snapshot| snapshot.through.0 as usize);
        assert_eq!(payloads(&recovered.records), model[through..], "round {round}");
        for burst in 0..bursts {
            proxies.iter().for_each(|proxy| proxy.delay(LATEST));
            for number in 0..4_u8 {
                let record = vec![round * 16 + burst * 4 + number; 10 + 150 * usize::from(number)];
                append_durably(&mut *writer, &record);
                model.push(record);
            }
            let state = vec![burst; 1_000];
            writer.compact(Position(model.len() as u64 - 2), Box::new(move || state.into())).unwrap();
            assert!(common::compacted(&*writer).compaction_failure.is_none());
            // Every copy has arrived, and nothing was done behind them that would hide what they did.
            std::thread::sleep(2 * LATEST);
            let read = direct.read().unwrap();
            let snapshot = read.snapshot.unwrap();
            assert_eq!(snapshot.payload, vec![burst; 1_000], "round {round}, burst {burst}");
            let rest = &model[snapshot.through.0 as usize..];
            assert_eq!(payloads(&read.records), rest, "round {round}, burst {burst}");
        }
        proxies.iter().for_each(|proxy| proxy.delay(Duration::ZERO));
        append_durably(&mut *writer, b"after");
        model.push(b"after".to_vec());
        writer.close().unwrap();
    }
}

#[test]
fn records_go_on_when_etcds_own_leader_is_killed() {
    if !is_there() {
        return;
    }
    let mut cluster = Cluster::start(3, &[]);
    let log = store(cluster.endpoints(), "/test/members", "test");
    let (_, mut writer) = log.open().unwrap();
    let mut longest = Duration::ZERO;
    for round in 0..6_usize {
        append_durably(&mut *writer, &[u8::try_from(round).unwrap()]);
        cluster.kill(round % 3);
        let begin = Instant::now();
        append_durably(&mut *writer, b"without one");
        longest = longest.max(begin.elapsed());
        cluster.run(round % 3);
        cluster.await_health();
    }
    println!("the longest append: {longest:?}");
    writer.close().unwrap();
    assert_eq!(log.read().unwrap().records.len(), 12);
}

#[test]
fn without_space_appends_wait_and_say_why_and_go_on_when_there_is_space() {
    if !is_there() {
        return;
    }
    let cluster = Cluster::start(1, &["--quota-backend-bytes", "2097152"]);
    let log = store(cluster.endpoints(), "/test/space", "test");
    let (_, mut writer) = log.open().unwrap();
    let durable = writer.durable();
    append_durably(&mut *writer, b"with space");
    // Somebody else fills it, with many versions of one key.
    let value = "x".repeat(100 << 10);
    let filled = (0..100).any(|_| !cluster.ctl(&["put", "/other", &value]).status.success());
    assert!(filled);
    let last = writer.append(b"without space").unwrap();
    until("it does not say that it is stalled", || durable.progress().stalled.is_some());
    let why = durable.progress().stalled.unwrap();
    assert!(why.contains("NOSPACE") && why.contains("disarm"), "{why}");
    assert!(!durable.reached(last).unwrap());
    // The place is still held, and nobody else gets it.
    writer.place().check().unwrap();
    assert_eq!(payloads(&log.read().unwrap().records), [b"with space"]);
    // An operator makes room, as the message says.
    let found = cluster.ctl(&["get", "/other", "-w", "json"]);
    let found: serde_json::Value = serde_json::from_slice(&found.stdout).unwrap();
    assert!(cluster.ctl(&["compact", &found["header"]["revision"].to_string()]).status.success());
    assert!(cluster.ctl(&["defrag"]).status.success());
    assert!(cluster.ctl(&["alarm", "disarm"]).status.success());
    writer.durable().wait_blocking(last).unwrap();
    until("it still says that it is stalled", || durable.progress().stalled.is_none());
    append_durably(&mut *writer, b"with space again");
    writer.close().unwrap();
    assert_eq!(log.read().unwrap().records.len(), 3);
}

#[test]
fn when_there_is_space_again_nobody_takes_the_place_of_a_holder_that_has_just_confirmed_itself() {
    if !is_there() {
        return;
    }
    let cluster = Cluster::start(1, &["--quota-backend-bytes", "2097152"]);
    let proxy = Proxy::to(&cluster.members[0].client);
    let log = store(vec![proxy.address.clone()], "/test/confirmed", "first");
    let (_, writer) = log.open().unwrap();
    let value = "x".repeat(100 << 10);
    assert!((0..100).any(|_| !cluster.ctl(&["put", "/other", &value]).status.success()));
    // Another one wants the place all the time, and cannot take it: every attempt ends, and the silence that it counts begins anew.
    let other = store(cluster.endpoints(), "/test/confirmed", "second");
    let (failed, fails) = std::sync::mpsc::channel();
    let standing_by = std::thread::spawn(move || {
        loop {
            match other.open() {
                Ok((_, taken)) => break (Instant::now(), taken),
                Err(OpenError::Held { .. } | OpenError::Read(ReadError::Remote { .. })) => {
                    let _ = failed.send(Instant::now());
                }
                Err(error) => panic!("{error}"),
            }
        }
    });
    let found = cluster.ctl(&["get", "/other", "-w", "json"]);
    let found: serde_json::Value = serde_json::from_slice(&found.stdout).unwrap();
    assert!(cluster.ctl(&["compact", &found["header"]["revision"].to_string()]).status.success());
    assert!(cluster.ctl(&["defrag"]).status.success());
    // It is confirmed without a word to anybody, for longer than a silence, until there is space again in the middle of what the other one
    // takes for one.
    let begin = Instant::now();
    let mut last = begin;
    let (shortest, longest) = (Duration::from_secs(2), Duration::from_secs(4));
    while begin.elapsed() < shortest || (last.elapsed() < Duration::from_millis(600) && begin.elapsed() < longest) {
        writer.place().check().unwrap();
        last = fails.try_iter().last().unwrap_or(last);
    }
    assert!(last > begin, "no attempt has ended");
    writer.place().check().unwrap();
    let confirmed = Instant::now();
    // Cut off from the very moment on: nobody hears it any more.
    proxy.lose_all(true);
    assert!(cluster.ctl(&["alarm", "disarm"]).status.success());
    until("it stays held", || standing_by.is_finished());
    let (taken, _held) = standing_by.join().unwrap();
    let after = taken - confirmed;
    assert!(after >= Duration::from_secs(1), "the place was taken {after:?} after it was confirmed");
    drop(writer);
}

#[test]
fn etcds_compaction_and_a_revoked_lease_change_nothing() {
    if !is_there() {
        return;
    }
    let cluster = Cluster::start(1, &["--auto-compaction-mode", "revision", "--auto-compaction-retention", "1"]);
    let log = store(cluster.endpoints(), "/test/compacted", "test");
    let (_, mut writer) = log.open().unwrap();
    let leases = String::from_utf8(cluster.ctl(&["lease", "list"]).stdout).unwrap();
    assert!(leases.contains("found 0 leases"), "nothing depends on a lease of etcd: {leases}");
    for round in 0..50_u8 {
        append_durably(&mut *writer, &[round]);
        if round % 10 == 9 {
            let revision = cluster.ctl(&["get", "/test/compacted/head", "-w", "json"]);
            let revision: serde_json::Value = serde_json::from_slice(&revision.stdout).unwrap();
            assert!(cluster.ctl(&["compact", &revision["header"]["revision"].to_string()]).status.success());
        }
    }
    writer.close().unwrap();
    assert_eq!(open(&log).0.records.len(), 50);
}

#[test]
fn an_older_state_of_etcd_is_refused_unless_told() {
    if !is_there() {
        return;
    }
    let kept = tempfile::tempdir().unwrap();
    let file = kept.path().join("snapshot").display().to_string();
    let mut cluster = Cluster::start(1, &[]);
    let endpoints = cluster.endpoints();
    let log = store(endpoints.clone(), "/test/restored", "test");
    let (_, mut writer) = log.open().unwrap();
    append_durably(&mut *writer, b"saved");
    assert!(cluster.ctl(&["snapshot", "save", &file]).status.success());
    for _ in 0..20 {
        append_durably(&mut *writer, b"acknowledged, and gone");
    }
    cluster.restore(&file);
    // The writer that was there knows more than etcd does.
    let position = writer.append(b"more").unwrap();
    let fault = writer.durable().wait_blocking(position).unwrap_err();
    assert!(fault.to_string().contains("an older state of etcd") || matches!(fault, Fault::Deposed { .. }), "{fault}");
    drop(writer);
    // Who opens it anew, too: by the cluster that it was written to.
    let fresh = store(endpoints.clone(), "/test/restored", "test");
    let begin = Instant::now();
    let error = loop {
        match fresh.open().map(drop) {
            Err(OpenError::Held { .. }) if begin.elapsed() < Duration::from_secs(10) => {}
            other => break other.unwrap_err(),
        }
    };
    assert!(matches!(error, OpenError::Restored { generation: 1, .. }), "{error}");
    assert!(error.to_string().contains("accept_restored = 1"), "{error}");
    let marked = |name: &str, accept_restored: Option<u64>| {
        let mark = Some(kept.path().join(name));
        let options = options(endpoints.clone(), "/test/restored", "test");
        Etcd::new(ratn_storage::EtcdOptions { mark, accept_restored, ..options }).unwrap()
    };
    let options = options(endpoints.clone(), "/test/restored", "test");
    let told = Etcd::new(ratn_storage::EtcdOptions { accept_restored: Some(1), ..options }).unwrap();
    let (recovered, writer) = open(&told);
    assert_eq!(payloads(&recovered.records), [b"saved"]);
    assert!(recovered.restored);
    drop(writer);
    // Once is enough. As long as nothing was written since, whoever opens it is told.
    let (recovered, mut writer) = open(&fresh);
    assert!(recovered.restored);
    append_durably(&mut *writer, b"since");
    drop(writer);
    assert!(!open(&fresh).0.restored);
    // The same cluster by its number: a host that has seen more knows. So does one that has seen a log where there is none.
    assert!(cluster.ctl(&["snapshot", "save", &file]).status.success());
    let (_, mut writer) = open(&marked("mark", None));
    append_durably(&mut *writer, b"gone again");
    drop(writer);
    assert!(!std::fs::read(kept.path().join("mark")).unwrap().is_empty());
    cluster.restore(&file);
    assert!(matches!(marked("mark", None).open(), Err(OpenError::Restored { generation: 2, .. })));
    // What was accepted the last time and was left in the config is not enough.
    assert!(matches!(marked("mark", Some(1)).open(), Err(OpenError::Restored { generation: 2, .. })));
    let (recovered, writer) = open(&marked("no mark", None));
    assert_eq!(payloads(&recovered.records), [&b"saved"[..], b"since"], "nobody knows of it there");
    // Who stands by beside it knows, and says so.
    let error = marked("mark", None).open().map(drop).unwrap_err();
    assert!(matches!(error, OpenError::Restored { generation: 2, .. }), "{error}");
    drop(writer);
    assert!(cluster.ctl(&["del", "--prefix", "/test/restored"]).status.success());
    assert!(matches!(marked("mark", None).open(), Err(OpenError::Restored { .. })));
    let (recovered, writer) = open(&marked("mark", Some(2)));
    assert!(recovered.restored, "it is empty, and was not");
    drop(writer);
    drop(open(&marked("mark", None)));
}

#[test]
fn a_state_that_is_copied_back_is_accepted_by_every_host_and_one_from_before_it_was_moved_by_none() {
    if !is_there() {
        return;
    }
    let kept = tempfile::tempdir().unwrap();
    let file = kept.path().join("snapshot").display().to_string();
    let mut cluster = Cluster::start(1, &[]);
    // From now on a restored etcd has the number of this one.
    assert!(cluster.ctl(&["snapshot", "save", &file]).status.success());
    cluster.restore(&file);
    let endpoints = cluster.endpoints();
    let host = |name: &str, prefix: &str| {
        let (mark, options) = (Some(kept.path().join(name)), options(endpoints.clone(), prefix, name));
        Etcd::new(ratn_storage::EtcdOptions { mark, ..options }).unwrap()
    };
    // The tool that copies keeps nothing.
    let tool = |prefix: &str| store(endpoints.clone(), prefix, "tool");
    let in_files = |name: &str| ratn_storage::Log::new(kept.path().join(name), ratn_storage::Options::default());
    let hosts = ["leader", "standby"];
    let (_, mut writer) = host("leader", "/test/back").open().unwrap();
    append_durably(&mut *writer, b"1");
    append_durably(&mut *writer, b"2");
    let standby = host("standby", "/test/back");
    for _ in 0..2 {
        assert!(matches!(standby.open(), Err(OpenError::Held { .. })));
    }
    writer.close().unwrap();
    assert!(cluster.ctl(&["snapshot", "save", &file]).status.success());
    transfer(&tool("/test/back"), &in_files("files")).unwrap();
    transfer(&in_files("files"), &tool("/test/other")).unwrap();
    for name in hosts {
        assert_eq!(payloads(&open(&host(name, "/test/other")).0.records), [b"1", b"2"]);
    }
    // A copy begins a generation of its own where it is not of the same second.
    std::thread::sleep(Duration::from_secs(1));
    assert!(cluster.ctl(&["del", "--prefix", "/test/back/"]).status.success());
    transfer(&tool("/test/other"), &tool("/test/back")).unwrap();
    for name in hosts {
        let (recovered, _writer) = open(&host(name, "/test/back"));
        assert_eq!(payloads(&recovered.records), [b"1", b"2"]);
        assert!(!recovered.restored, "nothing is missing");
    }
    cluster.restore(&file);
    for name in hosts {
        assert!(matches!(host(name, "/test/back").open(), Err(OpenError::Restored { .. })));
    }
}

#[test]
fn a_restored_etcd_is_accepted_by_one_host_for_all() {
    if !is_there() {
        return;
    }
    let kept = tempfile::tempdir().unwrap();
    let file = kept.path().join("snapshot").display().to_string();
    let mut cluster = Cluster::start(1, &[]);
    let endpoints = cluster.endpoints();
    let host = |name: &str, accept_restored: Option<u64>| {
        let (mark, options) = (Some(kept.path().join(name)), options(endpoints.clone(), "/test/hosts", name));
        Etcd::new(ratn_storage::EtcdOptions { mark, accept_restored, ..options }).unwrap()
    };
    let (first, second, third) = (host("first", None), host("second", None), host("third", None));
    let told = host("first", Some(1));
    let (_, mut writer) = first.open().unwrap();
    append_durably(&mut *writer, b"saved");
    assert!(cluster.ctl(&["snapshot", "save", &file]).status.success());
    for _ in 0..20 {
        append_durably(&mut *writer, b"acknowledged, and gone");
    }
    // They stand by, and see how far it is.
    for standby in [&second, &third] {
        for _ in 0..2 {
            assert!(matches!(standby.open(), Err(OpenError::Held { .. })));
        }
    }
    cluster.restore(&file);
    drop(writer);
    // One that stood by refuses it as one that starts, as often as they try it.
    let refused = |log: &Etcd| {
        let begin = Instant::now();
        loop {
            match log.open().map(drop) {
                Err(OpenError::Restored { generation, .. }) => break assert_eq!(generation, 1),
                other => assert!(begin.elapsed() < Duration::from_secs(10), "{other:?}"),
            }
        }
    };
    [&second, &second, &host("third", None), &third].into_iter().for_each(refused);
    let (recovered, mut writer) = open(&told);
    assert_eq!((recovered.records.len(), recovered.restored), (1, true));
    append_durably(&mut *writer, b"since");
    // It is accepted for those that stand by, too, and for one that is started again.
    let restarted = host("third", None);
    for standby in [&second, &restarted] {
        assert!(matches!(standby.open(), Err(OpenError::Held { .. })));
    }
    drop(writer);
    for next in [&second, &restarted] {
        let (recovered, _writer) = open(next);
        assert_eq!(payloads(&recovered.records), [&b"saved"[..], b"since"]);
        assert!(!recovered.restored);
    }
}

#[test]
fn a_leader_and_a_standby_notice_a_restored_etcd_while_a_member_of_the_old_one_still_runs_and_is_silent() {
    if !is_there() {
        return;
    }
    let kept = tempfile::tempdir().unwrap();
    let file = kept.path().join("snapshot").display().to_string();
    let mut cluster = Cluster::start(1, &[]);
    // It will hold what it is asked for as long as nobody answers it.
    let silent = Proxy::to(&cluster.members[0].client);
    let endpoints = vec![silent.address.clone(), cluster.endpoints().remove(0)];
    let (_, mut writer) = store(endpoints.clone(), "/test/minority", "leader").open().unwrap();
    append_durably(&mut *writer, b"saved");
    let standby = store(endpoints, "/test/minority", "standby");
    for _ in 0..2 {
        assert!(matches!(standby.open(), Err(OpenError::Held { .. })));
    }
    assert!(cluster.ctl(&["snapshot", "save", &file]).status.success());
    silent.lose_answers(true);
    cluster.restore(&file);
    // It writes nothing.
    let durable = writer.durable();
    until("the leader goes on for ever", || durable.progress().fault.is_some());
    let fault = durable.progress().fault.unwrap();
    assert!(matches!(fault, Fault::Remote { .. }) && fault.to_string().contains("is of the cluster"), "{fault}");
    let begin = Instant::now();
    loop {
        match standby.open().map(drop) {
            Err(OpenError::Restored { .. }) => break,
            other => assert!(begin.elapsed() < Duration::from_secs(20), "{other:?}"),
        }
    }
}

/// A server that refuses every call.
fn refusing() -> (tokio::runtime::Runtime, String) {
    let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(1).enable_all().build().unwrap();
    let address = std::net::TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap();
    runtime.spawn(tonic::transport::Server::builder().add_routes(tonic::service::Routes::default()).serve(address));
    until("it does not listen", || std::net::TcpStream::connect(address).is_ok());
    (runtime, format!("http://{address}"))
}

#[test]
fn a_member_that_refuses_is_passed_over_as_long_as_another_one_answers() {
    if !is_there() {
        return;
    }
    let cluster = Cluster::start(1, &[]);
    let (_runtime, refusing) = refusing();
    // One of two members does not begin a log.
    drop(store(cluster.endpoints(), "/test/refusing", "first").open().unwrap());
    let log = store([vec![refusing.clone()], cluster.endpoints()].concat(), "/test/refusing", "test");
    let (_, mut writer) = open(&log);
    append_durably(&mut *writer, b"performed");
    writer.place().check().unwrap();
    writer.close().unwrap();
    assert_eq!(payloads(&log.read().unwrap().records), [b"performed"]);
    let error = store(vec![refusing.clone()], "/test/refusing", "test").open().map(drop).unwrap_err().to_string();
    assert!(error.contains(&format!("etcd refuses: {refusing} says")), "{error}");
}

#[test]
fn what_is_missing_or_wrong_in_etcd_is_refused_by_name() {
    if !is_there() {
        return;
    }
    let cluster = Cluster::start(1, &[]);
    let log = store(cluster.endpoints(), "/test/damaged", "test");
    let (_, mut writer) = log.open().unwrap();
    for record in [b"1", b"2", b"3"] {
        append_durably(&mut *writer, record);
    }
    drop(writer);
    let keys = String::from_utf8(cluster.ctl(&["get", "--prefix", "/test/damaged/log", "--keys-only"]).stdout).unwrap();
    let keys: Vec<&str> = keys.split_whitespace().collect();
    assert_eq!(keys.len(), 3, "{keys:?}");
    assert!(cluster.ctl(&["put", keys[1], "something else"]).status.success());
    assert!(matches!(log.read(), Err(ReadError::Damaged { place, .. }) if place == keys[1]));
    assert!(cluster.ctl(&["del", keys[1]]).status.success());
    let error = log.open().map(drop).unwrap_err().to_string();
    assert!(error.contains("records 2 to 3 are missing"), "{error}");
    assert!(cluster.ctl(&["del", keys[2]]).status.success());
    let error = log.read().unwrap_err().to_string();
    assert!(error.contains("its head is record 3, and 1 is the last"), "{error}");
}

#[test]
fn without_any_member_opening_says_whom_it_asked() {
    let log = store(vec!["http://127.0.0.1:1".to_owned()], "/test/nobody", "test");
    let error = log.open().map(drop).unwrap_err().to_string();
    assert!(error.contains("cannot read from http://127.0.0.1:1"), "{error}");
}

#[test]
fn a_log_goes_from_files_to_etcd_and_back_and_never_over_another() {
    if !is_there() {
        return;
    }
    let (cluster, place) = (Cluster::start(1, &[]), tempfile::tempdir().unwrap());
    let in_files = |name: &str| ratn_storage::Log::new(place.path().join(name), ratn_storage::Options::default());
    let in_etcd = store(cluster.endpoints(), "/test/copy", "test");
    let (_, mut writer) = in_files("first").open().unwrap();
    for number in 0..10_u8 {
        append_durably(&mut *writer, &[number]);
    }
    writer.compact(Position(4), Box::new(|| bytes::Bytes::from_static(b"four"))).unwrap();
    common::compacted(&*writer);
    assert!(transfer(&in_files("first"), &in_etcd).is_err(), "it is being written");
    writer.close().unwrap();
    transfer_running(&in_files("first"), &in_files("second")).unwrap();
    transfer(&in_files("first"), &in_etcd).unwrap();
    let error = transfer(&in_files("second"), &in_etcd).unwrap_err();
    assert!(error.to_string().contains("nothing is overwritten"), "{error}");
    let is_the_same = |log: &dyn Store| {
        let read = log.read().unwrap();
        assert_eq!(read.snapshot.unwrap().payload, "four");
        assert_eq!(payloads(&read.records), (4..10_u8).map(|number| vec![number]).collect::<Vec<_>>());
    };
    is_the_same(&in_etcd);
    transfer(&in_etcd, &in_files("back")).unwrap();
    is_the_same(&in_files("back"));
    assert!(matches!(in_etcd.open(), Err(OpenError::Read(ReadError::Moved { .. }))));
    // As the message says: nothing was written since.
    assert!(cluster.ctl(&["del", "/test/copy/moved"]).status.success());
    let (_, _writer) = in_etcd.open().unwrap();
    assert!(transfer(&in_etcd, &in_files("again")).is_err());
    transfer_running(&in_etcd, &in_files("backup")).unwrap();
    is_the_same(&in_files("backup"));
    assert!(matches!(transfer(&in_files("nothing"), &in_files("other")), Err(ratn_storage::CopyError::Nothing { .. })));
}
