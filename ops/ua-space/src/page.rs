//! `ua-space page`: the page of the cell without a server, read-only.

mod recording;

use std::ffi::OsString;
use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::{Arc, OnceLock};

use bridge_node::{
    Arguments, Context, Failure, LocalDelivery, Observer, Owned, Port, PortEvent, Program, Site,
    TopicMetaData, TypePaths,
};
use mappings::{Mapping, SpaceId, TopicId};
use supervisor::{Page, StatusUrl};
use uadp::BuiltinType;

/// The arguments of `ua-space page`.
#[derive(Debug, clap::Args)]
pub(crate) struct PageArguments {
    #[command(flatten)]
    arguments: Arguments,
    /// Show the program with this address of --metrics, as http://127.0.0.1:9101. May be repeated
    #[arg(long, value_name = "URL")]
    status: Vec<StatusUrl>,
    /// Show the values, events and calls of this recording (pcapng) instead of the group
    #[arg(long, value_name = "FILE", conflicts_with = "status")]
    recording: Option<PathBuf>,
}

/// The program that serves the page.
#[derive(Debug, clap::Parser)]
#[command(name = "ua-space page", version = build_info::version())]
struct Viewer {
    #[command(flatten)]
    arguments: PageArguments,
    /// Made when it is first wanted.
    #[arg(skip)]
    page: OnceLock<Arc<Page>>,
}

/// Runs the page until it is stopped. `given` is the command line of `ua-space`.
pub(crate) fn page(given: Vec<OsString>) -> ExitCode {
    let has_address = given.iter().any(|argument| {
        let text = argument.to_string_lossy();
        text == "--metrics" || text.starts_with("--metrics=")
    });
    // The first argument is the program, the second the verb.
    let mut arguments: Vec<OsString> = vec!["ua-space page".into()];
    arguments.extend(given.into_iter().skip(2));
    if !has_address && std::env::var_os("UA_METRICS").is_none() {
        arguments.push(format!("--metrics={ADDRESS}").into());
    }
    bridge_node::run::<Viewer>(arguments)
}

impl Viewer {
    fn page(&self) -> Arc<Page> {
        let made = || Page::new(Self::NAME, self.arguments.status.clone(), None);
        Arc::clone(self.page.get_or_init(made))
    }
}

impl Program for Viewer {
    type Port = NoSide;

    const NAME: &'static str = "ua-space page";
    const LOCAL: bridge_core::Local = bridge_core::Local::Fields;

    fn arguments(&self) -> &Arguments {
        &self.arguments.arguments
    }

    /// The page publishes in no namespace, so it shows the values of all programs of space 0.
    fn owned(_mapping: &Mapping) -> Owned {
        Owned::Only([].into())
    }

    fn observer(&self) -> Option<Arc<dyn Observer>> {
        Some(self.page())
    }

    fn site(&self) -> Result<Option<Arc<dyn Site>>, Failure> {
        Ok(Some(self.page()))
    }

    fn spaces(&self, _mapping: &Mapping) -> Result<Vec<SpaceId>, Failure> {
        Ok(vec![SpaceId::UA])
    }

    async fn start(&self, _context: Context) -> Result<NoSide, Failure> {
        if let Some(file) = &self.arguments.recording {
            recording::show(file, self.page())?;
        }
        Ok(NoSide)
    }
}

/// A local side without values of its own.
struct NoSide;

impl Port for NoSide {
    async fn recv(&mut self) -> PortEvent {
        std::future::pending().await
    }

    fn publish(&mut self, _sample: LocalDelivery) -> Result<(), &'static str> {
        // The observer of the run loop has taken the value.
        Ok(())
    }

    fn wanted(
        &mut self,
        _topic: TopicId,
        _shape: &[(BuiltinType, bool)],
        _described: Option<&TopicMetaData>,
    ) {
        // Values of every type are shown.
    }

    fn silent(&mut self, _topic: TopicId, _silent: bool) {
        // The observer of the run loop shows it.
    }

    fn reload(&mut self, _mapping: &Arc<Mapping>, _types: &Arc<TypePaths>) -> Vec<String> {
        Vec::new()
    }

    async fn shutdown(self) {
        // There is nothing to withdraw.
    }
}

/// The address of the page if none is given.
const ADDRESS: &str = "127.0.0.1:8090";
