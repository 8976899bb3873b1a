//! The facts about a cell and its host, as far as they can be read and measured.

use std::collections::{BTreeMap, BTreeSet};
use std::net::SocketAddr;
use std::path::Path;

use serde::Serialize;

use super::super::overview::{all_pages, applications};
use super::super::pages::StatusPage;
use super::host::{self, HostFacts};
use super::ros::{self, Ros1, Ros2};
use crate::arguments::Doctor;
use crate::live::{SenderTiming, TopicSeen, listened};
use crate::report::warn;

/// All facts. The findings are functions of them.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub(super) struct CellFacts {
    /// The version of this program.
    pub(super) version: String,
    /// Seconds since 1970.
    pub(super) now: u64,
    pub(super) host: HostFacts,
    pub(super) pages: Vec<StatusPage>,
    pub(super) group: GroupFacts,
    pub(super) ros1: Ros1,
    pub(super) ros2: Ros2,
}

/// The group, and its contents.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub(super) struct GroupFacts {
    pub(super) address: String,
    /// The interface that the user named.
    pub(super) interface: Option<String>,
    /// The reason why the group cannot be received.
    pub(super) fault: Option<String>,
    pub(super) seconds: f64,
    pub(super) applications: Vec<AnnouncedApplication>,
    pub(super) topics: Vec<TopicSeen>,
    /// The shortest delay from each sender.
    pub(super) senders: Vec<SenderTiming>,
    /// Messages that were discarded, by reason.
    pub(super) dropped: BTreeMap<String, u64>,
}

/// An announced application.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub(super) struct AnnouncedApplication {
    pub(super) space: u16,
    pub(super) from: String,
    pub(super) uri: String,
    pub(super) name: String,
}

impl GroupFacts {
    pub(super) fn socket(&self) -> Option<SocketAddr> {
        self.address.parse().ok()
    }
}

/// Reads and measures all facts.
pub(super) async fn gather(arguments: &Doctor) -> CellFacts {
    let root = Path::new("/");
    let mut host = host::read(root);
    let (pages, group, ros1) = tokio::join!(
        all_pages(&host.processes, &arguments.urls),
        group(arguments),
        ros::ros1(&host),
    );
    if let Some(address) = group.socket() {
        host.measure(address).await;
    }
    CellFacts {
        version: env!("CARGO_PKG_VERSION").to_owned(),
        now: host::unix_seconds(),
        ros2: ros::ros2(),
        host,
        pages,
        group,
        ros1,
    }
}

async fn group(arguments: &Doctor) -> GroupFacts {
    let seconds = arguments.seconds;
    let mut facts = GroupFacts {
        interface: arguments.group.interface.clone(),
        seconds,
        ..GroupFacts::default()
    };
    match listened(&arguments.group, seconds).await {
        Ok(heard) => {
            facts.address.clone_from(&heard.group);
            facts.applications = applications(heard.applications)
                .into_iter()
                .map(|(space, from, one)| AnnouncedApplication {
                    space,
                    from: from.to_string(),
                    uri: one.uri,
                    name: one.name,
                })
                .collect();
            facts.topics = heard.topics;
            facts.senders = heard.senders;
            facts.dropped = heard.dropped;
        }
        Err(failure) => {
            warn(&format!("the group is not heard: {failure}"));
            facts.address = address(arguments);
            facts.fault = Some(failure.to_string());
        }
    }
    facts
}

fn address(arguments: &Doctor) -> String {
    let group = &arguments.group;
    let url = group.address.as_deref();
    match url.map(mappings::PubSub::parse_address) {
        Some(Some(address)) => address.to_string(),
        None if group.broker.is_none() => mappings::PubSub::ADDRESS.to_string(),
        // Checks of a multicast group do not apply.
        Some(None) | None => "the broker".to_owned(),
    }
}

impl CellFacts {
    /// Returns the names of topics, by topic.
    pub(super) fn names(&self) -> BTreeMap<&str, &str> {
        let seen = self.group.topics.iter();
        let seen = seen.filter_map(|one| Some((one.topic.as_str(), one.name.as_deref()?)));
        let pages = self.pages.iter().flat_map(|page| &page.topics);
        let pages = pages.filter_map(|(topic, one)| Some((topic.as_str(), one.name.as_deref()?)));
        pages.chain(seen).collect()
    }

    /// Returns the programs that bridge ROS 1 or ROS 2, by process or page.
    pub(super) fn has_program(&self, name: &str) -> bool {
        let pages = self.pages.iter().map(|page| &page.program);
        let processes = self.host.processes.iter().map(|process| &process.program);
        pages.chain(processes).any(|program| program == name)
    }

    /// Returns the interfaces that can carry the group: all that are up, or the named interface.
    pub(super) fn interfaces(&self) -> impl Iterator<Item = &host::InterfaceFacts> {
        let named = self.group.interface.as_deref();
        self.host.interfaces.iter().filter(move |one| match named {
            Some(named) => one.name == named || one.address == named,
            None => one.up,
        })
    }

    /// Returns the senders of each space other than 0 that announce themselves as bridges.
    pub(super) fn bridges(&self) -> BTreeMap<u16, BTreeSet<&str>> {
        let mut bridges: BTreeMap<u16, BTreeSet<&str>> = BTreeMap::new();
        for one in self.group.applications.iter().filter(|one| one.space != 0) {
            bridges.entry(one.space).or_default().insert(&one.from);
        }
        bridges
    }
}
