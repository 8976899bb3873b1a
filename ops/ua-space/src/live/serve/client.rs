//! The connections of viewers.
#![expect(
    clippy::result_large_err,
    reason = "the type of the callback of the library"
)]

use std::net::IpAddr;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Duration;

use futures_util::{SinkExt as _, StreamExt as _};
use tokio::net::{TcpListener, TcpStream};
use tokio_tungstenite::tungstenite::Message;
use tokio_tungstenite::tungstenite::handshake::server::{ErrorResponse, Request, Response};
use tokio_tungstenite::tungstenite::http::header::{HeaderMap, HeaderValue, ORIGIN};
use tokio_tungstenite::tungstenite::http::{StatusCode, Uri};
use tokio_tungstenite::tungstenite::protocol::WebSocketConfig;
use tokio_tungstenite::{WebSocketStream, accept_hdr_async_with_config};

use super::assets::AssetRequest;
use super::hub::{ConnectedViewer, Next, ViewerHub};
use crate::live::text::harmless;
use crate::report::warn;

/// Accepts viewers for as long as the listener works. `origins` are the web pages that may connect.
pub(super) async fn accept(listener: TcpListener, hub: Arc<ViewerHub>, origins: Arc<[String]>) {
    loop {
        match listener.accept().await {
            Ok((stream, _)) => {
                let (hub, origins) = (Arc::clone(&hub), Arc::clone(&origins));
                tokio::spawn(async move { serve(stream, &hub, &origins).await });
            }
            // Without a pause, a lack of file descriptors would keep the processor busy.
            Err(_) => tokio::time::sleep(PAUSE).await,
        }
    }
}

/// Serves a viewer until it leaves.
async fn serve(stream: TcpStream, hub: &ViewerHub, origins: &[String]) {
    // Without this option, small values would wait for the confirmations of earlier ones.
    let _faster = stream.set_nodelay(true);
    let Some((id, client)) = hub.connect() else {
        return;
    };
    let config = WebSocketConfig::default()
        .max_message_size(Some(LONGEST))
        .max_frame_size(Some(LONGEST));
    let callback = |request: &Request, response: Response| negotiate(request, response, origins);
    let accepted = accept_hdr_async_with_config(stream, callback, Some(config));
    if let Ok(Ok(stream)) = tokio::time::timeout(HANDSHAKE_WITHIN, accepted).await {
        exchange(stream, hub, &client).await;
    }
    hub.disconnect(id);
}

/// Sends the queue of a viewer and handles its messages, until either side ends.
async fn exchange(stream: WebSocketStream<TcpStream>, hub: &ViewerHub, client: &ConnectedViewer) {
    let (mut sink, mut messages) = stream.split();
    let sending = async {
        loop {
            let message = match client.next() {
                Next::Text(text) => Message::text(text),
                Next::Binary(value) => Message::binary(value),
                Next::Nothing => {
                    client.wake.notified().await;
                    continue;
                }
                Next::Closed => {
                    // The connection ends in either case.
                    let _closed = sink.close().await;
                    break;
                }
            };
            if sink.send(message).await.is_err() {
                break;
            }
        }
    };
    let receiving = async {
        while let Some(Ok(message)) = messages.next().await {
            match message {
                Message::Text(text) => {
                    if let Some(request) = hub.handle(client, &text) {
                        fetch(hub, client, request).await;
                    }
                }
                Message::Close(_) => break,
                Message::Binary(_) | Message::Ping(_) | Message::Pong(_) | Message::Frame(_) => {}
            }
        }
    };
    tokio::select! {
        () = sending => {}
        () = receiving => {}
        // The sender may wait for the viewer, so it cannot end the connection.
        () = client.given_up.notified() => {}
    }
}

/// Sends the file of a request. The next request waits until the file is sent, so that a viewer
/// holds the memory of one file only.
async fn fetch(hub: &ViewerHub, client: &ConnectedViewer, request: AssetRequest) {
    let assets = hub.assets.clone();
    let reading = tokio::task::spawn_blocking(move || assets.response(&request));
    if let Ok(message) = reading.await {
        client.push_asset(message);
        client.asset_sent.notified().await;
    }
}

