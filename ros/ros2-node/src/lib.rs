//! A ROS 2 node on tokio.
//!
//! A [`Domain`](domain::Domain) joins a DDS domain as a ROS node, with readers and writers of
//! topics, servers and clients of services and actions, parameters, and the graph of the other
//! nodes. Messages of any type are passed as bytes: CDR with its encapsulation header. A program
//! needs no generated code, and the crate `messages` decodes them by definitions at run time.
//!
//! - RustDDS provides discovery, reliability and fragmentation. Nodes with Fast DDS and Cyclone DDS
//!   are peers in the tests.
//! - Every queue is bounded and counts the samples that it drops. A writer never waits
//!   ([`Outlet`](outlet::Outlet)), and an [`Inbox`](inbox::Inbox) receives from many readers.
//! - The feature `patched-dds` needs RustDDS with the patches of this repository. It repairs large
//!   samples, announces type hashes, and runs the traffic as a task of the runtime.
//! - The feature `security` adds DDS Security with the enclaves of SROS2, and OpenSSL.
//!
//! Guide to the code: [`domain`] has the participant, [`node`] announces it, and [`graph`] has the
//! endpoints of others. [`raw`] passes samples as bytes; [`qos`] and [`compatibility`] have the
//! policies. [`service`], [`action`], [`parameters`] and [`type_description`] are built on topics
//! alone. [`limits`] names the RustDDS of the build.

pub mod action;
mod cdr;
pub mod clock;
pub mod compatibility;
pub mod discovery_info;
pub mod domain;
#[cfg(feature = "patched-dds")]
mod driver;
pub mod graph;
pub mod inbox;
pub mod limits;
pub mod node;
pub mod outlet;
pub mod parameters;
pub mod qos;
pub mod raw;
pub mod rosout;
pub mod security;
pub mod service;
pub mod type_description;
