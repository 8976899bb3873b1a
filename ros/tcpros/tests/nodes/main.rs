//! Nodes of this crate with each other and with misbehaving peers, around a master in this
//! process.
//!
//! Requirements of a node, and the tests that verify them:
//!
//! - Small messages are sent at once: `delivery`, and the unit tests of `topic_server` and `link`.
//! - A slow peer affects only itself, in messages and in bytes: `peers`, `delivery`.
//! - An announced length is trusted only as far as the peer delivers: `peers`, and the unit tests
//!   of `frame` and `header`.
//! - A peer that sends nothing or invalid data delays no other peer: `peers`.
//! - A publisher is retried until the master no longer lists it: `peers`.
//! - A node does not receive its own messages, under any name: `delivery`.
//! - The master may start late, stop and restart: `master`.
//! - Registrations that the master loses are registered again, and a name has one node: `master`,
//!   `slave_api`.
//! - Claims of peers cost a bounded number of connections and log entries: `peers`, and the unit
//!   tests of `crowd` and `rpc`.
//! - The end of a node leaves nothing behind: `master`.
//! - The slave API answers every call, on every kind of HTTP connection: `slave_api`, and the unit
//!   tests of `rpc`.
//! - The last message of a latched topic reaches late subscribers: `delivery`.

#![expect(clippy::unwrap_used, clippy::panic, reason = "test code")]

mod delivery;
mod master;
mod peers;
mod slave_api;
mod support;
