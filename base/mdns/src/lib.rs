//! mDNS of a cell on one interface: announcements and goodbyes of OPC UA servers, and announcements
//! of bridges.
//!
//! Reading order: `url`, `range` and `interface` (addresses), `servers` and `goodbye`
//! (announcements of OPC UA servers, OPC 10000-12, Annex C), `bridges` (programs that carry a
//! space).

mod bridges;
mod goodbye;
mod interface;
mod range;
mod servers;
mod url;

pub use bridges::{
    Bridge, HeardBridge, Telling, TellingArguments, ToldBridge, heard_bridges, tell_bridge,
};
pub use goodbye::{goodbyes, listen};
pub use interface::{MdnsInterface, Subnets};
pub use range::{Range, RangeFault};
pub use servers::{
    Aside, Mdns, MdnsEvent, MdnsFault, OwnAnnouncement, SERVICE, heard, is_own, same_place,
};
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
