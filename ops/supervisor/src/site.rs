//! The requests of browsers.

mod knowledge;

use std::error::Error;
use std::fs::File;
use std::io::Read as _;
use std::net::{IpAddr, SocketAddr};
use std::sync::Arc;
use std::time::Duration;

use bridge_node::{BoxFuture, PageBody, Site, Statuses, Visit, full};
use bytes::Bytes;
use http_body_util::{BodyExt as _, Limited};
use hyper::body::{Body, Incoming};
use hyper::header::{ALLOW, CONTENT_TYPE, COOKIE, HOST, HeaderMap, HeaderValue, ORIGIN};
use hyper::{Method, Request, Response, StatusCode};
use mappings::TopicId;
use serde::Deserialize;
use serde_json::{Map, Value, json};
use subtle::ConstantTimeEq as _;
use tracing::{info, warn};
use uri_text::{is_loopback_host, without_port};

use crate::encode;
use crate::operations::{ConditionChange, OperationFault, Operations};
use crate::page::Page;
use crate::responses::{FILES, RefusedRequest, json_page, refused, set_cookie, with_headers};
use crate::session::{BrowserSession, EventStreamBrowser, cookie};
use crate::stream::Events;
use crate::value;
use crate::view::BrowserView;

/// The origin of a request: its Host, and its session.
struct Browser {
    host: String,
    via: Via,
    session: Option<BrowserSession>,
    token: String,
}

/// The way of a request to the page.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Via {
    /// From this host, without TLS.
    Loopback,
    /// Through the reverse proxy, or from this host while there is a proxy: a proxy may pass on the
    /// name of loopback.
    Proxy,
    /// By TLS of the page itself.
    Tls,
}

impl Via {
    /// Returns whether browsers of other hosts use this way: each user signs in, also to read, and
    /// the browser has TLS.
    const fn is_remote(self) -> bool {
        match self {
            Self::Loopback => false,
            Self::Proxy | Self::Tls => true,
        }
    }
}

/// The body of a request to sign in.
#[derive(Deserialize)]
struct SignIn {
    user: String,
    password: String,
}

/// The body of a request for a call.
#[derive(Deserialize)]
struct CallRequest {
    topic: String,
    #[serde(default)]
    fields: Map<String, Value>,
}

/// The body of a request to write a value.
#[derive(Deserialize)]
struct Write {
    topic: String,
    value: Value,
}

impl Site for Page {
    fn start(&self, statuses: Statuses) {
        self.read_by(statuses);
    }

    fn answer(
        self: Arc<Self>,
        request: Request<Incoming>,
        visit: Visit,
    ) -> BoxFuture<Response<PageBody>> {
        Box::pin(async move {
            match self.respond(request, &visit).await {
                Ok(response) => response,
                Err(RefusedRequest(status, why)) => refused(status, &why),
            }
        })
    }

    fn describe(&self, at: SocketAddr) -> String {
        let here = if at.ip().is_loopback() {
            format!("page at http://{at}/")
        } else {
            format!(
                "page at http://127.0.0.1:{}/, for browsers on this host only",
                at.port()
            )
        };
        match &self.proxy {
            Some(proxy) => format!("{here}, and at {proxy}/ for signed-in users"),
            None => here,
        }
    }
}

/// The body of a request.
pub(crate) trait RequestBody:
    Body<Data: Send, Error: Into<Box<dyn Error + Send + Sync>>> + Send + 'static
{
}

impl<B> RequestBody for B where
    B: Body<Data: Send, Error: Into<Box<dyn Error + Send + Sync>>> + Send + 'static
{
}

