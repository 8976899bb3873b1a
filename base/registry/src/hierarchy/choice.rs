//! The selection of a discovery server.

use std::fmt;
use std::str::FromStr;

/// Selection of a discovery server.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum ServerChoice {
    /// The only discovery server of the network.
    Any,
    /// The discovery server at this URL, announced or not.
    At(String),
    /// By its ApplicationUri.
    Uri(NamePattern),
    /// By its mDNS instance name.
    Name(NamePattern),
    /// The discovery server with this node in its address space, such as `nsu=urn:cell;s=Marker`.
    Marker(String),
}

/// A text, or a prefix.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct NamePattern {
    text: String,
    is_prefix: bool,
}

/// Error for an invalid choice.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error(
    "`{0}` does not select a discovery server: give an opc.tcp:// URL, any, uri=<ApplicationUri>, \
     name=<mDNS name> (both may end with *) or node=<NodeId>"
)]
pub struct ChoiceFault(String);

/// An available discovery server.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ServerCandidate {
    /// Its mDNS instance name.
    pub name: String,
    /// Its URL.
    pub url: String,
    /// Its ApplicationUri; `None` if unknown.
    pub application_uri: Option<String>,
    /// Whether it has the node of [`ServerChoice::Marker`].
    pub is_marked: bool,
}

/// Result of a choice.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum ChosenServer {
    /// No candidate matches.
    Nobody,
    /// URL of the selected discovery server.
    At(String),
    /// Names of several matching candidates, of which only one may be meant.
    Several(Vec<String>),
}

impl ServerChoice {
    /// Selects a candidate. A discovery server with several addresses counts once, and is used at
    /// the first of its addresses.
    #[must_use]
    pub fn among(&self, candidates: &[ServerCandidate]) -> ChosenServer {
        if let Self::At(url) = self {
            return ChosenServer::At(url.clone());
        }
        let mut fit: Vec<&ServerCandidate> =
            candidates.iter().filter(|one| self.fits(one)).collect();
        fit.sort_by(|a, b| a.url.cmp(&b.url));
        let Some(first) = fit.first() else {
            return ChosenServer::Nobody;
        };
        let same = |one: &&&ServerCandidate| {
            one.url == first.url
                || (one.application_uri.is_some() && one.application_uri == first.application_uri)
        };
        if fit.iter().all(|one| same(&one)) {
            return ChosenServer::At(first.url.clone());
        }
        let mut names: Vec<String> = fit.iter().map(|one| one.name.clone()).collect();
        names.sort();
        ChosenServer::Several(names)
    }

    fn fits(&self, candidate: &ServerCandidate) -> bool {
        match self {
            Self::Any => true,
            Self::At(url) => candidate.url == *url,
            Self::Uri(pattern) => {
                let uri = candidate.application_uri.as_deref();
                uri.is_some_and(|uri| pattern.fits(uri))
            }
            Self::Name(pattern) => pattern.fits(&candidate.name),
            Self::Marker(_) => candidate.is_marked,
        }
    }
}

impl NamePattern {
    fn parse(text: &str) -> Option<Self> {
        let (text, is_prefix) = match text.strip_suffix('*') {
            Some(prefix) => (prefix, true),
            None => (text, false),
        };
        (!text.is_empty()).then(|| Self {
            text: text.to_owned(),
            is_prefix,
        })
    }

    fn fits(&self, text: &str) -> bool {
        if self.is_prefix {
            text.starts_with(&self.text)
        } else {
            text == self.text
        }
    }
}

impl FromStr for ServerChoice {
    type Err = ChoiceFault;

    fn from_str(text: &str) -> Result<Self, ChoiceFault> {
        let strange = text
            .chars()
            .any(|letter| letter.is_control() || letter.is_whitespace());
        let known = match text.split_once('=') {
            _ if strange || text.len() > MOST_TEXT => None,
            _ if text == "any" => Some(Self::Any),
            _ if text.starts_with("opc.tcp://") => Some(Self::At(text.to_owned())),
            Some(("uri", pattern)) => NamePattern::parse(pattern).map(Self::Uri),
            Some(("name", pattern)) => NamePattern::parse(pattern).map(Self::Name),
            Some(("node", node)) if !node.is_empty() => Some(Self::Marker(node.to_owned())),
            Some(_) | None => None,
        };
        known.ok_or_else(|| ChoiceFault(text.chars().take(80).collect()))
    }
}

