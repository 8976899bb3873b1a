//! Encodes values as text.

use std::fmt::Write as _;

use super::XmlRpcValue;

/// Appends a value in its tags.
pub(super) fn write_value(value: &XmlRpcValue, out: &mut String) {
    out.push_str("<value>");
    match value {
        XmlRpcValue::Int(number) => number_tag("i4", number, out),
        XmlRpcValue::Bool(flag) => number_tag("boolean", &u8::from(*flag), out),
        XmlRpcValue::Double(number) => number_tag("double", number, out),
        XmlRpcValue::String(text) => text_tag("string", text, out),
        XmlRpcValue::DateTime(text) => text_tag("dateTime.iso8601", text, out),
        XmlRpcValue::Binary(bytes) => text_tag("base64", &base64_encode(bytes), out),
        XmlRpcValue::Array(items) => {
            out.push_str("<array><data>");
            items.iter().for_each(|item| write_value(item, out));
            out.push_str("</data></array>");
        }
        XmlRpcValue::Struct(members) => {
            out.push_str("<struct>");
            for (name, member) in members {
                out.push_str("<member>");
                text_tag("name", name, out);
                write_value(member, out);
                out.push_str("</member>");
            }
            out.push_str("</struct>");
        }
        XmlRpcValue::Nil => out.push_str("<nil/>"),
    }
    out.push_str("</value>");
}

fn number_tag(tag: &str, number: &dyn std::fmt::Display, out: &mut String) {
    #[expect(
        clippy::let_underscore_must_use,
        reason = "writing to a String cannot fail"
    )]
    let _ = write!(out, "<{tag}>{number}</{tag}>");
}

fn text_tag(tag: &str, text: &str, out: &mut String) {
    out.push('<');
    out.push_str(tag);
    out.push('>');
    escape(text, out);
    out.push_str("</");
    out.push_str(tag);
    out.push('>');
}

/// Escapes text. XML cannot represent most control characters: they become U+FFFD.
pub(super) fn escape(text: &str, out: &mut String) {
    for c in text.chars() {
        match c {
            '<' => out.push_str("&lt;"),
            '>' => out.push_str("&gt;"),
            '&' => out.push_str("&amp;"),
            '\r' => out.push_str("&#13;"),
            '\t' | '\n' => out.push(c),
            '\u{0}'..='\u{1f}' | '\u{fffe}' | '\u{ffff}' => out.push('\u{fffd}'),
            _ => out.push(c),
        }
    }
}

fn base64_encode(bytes: &[u8]) -> String {
    let mut out = String::with_capacity(bytes.len().div_ceil(3) * 4);
    for chunk in bytes.chunks(3) {
        let word = chunk
            .iter()
            .fold(0u32, |word, byte| word << 8 | u32::from(*byte));
        let word = word << (8 * (3 - chunk.len()));
        for place in 0..4 {
            if place > chunk.len() {
                out.push('=');
            } else {
                let index = word >> (18 - 6 * place) & 0x3f;
                out.push(
                    usize::try_from(index)
                        .ok()
                        .and_then(|i| BASE64.get(i))
                        .map_or('=', |b| char::from(*b)),
                );
            }
        }
    }
    out
}

/// The digits of base64 (RFC 4648, 4).
pub(super) const BASE64: &[u8; 64] =
    b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