impl Page {
    async fn respond(
        self: Arc<Self>,
        request: Request<impl RequestBody>,
        visit: &Visit,
    ) -> Result<Response<PageBody>, RefusedRequest> {
        let (host, via) = self.host(request.headers(), visit)?;
        let path = request.uri().path().to_owned();
        if request.method() == Method::POST {
            let media = knowledge::media(&path).unwrap_or(JSON);
            check_origin(request.headers(), &self.origin(&host, via), media)?;
            let browser = self.browser(request.headers(), (host, via));
            if path == knowledge::QUERY {
                check_reader(&browser)?;
                visit.keep_open();
                return knowledge::query(&self, body(request).await?).await;
            }
            return self.change(&path, request, browser, visit).await;
        }
        if request.method() != Method::GET {
            let mut response = refused(StatusCode::METHOD_NOT_ALLOWED, "GET or POST is wanted");
            let allowed = HeaderValue::from_static("GET, POST");
            response.headers_mut().insert(ALLOW, allowed);
            return Ok(response);
        }
        if let Some((_, media, content)) = FILES.iter().find(|(name, ..)| *name == path) {
            return Ok(with_headers(media, full(content.as_bytes())));
        }
        let browser = self.browser(request.headers(), (host, via));
        match path.as_str() {
            "/session" => Ok(json_page(&self.told(browser.session.as_ref(), via))),
            "/events" => {
                check_reader(&browser)?;
                let query = request.uri().query().unwrap_or_default();
                let view = BrowserView::parse(query).map_err(bad_request)?;
                let worker = self.worker().ok_or_else(|| {
                    let why = "the system refuses another thread";
                    RefusedRequest::new(StatusCode::SERVICE_UNAVAILABLE, why)
                })?;
                visit.keep_open();
                let reader = EventStreamBrowser {
                    token: browser.token,
                    must_sign_in: via.is_remote(),
                };
                let events = Events::start(worker, Arc::clone(&self), view, reader);
                Ok(with_headers("text/event-stream", events.boxed_unsync()))
            }
            knowledge::QUESTIONS | knowledge::PLAN | knowledge::PICTURES | knowledge::PICTURE => {
                // A plan is work for `ua-mes`, which the page of another site must not cause.
                check_site(request.headers())?;
                check_reader(&browser)?;
                visit.keep_open();
                knowledge::read(&self, request.uri()).await
            }
            _ => Err(RefusedRequest::new(
                StatusCode::NOT_FOUND,
                "there is no such page; the start is /",
            )),
        }
    }

    /// Handles a request that changes something.
    async fn change(
        self: Arc<Self>,
        path: &str,
        request: Request<impl RequestBody>,
        browser: Browser,
        visit: &Visit,
    ) -> Result<Response<PageBody>, RefusedRequest> {
        let operations = self.operations.get().cloned().ok_or_else(|| {
            let why = format!("{} has no users: the page is read-only", self.program);
            RefusedRequest::new(StatusCode::FORBIDDEN, why)
        })?;
        let token = request.headers().get("x-csrf-token");
        let token = token
            .and_then(|token| token.to_str().ok())
            .unwrap_or_default();
        let token = token.to_owned();
        visit.keep_open();
        if path == "/sign-in" {
            return self
                .sign_in(&operations, &browser, body(request).await?)
                .await;
        }
        let session = browser
            .session
            .as_ref()
            .ok_or_else(|| RefusedRequest::new(StatusCode::UNAUTHORIZED, "sign in first"))?;
        let is_own: bool = session.csrf.as_bytes().ct_eq(token.as_bytes()).into();
        if !is_own {
            return Err(RefusedRequest::new(
                StatusCode::FORBIDDEN,
                "the request does not come from the page: load it again",
            ));
        }
        match path {
            "/sign-out" => {
                self.sessions().close(&browser.token);
                info!(user = session.user, "signed out of the page");
                let mut response = json_page(&self.told(None, browser.via));
                let expired = browser.cookie("", 0);
                set_cookie(&mut response, &expired);
                Ok(response)
            }
            "/call" => self.call(&operations, session, body(request).await?).await,
            "/write" => {
                let written = body(request).await?;
                self.write(&operations, session, written).await
            }
            "/condition" => {
                let change: ConditionChange = body(request).await?;
                change_condition(operations.as_ref(), session, &change)
            }
            knowledge::CHECK | knowledge::LOAD => {
                knowledge::upload(&self, operations.as_ref(), session, request).await
            }
            _ => Err(RefusedRequest::new(
                StatusCode::NOT_FOUND,
                "there is no such request",
            )),
        }
    }