impl fmt::Display for ServerChoice {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Any => f.write_str("any"),
            Self::At(url) => f.write_str(url),
            Self::Uri(pattern) => write!(f, "uri={pattern}"),
            Self::Name(pattern) => write!(f, "name={pattern}"),
            Self::Marker(node) => write!(f, "node={node}"),
        }
    }
}

impl fmt::Display for NamePattern {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { text, is_prefix } = self;
        write!(f, "{text}{}", if *is_prefix { "*" } else { "" })
    }
}

const MOST_TEXT: usize = 1024;

#[cfg(test)]
mod tests {
    use super::*;

    fn candidate(name: &str, url: &str, uri: Option<&str>) -> ServerCandidate {
        ServerCandidate {
            name: name.to_owned(),
            url: url.to_owned(),
            application_uri: uri.map(str::to_owned),
            is_marked: name == "marked",
        }
    }

    fn chosen(choice: &str, candidates: &[ServerCandidate]) -> ChosenServer {
        choice.parse::<ServerChoice>().unwrap().among(candidates)
    }

    #[test]
    fn of_several_discovery_servers_the_one_that_is_meant_is_taken() {
        let all = [
            candidate("cell-lds", "opc.tcp://10.0.0.9:4840", Some("urn:cell:lds")),
            candidate("marked", "opc.tcp://10.0.0.8:4840", Some("urn:station:a")),
            candidate("mute", "opc.tcp://10.0.0.7:4840", None),
        ];
        let at = |url: &str| ChosenServer::At(format!("opc.tcp://10.0.0.{url}:4840"));
        for (choice, wanted) in [
            ("uri=urn:cell:lds", at("9")),
            ("uri=urn:cell:*", at("9")),
            ("name=mute", at("7")),
            ("name=cell*", at("9")),
            ("node=nsu=urn:cell;s=Marker", at("8")),
            ("opc.tcp://10.0.0.7:4840", at("7")),
            ("uri=urn:cell:ld", ChosenServer::Nobody),
            (
                "opc.tcp://10.0.0.1:1",
                ChosenServer::At("opc.tcp://10.0.0.1:1".to_owned()),
            ),
        ] {
            assert_eq!(chosen(choice, &all), wanted, "{choice}");
        }
        let names = ["cell-lds", "marked", "mute"].map(str::to_owned);
        assert_eq!(chosen("any", &all), ChosenServer::Several(names.to_vec()));
        assert_eq!(chosen("any", &all[..1]), at("9"));
        assert_eq!(chosen("any", &[]), ChosenServer::Nobody);
    }

    #[test]
    fn one_that_is_heard_of_at_two_addresses_is_one() {
        let both = [
            candidate("lds (2)", "opc.tcp://10.0.1.1:4840", Some("urn:lds")),
            candidate("lds", "opc.tcp://10.0.0.1:4840", Some("urn:lds")),
        ];
        assert_eq!(
            chosen("any", &both),
            ChosenServer::At("opc.tcp://10.0.0.1:4840".to_owned())
        );
        let unknown = both.map(|one| ServerCandidate {
            application_uri: None,
            ..one
        });
        assert!(matches!(chosen("any", &unknown), ChosenServer::Several(_)));
    }

    #[test]
    fn choices_are_written_as_they_are_read_and_others_are_refused() {
        for text in [
            "any",
            "opc.tcp://h:1/",
            "uri=urn:a",
            "uri=urn:*",
            "name=n*",
            "node=i=7",
        ] {
            assert_eq!(text.parse::<ServerChoice>().unwrap().to_string(), text);
        }
        for text in [
            "", "some", "uri=", "uri=*", "name=", "node=", "name=a b", "uri=a\n", "http://h",
        ] {
            assert!(text.parse::<ServerChoice>().is_err(), "{text:?}");
        }
    }
}
