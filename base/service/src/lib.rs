//! The needs of every program: exit codes, logging, status pages, signals, the watchdog of the
//! service manager, and restarts.
//!
//! A program of the plant that carries no space implements [`ServiceProgram`], and its `main` is
//! [`run_service`]. The programs of the space start with `bridge_node::run`, which uses the same
//! parts.

mod clock;
pub mod descriptors;
mod exit;
pub mod logging;
mod pages;
pub mod restart;
mod run;
pub mod service_manager;
pub mod signals;

pub use exit::{Failure, FailureKind};
pub use hyper::StatusCode;
pub use logging::{LogArguments, LogFormat};
pub use pages::{
    Ask, BoxFuture, LiveAnswer, LivePage, PageBody, PageState, Pages, Requests, RunLoops, Secure,
    Site, Statuses, Stream, Visit, full, loops, never, serve_pages, serve_secure,
};
pub use run::{ServiceProgram, parse, run_service};
