//! XML-RPC as ROS 1 speaks it: calls, responses and faults as text.
//!
//! The reader takes what the specification allows and what ROS peers add (`<value>` without a type, `<nil/>`,
//! `<i8>`), and refuses the rest with the place it stopped at. It does not read DTDs, so there are no entities to
//! expand, and it bounds nesting; the size of a document is the caller's to bound.

use std::borrow::Cow;
use std::fmt::Write as _;

use thiserror::Error;

/// One XML-RPC value.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum Value {
    /// `<i4>` and `<int>`; also `<i8>` where the number fits.
    Int(i32),
    /// `<boolean>`, `0` or `1` on the wire.
    Bool(bool),
    /// `<double>`.
    Double(f64),
    /// `<string>`, or text directly in `<value>`.
    String(String),
    /// `<dateTime.iso8601>`, unparsed.
    DateTime(String),
    /// `<base64>`, decoded.
    Binary(Vec<u8>),
    /// `<array>`.
    Array(Vec<Self>),
    /// `<struct>`, members in the order of the document.
    Struct(Vec<(String, Self)>),
    /// `<nil/>`.
    Nil,
}

impl Value {
    /// The text of a string value.
    pub(crate) fn as_str(&self) -> Option<&str> {
        if let Self::String(text) = self {
            Some(text)
        } else {
            None
        }
    }

    /// The number of an integer value; a boolean counts as 0 or 1, as some peers write status codes so.
    pub(crate) fn as_int(&self) -> Option<i32> {
        match self {
            Self::Int(number) => Some(*number),
            Self::Bool(flag) => Some(i32::from(*flag)),
            Self::Double(_)
            | Self::String(_)
            | Self::DateTime(_)
            | Self::Binary(_)
            | Self::Array(_)
            | Self::Struct(_)
            | Self::Nil => None,
        }
    }

    /// The elements of an array value.
    pub(crate) fn as_array(&self) -> Option<&[Self]> {
        if let Self::Array(items) = self {
            Some(items)
        } else {
            None
        }
    }
}

impl From<&str> for Value {
    fn from(text: &str) -> Self {
        Self::String(text.to_owned())
    }
}

impl From<String> for Value {
    fn from(text: String) -> Self {
        Self::String(text)
    }
}

impl From<i32> for Value {
    fn from(number: i32) -> Self {
        Self::Int(number)
    }
}

impl From<Vec<Self>> for Value {
    fn from(items: Vec<Self>) -> Self {
        Self::Array(items)
    }
}

/// A method call.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Call {
    /// Name of the method.
    pub(crate) method: String,
    /// Its arguments, in order.
    pub(crate) params: Vec<Value>,
}

impl Call {
    /// Reads a `<methodCall>` document.
    pub(crate) fn parse(document: &[u8]) -> Result<Self, XmlError> {
        let mut reader = Reader::new(document)?;
        reader.open("methodCall")?;
        reader.open("methodName")?;
        let method = reader.text()?.trim().to_owned();
        reader.close("methodName")?;
        let params = reader.params()?;
        reader.close("methodCall")?;
        reader.end()?;
        Ok(Self { method, params })
    }

    /// The call as a document.
    pub(crate) fn encode(&self) -> String {
        let mut out = String::from("<?xml version=\"1.0\"?>\n<methodCall><methodName>");
        escape(&self.method, &mut out);
        out.push_str("</methodName><params>");
        for param in &self.params {
            out.push_str("<param>");
            write_value(param, &mut out);
            out.push_str("</param>");
        }
        out.push_str("</params></methodCall>\n");
        out
    }
}

/// A `<fault>` response.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
#[error("fault {code}: {message}")]
pub struct Fault {
    /// `faultCode`.
    pub code: i32,
    /// `faultString`.
    pub message: String,
}

/// What a method call came to.
pub(crate) type Response = Result<Value, Fault>;

/// Reads a `<methodResponse>` document.
pub(crate) fn parse_response(document: &[u8]) -> Result<Response, XmlError> {
    let mut reader = Reader::new(document)?;
    reader.open("methodResponse")?;
    let response = if reader.at_open("fault")? {
        reader.open("fault")?;
        let value = reader.value(0)?;
        reader.close("fault")?;
        Err(fault_of(&value))
    } else {
        let mut params = reader.params()?;
        if params.len() != 1 {
            return Err(XmlError::Content {
                expected: "one result",
                at: reader.position(),
            });
        }
        Ok(params.pop().unwrap_or(Value::Nil))
    };
    reader.close("methodResponse")?;
    reader.end()?;
    Ok(response)
}

