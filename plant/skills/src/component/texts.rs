//! Reads names, URIs and endpoints in the YAML of a component.

use crate::parameters::shortened;
use crate::yaml::{DocumentNode, YamlFindingCode, YamlReader};

/// Reads the name of a component or skill.
pub fn read_name(node: &DocumentNode, reader: &mut YamlReader<'_>) -> Option<String> {
    let text = reader.text(node, "a name")?;
    let fits = !text.is_empty()
        && text.len() <= LONGEST_NAME
        && text
            .bytes()
            .all(|b| b.is_ascii_alphanumeric() || b == b'-' || b == b'_');
    if fits {
        return Some(text.to_owned());
    }
    let message = format!("`{}` is no name of a component or skill", shortened(text));
    let help = "letters, digits, - and _, at most 64 of them";
    reader
        .findings()
        .error_with(YamlFindingCode::Name, node.place, message, help);
    None
}

pub(super) fn read_uri(
    node: &DocumentNode,
    code: YamlFindingCode,
    reader: &mut YamlReader<'_>,
) -> Option<String> {
    let text = reader.text(node, "a URI")?;
    let scheme = text.split_once(':').is_some_and(|(scheme, rest)| {
        !rest.is_empty()
            && scheme.starts_with(|c: char| c.is_ascii_alphabetic())
            && scheme.bytes().all(is_of_scheme)
    });
    let clean = !text
        .chars()
        .any(|c| c.is_whitespace() || c.is_control() || "<>\"{}|\\^`".contains(c));
    if scheme && clean && text.len() <= LONGEST_URI {
        return Some(text.to_owned());
    }
    let message = format!("`{}` is no URI", shortened(text));
    let help = "for example urn:example:gripper";
    reader
        .findings()
        .error_with(code, node.place, message, help);
    None
}

fn is_of_scheme(b: u8) -> bool {
    b.is_ascii_alphanumeric() || matches!(b, b'+' | b'-' | b'.')
}

/// Reads the endpoint of a server of OPC UA.
pub fn read_endpoint(node: &DocumentNode, reader: &mut YamlReader<'_>) -> Option<String> {
    let text = reader.text(node, "an endpoint")?;
    checked_endpoint(text, node, reader)
}

/// Returns an endpoint of a server of OPC UA; `None` if it is invalid, with a finding at the node.
pub fn checked_endpoint(
    text: &str,
    node: &DocumentNode,
    reader: &mut YamlReader<'_>,
) -> Option<String> {
    match text.parse::<plant_opcua::server::EndpointUrl>() {
        Ok(_) => Some(text.to_owned()),
        Err(error) => {
            let message = format!("`{}` is no endpoint: {error}", shortened(text));
            let help = format!("for example {DEFAULT_ENDPOINT}, where 0 is any free port");
            reader
                .findings()
                .error_with(YamlFindingCode::Endpoint, node.place, message, help);
            None
        }
    }
}

/// The endpoint of a component without the key `endpoint`.
pub const DEFAULT_ENDPOINT: &str = "opc.tcp://127.0.0.1:0";
pub(super) const LONGEST_NAME: usize = 64;
const LONGEST_URI: usize = 256;
