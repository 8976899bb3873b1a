//! The tests of the router, in a single program to save link time.
#![expect(
    clippy::cast_possible_truncation,
    clippy::indexing_slicing,
    clippy::panic,
    clippy::unwrap_used,
    clippy::wildcard_enum_match_arm,
    reason = "test code"
)]

mod cell;
#[path = "../../../ros/messages/tests/support/inventor.rs"]
#[expect(dead_code, reason = "the tests of `messages` use the rest")]
mod inventor;
#[path = "../../../ros/messages/tests/support/mod.rs"]
#[expect(dead_code, reason = "the tests of `messages` use the rest")]
mod support;

mod allocation;
mod applications;
mod bytes;
mod call_actions;
mod call_freedom;
mod call_safety;
mod calls;
mod claims;
mod confirm;
mod deadline;
mod events;
mod fields;
mod foreign;
mod large;
mod limited;
mod loop_freedom;
mod many;
mod metadata;
mod parts;
mod publish;
mod redundancy;
mod redundant_calls;
mod reload;
mod router;
mod secured;
mod shaped;
mod sharing;
mod strangers;
