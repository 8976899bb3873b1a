//! Formats and parses NodeIds and ExpandedNodeIds as text (OPC 10000-6, 5.1.12 and 5.1.13):
//! `ns=2;s=Robot`, `nsu=urn:x;i=85`.

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD as BASE64;
use uadp::{ExpandedNodeId, Guid, NodeId, NodeIdValue};

/// A NodeId that owns its text.
#[derive(Debug, Default)]
pub struct OwnedNodeId {
    namespace: u16,
    identifier: OwnedIdentifier,
    namespace_uri: Option<String>,
    server_index: u32,
}

#[derive(Debug)]
enum OwnedIdentifier {
    Numeric(u32),
    String(Option<String>),
    Guid(Guid),
    Opaque(Option<Vec<u8>>),
}

impl Default for OwnedIdentifier {
    fn default() -> Self {
        Self::Numeric(0)
    }
}

impl OwnedIdentifier {
    fn parse(text: &str) -> Option<Self> {
        match text {
            NULL_STRING => return Some(Self::String(None)),
            NULL_OPAQUE => return Some(Self::Opaque(None)),
            _ => {}
        }
        let (kind, identifier) = text.split_once('=')?;
        Some(match kind {
            "i" => Self::Numeric(identifier.parse().ok()?),
            "s" => Self::String(Some(identifier.to_owned())),
            "g" => Self::Guid(parse_guid(identifier)?),
            "b" => Self::Opaque(Some(BASE64.decode(identifier).ok()?)),
            _ => return None,
        })
    }
}

impl OwnedNodeId {
    /// Parses a NodeId or ExpandedNodeId.
    /// Parses the text of a NodeId or ExpandedNodeId.
    #[must_use]
    pub fn parse(text: &str) -> Option<Self> {
        let mut node_id = Self::default();
        let mut rest = text;
        if let Some((server, behind)) = part(rest, "svr=") {
            node_id.server_index = server.parse().ok()?;
            rest = behind;
        }
        if let Some((uri, behind)) = part(rest, "nsu=") {
            node_id.namespace_uri = Some(unescape(uri)?);
            rest = behind;
        }
        if let Some((namespace, behind)) = part(rest, "ns=") {
            node_id.namespace = namespace.parse().ok()?;
            rest = behind;
        }
        node_id.identifier = OwnedIdentifier::parse(rest)?;
        Some(node_id)
    }

    /// Returns the NodeId; `None` with a URI or server index, which a NodeId does not have.
    /// Returns the NodeId, if its namespace is an index.
    #[must_use]
    pub fn node_id(&self) -> Option<NodeId<'_>> {
        let expanded = self.expanded();
        (expanded == expanded.node_id.into()).then_some(expanded.node_id)
    }

    /// Returns the ExpandedNodeId.
    #[must_use]
    pub fn expanded(&self) -> ExpandedNodeId<'_> {
        let identifier = match &self.identifier {
            OwnedIdentifier::Numeric(identifier) => NodeIdValue::Numeric(*identifier),
            OwnedIdentifier::String(identifier) => NodeIdValue::String(identifier.as_deref()),
            OwnedIdentifier::Guid(identifier) => NodeIdValue::Guid(*identifier),
            OwnedIdentifier::Opaque(identifier) => NodeIdValue::Opaque(identifier.as_deref()),
        };
        ExpandedNodeId {
            node_id: NodeId {
                namespace: self.namespace,
                identifier,
            },
            namespace_uri: self.namespace_uri.as_deref(),
            server_index: self.server_index,
        }
    }
}