    async fn sign_in(
        &self,
        operations: &Arc<dyn Operations>,
        browser: &Browser,
        SignIn { user, password }: SignIn,
    ) -> Result<Response<PageBody>, RefusedRequest> {
        let now = self.at().since;
        let may_try = self.sessions().may_try(&user, now);
        may_try.map_err(|locked| {
            RefusedRequest::new(StatusCode::TOO_MANY_REQUESTS, locked.to_string())
        })?;
        // Counted before the check, so that attempts at the same time are limited too.
        self.sessions().fail(&user, now);
        let shown = value::cut(&user, 64);
        if !operations.sign_in(user.clone(), password).await {
            warn!(user = shown, "refused to sign in on the page");
            return Err(RefusedRequest::new(
                StatusCode::FORBIDDEN,
                "no such user, or another password",
            ));
        }
        let fault = |error| {
            warn!("cannot read {RANDOM}: {error}");
            RefusedRequest::new(StatusCode::INTERNAL_SERVER_ERROR, "no random token")
        };
        let (token, csrf) = (random().map_err(fault)?, random().map_err(fault)?);
        let session = {
            let mut sessions = self.sessions();
            sessions.succeed(&user);
            sessions.open(&user, [token.clone(), csrf], now)
        };
        info!(user = shown, "signed in on the page");
        let mut response = json_page(&self.told(Some(&session), browser.via));
        let made = browser.cookie(&token, 24 * 3600);
        set_cookie(&mut response, &made);
        Ok(response)
    }

    async fn call(
        &self,
        operations: &Arc<dyn Operations>,
        session: &BrowserSession,
        CallRequest { topic, fields }: CallRequest,
    ) -> Result<Response<PageBody>, RefusedRequest> {
        let topic = parse_topic(&topic)?;
        let known = self.board().calls.get(&topic).cloned();
        let (call, is_own) = known.ok_or_else(|| {
            let why = format!("the call {topic} has no executor");
            RefusedRequest::new(StatusCode::NOT_FOUND, why)
        })?;
        if is_own {
            let why = format!(
                "{} executes {topic} itself: call it by OPC UA",
                self.program
            );
            return Err(RefusedRequest::new(StatusCode::CONFLICT, why));
        }
        let request = encode::request(&call, &fields).map_err(bad_request)?;
        let user = session.user.clone();
        info!(user, %topic, call = call.name, "call requested on the page");
        let answered = operations.call(user.clone(), topic, request.into()).await;
        let outcome = outcome(answered.as_ref().err());
        info!(user, %topic, call = call.name, outcome, "called from the page");
        let response = answered.map_err(|fault| refusal(fault, &user))?;
        let names = call.response.iter().map(|field| field.name.clone());
        let names: Vec<String> = names.collect();
        let shown = value::fields(&response, &names).unwrap_or_default();
        Ok(json_page(&json!({ "outcome": outcome, "response": shown })))
    }

