//! The files of the page, and the headers of each response.

use bridge_node::{PageBody, full};
use bytes::Bytes;
use hyper::header::{
    CACHE_CONTROL, CONTENT_SECURITY_POLICY, CONTENT_TYPE, HeaderName, HeaderValue, REFERRER_POLICY,
    SET_COOKIE, X_CONTENT_TYPE_OPTIONS, X_FRAME_OPTIONS,
};
use hyper::{Response, StatusCode};
use serde_json::{Value, json};

pub(crate) fn set_cookie(response: &mut Response<PageBody>, cookie: &str) {
    // A token has hexadecimal digits only, so the header is valid.
    if let Ok(value) = HeaderValue::from_str(cookie) {
        response.headers_mut().insert(SET_COOKIE, value);
    }
}

/// The status and the reason of a refused request.
#[derive(Debug)]
pub(crate) struct RefusedRequest(pub(crate) StatusCode, pub(crate) String);

impl RefusedRequest {
    pub(crate) fn new(status: StatusCode, why: impl Into<String>) -> Self {
        Self(status, why.into())
    }
}

pub(crate) fn refused(status: StatusCode, why: &str) -> Response<PageBody> {
    let mut response = json_page(&json!({ "error": why }));
    *response.status_mut() = status;
    response
}

pub(crate) fn json_page(page: &Value) -> Response<PageBody> {
    with_headers("application/json", full(page.to_string()))
}

/// Returns a response with the headers that each page has.
pub(crate) fn with_headers(media: &'static str, body: PageBody) -> Response<PageBody> {
    let mut response = Response::new(body);
    let headers = response.headers_mut();
    headers.insert(CONTENT_TYPE, HeaderValue::from_static(media));
    for (name, value) in HEADERS {
        headers.insert(name, HeaderValue::from_static(value));
    }
    response
}

/// Returns a drawing. A browser that opens it by itself runs no script of it.
pub(crate) fn drawing(svg: Bytes) -> Response<PageBody> {
    let mut response = with_headers("image/svg+xml", full(svg));
    let policy = "default-src 'none'; style-src 'unsafe-inline'; sandbox; frame-ancestors 'none'";
    let headers = response.headers_mut();
    headers.insert(CONTENT_SECURITY_POLICY, HeaderValue::from_static(policy));
    response
}

const HEADERS: [(HeaderName, &str); 6] = [
    (
        CONTENT_SECURITY_POLICY,
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; connect-src 'self'; \
         form-action 'self'; frame-ancestors 'none'; base-uri 'none'",
    ),
    (X_CONTENT_TYPE_OPTIONS, "nosniff"),
    (X_FRAME_OPTIONS, "DENY"),
    (REFERRER_POLICY, "no-referrer"),
    (CACHE_CONTROL, "no-store"),
    (
        HeaderName::from_static("cross-origin-resource-policy"),
        "same-origin",
    ),
];

const SCRIPT: &str = "text/javascript; charset=utf-8";

/// The files of the page by their paths.
pub(crate) const FILES: [(&str, &str, &str); 17] = [
    (
        "/",
        "text/html; charset=utf-8",
        include_str!("../page/index.html"),
    ),
    (
        "/page.css",
        "text/css; charset=utf-8",
        include_str!("../page/page.css"),
    ),
    (
        "/icon.svg",
        "image/svg+xml",
        include_str!("../page/icon.svg"),
    ),
    ("/page.js", SCRIPT, include_str!("../page/page.js")),
    ("/dom.js", SCRIPT, include_str!("../page/dom.js")),
    ("/session.js", SCRIPT, include_str!("../page/session.js")),
    ("/programs.js", SCRIPT, include_str!("../page/programs.js")),
    ("/values.js", SCRIPT, include_str!("../page/values.js")),
    ("/topic.js", SCRIPT, include_str!("../page/topic.js")),
    ("/alarms.js", SCRIPT, include_str!("../page/alarms.js")),
    ("/events.js", SCRIPT, include_str!("../page/events.js")),
    ("/map.js", SCRIPT, include_str!("../page/map.js")),
    ("/skills.js", SCRIPT, include_str!("../page/skills.js")),
    (
        "/processes.js",
        SCRIPT,
        include_str!("../page/processes.js"),
    ),
    (
        "/knowledge.js",
        SCRIPT,
        include_str!("../page/knowledge.js"),
    ),
    ("/graph.js", SCRIPT, include_str!("../page/graph.js")),
    ("/pictures.js", SCRIPT, include_str!("../page/pictures.js")),
];

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_files_hold_nothing_that_the_policy_forbids() {
        for (path, _, content) in FILES {
            // Names of XML namespaces are no addresses.
            let content = content.replace("http://www.w3.org/2000/svg", "");
            for forbidden in [
                " style=\"",
                " onclick=",
                "<script>",
                "https://",
                "innerHTML",
                "eval(",
            ] {
                assert!(!content.contains(forbidden), "{path}: {forbidden}");
            }
        }
    }
}
