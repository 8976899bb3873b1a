//! Decoders of untrusted input, for the fuzzers of `fuzz/` only.

use std::net::{IpAddr, Ipv4Addr, SocketAddr};
use std::sync::Arc;
use std::time::Instant;

use mdns_sd::ServiceInfo;
use opcua::types::{ApplicationType, ByteString};
use registry::{AnnouncedServer, RegistrySettings, ServerRegistry};
use tokio::sync::mpsc;

use crate::connection::{RegistryRequest, ServerShared, serve};
use crate::services::{OwnDescription, RegistryAnswer, RegistryQuery};
use mdns::Url;

use crate::clock;
use mdns::Subnets;

/// Returns the response of a discovery server without registrations to a client that sends these
/// bytes, and the number of registrations afterwards. Requires a tokio runtime.
pub async fn answered(said: &[u8]) -> (Vec<u8>, usize) {
    let own = OwnDescription {
        application_uri: "urn:lds".to_owned(),
        name: "lds".to_owned(),
        url: "opc.tcp://127.0.0.1:4840".to_owned(),
        application_type: ApplicationType::DiscoveryServer,
        certificate: ByteString::null(),
    };
    let (ask, mut questions) = mpsc::channel::<RegistryRequest>(1);
    let answers = tokio::spawn(async move {
        let mut registry = ServerRegistry::new(RegistrySettings::default());
        let at = clock::now();
        while let Some((question, channel, reply)) = questions.recv().await {
            let answer = answer(&mut registry, question, &channel, at);
            drop(reply.send(answer));
            while registry.poll_event().is_some() {}
        }
        registry.find_servers(&[]).count()
    });
    let shared = Arc::new(ServerShared::new(own, None, ask));
    let mut heard = Vec::new();
    let peer = SocketAddr::new(IpAddr::V4(Ipv4Addr::LOCALHOST), 9);
    let client = (peer, shared.uses.begin());
    serve(tokio::io::join(said, &mut heard), client, &shared).await;
    drop(shared);
    (heard, answers.await.unwrap_or_default())
}

fn answer(
    registry: &mut ServerRegistry,
    question: RegistryQuery,
    channel: &registry::Channel,
    at: Instant,
) -> RegistryAnswer {
    match question {
        RegistryQuery::FindServers { uris } => {
            let uris: Vec<&str> = uris.iter().map(String::as_str).collect();
            let found = registry.find_servers(&uris);
            RegistryAnswer::Servers(found.map(|(asked, _)| asked.clone()).collect())
        }
        RegistryQuery::FindOnNetwork {
            from,
            most,
            capabilities,
        } => {
            let capabilities: Vec<&str> = capabilities.iter().map(String::as_str).collect();
            let records = registry.find_servers_on_network(from, most, &capabilities);
            RegistryAnswer::OnNetwork {
                records: records.into_iter().cloned().collect(),
                reset: clock::wall(),
            }
        }
        RegistryQuery::Register {
            asked,
            semaphore_is_there,
        } => match registry.register(*asked, channel, semaphore_is_there, at) {
            Ok(_) => RegistryAnswer::Registered,
            Err(fault) => RegistryAnswer::Refused(fault.status()),
        },
    }
}

/// Returns the instances that an mDNS packet withdraws.
#[must_use]
pub fn goodbyes(packet: &[u8]) -> Vec<String> {
    mdns::goodbyes(packet)
}

/// Decodes the announcement of a server from its instance name, its port, and the texts of its TXT
/// record.
#[must_use]
pub fn heard(
    instance: &str,
    port: u16,
    path: &[u8],
    capabilities: &[u8],
) -> Option<AnnouncedServer> {
    let texts = [("path", path), ("caps", capabilities)];
    let texts = texts.map(|(key, text)| (key, String::from_utf8_lossy(text).into_owned()));
    let address = IpAddr::V4(Ipv4Addr::new(10, 0, 0, 7));
    let info = ServiceInfo::new(
        mdns::SERVICE,
        instance,
        "h.local.",
        address,
        port,
        &texts[..],
    );
    let service = info.ok()?.as_resolved_service();
    let subnets = Subnets::of(Ipv4Addr::new(10, 0, 0, 1), Ipv4Addr::new(255, 0, 0, 0));
    mdns::heard(&service, &subnets).map(|(announcement, _)| announcement)
}

/// Parses and formats an OPC UA URL over TCP; `None` for any other text.
#[must_use]
pub fn url(text: &str) -> Option<String> {
    Url::parse(text).map(|url| url.to_string())
}
