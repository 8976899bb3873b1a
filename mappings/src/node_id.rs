//! The text of a NodeId: `ns=2;i=10`, `ns=2;s=Line.Running`, `ns=2;g=...`, `ns=2;b=...` (OPC
//! 10000-6, 5.1.12).

use std::fmt;
use std::num::NonZeroU16;
use std::str::FromStr;

/// Text form of a NodeId.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub struct NodeIdText {
    /// Namespace index; 0 is the namespace of OPC UA.
    pub namespace: u16,
    /// The identifier in its type.
    pub identifier: Identifier,
}

impl NodeIdText {
    /// Returns the identifier if it can be a DataSetWriterId: numeric, 1..=65535, not of namespace
    /// 0. Any other node needs an alias.
    #[must_use]
    pub fn writer_id(&self) -> Option<NonZeroU16> {
        match self.identifier {
            Identifier::Numeric(number) if self.namespace != 0 => {
                NonZeroU16::new(u16::try_from(number).ok()?)
            }
            Identifier::Numeric(_)
            | Identifier::String(_)
            | Identifier::Guid(_)
            | Identifier::Opaque(_) => None,
        }
    }
}

/// The identifier of a NodeId.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub enum Identifier {
    /// `i=`
    Numeric(u32),
    /// `s=`, at most 4096 bytes and not empty.
    String(String),
    /// `g=`, 8-4-4-4-12 hexadecimal digits, kept in lower case.
    Guid(String),
    /// `b=`, base64 with its padding.
    Opaque(String),
}

impl fmt::Display for NodeIdText {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if self.namespace != 0 {
            write!(f, "ns={};", self.namespace)?;
        }
        match &self.identifier {
            Identifier::Numeric(number) => write!(f, "i={number}"),
            Identifier::String(text) => write!(f, "s={text}"),
            Identifier::Guid(text) => write!(f, "g={text}"),
            Identifier::Opaque(text) => write!(f, "b={text}"),
        }
    }
}

impl FromStr for NodeIdText {
    type Err = NodeIdError;

    fn from_str(text: &str) -> Result<Self, NodeIdError> {
        let (namespace, rest) = match text.strip_prefix("ns=") {
            None => (0, text),
            Some(rest) => {
                let (index, rest) = rest.split_once(';').ok_or(NodeIdError::Form)?;
                (number(index).ok_or(NodeIdError::Namespace)?, rest)
            }
        };
        let (kind, value) = rest.split_once('=').ok_or(NodeIdError::Form)?;
        let identifier = match kind {
            "i" => Identifier::Numeric(number(value).ok_or(NodeIdError::Numeric)?),
            "s" if value.is_empty() || value.len() > MAX_STRING => return Err(NodeIdError::Length),
            "s" => Identifier::String(value.to_owned()),
            "g" if is_guid(value) => Identifier::Guid(value.to_ascii_lowercase()),
            "g" => return Err(NodeIdError::Guid),
            "b" if is_base64(value) => Identifier::Opaque(value.to_owned()),
            "b" => return Err(NodeIdError::Opaque),
            _ => return Err(NodeIdError::Form),
        };
        Ok(Self {
            namespace,
            identifier,
        })
    }
}

/// NodeId of another server, with the URI of its namespace or the index there:
/// `nsu=urn:plc;s=Line` or `ns=3;i=7` (OPC 10000-6, 5.1.12).
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub struct ExpandedNodeIdText {
    /// The namespace.
    pub namespace: NamespaceText,
    /// Identifier in the namespace.
    pub identifier: Identifier,
}

/// Namespace of a node of another server.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub enum NamespaceText {
    /// By its index.
    Index(u16),
    /// By its URI.
    Uri(String),
}

impl fmt::Display for ExpandedNodeIdText {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let namespace = match &self.namespace {
            NamespaceText::Index(index) => *index,
            NamespaceText::Uri(uri) => {
                write!(f, "nsu={};", uri.replace('%', "%25").replace(';', "%3B"))?;
                0
            }
        };
        let identifier = self.identifier.clone();
        NodeIdText {
            namespace,
            identifier,
        }
        .fmt(f)
    }
}

impl FromStr for ExpandedNodeIdText {
    type Err = NodeIdError;

    fn from_str(text: &str) -> Result<Self, NodeIdError> {
        let Some(rest) = text.strip_prefix("nsu=") else {
            let node: NodeIdText = text.parse()?;
            return Ok(Self {
                namespace: NamespaceText::Index(node.namespace),
                identifier: node.identifier,
            });
        };
        let (uri, rest) = rest.split_once(';').ok_or(NodeIdError::Form)?;
        let uri = uri
            .replace("%3B", ";")
            .replace("%3b", ";")
            .replace("%25", "%");
        if uri.is_empty() || uri.len() > MAX_STRING || uri.contains(char::is_control) {
            return Err(NodeIdError::Uri);
        }
        if rest.starts_with("ns=") {
            return Err(NodeIdError::Form);
        }
        let node: NodeIdText = rest.parse()?;
        Ok(Self {
            namespace: NamespaceText::Uri(uri),
            identifier: node.identifier,
        })
    }
}

