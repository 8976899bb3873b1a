//! The page of the cell: programs, values, topics, skills, processes and alarms in a browser.
//!
//! A program gives a [`Page`] to its run loop as observer and as site. The page learns values and
//! calls from the run loop, and the state of programs from their `/status`. It is served beside
//! that status, without files: HTML, styles and scripts are part of the program.
//!
//! Reading order: `board` (the last value of each topic), `announced` (names and units),
//! `program` (rows of programs), `skill` (tiles of skills), `timeline` (events), `view` (what a
//! browser is sent), `stream` (server-sent events), `fetch` (the status of other programs), `hops`
//! (the delays of a topic), `page` (state and events), `session` (signed-in users), `encode`
//! (forms), `operations` (commands), `mes` and `table` (the knowledge of the plant), `proxy`,
//! `tls`, `responses` and `site` (requests).

mod announced;
mod board;
mod encode;
mod fetch;
mod hops;
mod mes;
mod operations;
mod page;
mod program;
mod proxy;
mod responses;
mod session;
mod site;
mod skill;
mod stream;
mod table;
mod timeline;
mod tls;
mod value;
mod view;

pub use fetch::{StatusUrl, StatusUrlError};
pub use mes::source_kind;
pub use operations::{
    ConditionAction, ConditionChange, ConditionState, MOST_CONDITIONS, OperationFault, Operations,
};
pub use page::{Page, Recorded};
pub use program::is_intended_drop;
pub use proxy::{ProxyUrl, ProxyUrlError};
pub use tls_server::CertificateFiles;
