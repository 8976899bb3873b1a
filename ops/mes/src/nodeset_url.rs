//! NodeSets by their namespaces from a URL that the YAML names: a template with `{uri}`, or an
//! index in JSON.

use std::collections::BTreeMap;
use std::fmt;
use std::str::FromStr;
use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use http_client::header::{ACCEPT, AUTHORIZATION, InvalidHeaderValue};
use http_client::{
    HttpHost, HttpLimits, HttpUrl, HttpUrlError, Request, RequestError, StatusCode, TlsError,
};
use knowledge::nodeset::{self, NodeSetContents, NodeSetReadFault};
use thiserror::Error;
use tokio::task::{JoinError, spawn_blocking};
use uri_text::escaped;

/// A URL of NodeSets. As text it has neither its query nor its user and password.
#[derive(Clone, PartialEq, Eq)]
pub(crate) struct NodeSetUrl {
    text: String,
    url: HttpUrl,
    form: NodeSetUrlForm,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum NodeSetUrlForm {
    /// The URL of a NodeSet, in which `{uri}` is its namespace, escaped.
    Template,
    /// The URL of a JSON object with the URLs of NodeSets by their namespaces.
    Index,
}

/// The reason why a text is no [`NodeSetUrl`].
#[derive(Debug, Clone, PartialEq, Eq, Error)]
pub(crate) enum NodeSetUrlError {
    #[error(transparent)]
    Url(#[from] HttpUrlError),
    #[error("the URL has a brace that is not of {{uri}}, the only placeholder; escape it as %7B")]
    Placeholder,
    #[error(
        "the URL has no {{uri}} for the namespace, as http://host/{{uri}}.xml, and is no index, \
         whose path ends with .json"
    )]
    NoForm,
}

