//! Text in URIs: percent-encoding, and hosts with their ports.

use std::net::IpAddr;

/// Escapes a text for a part of a path, a value of a query or a part of an IRI: all bytes except
/// ASCII letters, digits, `-`, `.`, `_` and `~` become `%XX` (RFC 3986, 2.3).
#[must_use]
pub fn escaped(text: &str) -> String {
    let mut escaped = String::with_capacity(text.len());
    for byte in text.bytes() {
        match byte {
            b'A'..=b'Z' | b'a'..=b'z' | b'0'..=b'9' | b'-' | b'.' | b'_' | b'~' => {
                escaped.push(char::from(byte));
            }
            _ => escaped.push_str(&format!("%{byte:02X}")),
        }
    }
    escaped
}

/// Returns the text of a part of a query or form, in which `+` is a space. `None` if it is not
/// escaped as `%XX` of UTF-8.
#[must_use]
pub fn unescaped(text: &str) -> Option<String> {
    let mut bytes = Vec::with_capacity(text.len());
    let mut rest = text.bytes();
    while let Some(byte) = rest.next() {
        bytes.push(match byte {
            b'+' => b' ',
            b'%' => {
                let (high, low) = (digit(rest.next()?)?, digit(rest.next()?)?);
                high << 4 | low
            }
            byte => byte,
        });
    }
    String::from_utf8(bytes).ok()
}

fn digit(byte: u8) -> Option<u8> {
    let digit = char::from(byte).to_digit(16)?;
    u8::try_from(digit).ok()
}

/// Returns the name or address of a host with an optional port, without brackets.
#[must_use]
pub fn without_port(host: &str) -> &str {
    let name = match host.rsplit_once(':') {
        Some((name, port)) if port.bytes().all(|byte| byte.is_ascii_digit()) => name,
        Some(_) | None => host,
    };
    name.trim_start_matches('[').trim_end_matches(']')
}

/// Returns whether a host with an optional port is `localhost` or an address of loopback. Other
/// names can resolve to loopback too, such as names of a page that attacks a local server.
#[must_use]
pub fn is_loopback_host(host: &str) -> bool {
    let name = without_port(host);
    let address = name.parse::<IpAddr>();
    name == "localhost" || address.is_ok_and(|address| address.is_loopback())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_unreserved_characters_are_left_as_they_are() {
        assert_eq!(escaped("urn:a b&c=ü"), "urn%3Aa%20b%26c%3D%C3%BC");
        assert_eq!(escaped("Opc.Ua_Di-1~"), "Opc.Ua_Di-1~");
    }

    #[test]
    fn an_escaped_text_is_the_same_after_its_way_and_a_wrong_escape_is_refused() {
        for text in ["a b+c/ü%", "", "100 %"] {
            assert_eq!(unescaped(&escaped(text)).as_deref(), Some(text));
        }
        assert_eq!(unescaped("a+b").as_deref(), Some("a b"));
        for wrong in ["%", "%4", "%zz", "%ff"] {
            assert_eq!(unescaped(wrong), None, "{wrong}");
        }
    }

    #[test]
    fn only_names_of_loopback_are_loopback() {
        for host in [
            "localhost",
            "localhost:80",
            "127.0.0.1:9100",
            "[::1]:9100",
            "127.9.9.9",
        ] {
            assert!(is_loopback_host(host), "{host}");
        }
        for host in [
            "evil.example",
            "localhost.evil.example:80",
            "10.0.0.1",
            "",
            "0.0.0.0",
        ] {
            assert!(!is_loopback_host(host), "{host}");
        }
    }
}
