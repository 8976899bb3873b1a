//! Requests with parameters in the path and in the body.

use std::fmt;
use std::time::Duration;

use http_client::{HttpHost, HttpUrl};
use serde_json::{Map, Value as Json};
use skills::yaml::{DocumentKind, DocumentNode, YamlFindingCode, YamlReader};
use skills::{InvalidParameter, Parameters, SkillValue};
use uri_text::escaped;

use crate::http::{DeviceHost, DeviceRequest, HttpFault};

/// A request of the YAML.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Template {
    method: String,
    host: DeviceHost,
    /// The path, in which `{Name}` is a parameter.
    path: String,
    /// The body. A text `{Name}` is the value of a parameter.
    body: Option<Json>,
}

impl Template {
    /// Reads a URL, or a map with the keys `method`, `url` and `body`. `usual` is the default
    /// method.
    pub(super) fn read(
        node: &DocumentNode,
        usual: &str,
        reader: &mut YamlReader<'_>,
    ) -> Option<Self> {
        let [method, url, body] = match &node.kind {
            DocumentKind::Scalar(_) => [None, Some(node), None],
            DocumentKind::Null | DocumentKind::List(_) | DocumentKind::Map(_) => {
                reader.map(node, ["method", "url", "body"])?
            }
        };
        let method = match method {
            None => Some(usual.to_owned()),
            Some(node) => {
                let text = reader.text(node, "GET, POST, PUT, PATCH or DELETE")?;
                let known = ["GET", "POST", "PUT", "PATCH", "DELETE"].contains(&text);
                known.then(|| text.to_owned()).or_else(|| {
                    let message =
                        format!("expected GET, POST, PUT, PATCH or DELETE, found `{text}`");
                    reader.refuse(node, YamlFindingCode::WrongValue, message)
                })
            }
        };
        let url = reader
            .needed(url, "url", node.place)
            .and_then(|node| read_url(node, reader));
        let (host, path) = url?;
        Some(Self {
            method: method?,
            host,
            path,
            body: body.map(to_json),
        })
    }

    /// Reads the URL of a request without a body.
    pub(super) fn read_url(
        node: &DocumentNode,
        method: &str,
        reader: &mut YamlReader<'_>,
    ) -> Option<Self> {
        let (host, path) = read_url(node, reader)?;
        Some(Self {
            method: method.to_owned(),
            host,
            path,
            body: None,
        })
    }

    /// Returns the server.
    pub(super) const fn host(&self) -> &DeviceHost {
        &self.host
    }

    /// Sends the request without parameters: its path has no `{Name}` to replace.
    pub(super) async fn ask(&self, within: Duration) -> Result<Json, HttpFault> {
        let asked = DeviceRequest {
            method: &self.method,
            path: &self.path,
            body: None,
            within,
        };
        self.host.ask(asked).await
    }

    /// Checks the parameters.
    ///
    /// # Errors
    /// A parameter that is unknown or does not fit in the path.
    pub(super) fn check(&self, parameters: &Parameters) -> Result<(), InvalidParameter> {
        self.filled(parameters).map(drop)
    }

    /// Sends the request with the values of parameters.
    pub(super) async fn send(
        &self,
        parameters: &Parameters,
        within: Duration,
    ) -> Result<Json, HttpFault> {
        self.send_unless(parameters, within, || false).await
    }

    /// Sends the request, unless it is withdrawn before.
    pub(super) async fn send_unless(
        &self,
        parameters: &Parameters,
        within: Duration,
        withdrawn: impl Fn() -> bool + Send,
    ) -> Result<Json, HttpFault> {
        let filled = self.filled(parameters);
        let (path, body) = filled.map_err(|why| HttpFault::Unreachable(why.to_string()))?;
        let asked = DeviceRequest {
            method: &self.method,
            path: &path,
            body: body.as_ref(),
            within,
        };
        self.host.ask_unless(asked, withdrawn).await
    }