/// Chooses the protocol, and refuses web pages of other hosts. A browser lets any page connect to
/// this host.
fn negotiate(
    request: &Request,
    mut response: Response,
    origins: &[String],
) -> Result<Response, ErrorResponse> {
    let headers = request.headers();
    if let Some(origin) = foreign_origin(headers, origins) {
        warn_of_page(&origin);
        return Err(refusal(
            StatusCode::FORBIDDEN,
            "this web page may not connect",
        ));
    }
    let offered = headers.get_all(PROTOCOL).iter();
    let offered = offered.filter_map(|value| value.to_str().ok());
    let offered: Vec<&str> = offered
        .flat_map(|list| list.split(',').map(str::trim))
        .collect();
    let chosen = PROTOCOLS.iter().find(|known| offered.contains(*known));
    let Some(chosen) = chosen else {
        let why = "this server speaks foxglove.sdk.v1 and foxglove.websocket.v1";
        return Err(refusal(StatusCode::BAD_REQUEST, why));
    };
    let headers = response.headers_mut();
    headers.insert(PROTOCOL, HeaderValue::from_static(chosen));
    Ok(response)
}

/// Reports a refused web page. A page can try again without end, so the reports are limited.
fn warn_of_page(origin: &str) {
    static REFUSED: AtomicUsize = AtomicUsize::new(0);
    let before = REFUSED.fetch_add(1, Ordering::Relaxed);
    if before < MOST_WARNINGS {
        let origin = harmless(origin);
        warn(&format!(
            "refused a viewer in a page of {origin}; --origin {origin} admits it"
        ));
    }
}

/// Returns the origin of a web page that may not connect. Programs send no origin, or an origin
/// that is not of the web.
fn foreign_origin(headers: &HeaderMap, origins: &[String]) -> Option<String> {
    let origin = headers.get(ORIGIN)?;
    let Ok(text) = origin.to_str() else {
        return Some("an unreadable origin".to_owned());
    };
    let is_admitted = origins.iter().any(|known| known == "*" || known == text);
    (!is_admitted && text != "file://" && !is_of_this_host(text)).then(|| text.to_owned())
}

/// Returns whether an origin is not of the web, or of a page from this host.
fn is_of_this_host(origin: &str) -> bool {
    if origin == "null" {
        return false;
    }
    let Ok(uri) = origin.parse::<Uri>() else {
        return false;
    };
    match (uri.scheme_str(), uri.host()) {
        (Some("http" | "https"), Some(host)) => {
            let host = host.trim_matches(['[', ']']);
            let address = host.parse::<IpAddr>();
            host == "localhost" || address.is_ok_and(|address| address.is_loopback())
        }
        (Some("http" | "https") | None, _) => false,
        (Some(_), _) => true,
    }
}

fn refusal(status: StatusCode, why: &str) -> ErrorResponse {
    let mut refusal = ErrorResponse::new(Some(why.to_owned()));
    *refusal.status_mut() = status;
    refusal
}

const PROTOCOL: &str = "sec-websocket-protocol";
/// The protocols, the newest first.
const PROTOCOLS: [&str; 2] = ["foxglove.sdk.v1", "foxglove.websocket.v1"];
const HANDSHAKE_WITHIN: Duration = Duration::from_secs(5);
/// Maximum number of reports of refused web pages.
const MOST_WARNINGS: usize = 20;
const PAUSE: Duration = Duration::from_millis(100);
/// Maximum size of a message of a viewer, in bytes.
const LONGEST: usize = 1 << 20;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn web_pages_of_other_hosts_are_refused_and_programs_are_not() {
        let refused = |origin: &'static str, admitted: &[String]| {
            let mut headers = HeaderMap::new();
            headers.insert(ORIGIN, HeaderValue::from_static(origin));
            foreign_origin(&headers, admitted).is_some()
        };
        for origin in [
            "https://viewer.example",
            "http://10.0.0.7:8080",
            "null",
            "?",
        ] {
            assert!(refused(origin, &[]), "{origin}");
            assert!(!refused(origin, &[origin.to_owned()]), "{origin}");
            assert!(!refused(origin, &["*".to_owned()]), "{origin}");
        }
        for origin in [
            "http://localhost:8080",
            "http://[::1]",
            "file://",
            "app://viewer",
        ] {
            assert!(!refused(origin, &[]), "{origin}");
        }
        assert_eq!(foreign_origin(&HeaderMap::new(), &[]), None);
    }

    #[test]
    fn the_newest_protocol_of_both_sides_is_chosen() {
        let chosen = |offered: &'static str| {
            let mut request = Request::new(());
            let headers = request.headers_mut();
            headers.insert(PROTOCOL, HeaderValue::from_static(offered));
            let response = negotiate(&request, Response::new(()), &[]);
            response.map(|response| response.headers()[PROTOCOL].clone())
        };
        let old = chosen("foxglove.websocket.v1").unwrap();
        assert_eq!(old, "foxglove.websocket.v1");
        let new = chosen("foxglove.websocket.v1, foxglove.sdk.v1").unwrap();
        assert_eq!(new, "foxglove.sdk.v1");
        let refusal = chosen("chat").unwrap_err();
        assert_eq!(refusal.status(), StatusCode::BAD_REQUEST);
    }
}