/// A response as a document.
pub(crate) fn encode_response(response: &Response) -> String {
    let mut out = String::from("<?xml version=\"1.0\"?>\n<methodResponse>");
    match response {
        Ok(value) => {
            out.push_str("<params><param>");
            write_value(value, &mut out);
            out.push_str("</param></params>");
        }
        Err(fault) => {
            out.push_str("<fault>");
            let members = vec![
                ("faultCode".to_owned(), Value::Int(fault.code)),
                (
                    "faultString".to_owned(),
                    Value::String(fault.message.clone()),
                ),
            ];
            write_value(&Value::Struct(members), &mut out);
            out.push_str("</fault>");
        }
    }
    out.push_str("</methodResponse>\n");
    out
}

/// Why a document was refused. Positions are byte offsets.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
#[non_exhaustive]
pub enum XmlError {
    /// Not UTF-8, which is the only encoding ROS peers use.
    #[error("the document is not UTF-8")]
    NotUtf8,
    /// A tag other than those allowed here, or none.
    #[error("expected {expected} at byte {at}")]
    Tag {
        /// What would have been right.
        expected: &'static str,
        /// Where.
        at: usize,
    },
    /// The text inside a tag does not read as its type.
    #[error("expected {expected} before byte {at}")]
    Content {
        /// What would have been right.
        expected: &'static str,
        /// Where the text ends.
        at: usize,
    },
    /// The document ends inside an element.
    #[error("the document ends inside {0}")]
    Truncated(&'static str),
    /// Arrays and structs nested deeper than ROS uses.
    #[error("values are nested more than {MAX_DEPTH} deep")]
    TooDeep,
}

fn fault_of(value: &Value) -> Fault {
    let mut fault = Fault {
        code: 0,
        message: String::new(),
    };
    if let Value::Struct(members) = value {
        for (name, member) in members {
            match name.as_str() {
                "faultCode" => fault.code = member.as_int().unwrap_or(0),
                "faultString" => member.as_str().unwrap_or("").clone_into(&mut fault.message),
                _ => {}
            }
        }
    }
    fault
}

struct Reader<'a> {
    document: &'a str,
    rest: &'a str,
}

#[derive(Clone, Copy, PartialEq, Eq)]
enum Kind {
    Open,
    Close,
    Empty,
}

#[derive(Clone, Copy)]
struct Tag<'a> {
    name: &'a str,
    kind: Kind,
}

impl<'a> Reader<'a> {
    fn new(document: &'a [u8]) -> Result<Self, XmlError> {
        let document = std::str::from_utf8(document).map_err(|_| XmlError::NotUtf8)?;
        let rest = document.strip_prefix('\u{feff}').unwrap_or(document);
        Ok(Self { document, rest })
    }

    fn position(&self) -> usize {
        self.document.len() - self.rest.len()
    }

    /// Skips white space, comments and processing instructions.
    fn skip(&mut self) -> Result<(), XmlError> {
        loop {
            self.rest = self.rest.trim_start();
            let (end, what) = if self.rest.starts_with("<!--") {
                ("-->", "a comment")
            } else if self.rest.starts_with("<?") {
                ("?>", "a processing instruction")
            } else {
                return Ok(());
            };
            let Some((_, rest)) = self.rest.split_once(end) else {
                return Err(XmlError::Truncated(what));
            };
            self.rest = rest;
        }
    }

    /// The next tag, which stays unread, and the text after it.
    fn peek(&mut self) -> Result<(Tag<'a>, &'a str), XmlError> {
        self.skip()?;
        let at = self.position();
        let Some(rest) = self.rest.strip_prefix('<') else {
            return Err(XmlError::Tag {
                expected: "a tag",
                at,
            });
        };
        let Some((inside, rest)) = rest.split_once('>') else {
            return Err(XmlError::Truncated("a tag"));
        };
        let (inside, kind) = if let Some(inside) = inside.strip_prefix('/') {
            (inside, Kind::Close)
        } else if let Some(inside) = inside.strip_suffix('/') {
            (inside, Kind::Empty)
        } else {
            (inside, Kind::Open)
        };
        let name = inside.trim_end();
        if name.is_empty()
            || !name
                .bytes()
                .all(|b| b.is_ascii_alphanumeric() || b == b'.' || b == b':')
        {
            return Err(XmlError::Tag {
                expected: "a tag of XML-RPC",
                at,
            });
        }
        Ok((Tag { name, kind }, rest))
    }

