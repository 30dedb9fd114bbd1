//! What every store must do, as tests that each store runs.
//!
//! ```text
//! Fixture (one per store: opens stores by name) ──► rules, which panic where the store breaks one
//! ```
//!
//! A store writes a [`Fixture`] and one line,
//! [`store_conformance_tests!`](crate::store_conformance_tests), which makes a test of each rule.
//! All waits are on conditions with a deadline, never on time alone.
#![allow(
    clippy::unwrap_used,
    clippy::panic,
    clippy::missing_panics_doc,
    reason = "these are tests: a store that breaks a rule fails one"
)]

mod archive;
mod commits;
mod many;
pub(crate) mod samples;
mod tools;
mod trimming;
mod upkeep;

use std::sync::Arc;

use async_trait::async_trait;

use blaze_config::store::FullStore;

pub use archive::{
    answers_are_kept_until_they_expire, audit_is_filtered_and_paged,
    audit_of_commits_is_among_the_rest, audit_written_twice_is_there_once,
    revisions_before_a_time_are_found, tokens_are_kept_and_revoked, versions_come_newest_first,
};
pub use commits::{
    a_group_is_written_whole, a_taken_answer_is_a_conflict, a_taken_revision_is_a_conflict,
    an_empty_store_is_at_zero, commits_are_whole_whatever_their_size,
    commits_come_in_order_and_in_parts, what_was_written_is_read_back,
};
pub use many::{
    a_foreign_commit_is_noticed, a_store_that_is_reopened_is_the_same,
    documents_are_right_whoever_tidies, one_of_two_writers_has_each_revision,
    readers_never_see_a_hole_while_history_is_trimmed,
};
pub use trimming::{
    a_clock_that_leaps_ahead_makes_nothing_expire_at_once, a_long_history_is_trimmed,
    a_writer_that_slept_through_a_trim_is_refused, every_revision_from_the_floor_on_can_be_told,
    many_commits_of_others_hide_no_version, the_floor_rises_and_commits_go,
    versions_that_hold_or_are_young_stay, what_outlives_a_commit_stays,
};
pub use upkeep::{
    a_backup_is_restored_elsewhere, a_closed_store_is_unavailable, documents_are_rewritten_in_place,
};

/// A server or folder for the tests of one store.
#[async_trait]
pub trait Fixture: Send + Sync {
    /// Opens the store of a name, as a process of its own would; it is made, empty, when the name
    /// is new. Where [`Fixture::is_shared`], it may be opened several times at once.
    async fn open(&self, name: &str) -> Arc<dyn FullStore>;

    /// Whether several processes may use one store at once.
    fn is_shared(&self) -> bool;
}

/// The list of rules, for the tests of
/// [`store_conformance_tests!`](crate::store_conformance_tests).
macro_rules! rules {
    ($d:tt $($rule:ident),+ $(,)?) => {
        /// Makes a test of each rule. The argument is an expression whose `await` gives a
        /// [`Fixture`]; it is evaluated once for each test.
        #[macro_export]
        macro_rules! store_conformance_tests {
            ($d fixture:expr) => {
                $(
                    #[tokio::test(flavor = "multi_thread", worker_threads = 2)]
                    async fn $rule() {
                        $d crate::store::$rule(&$d fixture.await).await;
                    }
                )+
            };
        }
    };
}

rules!(
    $
    an_empty_store_is_at_zero,
    what_was_written_is_read_back,
    a_group_is_written_whole,
    a_taken_revision_is_a_conflict,
    a_taken_answer_is_a_conflict,
    commits_come_in_order_and_in_parts,
    commits_are_whole_whatever_their_size,
    versions_come_newest_first,
    revisions_before_a_time_are_found,
    audit_is_filtered_and_paged,
    audit_written_twice_is_there_once,
    audit_of_commits_is_among_the_rest,
    answers_are_kept_until_they_expire,
    tokens_are_kept_and_revoked,
    the_floor_rises_and_commits_go,
    versions_that_hold_or_are_young_stay,
    what_outlives_a_commit_stays,
    a_long_history_is_trimmed,
    a_clock_that_leaps_ahead_makes_nothing_expire_at_once,
    many_commits_of_others_hide_no_version,
    every_revision_from_the_floor_on_can_be_told,
    a_writer_that_slept_through_a_trim_is_refused,
    a_store_that_is_reopened_is_the_same,
    one_of_two_writers_has_each_revision,
    a_foreign_commit_is_noticed,
    readers_never_see_a_hole_while_history_is_trimmed,
    documents_are_right_whoever_tidies,
    documents_are_rewritten_in_place,
    a_backup_is_restored_elsewhere,
    a_closed_store_is_unavailable,
);