    /// Returns the path and the body with the values of parameters.
    ///
    /// # Errors
    /// A parameter that is unknown or does not fit in the path.
    fn filled(&self, parameters: &Parameters) -> Result<(String, Option<Json>), InvalidParameter> {
        let value = |name: &str| {
            let value = parameters.get(name).map(SkillValue::to_json);
            value.ok_or_else(|| no_parameter(name))
        };
        let path = filled_path(&self.path, &value)?;
        let body = self.body.as_ref().map(|body| filled(body, &value));
        Ok((path, body.transpose()?))
    }
}

impl fmt::Display for Template {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}{}", self.host, self.path)
    }
}

pub(super) fn no_parameter(name: &str) -> InvalidParameter {
    InvalidParameter::Unexpected {
        name: name.to_owned(),
        given: None,
        expected: "is not a parameter of the skill".to_owned(),
    }
}

/// Replaces each `{Name}` of a text.
fn fill(
    text: &str,
    value: &dyn Fn(&str) -> Result<String, InvalidParameter>,
) -> Result<String, InvalidParameter> {
    let mut out = String::new();
    let mut rest = text;
    while let Some((before, after)) = rest.split_once('{') {
        out.push_str(before);
        match after.split_once('}') {
            Some((name, after)) if is_name(name) => {
                out.push_str(&value(name)?);
                rest = after;
            }
            _ => {
                out.push('{');
                rest = after;
            }
        }
    }
    out.push_str(rest);
    Ok(out)
}

/// Fills a path and its query. Values are escaped: each stays within its segment of the path.
///
/// # Errors
/// A parameter that is unknown, or with which a segment is `.` or `..`: servers replace such
/// segments.
fn filled_path(
    template: &str,
    value: &dyn Fn(&str) -> Result<Json, InvalidParameter>,
) -> Result<String, InvalidParameter> {
    let (path, query) = match template.find('?') {
        Some(at) => template.split_at(at),
        None => (template, ""),
    };
    let part = |text: &str| fill(text, &|name| Ok(escaped(&plain(&value(name)?))));
    let segment = |template: &str| {
        let segment = part(template)?;
        let name = template.split(['{', '}']).nth(1);
        match name.filter(|_| matches!(&*segment, "." | "..")) {
            None => Ok(segment),
            Some(name) => Err(InvalidParameter::Unexpected {
                name: name.to_owned(),
                given: Some(segment.as_str().into()),
                expected: format!("makes `{segment}` a segment of the path"),
            }),
        }
    };
    let segments: Vec<String> = path.split('/').map(segment).collect::<Result<_, _>>()?;
    Ok(segments.join("/") + &part(query)?)
}

fn filled(
    json: &Json,
    value: &dyn Fn(&str) -> Result<Json, InvalidParameter>,
) -> Result<Json, InvalidParameter> {
    Ok(match json {
        Json::String(text) => {
            let whole = text.strip_prefix('{').and_then(|of| of.strip_suffix('}'));
            match whole.filter(|name| is_name(name)) {
                Some(name) => value(name)?,
                None => fill(text, &|name| Ok(plain(&value(name)?)))?.into(),
            }
        }
        Json::Array(elements) => {
            let elements = elements.iter().map(|element| filled(element, value));
            Json::Array(elements.collect::<Result<_, _>>()?)
        }
        Json::Object(entries) => {
            let entries = entries
                .iter()
                .map(|(key, json)| Ok((key.clone(), filled(json, value)?)));
            Json::Object(entries.collect::<Result<Map<_, _>, InvalidParameter>>()?)
        }
        Json::Null | Json::Bool(_) | Json::Number(_) => json.clone(),
    })
}

fn is_name(text: &str) -> bool {
    !text.is_empty() && text.bytes().all(|b| b.is_ascii_alphanumeric() || b == b'_')
}

