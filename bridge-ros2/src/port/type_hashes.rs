//! Fetches type descriptions from the nodes that use the types: since ROS 2 Iron each node serves
//! them.

use std::time::Duration;

use messages::{DefinitionError, DescribedType, TypeHash, TypeName};
use ros2_node::graph::RemoteEndpoint;
use ros2_node::service::{ServiceClient, ServiceClientOptions};
use ros2_node::type_description;
use rustdds::GUID;
use tokio::time::Instant;
use tracing::{debug, info, warn};

use super::descriptions::WantedType;
use super::inquiry::{Inquiry, InquiryOutcome};
use super::side::Ros2Side;

impl Ros2Side {
    /// Returns the hash of the type definition that applies to a topic with these endpoints.
    ///
    /// In order of preference:
    /// 1. the current hash, if its definition is known and an endpoint announces it, or no endpoint
    ///    announces a hash
    /// 2. the first announced hash with a known definition
    /// 3. after the nodes of the endpoints were asked for the definitions: the current hash if it
    ///    is announced or no endpoint announces a hash, else the first announced hash
    ///
    /// Endpoints without a hash belong to releases that announce no hash. Returns `None` while a
    /// node is asked for the first time.
    pub(super) fn hash_that_counts(
        &mut self,
        name: &TypeName,
        endpoints: &[RemoteEndpoint],
        current: Option<TypeHash>,
        now: Instant,
    ) -> Option<Option<TypeHash>> {
        let dds_type = name.dds();
        let of_type = endpoints
            .iter()
            .filter(|endpoint| endpoint.type_name == dds_type);
        let mut announced: Vec<TypeHash> = Vec::new();
        for hash in of_type.filter_map(|endpoint| endpoint.type_hash) {
            if !announced.contains(&hash) {
                announced.push(hash);
            }
        }
        let there = current.filter(|hash| announced.is_empty() || announced.contains(hash));
        let candidates = there.into_iter().chain(announced.iter().copied());
        for hash in candidates {
            if self.definitions.of_hash(name, hash).is_some() {
                return Some(Some(hash));
            }
        }
        let mut settled = true;
        for hash in &announced {
            settled &= self.is_settled((name.clone(), *hash), endpoints, now);
        }
        settled.then(|| there.or_else(|| announced.first().copied()))
    }

    /// Returns whether the type of the hash is known or no node describes it; `false` while a node
    /// is asked for the first time.
    fn is_settled(
        &mut self,
        wanted: WantedType,
        endpoints: &[RemoteEndpoint],
        now: Instant,
    ) -> bool {
        let full = self.descriptions.asked.len() >= MOST_ASKED;
        let mut inquiry = match self.descriptions.asked.remove(&wanted) {
            Some(inquiry) => inquiry,
            None if full => return true,
            None => Inquiry::new(now),
        };
        let (name, hash) = &wanted;
        let dds_type = name.dds();
        let alike = |endpoint: &&RemoteEndpoint| {
            endpoint.type_hash.as_ref() == Some(hash) && endpoint.type_name == dds_type
        };
        let alike: Vec<GUID> = endpoints.iter().filter(alike).map(|it| it.guid).collect();
        let met = inquiry.meet(alike.iter().copied(), |guid| self.graph.holds(guid), now);
        self.tell_untold(
            &wanted,
            met,
            "the nodes that use it left before they described it",
        );
        self.ask(&wanted, &alike, &mut inquiry, now);
        let settled = !inquiry.is_waited_for();
        self.descriptions.asked.insert(wanted, inquiry);
        settled
    }

