//! The namespace numbers and names of discovered servers in the space.

use std::collections::{BTreeMap, BTreeSet};
use std::ops::RangeInclusive;

/// The namespace number and the name of a server.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct ServerNumber {
    pub(super) namespace: u16,
    pub(super) name: String,
}

/// The assigned numbers, by ApplicationUri. An offline server keeps its number as long as other
/// numbers are free.
#[derive(Debug, Default)]
pub(super) struct ServerNumbers {
    given: BTreeMap<String, ServerNumber>,
}

/// The available numbers and the names in use.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(super) struct FreeNumbers {
    /// The range of namespace numbers, or `None` if no servers are to be found.
    pub(super) namespaces: Option<RangeInclusive<u16>>,
    /// Namespace numbers that are reserved, with their ApplicationUris.
    pub(super) kept: BTreeMap<u16, String>,
    /// Names that are in use by other servers.
    pub(super) named: BTreeSet<String>,
}

impl ServerNumbers {
    /// Returns the number and the name of a server. The number is reserved for the server, or is
    /// its previous number. A new server gets the number that follows from its ApplicationUri, so
    /// that it is the same after a restart, or else the next free number. `there` are the
    /// ApplicationUris of the servers that are online. Returns `None` if these use all numbers.
    pub(super) fn give(
        &mut self,
        application_uri: &str,
        room: &FreeNumbers,
        there: &BTreeSet<String>,
    ) -> Option<ServerNumber> {
        let range = room.namespaces.clone()?;
        let mut kept = room.kept.iter();
        let own = kept
            .find(|(namespace, uri)| *uri == application_uri && range.contains(namespace))
            .map(|(namespace, _)| *namespace);
        let stays = |place: &ServerNumber| {
            let fits = match own {
                Some(own) => place.namespace == own,
                None => {
                    range.contains(&place.namespace) && !room.kept.contains_key(&place.namespace)
                }
            };
            fits && !room.named.contains(&place.name)
        };
        if let Some(place) = self.given.get(application_uri).filter(|place| stays(place)) {
            return Some(place.clone());
        }
        self.given.remove(application_uri);
        let namespace = match own {
            Some(own) => own,
            None => self.free(application_uri, (&range, room), there)?,
        };
        // The previous owner is offline, or has a reserved number.
        self.given.retain(|_, place| place.namespace != namespace);
        let name = self.name(application_uri, namespace, &room.named);
        let place = ServerNumber { namespace, name };
        self.given.insert(application_uri.to_owned(), place.clone());
        Some(place)
    }

    fn free(
        &self,
        application_uri: &str,
        (range, room): (&RangeInclusive<u16>, &FreeNumbers),
        there: &BTreeSet<String>,
    ) -> Option<u16> {
        let open = range.clone().filter(|one| !room.kept.contains_key(one));
        let open: Vec<u16> = open.collect();
        let first = usize::try_from(hash(application_uri)).unwrap_or_default() % open.len().max(1);
        let order = || open.iter().skip(first).chain(open.iter().take(first));
        let has = |namespace: u16, who: &dyn Fn(&String) -> bool| {
            let mut given = self.given.iter();
            given.any(|(uri, place)| place.namespace == namespace && who(uri))
        };
        let unused = order().find(|one| !has(**one, &|_| true));
        let left = || order().find(|one| !has(**one, &|uri| there.contains(uri)));
        unused.or_else(left).copied()
    }

    /// Returns the last part of the ApplicationUri. The namespace number is appended if another
    /// server has that name.
    fn name(&self, application_uri: &str, namespace: u16, named: &BTreeSet<String>) -> String {
        let plain = |c: char| c.is_ascii_alphanumeric() || c == '_' || c == '-';
        let mut parts = application_uri.rsplit([':', '/']);
        let last = parts.find(|part| part.contains(plain));
        let name: String = last
            .unwrap_or("server")
            .chars()
            .map(|c| if plain(c) { c } else { '_' })
            .take(MOST_NAME)
            .collect();
        let is_taken = named.contains(&name) || self.given.values().any(|place| place.name == name);
        if is_taken {
            format!("{name}-{namespace}")
        } else {
            name
        }
    }
}

/// Returns the FNV-1a hash of a text.
fn hash(text: &str) -> u32 {
    let step = |hash: u32, byte: u8| (hash ^ u32::from(byte)).wrapping_mul(0x0100_0193);
    text.bytes().fold(0x811c_9dc5, step)
}

/// Largest length of a name, in characters.
const MOST_NAME: usize = 48;

#[cfg(test)]
mod tests {
    use super::*;

    fn room(range: RangeInclusive<u16>, kept: &[(u16, &str)]) -> FreeNumbers {
        FreeNumbers {
            namespaces: Some(range),
            kept: kept
                .iter()
                .map(|(namespace, uri)| (*namespace, (*uri).to_owned()))
                .collect(),
            named: BTreeSet::from(["press".to_owned()]),
        }
    }

    fn there(uris: &[&str]) -> BTreeSet<String> {
        uris.iter().map(|uri| (*uri).to_owned()).collect()
    }

    #[test]
    fn a_place_is_the_same_in_every_order_and_that_of_whoever_it_is_kept_for() {
        let room = room(40..=47, &[(44, "urn:v:oven"), (90, "urn:v:belt")]);
        let all = there(&["urn:v:oven", "urn:v:belt", "urn:v:saw"]);
        let given = |order: &[&str]| {
            let mut places = ServerNumbers::default();
            let mut given: Vec<(String, u16)> = order
                .iter()
                .map(|uri| {
                    let place = places.give(uri, &room, &all).unwrap();
                    ((*uri).to_owned(), place.namespace)
                })
                .collect();
            given.sort();
            given
        };
        let first = given(&["urn:v:oven", "urn:v:belt", "urn:v:saw"]);
        assert_eq!(first, given(&["urn:v:saw", "urn:v:belt", "urn:v:oven"]));
        let numbers: BTreeSet<u16> = first.iter().map(|(_, namespace)| *namespace).collect();
        assert_eq!(numbers.len(), 3);
        assert!(numbers.iter().all(|one| (40..=47).contains(one)));
        assert!(first.contains(&("urn:v:oven".to_owned(), 44)));
    }

    #[test]
    fn whoever_is_away_gives_way_and_who_is_there_does_not() {
        let room = room(40..=41, &[]);
        let mut places = ServerNumbers::default();
        let all = there(&["urn:a", "urn:b", "urn:c"]);
        let a = places.give("urn:a", &room, &all).unwrap();
        let b = places.give("urn:b", &room, &all).unwrap();
        assert_ne!(a.namespace, b.namespace);
        assert_eq!(places.give("urn:c", &room, &all), None);
        assert_eq!(places.give("urn:a", &room, &all), Some(a));
        let c = places.give("urn:c", &room, &there(&["urn:a", "urn:c"]));
        assert_eq!(c.unwrap().namespace, b.namespace);
    }

    #[test]
    fn names_are_the_last_part_and_none_is_that_of_another() {
        let room = room(40..=47, &[]);
        let mut places = ServerNumbers::default();
        let mut name = |uri: &str| {
            let place = places.give(uri, &room, &BTreeSet::new()).unwrap();
            (place.name, place.namespace)
        };
        assert_eq!(name("urn:cell:OPC UA:Saw.1").0, "Saw_1");
        assert_eq!(name("http://vendor/oven/").0, "oven");
        let (press, namespace) = name("urn:vendor:press");
        assert_eq!(press, format!("press-{namespace}"));
        let (oven, namespace) = name("urn:other:oven");
        assert_eq!(oven, format!("oven-{namespace}"));
    }
}
