//! A server without services other than discovery: [`be_there`].

use std::sync::Arc;

use opcua::types::{ApplicationType, ByteString};
use tokio::net::TcpListener;
use tokio::sync::mpsc;

use crate::connection::{RegistryRequest, ServerShared};
use crate::description::ServerDescription;
use crate::endpoint;
use crate::services::{OwnDescription, RegistryAnswer, RegistryQuery};

/// Answers FindServers and GetEndpoints on a listener, over unsecured channels. Sessions and all
/// other services are not supported. Ends when the future is dropped.
pub async fn be_there(listener: TcpListener, server: &ServerDescription) {
    let own = OwnDescription {
        application_uri: server.application_uri.clone(),
        name: server.name.clone(),
        url: server.url.clone(),
        application_type: ApplicationType::Server,
        certificate: ByteString::null(),
    };
    let (ask, mut questions) = mpsc::channel::<RegistryRequest>(16);
    let answers = async {
        while let Some((question, _, reply)) = questions.recv().await {
            let answer = match question {
                // The response adds the server itself.
                RegistryQuery::FindServers { .. } => RegistryAnswer::Servers(Vec::new()),
                RegistryQuery::FindOnNetwork { .. } | RegistryQuery::Register { .. } => {
                    RegistryAnswer::Refused(UNSUPPORTED)
                }
            };
            // The client may have disconnected.
            drop(reply.send(answer));
        }
    };
    let shared = Arc::new(ServerShared::new(own, None, ask));
    tokio::join!(endpoint::accept(listener, shared), answers);
}

/// BadServiceUnsupported.
const UNSUPPORTED: u32 = 0x800B_0000;
