//! mDNS of a cell on one interface: announcements and goodbyes of OPC UA servers, and announcements
//! of bridges.
//!
//! Reading order: `url`, `range` and `interface` (addresses), `packet` and `group` (packets of the
//! mDNS group), `announcement` (announcements of OPC UA servers, OPC 10000-12, Annex C), `own`,
//! `announcer` and `nearby` (a program that announces its server), `servers` (a program that also
//! discovers others), `bridges` (programs that carry a space).

mod announcement;
mod announcer;
mod bridges;
mod group;
mod interface;
mod nearby;
mod own;
mod packet;
mod range;
mod servers;
mod url;

pub use announcement::{
    Aside, MdnsEvent, MdnsFault, OwnAnnouncement, SERVICE, heard, is_own, same_place,
};
pub use announcer::MdnsAnnouncer;
pub use bridges::{
    Bridge, HeardBridge, Telling, TellingArguments, ToldBridge, heard_bridges, tell_bridge,
};
pub use group::goodbyes;
pub use interface::{MdnsInterface, Subnets};
pub use range::{Range, RangeFault};
pub use servers::Mdns;
pub use url::Url;

/// Returns the name of this host, without a domain.
#[must_use]
pub fn host_name() -> String {
    let name = std::fs::read_to_string("/proc/sys/kernel/hostname").unwrap_or_default();
    let name = name.trim();
    match name.split('.').next() {
        Some(first) if !first.is_empty() => first.to_owned(),
        _ => "localhost".to_owned(),
    }
}
