//! Nodes of this crate with one another and with peers that misbehave, around a master in this process.
//!
//! What a node must hold, and where it is shown:
//!
//! - Small messages leave at once: `delivery`, and the unit tests of `topic_server` and `link`.
//! - A slow peer costs only itself, in messages and in bytes: `peers`, `delivery`.
//! - What a peer announces is believed as far as it delivers: `peers`, and the unit tests of `frame` and `header`.
//! - A peer that says nothing or nonsense keeps nobody else waiting: `peers`.
//! - A publisher is tried again until the master no longer names it: `peers`.
//! - A node does not hear itself, whatever it is called: `delivery`.
//! - The master may come late, go and come back: `master`.
//! - What the master loses of a node is registered again, and a name has one node: `master`, `slave_api`.
//! - What peers claim costs a bounded number of connections and log lines: `peers`, and the unit tests of `crowd` and `rpc`.
//! - The end of a node leaves nothing behind: `master`.
//! - The slave API answers everything, on every kind of HTTP connection: `slave_api`, and the unit tests of `rpc`.
//! - The last message of a latched topic reaches late subscribers: `delivery`.

#![expect(clippy::unwrap_used, clippy::panic, reason = "test code")]

mod delivery;
mod master;
mod peers;
mod slave_api;
mod support;
