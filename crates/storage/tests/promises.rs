//! What every log promises, of the log in files; `etcd.rs` has the same of the log in etcd.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

mod common;

use common::promises;
use ratn_storage::{Log, Options, Store};

/// A log for each name, in a directory that vanishes.
fn with_logs(test: impl Fn(promises::Make<'_>)) {
    let place = tempfile::tempdir().unwrap();
    let make = |name: &str| -> Box<dyn Store> { Box::new(Log::new(place.path().join(name), Options::default())) };
    test(&make);
}

#[test]
fn a_second_writer_is_refused_until_the_first_is_gone() {
    with_logs(promises::a_second_writer_is_refused_until_the_first_is_gone);
}

#[test]
fn many_restarts_keep_every_record() {
    with_logs(promises::many_restarts_keep_every_record);
}

#[test]
fn compaction_beside_appends_loses_nothing() {
    with_logs(promises::compaction_beside_appends_loses_nothing);
}

#[test]
fn a_waiter_hears_when_the_writer_is_gone() {
    with_logs(promises::a_waiter_hears_when_the_writer_is_gone);
}

#[test]
fn a_log_is_a_vector() {
    with_logs(|make| promises::a_log_is_a_vector(make, 16, 60, 60));
}

#[test]
fn a_copy_that_was_interrupted_when_its_source_was_marked_is_finished_by_the_same_copy() {
    with_logs(promises::a_copy_that_was_interrupted_when_its_source_was_marked_is_finished_by_the_same_copy);
}

#[test]
fn what_was_moved_is_opened_only_where_it_is_now() {
    with_logs(promises::what_was_moved_is_opened_only_where_it_is_now);
}

#[test]
fn a_copy_of_what_another_writer_has_taken_meanwhile_is_not_opened() {
    let place = tempfile::tempdir().unwrap();
    let make = |name: &str| -> Box<dyn Store> { Box::new(Log::new(place.path().join(name), Options::default())) };
    let take = |name: &str| std::fs::remove_file(place.path().join(name).join("writer.lock")).unwrap();
    promises::a_copy_of_what_another_writer_has_taken_meanwhile_is_not_opened(&make, &take);
}

#[test]
fn a_copy_to_what_another_writer_has_taken_meanwhile_leaves_it_alone() {
    let place = tempfile::tempdir().unwrap();
    let make = |name: &str| -> Box<dyn Store> { Box::new(Log::new(place.path().join(name), Options::default())) };
    let take = |name: &str| std::fs::remove_file(place.path().join(name).join("writer.lock")).unwrap();
    promises::a_copy_to_what_another_writer_has_taken_meanwhile_leaves_it_alone(&make, &take);
}

#[test]
fn a_copy_that_was_interrupted_is_not_opened() {
    with_logs(promises::a_copy_that_was_interrupted_is_not_opened);
}