/// The reason why a NodeSet is not fetched.
#[derive(Debug, Error)]
pub(crate) enum NodeSetFetchError {
    #[error("the namespace has {0} bytes as a part of a URL, more than {LONGEST_NAME}")]
    LongName(usize),
    #[error("there is no connection: {0}")]
    Tls(#[from] TlsError),
    #[error(transparent)]
    Request(#[from] RequestError),
    #[error("the user of the URL is too long: {0}")]
    User(#[from] InvalidHeaderValue),
    #[error("the path of the URL cannot be requested: {0}")]
    Target(String),
    #[error("the response is {0}, a redirection, which is not followed; name its target")]
    Redirect(StatusCode),
    #[error("the response is {0}")]
    Status(StatusCode),
    #[error("the index is no JSON object with the URLs of NodeSets by their namespaces: {0}")]
    Index(#[from] serde_json::Error),
    #[error("the index does not have it; add it with the URL of its file")]
    NotInIndex,
    #[error("the index names `{name}`: {error}")]
    IndexedUrl { name: String, error: HttpUrlError },
    #[error("the index names {0}, which is at another host, port or scheme; give a path")]
    OtherOrigin(HttpUrl),
    #[error("the file cannot be decoded: {0}")]
    Encoding(String),
    #[error("the file cannot be read: {0}")]
    Read(#[from] NodeSetReadFault),
    #[error("the file is the NodeSet of {0}")]
    OtherModel(String),
    #[error("the program ends: {0}")]
    Ended(#[from] JoinError),
}

impl NodeSetFetchError {
    /// Returns whether the file may be fetched later.
    pub(crate) fn is_transient(&self) -> bool {
        match self {
            Self::Request(_) => true,
            Self::Status(status) => status.is_server_error(),
            Self::LongName(_)
            | Self::Tls(_)
            | Self::User(_)
            | Self::Target(_)
            | Self::Redirect(_)
            | Self::Index(_)
            | Self::NotInIndex
            | Self::IndexedUrl { .. }
            | Self::OtherOrigin(_)
            | Self::Encoding(_)
            | Self::Read(_)
            | Self::OtherModel(_)
            | Self::Ended(_) => false,
        }
    }
}

impl NodeSetUrl {
    /// Returns the name of a folder for the files of this URL, which is that of its host.
    pub(crate) fn folder_name(&self) -> String {
        escaped(&self.url.address())
    }
}

impl FromStr for NodeSetUrl {
    type Err = NodeSetUrlError;

    fn from_str(text: &str) -> Result<Self, NodeSetUrlError> {
        let url: HttpUrl = text.parse()?;
        let target = url.target();
        if target.replace(NAMESPACE, "").contains(['{', '}']) {
            return Err(NodeSetUrlError::Placeholder);
        }
        let (path, _query) = target.split_once('?').unwrap_or((target, ""));
        let form = match target.contains(NAMESPACE) {
            true => NodeSetUrlForm::Template,
            false if path.ends_with(".json") => NodeSetUrlForm::Index,
            false => return Err(NodeSetUrlError::NoForm),
        };
        Ok(Self {
            text: text.to_owned(),
            url,
            form,
        })
    }
}

impl fmt::Display for NodeSetUrl {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.url.fmt(f)
    }
}

impl fmt::Debug for NodeSetUrl {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.url.fmt(f)
    }
}

/// Fetches NodeSets, and the index at most once.
#[derive(Debug)]
pub(crate) struct NodeSetFetcher {
    url: Arc<NodeSetUrl>,
    /// The URLs of the index, by their namespaces.
    index: Option<BTreeMap<String, String>>,
}

impl NodeSetFetcher {
    pub(crate) const fn new(url: Arc<NodeSetUrl>) -> Self {
        Self { url, index: None }
    }

    pub(crate) const fn url(&self) -> &Arc<NodeSetUrl> {
        &self.url
    }

    /// Fetches the file of a namespace.
    ///
    /// # Errors
    /// [`NodeSetFetchError`].
    pub(crate) async fn fetch(&mut self, namespace: &str) -> Result<Bytes, NodeSetFetchError> {
        let name = file_name(namespace)?;
        let url = match self.url.form {
            NodeSetUrlForm::Template => {
                let text = self.url.text.replace(NAMESPACE, &name);
                let url = text.parse();
                url.map_err(|error: HttpUrlError| NodeSetFetchError::Target(error.to_string()))?
            }
            NodeSetUrlForm::Index => {
                let index = match self.index.take() {
                    Some(index) => index,
                    None => {
                        serde_json::from_slice(&get(self.url.url.clone(), LARGEST_INDEX).await?)?
                    }
                };
                let index = self.index.insert(index);
                self.url.indexed(index, namespace)?
            }
        };
        get(url, LARGEST).await
    }
}

impl NodeSetUrl {
    /// Returns the URL of a namespace in the index.
    fn indexed(
        &self,
        index: &BTreeMap<String, String>,
        namespace: &str,
    ) -> Result<HttpUrl, NodeSetFetchError> {
        let name = index.get(namespace).ok_or(NodeSetFetchError::NotInIndex)?;
        let url = self.url.join(name);
        let url = url.map_err(|error| NodeSetFetchError::IndexedUrl {
            name: name.chars().take(SHOWN).collect(),
            error,
        })?;
        match url.has_origin_of(&self.url) {
            true => Ok(url),
            false => Err(NodeSetFetchError::OtherOrigin(url)),
        }
    }
}

/// Returns a namespace as a part of a URL, and as the name of a file without its ending.
///
/// # Errors
/// [`NodeSetFetchError::LongName`].
pub(crate) fn file_name(namespace: &str) -> Result<String, NodeSetFetchError> {
    let name = escaped(namespace);
    match name.len() {
        length if length > LONGEST_NAME => Err(NodeSetFetchError::LongName(length)),
        _ => Ok(name),
    }
}

/// Reads the NodeSet of a namespace.
///
/// # Errors
/// The file is no NodeSet, or that of another namespace.
pub(crate) fn read(bytes: &[u8], namespace: &str) -> Result<NodeSetContents, NodeSetFetchError> {
    let text = xml_text::decode(bytes);
    let text = text.map_err(|error| NodeSetFetchError::Encoding(error.to_string()))?;
    let read = nodeset::read(&text)?;
    if read.model.namespace != namespace {
        let other = read.model.namespace.chars().take(SHOWN).collect();
        return Err(NodeSetFetchError::OtherModel(other));
    }
    Ok(read)
}

/// Fetches a file of at most `most` bytes.
async fn get(url: HttpUrl, most: usize) -> Result<Bytes, NodeSetFetchError> {
    let mut request = Request::get(url.target()).header(ACCEPT, ACCEPTED);
    if let Some(user) = url.authorization()? {
        request = request.header(AUTHORIZATION, user);
    }
    let request = request.body(Bytes::new());
    let request = request.map_err(|error| NodeSetFetchError::Target(error.to_string()))?;
    // The file of the authorities is read.
    let host = spawn_blocking(move || HttpHost::of(&url)).await??;
    let limits = HttpLimits {
        within: WITHIN,
        most,
    };
    let response = host.send(request, limits).await?;
    match response.status() {
        StatusCode::OK => Ok(response.into_body()),
        status if status.is_redirection() => Err(NodeSetFetchError::Redirect(status)),
        status => Err(NodeSetFetchError::Status(status)),
    }
}

/// The placeholder for a namespace.
const NAMESPACE: &str = "{uri}";
const ACCEPTED: &str = "application/xml, text/xml, application/json, */*;q=0.1";
/// Time limit for a file.
const WITHIN: Duration = Duration::from_secs(30);
/// Maximum size of a file in bytes.
const LARGEST: usize = 32 << 20;
/// Maximum size of an index in bytes.
const LARGEST_INDEX: usize = 1 << 20;
/// Maximum size of an escaped namespace in bytes, which is the name of a file too.
const LONGEST_NAME: usize = 240;
/// Number of characters of a wrong name that a message shows.
const SHOWN: usize = 200;

#[cfg(test)]
mod tests {
    use super::*;

    fn url(text: &str) -> NodeSetUrl {
        text.parse().unwrap()
    }

    #[test]
    fn a_url_is_a_template_or_an_index() {
        for (text, form) in [
            ("http://h/{uri}.xml", NodeSetUrlForm::Template),
            ("https://h/find?of={uri}&v=2", NodeSetUrlForm::Template),
            ("http://h/sets/index.json?key=1", NodeSetUrlForm::Index),
        ] {
            assert_eq!(url(text).form, form, "{text}");
        }
        for (text, expected) in [
            ("ftp://h/{uri}", NodeSetUrlError::Url(HttpUrlError::Scheme)),
            ("http://h/sets/", NodeSetUrlError::NoForm),
            ("http://h/sets?a.json", NodeSetUrlError::NoForm),
            ("http://h/{uri}/{version}", NodeSetUrlError::Placeholder),
            ("http://h/{namespace}.json", NodeSetUrlError::Placeholder),
        ] {
            assert_eq!(text.parse::<NodeSetUrl>(), Err(expected), "{text}");
        }
        let host = "http://{uri}/a.json".parse::<NodeSetUrl>();
        assert!(matches!(host, Err(NodeSetUrlError::Url(_))), "{host:?}");
    }

    #[test]
    fn an_index_names_files_of_its_own_host_only() {
        let url = url("http://u:p@h/sets/index.json");
        let index = [
            ("urn:a", "a.xml"),
            ("urn:b", "http://other/b.xml"),
            ("urn:c", "https://h/c.xml"),
            ("urn:d", "d d.xml"),
        ];
        let index = index.map(|(namespace, name)| (namespace.to_owned(), name.to_owned()));
        let index = BTreeMap::from(index);
        let of = |namespace: &str| url.indexed(&index, namespace);
        assert_eq!(of("urn:a").unwrap().target(), "/sets/a.xml");
        for namespace in ["urn:b", "urn:c"] {
            let error = of(namespace).unwrap_err();
            assert!(
                matches!(error, NodeSetFetchError::OtherOrigin(_)),
                "{error}"
            );
        }
        let error = of("urn:d").unwrap_err().to_string();
        assert!(error.starts_with("the index names `d d.xml`"), "{error}");
        let error = of("urn:e").unwrap_err();
        assert!(matches!(error, NodeSetFetchError::NotInIndex), "{error}");
    }

    #[test]
    fn a_file_must_be_the_nodeset_of_its_namespace() {
        let text = "<UANodeSet><Models><Model ModelUri=\"urn:a\"/></Models></UANodeSet>";
        assert!(read(text.as_bytes(), "urn:a").is_ok());
        let error = read(text.as_bytes(), "urn:b").unwrap_err();
        assert!(matches!(error, NodeSetFetchError::OtherModel(of) if of == "urn:a"));
        let error = read(b"<html></html>", "urn:a").unwrap_err();
        assert!(matches!(error, NodeSetFetchError::Read(_)), "{error}");
    }

    #[test]
    fn a_long_namespace_is_neither_requested_nor_a_file() {
        assert_eq!(file_name("urn:a/b").unwrap(), "urn%3Aa%2Fb");
        assert!(file_name(&"a".repeat(LONGEST_NAME)).is_ok());
        let error = file_name(&"/".repeat(LONGEST_NAME / 3 + 1)).unwrap_err();
        assert!(matches!(error, NodeSetFetchError::LongName(243)), "{error}");
    }
}
