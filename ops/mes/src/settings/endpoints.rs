//! Addresses of listeners.

use std::net::SocketAddr;

use skills::yaml::{DocumentNode, YamlFindingCode};

use super::{Reading, shortened};

impl Reading<'_, '_> {
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
