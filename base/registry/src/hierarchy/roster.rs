//! Who is on a level, whoever tells of it: a server may be registered, announced by itself, and announced by others.

use std::collections::BTreeMap;

/// What has changed.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Change {
    /// Somebody is at this URL.
    Joined(String),
    /// Nobody is there any more.
    Left(String),
}

/// The servers of a level by who tells of them. URLs that differ by a slash at the end alone are one.
#[derive(Debug)]
pub struct Roster {
    told: BTreeMap<String, String>,
    most: usize,
}

impl Roster {
    /// Nobody is there. No more than `most` are taken in.
    #[must_use]
    pub fn new(most: usize) -> Self {
        Self {
            told: BTreeMap::new(),
            most,
        }
    }

    /// A source, as an ApplicationUri or an mDNS name, tells of a server at a URL, and of the one before no longer.
    pub fn put(&mut self, source: &str, url: &str) -> Vec<Change> {
        let url = url.trim_end_matches('/').to_owned();
        if self.told.get(source) == Some(&url) {
            return Vec::new();
        }
        let mut changes = self.remove(source);
        if self.told.len() < self.most {
            if !self.told.values().any(|known| *known == url) {
                changes.push(Change::Joined(url.clone()));
            }
            self.told.insert(source.to_owned(), url);
        }
        changes
    }

    /// A source tells of nobody any more.
    pub fn remove(&mut self, source: &str) -> Vec<Change> {
        let Some(url) = self.told.remove(source) else {
            return Vec::new();
        };
        match self.told.values().any(|known| *known == url) {
            true => Vec::new(),
            false => vec![Change::Left(url)],
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_server_is_there_until_nobody_tells_of_it() {
        let mut roster = Roster::new(3);
        let joined = |url: &str| vec![Change::Joined(url.to_owned())];
        let left = |url: &str| vec![Change::Left(url.to_owned())];
        assert_eq!(
            roster.put("urn:arm", "opc.tcp://a:1/"),
            joined("opc.tcp://a:1")
        );
        assert!(roster.put("arm", "opc.tcp://a:1").is_empty(), "the same");
        assert!(roster.remove("urn:arm").is_empty());
        let moved = roster.put("arm", "opc.tcp://a:2");
        assert_eq!(
            moved,
            [left("opc.tcp://a:1"), joined("opc.tcp://a:2")].concat()
        );
        assert_eq!(roster.remove("arm"), left("opc.tcp://a:2"));
        assert!(roster.remove("arm").is_empty());
        for at in 0..3 {
            assert_eq!(roster.put(&at.to_string(), &format!("u{at}")).len(), 1);
        }
        assert!(roster.put("3", "u3").is_empty(), "there is no room");
    }
}
