//! The requests about the knowledge of the plant, which `ua-mes` answers: queries by every reader,
//! and files by users with the role for it.
//!
//! `ua-mes` decides about each file too. Its users may differ from those of the page: the page then
//! passes on the password that the user gives for `ua-mes`.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use bridge_node::PageBody;
use bytes::Bytes;
use hyper::header::{CONTENT_LENGTH, HeaderMap};
use hyper::{Request, Response, StatusCode, Uri};
use serde::Deserialize;
use serde_json::{Value, json};
use tokio::sync::oneshot;
use tracing::{info, warn};

use super::{RequestBody, bytes};
use crate::mes::{MesClient, MesCredentials, MesFault, SourceFile, source_kind};
use crate::operations::Operations;
use crate::page::Page;
use crate::responses::{RefusedRequest, drawing, json_page};
use crate::session::BrowserSession;
use crate::table::MOST_ROWS;
use crate::value::cut;
use crate::view::pairs;

/// The path of the named questions.
pub(super) const QUESTIONS: &str = "/knowledge/questions";
/// The path of the plan of a process.
pub(super) const PLAN: &str = "/knowledge/plan";
/// The path of the list of pictures.
pub(super) const PICTURES: &str = "/knowledge/pictures";
/// The path of a picture as a drawing.
pub(super) const PICTURE: &str = "/knowledge/picture";
/// The path of queries.
pub(super) const QUERY: &str = "/knowledge/query";
/// The path of a file that is checked.
pub(super) const CHECK: &str = "/knowledge/check";
/// The path of a file that is checked and loaded.
pub(super) const LOAD: &str = "/knowledge/load";

/// The body of a query: SPARQL, or a named question with its parameters.
#[derive(Deserialize)]
#[serde(untagged)]
pub(super) enum QueryBody {
    /// A query of SPARQL.
    Sparql { query: String },
    /// A named question.
    Named {
        question: String,
        #[serde(default)]
        parameters: BTreeMap<String, String>,
    },
}

/// Returns the media type of a request with a file as its body.
pub(super) fn media(path: &str) -> Option<&'static str> {
    matches!(path, CHECK | LOAD).then_some("application/octet-stream")
}

/// Answers with the named questions, the plan of a process, the list of pictures, or a picture.
pub(super) async fn read(page: &Page, uri: &Uri) -> Result<Response<PageBody>, RefusedRequest> {
    let _place = page
        .places
        .queries
        .try_acquire()
        .map_err(|_| busy("queries"))?;
    let mes = mes(page).await?;
    let page = match uri.path() {
        QUESTIONS => {
            let mut shown = mes.questions().await.map_err(refusal)?;
            if let Some(shown) = shown.as_object_mut() {
                shown.insert("most_rows".to_owned(), MOST_ROWS.into());
                shown.insert("largest_file".to_owned(), LARGEST_FILE.into());
            }
            shown
        }
        PICTURES => mes.pictures().await.map_err(refusal)?,
        PICTURE => {
            let picture = iri(uri, "picture")?;
            let svg = mes.picture(&picture).await.map_err(refusal)?;
            return Ok(drawing(svg));
        }
        _ => {
            let process = iri(uri, "process")?;
            mes.plan(&process).await.map_err(refusal)?
        }
    };
    Ok(json_page(&page))
}

/// Returns the IRI of a thing that a request names.
fn iri(uri: &Uri, thing: &str) -> Result<String, RefusedRequest> {
    parameter(uri, thing).ok_or_else(|| {
        let why = format!("name the {thing} as ?{thing}=IRI");
        RefusedRequest::new(StatusCode::BAD_REQUEST, why)
    })
}

/// Answers a query.
pub(super) async fn query(
    page: &Page,
    query: QueryBody,
) -> Result<Response<PageBody>, RefusedRequest> {
    let _place = page
        .places
        .queries
        .try_acquire()
        .map_err(|_| busy("queries"))?;
    let mes = mes(page).await?;
    let table = match query {
        QueryBody::Sparql { query } => mes.query(query).await,
        QueryBody::Named {
            question,
            parameters,
        } => mes.ask(&question, parameters.iter()).await,
    };
    table.map(|table| json_page(&table)).map_err(refusal)
}