    fn at_open(&mut self, name: &str) -> Result<bool, XmlError> {
        let (tag, _) = self.peek()?;
        Ok(tag.name == name && tag.kind != Kind::Close)
    }

    fn open(&mut self, name: &'static str) -> Result<(), XmlError> {
        self.take(name, Kind::Open)
    }

    fn close(&mut self, name: &'static str) -> Result<(), XmlError> {
        self.take(name, Kind::Close)
    }

    fn take(&mut self, name: &'static str, kind: Kind) -> Result<(), XmlError> {
        let (tag, rest) = self.peek()?;
        if tag.name != name || tag.kind != kind {
            return Err(XmlError::Tag {
                expected: name,
                at: self.position(),
            });
        }
        self.rest = rest;
        Ok(())
    }

    fn end(&mut self) -> Result<(), XmlError> {
        self.skip()?;
        if self.rest.is_empty() {
            Ok(())
        } else {
            Err(XmlError::Tag {
                expected: "the end of the document",
                at: self.position(),
            })
        }
    }

    /// `<params>`, which a peer may leave out or leave empty.
    fn params(&mut self) -> Result<Vec<Value>, XmlError> {
        let mut params = Vec::new();
        let (tag, rest) = self.peek()?;
        if tag.name != "params" || tag.kind == Kind::Close {
            return Ok(params);
        }
        self.rest = rest;
        if tag.kind == Kind::Empty {
            return Ok(params);
        }
        while self.at_open("param")? {
            self.open("param")?;
            params.push(self.value(0)?);
            self.close("param")?;
        }
        self.close("params")?;
        Ok(params)
    }

    fn value(&mut self, depth: usize) -> Result<Value, XmlError> {
        if depth > MAX_DEPTH {
            return Err(XmlError::TooDeep);
        }
        let (tag, rest) = self.peek()?;
        if tag.name != "value" || tag.kind == Kind::Close {
            return Err(XmlError::Tag {
                expected: "value",
                at: self.position(),
            });
        }
        self.rest = rest;
        if tag.kind == Kind::Empty {
            return Ok(Value::String(String::new()));
        }
        let before = self.rest;
        let untyped = match self.peek() {
            Ok((tag, _)) => tag.kind == Kind::Close,
            Err(XmlError::Tag { .. }) => true,
            Err(other) => return Err(other),
        };
        let value = if untyped {
            // White space belongs to the text here.
            self.rest = before;
            Value::String(self.text()?.into_owned())
        } else {
            self.typed(depth)?
        };
        self.close("value")?;
        Ok(value)
    }

    fn typed(&mut self, depth: usize) -> Result<Value, XmlError> {
        let (tag, rest) = self.peek()?;
        let at = self.position();
        self.rest = rest;
        if tag.kind == Kind::Empty {
            return match tag.name {
                "nil" | "ex:nil" => Ok(Value::Nil),
                "string" => Ok(Value::String(String::new())),
                "base64" => Ok(Value::Binary(Vec::new())),
                "struct" => Ok(Value::Struct(Vec::new())),
                _ => Err(XmlError::Tag {
                    expected: "a type of XML-RPC",
                    at,
                }),
            };
        }
        let value = match tag.name {
            "array" => self.array(depth)?,
            "struct" => self.members(depth)?,
            "nil" | "ex:nil" => Value::Nil,
            "i4" | "int" | "i8" | "ex:i8" | "boolean" | "double" | "string" | "base64"
            | "dateTime.iso8601" => self.scalar(tag.name)?,
            _ => {
                return Err(XmlError::Tag {
                    expected: "a type of XML-RPC",
                    at,
                });
            }
        };
        let (closing, rest) = self.peek()?;
        if closing.name != tag.name || closing.kind != Kind::Close {
            return Err(XmlError::Tag {
                expected: "the closing tag",
                at: self.position(),
            });
        }
        self.rest = rest;
        Ok(value)
    }