/// Formats a NodeId. A null identifier, for which the standard has no text, is `s` or `b` alone.
#[must_use]
pub fn text(node_id: NodeId<'_>) -> String {
    let identifier = match node_id.identifier {
        NodeIdValue::Numeric(identifier) => format!("i={identifier}"),
        NodeIdValue::String(Some(identifier)) => format!("s={identifier}"),
        NodeIdValue::String(None) => NULL_STRING.to_owned(),
        NodeIdValue::Guid(identifier) => format!("g={}", identifier.to_string().to_lowercase()),
        NodeIdValue::Opaque(Some(identifier)) => format!("b={}", BASE64.encode(identifier)),
        NodeIdValue::Opaque(None) => NULL_OPAQUE.to_owned(),
    };
    match node_id.namespace {
        0 => identifier,
        namespace => format!("ns={namespace};{identifier}"),
    }
}

/// Formats an ExpandedNodeId. A namespace index besides a URI is kept.
#[must_use]
pub fn expanded_text(node_id: ExpandedNodeId<'_>) -> String {
    let server = match node_id.server_index {
        0 => String::new(),
        index => format!("svr={index};"),
    };
    let uri = node_id
        .namespace_uri
        .map(|uri| format!("nsu={};", uri.replace('%', "%25").replace(';', "%3B")));
    format!(
        "{server}{}{}",
        uri.unwrap_or_default(),
        text(node_id.node_id)
    )
}

/// Parses a Guid of the form `72962B91-FA75-4AE6-8D28-B404DC7DAF63`, in either case.
#[must_use]
pub fn parse_guid(text: &str) -> Option<Guid> {
    let mut parts = text.split('-');
    let mut next = |digits: usize| {
        let part = parts.next().filter(|part| part.len() == digits)?;
        let hex = part.bytes().all(|byte| byte.is_ascii_hexdigit());
        hex.then(|| u64::from_str_radix(part, 16).ok()).flatten()
    };
    let (data1, data2, data3) = (next(8)?, next(4)?, next(4)?);
    let data4 = next(4)? << 48 | next(12)?;
    parts.next().is_none().then_some(Guid::from_fields(
        u32::try_from(data1).ok()?,
        u16::try_from(data2).ok()?,
        u16::try_from(data3).ok()?,
        data4.to_be_bytes(),
    ))
}

/// Returns the text between a prefix and the next semicolon, and the text after the semicolon.
fn part<'a>(text: &'a str, prefix: &str) -> Option<(&'a str, &'a str)> {
    text.strip_prefix(prefix)?.split_once(';')
}

fn unescape(uri: &str) -> Option<String> {
    let mut parts = uri.split('%');
    let mut out = parts.next()?.to_owned();
    for part in parts {
        let (code, rest) = part.split_at_checked(2)?;
        out.push(char::from(u8::from_str_radix(code, 16).ok()?));
        out.push_str(rest);
    }
    Some(out)
}

const NULL_STRING: &str = "s";
const NULL_OPAQUE: &str = "b";

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_form_of_a_node_id_survives_its_text() {
        for form in [
            "i=85",
            "ns=2;i=1000",
            "ns=3;s=Robot.Axis1",
            "s=a;b=c",
            "s=",
            "ns=1;s",
            "b",
            "ns=5;b=YWJj",
            "g=72962b91-fa75-4ae6-8d28-b404dc7daf63",
        ] {
            let node_id = OwnedNodeId::parse(form).unwrap();
            assert_eq!(text(node_id.node_id().unwrap()), form);
        }
        for form in [
            "nsu=urn:example:ns;s=Robot.Axis1",
            "svr=3;nsu=urn:a%3Bb%25;ns=4;i=1",
            "svr=1;i=85",
        ] {
            let node_id = OwnedNodeId::parse(form).unwrap();
            assert_eq!(expanded_text(node_id.expanded()), form);
            assert_eq!(node_id.node_id(), None, "{form} is no plain NodeId");
        }
    }

    #[test]
    fn what_is_no_node_id_is_refused() {
        for form in [
            "",
            "i",
            "i=-1",
            "i=4294967296",
            "ns=65536;i=1",
            "ns=1",
            "x=1",
            "b=?",
            "g=1",
            "nsu=%;i=1",
        ] {
            assert!(OwnedNodeId::parse(form).is_none(), "{form}");
        }
    }
}