/// Checks a file, and loads it if that is wanted and nothing is wrong with it. A file whose browser
/// has left before the load is checked only; each outcome is logged.
pub(super) async fn upload(
    page: &Arc<Page>,
    operations: &dyn Operations,
    session: &BrowserSession,
    request: Request<impl RequestBody>,
) -> Result<Response<PageBody>, RefusedRequest> {
    let user = session.user.as_str();
    require_role(operations, user)?;
    let loads = request.uri().path() == LOAD;
    let by = credentials(request.headers(), user)?;
    let place = Arc::clone(&page.places.files).try_acquire_owned();
    let place = place.map_err(|_| busy("files"))?;
    let file = source_file(request).await?;
    let mes = mes(page).await?;
    if !uri_text::is_loopback_host(mes.authority()) {
        let why = "ua-mes is not on this host: load the file there with ua-space source add";
        return Err(RefusedRequest::new(StatusCode::CONFLICT, why));
    }
    let (page, user) = (Arc::clone(page), user.to_owned());
    let (answer, done) = oneshot::channel();
    // The task goes on after the browser has left, so that the outcome is known.
    drop(tokio::spawn(async move {
        let _place = place;
        if loads {
            report(&user, &file, "load requested");
        }
        let loads = || loads && !answer.is_closed();
        let done = checked(&page, &mes, (&file, by.as_ref()), loads).await;
        report(&user, &file, outcome(&done));
        // The browser may have left.
        let _left = answer.send(done);
    }));
    let done = done.await.unwrap_or_else(|_| {
        let why = "the outcome is unknown: the page has failed";
        Err(RefusedRequest::new(StatusCode::GATEWAY_TIMEOUT, why))
    });
    done.map(|answer| json_page(&answer))
}

fn require_role(operations: &dyn Operations, user: &str) -> Result<(), RefusedRequest> {
    if operations.may_load(user) {
        return Ok(());
    }
    warn!(
        user,
        "refused to load a source on the page: no role engineer"
    );
    let why = format!("{user} has no role that permits it: sources need the role engineer");
    Err(RefusedRequest::new(StatusCode::FORBIDDEN, why))
}

/// Logs the check or the load of a file.
fn report(user: &str, file: &SourceFile, outcome: &str) {
    let (kind, source, size) = (file.kind, cut(&file.name, 100), file.contents.len());
    info!(
        user,
        kind, source, size, outcome, "source sent from the page"
    );
}

/// Returns the outcome of a file for the log.
fn outcome(done: &Result<Value, RefusedRequest>) -> &'static str {
    match done {
        Ok(answer) if answer["needs_password"] == true => "no user of ua-mes",
        Ok(answer) if answer["loaded"] == true => "loaded",
        Ok(answer) if answer["accepted"] == true => "checked",
        Ok(_) => "not accepted",
        Err(RefusedRequest(StatusCode::GATEWAY_TIMEOUT, _)) => "unknown",
        Err(_) => "refused",
    }
}

/// Returns the file of a request. Its name and its contents show its kind.
async fn source_file(request: Request<impl RequestBody>) -> Result<SourceFile, RefusedRequest> {
    let name = parameter(request.uri(), "name").unwrap_or_default();
    if name.is_empty() || name.len() > LONGEST_NAME {
        let why = "name the file as ?name=FILE, in at most 256 bytes";
        return Err(RefusedRequest::new(StatusCode::BAD_REQUEST, why));
    }
    let contents = file(request).await?;
    // The search of a large file would keep the thread of the program.
    let searched = (name.clone(), contents.clone());
    let kind = tokio::task::spawn_blocking(move || source_kind(&searched.0, &searched.1)).await;
    let kind = kind.ok().flatten().ok_or_else(|| {
        let why = format!(
            "`{}` is no source: send .aml, .mtp, .amlx, .ttl, .nt, .bpmn, .batchml, or .xml with a \
             NodeSet, a manifest or a recipe",
            cut(&name, 100)
        );
        RefusedRequest::new(StatusCode::BAD_REQUEST, why)
    })?;
    Ok(SourceFile {
        kind,
        name,
        contents,
    })
}

/// Checks a file, and loads it if it was accepted and `loads` is still true.
async fn checked(
    page: &Page,
    mes: &MesClient,
    (file, by): (&SourceFile, Option<&MesCredentials>),
    loads: impl Fn() -> bool,
) -> Result<Value, RefusedRequest> {
    if let Some(by) = by {
        let now = page.at().since;
        let may_try = page.sessions().may_try(&by.user, now);
        may_try.map_err(|locked| {
            RefusedRequest::new(StatusCode::TOO_MANY_REQUESTS, locked.to_string())
        })?;
        // Counted before the check, so that attempts at the same time are limited too.
        page.sessions().fail(&by.user, now);
    }
    let checked = mes.check(file, by).await;
    let is_wrong = matches!(
        &checked,
        Err(MesFault::Refused { status, .. }) if *status == StatusCode::UNAUTHORIZED
    );
    if let Some(by) = by.filter(|_| !is_wrong) {
        page.sessions().forgive(&by.user);
    }
    let mut answer = match checked {
        Ok(answer) => answer,
        Err(_) if is_wrong => {
            return Ok(json!({ "needs_password": true, "accepted": false, "loaded": false }));
        }
        Err(fault) => return Err(refusal(fault)),
    };
    let loads = answer.get("accepted") == Some(&Value::Bool(true)) && loads();
    if loads {
        mes.load(file, by).await.map_err(unknown_or_refused)?;
    }
    if let Some(answer) = answer.as_object_mut() {
        answer.insert("loaded".to_owned(), loads.into());
        answer.insert("kind".to_owned(), file.kind.into());
    }
    Ok(answer)
}