    async fn write(
        &self,
        operations: &Arc<dyn Operations>,
        session: &BrowserSession,
        Write {
            topic,
            value: given,
        }: Write,
    ) -> Result<Response<PageBody>, RefusedRequest> {
        let topic = parse_topic(&topic)?;
        let writable = {
            let board = self.board();
            let entry = board.topics.get(&topic);
            entry.and_then(|entry| entry.writable.clone())
        };
        let writable = writable.ok_or_else(|| {
            let why = format!("{topic} is not written on the page: use an OPC UA client");
            RefusedRequest::new(StatusCode::CONFLICT, why)
        })?;
        let (node, field) = &*writable;
        let block = encode::value(field, &given).map_err(bad_request)?;
        let user = session.user.clone();
        let value = value::cut(&given.to_string(), 200);
        info!(user, %topic, value, "write requested on the page");
        let written = operations.write(user.clone(), node, block.into()).await;
        let outcome = outcome(written.as_ref().err());
        info!(user, %topic, value, outcome, "written from the page");
        written.map_err(|fault| refusal(fault, &user))?;
        Ok(json_page(&json!({ "outcome": outcome })))
    }

    /// Returns the session for the browser.
    fn told(&self, session: Option<&BrowserSession>, via: Via) -> Value {
        let operations = self.operations.get();
        let may_sign_in = operations.is_some_and(|operations| operations.has_users());
        let user = session.and_then(|session| {
            let roles = operations?.roles(&session.user)?;
            Some((session, roles))
        });
        let may = |right: fn(&dyn Operations, &str) -> bool| {
            let user = user.as_ref().zip(operations);
            user.is_some_and(|((session, _), operations)| right(operations.as_ref(), &session.user))
        };
        json!({
            "program": self.program,
            "version": build_info::version(),
            "may_sign_in": may_sign_in,
            "must_sign_in": via.is_remote() && user.is_none(),
            "may_operate": may(Operations::may_operate),
            "may_load": may(Operations::may_load),
            "user": user.as_ref().map(|(session, _)| &session.user),
            "roles": user.as_ref().map(|(_, roles)| roles),
            "csrf": user.as_ref().map(|(session, _)| &session.csrf),
        })
    }

    /// Checks that a request was meant for the page, because a page of another site can reach it by
    /// a name that resolves to its address; without TLS, it comes from this host. Returns the Host
    /// and the way.
    fn host(&self, headers: &HeaderMap, visit: &Visit) -> Result<(String, Via), RefusedRequest> {
        let host = headers.get(HOST).and_then(|host| host.to_str().ok());
        let host = host.unwrap_or_default();
        if visit.is_secure {
            return if self.is_own_name(without_port(host)) {
                Ok((host.to_owned(), Via::Tls))
            } else {
                Err(RefusedRequest::new(
                    StatusCode::MISDIRECTED_REQUEST,
                    "the page is served by the names in the certificate of the program",
                ))
            };
        }
        if !visit.peer.ip().to_canonical().is_loopback() {
            return Err(RefusedRequest::new(
                StatusCode::FORBIDDEN,
                "the page is for browsers on this host: use --page-tls, an SSH tunnel, or a reverse proxy with --page-proxy",
            ));
        }
        // A proxy connects from loopback on behalf of other hosts.
        let is_forwarded = FORWARDED.iter().any(|name| headers.contains_key(*name));
        if is_forwarded && self.proxy.is_none() {
            return Err(RefusedRequest::new(
                StatusCode::FORBIDDEN,
                "the request comes through a proxy: name it with --page-proxy, so that users sign in",
            ));
        }
        let is_proxy = self.proxy.as_ref().is_some_and(|proxy| proxy.is_host(host));
        if is_proxy || is_loopback_host(host) {
            let via = match self.proxy {
                Some(_) => Via::Proxy,
                None => Via::Loopback,
            };
            return Ok((host.to_owned(), via));
        }
        Err(RefusedRequest::new(
            StatusCode::MISDIRECTED_REQUEST,
            "the page is served on loopback, by 127.0.0.1, [::1] or localhost",
        ))
    }

    /// Returns whether the certificate of the page has a name or address. An address that it does
    /// not have is no name of another site either: a browser warns of it.
    fn is_own_name(&self, name: &str) -> bool {
        let certificate = self.tls.get();
        let is_address = name.parse::<IpAddr>().is_ok();
        is_address || certificate.is_some_and(|certificate| certificate.is_for(name))
    }

