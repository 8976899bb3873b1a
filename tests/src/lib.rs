//! The base of the system tests: a separate network, third-party peers, and the programs under
//! test.
//!
//! A test starts with [`Cell::with`], which puts its thread into a new network namespace. All
//! processes that it starts from there live in that network only, so ports, multicast groups and
//! DDS domains of two tests never meet, and fixed port numbers are free.
//!
//! `cells/` has the mappings of the tests' cells.
//!
//! A test without its peer on this machine is skipped with the reason; with `CI=true` it
//! fails.

mod announcer;
mod arrows;
mod asker;
mod bare_node;
mod browser;
mod capture;
mod cell;
mod child;
mod clock;
mod codec_asker;
mod enclave;
mod executor;
mod group_numbers;
mod host;
mod judge;
mod mosquitto;
mod nats;
mod net;
mod numbered;
mod peers;
mod plant;
mod programs;
mod relay;
mod rtps;
mod shape;
mod stamp;
mod times;
mod ua_side;
mod usage;
mod wait;

pub use announcer::LeasedParticipant;
pub use arrows::{forbidden, tree};
pub use asker::{CallerKind, CallerScript, Counting};
pub use bare_node::{BareNode, BareSubscription, PATIENCE, string_frame};
pub use browser::{Browser, EventStream, WebAnswer};
pub use capture::{CaptureFile, Dissected, hex, is_true};
pub use cell::{Cell, CoveredPath, Distribution, Peer};
pub use child::{Child, StartedChild};
pub use clock::WallClock;
pub use codec_asker::{CallEnd, CodecAsker, send_from};
pub use enclave::{Governance, Keystore, Wiretap, has_security};
pub use executor::{Executes, Executor};
pub use group_numbers::GroupNumbers;
pub use host::{Cable, HERE, Host, THERE, WIRE, WireEffect};
pub use judge::Judge;
pub use mosquitto::{BROKER, Bridged};
pub use nats::NatsCluster;
pub use net::{
    GROUP, UadpSocket, all_overflowed, group_member, http_answer, http_get, metrics, overflowed,
    overflowed_outside_group, xml_rpc,
};
pub use numbered::{Numbered, numbered};
pub use peers::MASTER;
pub use plant::{PlantSite, Segment};
pub use programs::{
    METRICS_CELL, METRICS_ROS1, METRICS_ROS2, METRICS_SERVER, SERVER_ENDPOINT, drops,
    drops_by_reason, number, program,
};
pub use relay::{GroupRelay, OTHER_GROUP, Weather};
pub use rtps::{Mutator, announced, claims_too_much, queued};
pub use shape::ArrayShape;
pub use stamp::{TextStamp, now};
pub use times::{Times, micros, per_message, processor_time};
pub use ua_side::{TopicTriple, UaSide};
pub use usage::{SystemCalls, anonymous, cpu_share, peak, resident, threads, wake_ups};
pub use wait::{eventually, holds_for};
