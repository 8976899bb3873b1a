//! Decodes text to values.

use std::borrow::Cow;

use super::writer::BASE64;
use super::{MAX_DEPTH, XmlError, XmlRpcValue};

/// A document and the part that is not read yet.
pub(super) struct XmlReader<'a> {
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

impl<'a> XmlReader<'a> {
    pub(super) fn new(document: &'a [u8]) -> Result<Self, XmlError> {
        let document = std::str::from_utf8(document).map_err(|_| XmlError::NotUtf8)?;
        let rest = document.strip_prefix('\u{feff}').unwrap_or(document);
        Ok(Self { document, rest })
    }

    pub(super) fn position(&self) -> usize {
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

    /// Returns the next tag without consuming it, and the text after it.
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

    pub(super) fn at_open(&mut self, name: &str) -> Result<bool, XmlError> {
        let (tag, _) = self.peek()?;
        Ok(tag.name == name && tag.kind != Kind::Close)
    }

    pub(super) fn open(&mut self, name: &'static str) -> Result<(), XmlError> {
        self.take(name, Kind::Open)
    }

    pub(super) fn close(&mut self, name: &'static str) -> Result<(), XmlError> {
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

    pub(super) fn end(&mut self) -> Result<(), XmlError> {
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

    /// Reads `<params>`, which a peer may omit or leave empty.
    pub(super) fn params(&mut self) -> Result<Vec<XmlRpcValue>, XmlError> {
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

    pub(super) fn value(&mut self, depth: usize) -> Result<XmlRpcValue, XmlError> {
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
            return Ok(XmlRpcValue::String(String::new()));
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
            XmlRpcValue::String(self.text()?.into_owned())
        } else {
            self.typed(depth)?
        };
        self.close("value")?;
        Ok(value)
    }

    fn typed(&mut self, depth: usize) -> Result<XmlRpcValue, XmlError> {
        let (tag, rest) = self.peek()?;
        let at = self.position();
        self.rest = rest;
        if tag.kind == Kind::Empty {
            return match tag.name {
                "nil" | "ex:nil" => Ok(XmlRpcValue::Nil),
                "string" => Ok(XmlRpcValue::String(String::new())),
                "base64" => Ok(XmlRpcValue::Binary(Vec::new())),
                "struct" => Ok(XmlRpcValue::Struct(Vec::new())),
                _ => Err(XmlError::Tag {
                    expected: "a type of XML-RPC",
                    at,
                }),
            };
        }
        let value = match tag.name {
            "array" => self.array(depth)?,
            "struct" => self.members(depth)?,
            "nil" | "ex:nil" => XmlRpcValue::Nil,
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

    fn scalar(&mut self, name: &str) -> Result<XmlRpcValue, XmlError> {
        let text = self.text()?;
        let trimmed = text.trim();
        let wrong = |expected| XmlError::Content {
            expected,
            at: self.position(),
        };
        Ok(match name {
            "i4" | "int" | "i8" | "ex:i8" => {
                XmlRpcValue::Int(trimmed.parse().map_err(|_| wrong("a 32 bit integer"))?)
            }
            "boolean" => match trimmed {
                "0" => XmlRpcValue::Bool(false),
                "1" => XmlRpcValue::Bool(true),
                _ => return Err(wrong("0 or 1")),
            },
            "double" => XmlRpcValue::Double(trimmed.parse().map_err(|_| wrong("a number"))?),
            "base64" => XmlRpcValue::Binary(base64_decode(&text).ok_or_else(|| wrong("base64"))?),
            "string" => XmlRpcValue::String(text.into_owned()),
            _ => XmlRpcValue::DateTime(trimmed.to_owned()),
        })
    }

    fn array(&mut self, depth: usize) -> Result<XmlRpcValue, XmlError> {
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
        Ok(XmlRpcValue::Array(items))
    }

    fn members(&mut self, depth: usize) -> Result<XmlRpcValue, XmlError> {
        let mut members = Vec::new();
        while self.at_open("member")? {
            self.open("member")?;
            self.open("name")?;
            let name = self.text()?.into_owned();
            self.close("name")?;
            members.push((name, self.value(depth + 1)?));
            self.close("member")?;
        }
        Ok(XmlRpcValue::Struct(members))
    }

    /// Reads text up to the next tag, with references and CDATA resolved.
    pub(super) fn text(&mut self) -> Result<Cow<'a, str>, XmlError> {
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
        // The longest reference is `&#x10FFFF;`; a longer search would make hostile text quadratic.
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

/// Decodes base64. White space is skipped, because peers break lines; padding must be correct if
/// present and must end the text.
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