    /// Returns the origin of the requests of the page itself.
    fn origin(&self, host: &str, via: Via) -> String {
        match (via, &self.proxy) {
            (Via::Proxy, Some(proxy)) => proxy.to_string(),
            (Via::Tls, _) => format!("https://{host}"),
            (Via::Proxy | Via::Loopback, _) => format!("http://{host}"),
        }
    }

    fn browser(&self, headers: &HeaderMap, (host, via): (String, Via)) -> Browser {
        let name = cookie_name(&host, via);
        let cookies = headers.get(COOKIE).and_then(|value| value.to_str().ok());
        let token = cookies.and_then(|cookies| cookie(cookies, &name));
        let token = token.unwrap_or_default().to_owned();
        let now = self.at().since;
        let session = self.sessions().find(&token, now);
        // A removed user has no session.
        let session = session.filter(|session| {
            let operations = self.operations.get();
            operations.is_some_and(|operations| operations.roles(&session.user).is_some())
        });
        Browser {
            host,
            via,
            session,
            token,
        }
    }

    /// Returns whether the browser of a session may still read.
    pub(crate) fn may_read(&self, reader: &EventStreamBrowser) -> bool {
        if !reader.must_sign_in {
            return true;
        }
        let now = self.at().since;
        let user = self.sessions().user(&reader.token, now);
        let operations = self.operations.get();
        user.zip(operations)
            .is_some_and(|(user, operations)| operations.roles(&user).is_some())
    }
}

/// Checks that a browser may read: on loopback without a proxy every browser may. Otherwise the
/// request may come from any host, so each user signs in.
fn check_reader(browser: &Browser) -> Result<(), RefusedRequest> {
    if !browser.via.is_remote() || browser.session.is_some() {
        Ok(())
    } else {
        Err(RefusedRequest::new(
            StatusCode::UNAUTHORIZED,
            "sign in first",
        ))
    }
}

/// Returns the name of the session cookie. Browsers send cookies of loopback to every port, and do
/// not accept secure cookies over plain HTTP everywhere, so the name has the port there.
fn cookie_name(host: &str, via: Via) -> String {
    if via.is_remote() {
        return "__Host-ua-session".to_owned();
    }
    let port = host.rsplit_once(':').map_or("80", |(_, port)| port);
    format!("ua-session-{port}")
}

impl Browser {
    fn cookie(&self, token: &str, max_age: u32) -> String {
        let name = cookie_name(&self.host, self.via);
        let secure = if self.via.is_remote() { "; Secure" } else { "" };
        format!("{name}={token}; Path=/; Max-Age={max_age}; HttpOnly; SameSite=Strict{secure}")
    }
}

/// Acknowledges or confirms a condition.
fn change_condition(
    operations: &dyn Operations,
    session: &BrowserSession,
    change: &ConditionChange,
) -> Result<Response<PageBody>, RefusedRequest> {
    let user = &session.user;
    let condition = value::cut(&change.condition, 200);
    let comment = value::cut(&change.comment, 200);
    let changed = operations.change_condition(user, change);
    let outcome = outcome(changed.as_ref().err());
    let action = change.action.name();
    info!(
        user,
        condition, action, comment, outcome, "condition changed on the page"
    );
    changed.map_err(|fault| refusal(fault, user))?;
    Ok(json_page(&json!({ "outcome": outcome })))
}

fn parse_topic(text: &str) -> Result<TopicId, RefusedRequest> {
    text.parse()
        .map_err(|_| bad_request("a topic is wanted, as ua_0_7_105"))
}

fn bad_request(why: impl std::fmt::Display) -> RefusedRequest {
    RefusedRequest(StatusCode::BAD_REQUEST, why.to_string())
}

/// Returns the outcome of a command for the log.
fn outcome(fault: Option<&OperationFault>) -> &'static str {
    match fault {
        None => "done",
        Some(OperationFault::Denied) => "denied",
        Some(OperationFault::Refused(_)) => "refused",
        Some(OperationFault::Failed(_)) => "failed",
        Some(OperationFault::Unknown(_)) => "unknown",
    }
}