/// Returns the user of `ua-mes`: the signed-in user, with the password that the request has for it.
fn credentials(headers: &HeaderMap, user: &str) -> Result<Option<MesCredentials>, RefusedRequest> {
    let Some(given) = headers.get("x-mes-password") else {
        return Ok(None);
    };
    let decoded = STANDARD.decode(given.as_bytes()).ok();
    let password = decoded.and_then(|bytes| String::from_utf8(bytes).ok());
    let password = password.ok_or_else(|| {
        let why = "the password for ua-mes is not in base64 of UTF-8";
        RefusedRequest::new(StatusCode::BAD_REQUEST, why)
    })?;
    Ok(Some(MesCredentials {
        user: user.to_owned(),
        password,
    }))
}

/// Returns the file in a request.
async fn file(request: Request<impl RequestBody>) -> Result<Bytes, RefusedRequest> {
    let length = request.headers().get(CONTENT_LENGTH);
    let length = length.and_then(|length| length.to_str().ok()?.parse::<usize>().ok());
    let too_large = || {
        let why = format!(
            "the file has more than {} MiB: load it with ua-space source add",
            LARGEST_FILE >> 20
        );
        RefusedRequest::new(StatusCode::PAYLOAD_TOO_LARGE, why)
    };
    if length.is_some_and(|length| length > LARGEST_FILE) {
        return Err(too_large());
    }
    let read = bytes(request, (LARGEST_FILE, FILE_TIME)).await;
    read.map_err(|RefusedRequest(status, why)| match status {
        StatusCode::PAYLOAD_TOO_LARGE => too_large(),
        status => RefusedRequest(status, why),
    })
}

async fn mes(page: &Page) -> Result<MesClient, RefusedRequest> {
    page.mes().await.ok_or_else(|| {
        let why = "no ua-mes is known: name the address of its --sparql with --status URL";
        RefusedRequest::new(StatusCode::NOT_FOUND, why)
    })
}

fn parameter(uri: &Uri, name: &str) -> Option<String> {
    let pairs = pairs(uri.query().unwrap_or_default()).into_iter();
    let mut values = pairs.filter(|(key, _)| key == name);
    values.next().map(|(_, value)| value)
}

fn busy(of: &str) -> RefusedRequest {
    let why = format!("other {of} are being answered: try again in a few seconds");
    RefusedRequest::new(StatusCode::SERVICE_UNAVAILABLE, why)
}

fn refusal(fault: MesFault) -> RefusedRequest {
    let status = match &fault {
        // The user is still signed in on the page.
        MesFault::Refused { status, .. } if *status == StatusCode::UNAUTHORIZED => {
            StatusCode::FORBIDDEN
        }
        MesFault::Refused { status, .. } => *status,
        MesFault::TooLarge => StatusCode::INSUFFICIENT_STORAGE,
        MesFault::Request(_) | MesFault::Unreadable(_) | MesFault::Uri(_) | MesFault::Header(_) => {
            StatusCode::BAD_GATEWAY
        }
    };
    RefusedRequest(status, fault.to_string())
}

/// Returns the refusal of a change: without a response the change may have been made.
fn unknown_or_refused(fault: MesFault) -> RefusedRequest {
    let was_sent = match &fault {
        MesFault::Request(error) => !error.is_unsent(),
        MesFault::TooLarge => true,
        MesFault::Refused { .. }
        | MesFault::Unreadable(_)
        | MesFault::Uri(_)
        | MesFault::Header(_) => false,
    };
    if was_sent {
        let why = format!("the outcome is unknown, the file may have been loaded: {fault}");
        return RefusedRequest(StatusCode::GATEWAY_TIMEOUT, why);
    }
    refusal(fault)
}

const LARGEST_FILE: usize = 32 << 20;
const LONGEST_NAME: usize = 256;
const FILE_TIME: Duration = Duration::from_secs(60);

#[cfg(test)]
mod tests;