    /// Sends a request to a node of these endpoints, if it is due and a node offers the service.
    fn ask(&mut self, wanted: &WantedType, alike: &[GUID], inquiry: &mut Inquiry, now: Instant) {
        let Some(turn) = inquiry.due(now) else {
            return;
        };
        // Background inquiries leave room for inquiries that endpoints wait for.
        let most = match inquiry.is_waited_for() {
            true => MOST_CALLS,
            false => MOST_CALLS / 2,
        };
        if self.descriptions.calls.len() >= most {
            return;
        }
        let (name, hash) = wanted;
        let nodes: Vec<String> = alike
            .iter()
            .filter_map(|guid| self.domain.owner(*guid))
            .collect();
        let snapshot = self.descriptions.peers.look(now, FRESH);
        let services: Vec<_> = nodes
            .iter()
            .map(|node| type_description::service(node))
            .filter(|service| !snapshot.readers(&service.request_topic()).is_empty())
            .collect();
        let Some(service) = services.get(turn % services.len().max(1)) else {
            let outcome = inquiry.nobody(now);
            self.tell_untold(
                wanted,
                outcome,
                "no node that uses it offers get_type_description",
            );
            return;
        };
        let options = ServiceClientOptions {
            timeout: Some(ANSWERED_WITHIN),
            max_calls: 1,
        };
        let peers = self.descriptions.peers.clone();
        let opened = self.make(|domain| ServiceClient::open(domain, &peers, service, options));
        let Some(client) = opened else {
            return;
        };
        debug!(message_type = %name, service = service.name, "requesting the description of a type");
        let request = type_description::request(name, *hash);
        let asked = service.name.clone();
        let calls = &mut self.descriptions.calls;
        calls.begin(wanted.clone(), asked, async move {
            match client.call(request).await {
                Ok(answer) => Ok(type_description::read_answer(&answer)?),
                Err(error) => Err(error.into()),
            }
        });
        inquiry.asked();
    }

    /// Processes the responses that arrived after the last pass.
    pub(super) fn take_descriptions(&mut self, now: Instant) {
        while let Some((wanted, service, told)) = self.descriptions.calls.ended() {
            let Some(mut inquiry) = self.descriptions.asked.remove(&wanted) else {
                continue;
            };
            let (outcome, why) = match told {
                Ok(types) => match self.described(&wanted, &service, &types) {
                    Ok(()) => (inquiry.told(), String::new()),
                    // A second request to the same node would return the same description.
                    Err(why) => (inquiry.untold(now), why.to_string()),
                },
                Err(why) => (inquiry.failed(now), why.to_string()),
            };
            debug!(message_type = %wanted.0, service, ?outcome, why, "received the response to a type description request");
            self.tell_untold(&wanted, outcome, &format!("{service}: {why}"));
            self.descriptions.asked.insert(wanted, inquiry);
        }
    }

    /// Adds the types if they match the hash.
    fn described(
        &mut self,
        (name, hash): &WantedType,
        service: &str,
        types: &[DescribedType],
    ) -> Result<(), DefinitionError> {
        let from = format!("type description of {service}");
        self.definitions.add_described(name, types, *hash, &from)?;
        info!(message_type = %name, %hash, service, "received the description of the type from a node that uses it");
        Ok(())
    }

    fn tell_untold(&mut self, (name, hash): &WantedType, outcome: InquiryOutcome, why: &str) {
        if outcome != InquiryOutcome::Untold {
            return;
        }
        let ours = self.definitions.here(name).ok();
        let ours = ours.and_then(|here| Some((here.hash?, here.from)));
        if let Some((ours, from)) = ours {
            warn!(
                message_type = %name,
                definition = %from,
                "another node uses the type with the hash {hash}, this bridge with {ours}: messages may be misread or dropped; {why}"
            );
        } else {
            warn!(message_type = %name, %hash, "cannot get the type from the nodes that use it: {why}");
        }
    }
}

/// The timeout of a call.
const ANSWERED_WITHIN: Duration = Duration::from_secs(3);
/// Maximum number of concurrent calls; each has two endpoints.
const MOST_CALLS: usize = 4;
/// Maximum number of types requested in the lifetime of the process: any participant of the domain
/// can invent names.
const MOST_ASKED: usize = 1024;
/// The maximum age of a snapshot of the service peers.
const FRESH: Duration = Duration::from_millis(100);