fn refusal(fault: OperationFault, user: &str) -> RefusedRequest {
    match fault {
        OperationFault::Denied => {
            let why = format!("{user} has no role that permits it");
            RefusedRequest(StatusCode::FORBIDDEN, why)
        }
        OperationFault::Refused(why) => RefusedRequest(StatusCode::CONFLICT, why),
        OperationFault::Failed(why) => RefusedRequest(StatusCode::BAD_GATEWAY, why),
        OperationFault::Unknown(why) => {
            let why = format!("the outcome is unknown, it may have been executed: {why}");
            RefusedRequest(StatusCode::GATEWAY_TIMEOUT, why)
        }
    }
}

/// Refuses requests that the page of another site has sent. `own` is the origin of the page.
/// `media` is the media type that only scripts of the page itself send.
fn check_origin(headers: &HeaderMap, own: &str, media: &str) -> Result<(), RefusedRequest> {
    let text = |name| {
        headers
            .get(name)
            .and_then(|value: &HeaderValue| value.to_str().ok())
    };
    check_site(headers)?;
    let origin = text(ORIGIN);
    let is_own = origin.is_none_or(|origin| origin == own);
    let is_media = text(CONTENT_TYPE).is_some_and(|sent| sent.starts_with(media));
    if !is_own || !is_media {
        let why = format!("only the page itself may send this, as {media}");
        return Err(RefusedRequest::new(StatusCode::FORBIDDEN, why));
    }
    Ok(())
}

/// Checks that no page of another site has sent a request. Programs other than browsers do not name
/// a site.
fn check_site(headers: &HeaderMap) -> Result<(), RefusedRequest> {
    let site = headers.get("sec-fetch-site");
    if site.is_some_and(|site| site != "same-origin") {
        let why = "only the page itself may send this";
        return Err(RefusedRequest::new(StatusCode::FORBIDDEN, why));
    }
    Ok(())
}

async fn body<T: for<'d> Deserialize<'d>>(
    request: Request<impl RequestBody>,
) -> Result<T, RefusedRequest> {
    let bytes = bytes(request, (LARGEST_BODY, BODY_TIME)).await?;
    serde_json::from_slice(&bytes)
        .map_err(|error| RefusedRequest::new(StatusCode::BAD_REQUEST, error.to_string()))
}

/// Returns the body of a request, if it has at most `most` bytes and arrives in time.
async fn bytes(
    request: Request<impl RequestBody>,
    (most, limit): (usize, Duration),
) -> Result<Bytes, RefusedRequest> {
    let limited = Limited::new(request.into_body(), most);
    match tokio::time::timeout(limit, limited.collect()).await {
        Ok(Ok(body)) => Ok(body.to_bytes()),
        Ok(Err(error)) => Err(RefusedRequest::new(
            StatusCode::PAYLOAD_TOO_LARGE,
            error.to_string(),
        )),
        Err(_) => Err(RefusedRequest::new(
            StatusCode::REQUEST_TIMEOUT,
            "the request has not arrived",
        )),
    }
}

/// Returns a random token in hexadecimal.
fn random() -> std::io::Result<String> {
    let mut bytes = [0; 32];
    File::open(RANDOM)?.read_exact(&mut bytes)?;
    Ok(bytes.iter().map(|byte| format!("{byte:02x}")).collect())
}

/// Headers that proxies add.
const FORWARDED: [&str; 4] = ["forwarded", "x-forwarded-for", "x-real-ip", "via"];
const RANDOM: &str = "/dev/urandom";
const LARGEST_BODY: usize = 64 << 10;
const BODY_TIME: Duration = Duration::from_secs(5);
const JSON: &str = "application/json";

#[cfg(test)]
mod tests;