    fn scalar(&mut self, name: &str) -> Result<Value, XmlError> {
        let text = self.text()?;
        let trimmed = text.trim();
        let wrong = |expected| XmlError::Content {
            expected,
            at: self.position(),
        };
        Ok(match name {
            "i4" | "int" | "i8" | "ex:i8" => {
                Value::Int(trimmed.parse().map_err(|_| wrong("a 32 bit integer"))?)
            }
            "boolean" => match trimmed {
                "0" => Value::Bool(false),
                "1" => Value::Bool(true),
                _ => return Err(wrong("0 or 1")),
            },
            "double" => Value::Double(trimmed.parse().map_err(|_| wrong("a number"))?),
            "base64" => Value::Binary(base64_decode(&text).ok_or_else(|| wrong("base64"))?),
            "string" => Value::String(text.into_owned()),
            _ => Value::DateTime(trimmed.to_owned()),
        })
    }

    fn array(&mut self, depth: usize) -> Result<Value, XmlError> {
        let mut items = Vec::new();
        let (tag, rest) = self.peek()?;
        if tag.name != "data" || tag.kind == Kind::Close {
            return Err(XmlError::Tag {
                expected: "data",
                at: self.position(),
            });
        }
        self.rest = rest;
        if tag.kind == Kind::Open {
            while self.at_open("value")? {
                items.push(self.value(depth + 1)?);
            }
            self.close("data")?;
        }
        Ok(Value::Array(items))
    }

    fn members(&mut self, depth: usize) -> Result<Value, XmlError> {
        let mut members = Vec::new();
        while self.at_open("member")? {
            self.open("member")?;
            self.open("name")?;
            let name = self.text()?.into_owned();
            self.close("name")?;
            members.push((name, self.value(depth + 1)?));
            self.close("member")?;
        }
        Ok(Value::Struct(members))
    }

    /// Text up to the next tag, with references and CDATA resolved.
    fn text(&mut self) -> Result<Cow<'a, str>, XmlError> {
        let mut text = Cow::Borrowed("");
        loop {
            let Some(end) = self.rest.find(['<', '&']) else {
                return Err(XmlError::Truncated("a text"));
            };
            let (plain, rest) = self.rest.split_at(end);
            text += plain;
            self.rest = rest;
            if let Some(rest) = rest.strip_prefix('&') {
                text.to_mut().push(self.reference(rest)?);
            } else if let Some(rest) = rest.strip_prefix("<![CDATA[") {
                let (data, rest) = rest.split_once("]]>").ok_or(XmlError::Truncated("CDATA"))?;
                text += data;
                self.rest = rest;
            } else if rest.starts_with("<!--") {
                let (_, rest) = rest
                    .split_once("-->")
                    .ok_or(XmlError::Truncated("a comment"))?;
                self.rest = rest;
            } else {
                return Ok(text);
            }
        }
    }

    fn reference(&mut self, rest: &'a str) -> Result<char, XmlError> {
        let unknown = XmlError::Content {
            expected: "a known reference",
            at: self.position(),
        };
        // The longest is `&#x10FFFF;`; looking further would make hostile text quadratic.
        let Some(end) = rest.bytes().take(12).position(|b| b == b';') else {
            return Err(unknown);
        };
        let (Some(name), Some(after)) = (rest.get(..end), rest.get(end + 1..)) else {
            return Err(unknown);
        };
        let resolved = match name {
            "lt" => Some('<'),
            "gt" => Some('>'),
            "amp" => Some('&'),
            "quot" => Some('"'),
            "apos" => Some('\''),
            _ => name
                .strip_prefix('#')
                .and_then(|number| match number.strip_prefix(['x', 'X']) {
                    Some(hex) => u32::from_str_radix(hex, 16).ok(),
                    None => number.parse().ok(),
                })
                .and_then(char::from_u32),
        };
        self.rest = after;
        resolved.ok_or(unknown)
    }
}