/// Error of a text that is not a NodeId.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum NodeIdError {
    /// Not `ns=<index>;<i|s|g|b>=<identifier>`.
    #[error(
        "a node id is `ns=<index>;i=<number>`, or `s=<text>`, `g=<guid>`, `b=<base64>` after the `;`"
    )]
    Form,
    /// The index after `ns=`.
    #[error("the namespace index after `ns=` is not a number 0..65535")]
    Namespace,
    /// The URI after `nsu=`.
    #[error("the namespace URI after `nsu=` is empty, longer than 4096 bytes or no text")]
    Uri,
    /// The identifier after `i=`.
    #[error("the identifier after `i=` is not a number 0..4294967295")]
    Numeric,
    /// The identifier after `s=`.
    #[error("the identifier after `s=` is empty or longer than 4096 bytes")]
    Length,
    /// The identifier after `g=`.
    #[error("the identifier after `g=` is not a GUID like 09087e75-8e5e-499b-954f-f2a9603db28a")]
    Guid,
    /// The identifier after `b=`.
    #[error("the identifier after `b=` is not base64")]
    Opaque,
}

/// Longest string identifier (OPC 10000-3, 8.2.4).
const MAX_STRING: usize = 4096;

fn number<N: FromStr>(text: &str) -> Option<N> {
    let canonical =
        text.bytes().all(|b| b.is_ascii_digit()) && (text == "0" || !text.starts_with('0'));
    canonical.then(|| text.parse().ok())?
}

fn is_guid(text: &str) -> bool {
    let groups: Vec<&str> = text.split('-').collect();
    groups.iter().map(|group| group.len()).eq([8, 4, 4, 4, 12])
        && groups
            .iter()
            .all(|group| group.bytes().all(|b| b.is_ascii_hexdigit()))
}

fn is_base64(text: &str) -> bool {
    let data = text.trim_end_matches('=');
    !data.is_empty()
        && text.len().is_multiple_of(4)
        && text.len() - data.len() <= 2
        && text.len() <= MAX_STRING
        && data
            .bytes()
            .all(|b| b.is_ascii_alphanumeric() || b == b'+' || b == b'/')
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn parse(text: &str) -> Result<NodeIdText, NodeIdError> {
        text.parse()
    }

    #[test]
    fn a_node_of_another_server_is_read_by_uri_or_index_and_prints_as_it_was_read() {
        for text in [
            "i=2253",
            "ns=3;i=7",
            "nsu=urn:plc;s=Line.Reset",
            "nsu=urn:a%3Bb%25;s=x;y",
            "nsu=http://opcfoundation.org/UA/;i=85",
        ] {
            let node: ExpandedNodeIdText = text.parse().unwrap();
            assert_eq!(node.to_string(), text);
        }
        let node: ExpandedNodeIdText = "nsu=urn:a%3Bb%25;i=1".parse().unwrap();
        assert_eq!(node.namespace, NamespaceText::Uri("urn:a;b%".to_owned()));
        for text in [
            "nsu=;i=1",
            "nsu=urn:plc",
            "nsu=urn:plc;ns=2;i=1",
            "nsu=urn:plc;i=x",
            "svr=1;i=1",
        ] {
            assert!(text.parse::<ExpandedNodeIdText>().is_err(), "{text}");
        }
    }

    #[test]
    fn each_kind_of_identifier_is_read_and_printed() {
        for text in [
            "ns=2;i=10",
            "i=2258",
            "ns=3;s=Line=1;Running",
            "ns=1;g=09087e75-8e5e-499b-954f-f2a9603db28a",
            "ns=1;b=M/RbKBsRVkePCePcx24oRA==",
        ] {
            assert_eq!(parse(text).unwrap().to_string(), text);
        }
        assert_eq!(parse("ns=0;i=85").unwrap(), parse("i=85").unwrap());
    }

    #[test]
    fn what_is_wrong_is_named() {
        assert_eq!(parse(""), Err(NodeIdError::Form));
        assert_eq!(parse("ns=2"), Err(NodeIdError::Form));
        assert_eq!(parse("ns=2;x=1"), Err(NodeIdError::Form));
        assert_eq!(parse("ns=70000;i=1"), Err(NodeIdError::Namespace));
        assert_eq!(parse("ns=+2;i=1"), Err(NodeIdError::Namespace));
        assert_eq!(parse("ns=2;i=4294967296"), Err(NodeIdError::Numeric));
        assert_eq!(parse("ns=2;i="), Err(NodeIdError::Numeric));
        assert_eq!(parse("ns=2;i=007"), Err(NodeIdError::Numeric));
        assert_eq!(parse("ns=2;s="), Err(NodeIdError::Length));
        assert_eq!(
            parse(&format!("s={}", "x".repeat(4097))),
            Err(NodeIdError::Length)
        );
        assert_eq!(
            parse("g=09087e75-8e5e-499b-954ff2a9603db28a"),
            Err(NodeIdError::Guid)
        );
        assert_eq!(parse("b=abc"), Err(NodeIdError::Opaque));
        assert_eq!(parse("b===="), Err(NodeIdError::Opaque));
    }

    #[test]
    fn only_a_small_number_outside_namespace_0_is_a_writer_id() {
        let id = |text| parse(text).unwrap().writer_id().map(NonZeroU16::get);
        assert_eq!(id("ns=2;i=1"), Some(1));
        assert_eq!(id("ns=2;i=65535"), Some(65535));
        for text in ["ns=2;i=0", "ns=2;i=65536", "i=10", "ns=2;s=10"] {
            assert_eq!(id(text), None, "{text}");
        }
    }

    proptest! {
        #[test]
        fn what_is_read_is_read_again_from_its_print(text in "(ns=[0-9]{1,6};)?[isgbx]=[0-9a-f=+/-]{0,40}|\\PC{0,30}") {
            if let Ok(node) = parse(&text) {
                prop_assert_eq!(parse(&node.to_string()), Ok(node));
            }
        }
    }
}
