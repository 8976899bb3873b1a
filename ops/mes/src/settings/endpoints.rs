//! Endpoints of OPC UA, and addresses of listeners.

use std::net::SocketAddr;

use skills::ComponentSecurity;
use skills::yaml::{DocumentNode, YamlFindingCode};

use super::{Reading, shortened};

impl Reading<'_> {
    pub(super) fn endpoint(&mut self, node: &DocumentNode) -> Option<String> {
        let text = self.reader.text(node, "an endpoint")?;
        self.checked_endpoint(text, node)
    }

    pub(super) fn checked_endpoint(&mut self, text: &str, node: &DocumentNode) -> Option<String> {
        match text.parse::<plant_opcua::server::EndpointUrl>() {
            Ok(_) => Some(text.to_owned()),
            Err(error) => self.reader.refuse(
                node,
                YamlFindingCode::Endpoint,
                format!("`{}` is no endpoint: {error}", shortened(text)),
            ),
        }
    }

    pub(super) fn security(&mut self, node: &DocumentNode) -> Option<Vec<ComponentSecurity>> {
        let read = self.each(node, |reading, node| {
            match reading.reader.text(node, "None or Basic256Sha256")? {
                "None" => Some(ComponentSecurity::None),
                "Basic256Sha256" => Some(ComponentSecurity::Basic256Sha256),
                other => reading.reader.refuse(
                    node,
                    YamlFindingCode::WrongValue,
                    format!(
                        "expected None or Basic256Sha256, found `{}`",
                        shortened(other)
                    ),
                ),
            }
        });
        Some(read).filter(|read| !read.is_empty())
    }

    /// Reads the address of a listener. With `is_of_loopback`, other addresses are refused.
    pub(super) fn address(
        &mut self,
        node: &DocumentNode,
        is_of_loopback: bool,
    ) -> Option<SocketAddr> {
        let text = self.reader.text(node, "an address with a port")?;
        let address: Option<SocketAddr> = text.parse().ok();
        let address = address.filter(|address| !is_of_loopback || address.ip().is_loopback());
        address.or_else(|| {
            let wanted = match is_of_loopback {
                true => "of loopback, as 127.0.0.1:8087",
                false => "with a port, as 0.0.0.0:8443",
            };
            let why = format!("expected an address {wanted}, found `{}`", shortened(text));
            self.reader.refuse(node, YamlFindingCode::WrongValue, why)
        })
    }
}