fn write_value(value: &Value, out: &mut String) {
    out.push_str("<value>");
    match value {
        Value::Int(number) => number_tag("i4", number, out),
        Value::Bool(flag) => number_tag("boolean", &u8::from(*flag), out),
        Value::Double(number) => number_tag("double", number, out),
        Value::String(text) => text_tag("string", text, out),
        Value::DateTime(text) => text_tag("dateTime.iso8601", text, out),
        Value::Binary(bytes) => text_tag("base64", &base64_encode(bytes), out),
        Value::Array(items) => {
            out.push_str("<array><data>");
            items.iter().for_each(|item| write_value(item, out));
            out.push_str("</data></array>");
        }
        Value::Struct(members) => {
            out.push_str("<struct>");
            for (name, member) in members {
                out.push_str("<member>");
                text_tag("name", name, out);
                write_value(member, out);
                out.push_str("</member>");
            }
            out.push_str("</struct>");
        }
        Value::Nil => out.push_str("<nil/>"),
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

/// XML has no way to write most control characters: they become U+FFFD.
fn escape(text: &str, out: &mut String) {
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

/// White space is skipped (peers break lines); padding must be right where it is given and end the text.
fn base64_decode(text: &str) -> Option<Vec<u8>> {
    let mut out = Vec::with_capacity(text.len() / 4 * 3);
    let (mut word, mut bits, mut padding) = (0u32, 0u32, 0u32);
    for byte in text.bytes().filter(|b| !b.is_ascii_whitespace()) {
        if byte == b'=' {
            padding += 1;
            continue;
        }
        if padding > 0 {
            return None;
        }
        let digit = BASE64.iter().position(|b| *b == byte)?;
        word = word << 6 | u32::try_from(digit).ok()?;
        bits += 6;
        if bits >= 8 {
            bits -= 8;
            out.push(u8::try_from(word >> bits & 0xff).ok()?);
            word &= (1 << bits) - 1;
        }
    }
    (bits < 6 && word == 0 && padding <= 2).then_some(out)
}

const MAX_DEPTH: usize = 32;
const BASE64: &[u8; 64] = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn value_of(inner: &str) -> Result<Value, XmlError> {
        let document = format!(
            "<?xml version='1.0'?><methodResponse><params><param>{inner}</param></params></methodResponse>"
        );
        parse_response(document.as_bytes()).map(|response| response.unwrap())
    }

    #[test]
    fn a_call_of_xmlrpc_plus_plus_reads_as_it_was_meant() {
        let document = b"<?xml version=\"1.0\"?>\r\n<methodCall><methodName>requestTopic</methodName>\r\n\
            <params><param><value>/relay</value></param><param><value>/a&amp;b</value></param><param><value><array><data>\
            <value><array><data><value>TCPROS</value></data></array></value></data></array></value></param></params></methodCall>\r\n";
        let call = Call::parse(document).unwrap();
        assert_eq!(call.method, "requestTopic");
        assert_eq!(
            call.params,
            [
                "/relay".into(),
                "/a&b".into(),
                Value::Array(vec![Value::Array(vec!["TCPROS".into()])])
            ]
        );
    }

    #[test]
    fn every_type_reads_from_its_tag() {
        assert_eq!(
            value_of("<value><int> -7 </int></value>"),
            Ok(Value::Int(-7))
        );
        assert_eq!(value_of("<value><i4>+7</i4></value>"), Ok(Value::Int(7)));
        assert_eq!(
            value_of("<value><boolean>1</boolean></value>"),
            Ok(Value::Bool(true))
        );
        assert_eq!(
            value_of("<value><double>-1.5e3</double></value>"),
            Ok(Value::Double(-1500.0))
        );
        assert_eq!(value_of("<value><nil/></value>"), Ok(Value::Nil));
        assert_eq!(value_of("<value/>"), Ok("".into()));
        assert_eq!(value_of("<value></value>"), Ok("".into()));
        assert_eq!(value_of("<value> a </value>"), Ok(" a ".into()));
        assert_eq!(value_of("<value>\n <string/>\n</value>"), Ok("".into()));
        assert_eq!(
            value_of("<value><string>&lt;&#65;&#x42;<![CDATA[<&]]></string></value>"),
            Ok("<AB<&".into())
        );
        assert_eq!(
            value_of("<value><base64>AP8Q\n/w==</base64></value>"),
            Ok(Value::Binary(vec![0, 255, 16, 255]))
        );
        assert_eq!(
            value_of("<value><array><data/></array></value>"),
            Ok(Value::Array(vec![]))
        );
        assert_eq!(
            value_of(
                "<value><struct><member><name>a</name><value>b</value></member></struct></value>"
            ),
            Ok(Value::Struct(vec![("a".to_owned(), "b".into())]))
        );
    }

    #[test]
    fn what_is_not_xmlrpc_is_refused_with_its_place() {
        let at = |inner: &str| value_of(inner).unwrap_err();
        assert!(matches!(
            at("<value><i4>2147483648</i4></value>"),
            XmlError::Content {
                expected: "a 32 bit integer",
                ..
            }
        ));
        assert!(matches!(
            at("<value><boolean>true</boolean></value>"),
            XmlError::Content {
                expected: "0 or 1",
                ..
            }
        ));
        assert!(matches!(
            at("<value><i4>1</int></value>"),
            XmlError::Tag {
                expected: "the closing tag",
                ..
            }
        ));
        assert!(matches!(
            at("<value><float>1</float></value>"),
            XmlError::Tag {
                expected: "a type of XML-RPC",
                ..
            }
        ));
        assert!(matches!(
            at("<value>&unknown;</value>"),
            XmlError::Content {
                expected: "a known reference",
                ..
            }
        ));
        assert!(matches!(
            at("<value>&#xD800;</value>"),
            XmlError::Content { .. }
        ));
        assert!(matches!(
            at("<value><base64>A===</base64></value>"),
            XmlError::Content {
                expected: "base64",
                ..
            }
        ));
        assert_eq!(
            Call::parse(b"<methodCall><methodName>x"),
            Err(XmlError::Truncated("a text"))
        );
        assert_eq!(Call::parse(b"\xff"), Err(XmlError::NotUtf8));
        let deep = format!(
            "{}{}",
            "<value><array><data>".repeat(40),
            "</data></array></value>".repeat(40)
        );
        assert_eq!(at(&deep), XmlError::TooDeep);
    }

    #[test]
    fn a_fault_comes_out_as_a_fault() {
        let fault = Fault {
            code: -1,
            message: "no <such> method".to_owned(),
        };
        let document = encode_response(&Err(fault.clone()));
        assert_eq!(parse_response(document.as_bytes()), Ok(Err(fault)));
    }

    fn any_value() -> impl Strategy<Value = Value> {
        let leaf = prop_oneof![
            any::<i32>().prop_map(Value::Int),
            any::<bool>().prop_map(Value::Bool),
            (-1e300..1e300).prop_map(Value::Double),
            "[^\\x00-\\x08\\x0b\\x0c\\x0e-\\x1f\u{fffe}\u{ffff}]*".prop_map(Value::String),
            prop::collection::vec(any::<u8>(), 0..40).prop_map(Value::Binary),
            Just(Value::Nil),
        ];
        leaf.prop_recursive(4, 32, 4, |inner| {
            prop_oneof![
                prop::collection::vec(inner.clone(), 0..4).prop_map(Value::Array),
                prop::collection::vec(("[a-z<&>]{0,6}", inner), 0..4).prop_map(Value::Struct),
            ]
        })
    }

    proptest! {
        #[test]
        fn a_written_call_reads_back_equal(method in "[a-zA-Z]{1,12}", params in prop::collection::vec(any_value(), 0..4)) {
            let call = Call { method, params };
            prop_assert_eq!(Call::parse(call.encode().as_bytes()), Ok(call));
        }

        #[test]
        fn a_prefix_of_a_call_is_an_error(params in prop::collection::vec(any_value(), 0..3), cut in any::<prop::sample::Index>()) {
            let document = Call { method: "m".to_owned(), params }.encode();
            let document = document.trim_end().as_bytes();
            prop_assert!(Call::parse(&document[..cut.index(document.len())]).is_err());
        }

        #[test]
        fn random_bytes_never_panic(bytes in prop::collection::vec(any::<u8>(), 0..300)) {
            prop_assert!(Call::parse(&bytes).is_err());
        }

        #[test]
        fn random_tags_never_panic(text in "(<(/)?(methodCall|methodName|params|param|value|array|data|struct|member|name|i4|base64)(/)?>|[a&;#<>!\\[\\]-]){0,60}") {
            // The call may be well formed by chance; what counts is that reading ends in a value or an error.
            if let Ok(call) = Call::parse(text.as_bytes()) {
                prop_assert_eq!(Call::parse(call.encode().as_bytes()), Ok(call));
            }
        }
    }
}
