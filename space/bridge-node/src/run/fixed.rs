//! Settings that are fixed at the start of a program.

use std::sync::Arc;

use mappings::{Mapping, PubSub};

/// Settings of the mapping that are fixed at the start of the program.
#[derive(Debug)]
pub(crate) struct Fixed {
    pub(crate) started: Arc<Mapping>,
    /// The mapping that was adopted last.
    pub(crate) taken: Arc<Mapping>,
    /// Whether the mapping sets the address; else the command line does.
    pub(crate) address: bool,
    /// Whether the mapping sets the interface; else the command line does.
    pub(crate) interface: bool,
}

impl Fixed {
    /// Returns the keys of `mapping` that differ from the running settings.
    pub(super) fn differing(&self, mapping: &Mapping) -> Vec<String> {
        let (was, is) = (self.started.pubsub(), mapping.pubsub());
        let media = |of: &PubSub| -> Vec<_> {
            let carriers = of.carriers.iter();
            carriers.map(|carrier| carrier.medium.clone()).collect()
        };
        let listed = (media(was), media(is));
        let is_listed = !(listed.0.is_empty() && listed.1.is_empty());
        if is_listed && self.address {
            let differs = listed.0 != listed.1;
            return differs.then(|| "pubsub".to_owned()).into_iter().collect();
        }
        let keys = [
            ("pubsub.address", self.address && was.address != is.address),
            (
                "pubsub.interface",
                self.interface && was.interface != is.interface,
            ),
            ("pubsub.ttl", was.ttl != is.ttl),
            ("pubsub.mqtt", was.broker != is.broker),
        ];
        let differing = keys.into_iter().filter(|(_, differs)| *differs);
        differing.map(|(key, _)| key.to_owned()).collect()
    }
}