/// Returns a text without quotes, and other values as JSON.
pub(super) fn plain(json: &Json) -> String {
    json.as_str()
        .map_or_else(|| json.to_string(), str::to_owned)
}

/// Reads `http://host[:port]/path`, or the same with `https`.
fn read_url(node: &DocumentNode, reader: &mut YamlReader<'_>) -> Option<(DeviceHost, String)> {
    let text = reader.text(node, "a URL, as http://10.0.0.9/api/state")?;
    let url = text.parse::<HttpUrl>().ok().filter(|url| !url.has_user());
    let Some(url) = url else {
        let message = format!("expected http://host[:port]/path or https://, found `{text}`");
        return reader.refuse(node, YamlFindingCode::WrongValue, message);
    };
    match HttpHost::of(&url) {
        Ok(host) => Some((DeviceHost::new(host), url.target().to_owned())),
        Err(error) => {
            let message = format!("`{text}`: {error}");
            reader.refuse(node, YamlFindingCode::WrongValue, message)
        }
    }
}

/// Converts a tree to JSON. Scalars are numbers and Booleans as far as they are such.
fn to_json(node: &DocumentNode) -> Json {
    match &node.kind {
        DocumentKind::Null => Json::Null,
        DocumentKind::Scalar(text) => match serde_json::from_str(text) {
            Ok(json @ (Json::Number(_) | Json::Bool(_))) => json,
            Ok(_) | Err(_) => Json::from(text.as_str()),
        },
        DocumentKind::List(nodes) => nodes.iter().map(to_json).collect(),
        DocumentKind::Map(pairs) => {
            let entries = pairs.iter().filter_map(|(key, value)| {
                let DocumentKind::Scalar(key) = &key.kind else {
                    return None;
                };
                Some((key.clone(), to_json(value)))
            });
            Json::Object(entries.collect())
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parameters_fill_templates_as_values_as_text_and_escaped_in_a_path() {
        let value = |name: &str| match name {
            "Name" => Ok(Json::from("a b/c")),
            "Force" => Ok(Json::from(2.5)),
            other => Err(no_parameter(other)),
        };
        let body = serde_json::json!({"n": "{Name}", "f": ["{Force}", "{Force} N", "{ x }", 1]});
        let expected = serde_json::json!({"n": "a b/c", "f": [2.5, "2.5 N", "{ x }", 1]});
        assert_eq!(filled(&body, &value), Ok(expected));
        let path = filled_path("/{Name}?f={Force}", &value);
        assert_eq!(path.unwrap(), "/a%20b%2Fc?f=2.5");
        assert!(filled(&"{Speed}".into(), &value).is_err());
    }

    #[test]
    fn a_parameter_does_not_leave_its_segment_of_a_path() {
        let path = |template: &str, name: &str| {
            let value = |_: &str| Ok(Json::from(name));
            filled_path(template, &value)
        };
        let start = "/programs/{Name}/start";
        for (name, expected) in [
            ("../a?b#c", "/programs/..%2Fa%3Fb%23c/start"),
            ("..\\a", "/programs/..%5Ca/start"),
            ("%2e%2e", "/programs/%252e%252e/start"),
            ("...", "/programs/.../start"),
            ("a.b", "/programs/a.b/start"),
        ] {
            assert_eq!(path(start, name).as_deref(), Ok(expected));
        }
        for (template, name) in [(start, "."), (start, ".."), ("/{Name}{Name}?x", ".")] {
            let refused = path(template, name).unwrap_err();
            let refused = refused.to_string();
            assert!(refused.starts_with("Name makes `."), "{refused}");
        }
        assert_eq!(
            path("/a?name={Name}&b", "..").as_deref(),
            Ok("/a?name=..&b")
        );
        assert_eq!(
            path("/a?name={Name}&b", "/?&=").as_deref(),
            Ok("/a?name=%2F%3F%26%3D&b")
        );
        assert_eq!(path("/{x y}/b", "a").as_deref(), Ok("/{x y}/b"));
    }
}
