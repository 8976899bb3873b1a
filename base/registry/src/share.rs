//! Selects the entry of a full table that is displaced by a new entry.
//!
//! Any host on the network can announce names, and any program of the host can register servers. A
//! table therefore has a share for each endpoint and for each sender, and unverified entries are
//! displaced first.

use std::collections::HashMap;
use std::time::{Duration, Instant};

/// The properties of an entry that decide about its displacement.
#[derive(Debug)]
pub(crate) struct ShareEntry<'e> {
    /// The name of the entry.
    pub(crate) key: &'e str,
    /// Host and port of its endpoint.
    pub(crate) place: &'e str,
    /// The address that counts as its sender.
    pub(crate) sender: &'e str,
    /// The order of arrival, and its time.
    pub(crate) arrival: (u64, Instant),
    /// Whether it is registered by a certificate.
    pub(crate) is_certified: bool,
    /// Whether its endpoint has answered.
    pub(crate) is_live: bool,
}

/// A new entry.
#[derive(Debug)]
pub(crate) struct Newcomer<'e> {
    pub(crate) place: &'e str,
    pub(crate) sender: &'e str,
}

/// Decision about a new entry.
#[derive(Debug, PartialEq, Eq)]
pub(crate) enum AdmissionVerdict {
    /// The entry is accepted.
    Room,
    /// The entry is accepted and displaces this entry.
    InsteadOf(String),
    /// The new entry is refused.
    Full,
}

/// Decides on a new entry of a table of at most `most`.
pub(crate) fn admit(
    entries: &[ShareEntry<'_>],
    newcomer: &Newcomer<'_>,
    most: usize,
    now: Instant,
) -> AdmissionVerdict {
    let at_place = entries
        .iter()
        .filter(|entry| entry.place == newcomer.place && !entry.is_certified)
        .count();
    let is_nearly_full = entries.len() >= most - most / 4;
    if at_place < PLACE_SHARE && !is_nearly_full {
        return AdmissionVerdict::Room;
    }
    // The first entry of a live endpoint is verified; further names of the endpoint are not.
    let mut firsts: HashMap<&str, u64> = HashMap::new();
    let mut senders: HashMap<&str, usize> = HashMap::new();
    for entry in entries {
        let first = firsts.entry(entry.place).or_insert(entry.arrival.0);
        *first = entry.arrival.0.min(*first);
        *senders.entry(entry.sender).or_default() += 1;
    }
    let is_kept = |entry: &&ShareEntry<'_>| {
        let is_first = firsts.get(entry.place) == Some(&entry.arrival.0);
        entry.is_certified || (entry.is_live && is_first)
    };
    let oldest = |wanted: &dyn Fn(&ShareEntry<'_>) -> bool| {
        let unverified = entries.iter().filter(|entry| !is_kept(entry));
        let oldest = unverified
            .filter(|entry| wanted(entry))
            .min_by_key(|entry| entry.arrival.0);
        oldest.map(|entry| (entry.key.to_owned(), entry.arrival.1))
    };
    let instead = |found: Option<(String, Instant)>| {
        found.map_or(AdmissionVerdict::Full, |(key, _)| {
            AdmissionVerdict::InsteadOf(key)
        })
    };
    if at_place >= PLACE_SHARE {
        // A flood of names for an endpoint exchanges them slowly.
        let found = oldest(&|entry| entry.place == newcomer.place);
        return instead(found.filter(|(_, since)| now.duration_since(*since) >= EXCHANGE_AFTER));
    }
    let own = senders.get(newcomer.sender).copied().unwrap_or_default();
    if entries.len() < most {
        return if own >= most / 2 {
            instead(oldest(&|entry| entry.sender == newcomer.sender))
        } else {
            AdmissionVerdict::Room
        };
    }
    // The sender with the largest share loses an entry.
    let largest = entries
        .iter()
        .filter(|entry| !is_kept(entry))
        .map(|entry| senders.get(entry.sender).copied().unwrap_or_default())
        .max();
    instead(oldest(&|entry| {
        senders.get(entry.sender).copied() == largest
    }))
}

/// Maximum number of entries without a certificate for an endpoint.
const PLACE_SHARE: usize = 16;
/// Minimum time for which an entry of an endpoint stays.
const EXCHANGE_AFTER: Duration = Duration::from_secs(2);

#[cfg(test)]
mod tests {
    #![expect(
        clippy::disallowed_methods,
        reason = "a test needs some instant to count from"
    )]
    use super::*;

    fn entry(key: &str, place: &str, number: u64, since: Instant) -> ShareEntry<'static> {
        let leak = |text: &str| -> &'static str { Box::leak(text.to_owned().into_boxed_str()) };
        ShareEntry {
            key: leak(key),
            place: leak(place),
            sender: leak(place.split(':').next().unwrap()),
            arrival: (number, since),
            is_certified: false,
            is_live: false,
        }
    }

    fn new(place: &str) -> Newcomer<'_> {
        Newcomer {
            place,
            sender: place.split(':').next().unwrap(),
        }
    }

    #[test]
    fn the_oldest_unverified_entry_of_the_largest_sender_gives_way() {
        let now = Instant::now();
        let mut all = vec![
            entry("live", "a:0", 1, now),
            entry("certified", "a:1", 2, now),
            entry("other", "b:1", 3, now),
        ];
        all[0].is_live = true;
        all[1].is_certified = true;
        for number in 4..=8 {
            all.push(entry(
                &format!("forged {number}"),
                &format!("a:{number}"),
                number,
                now,
            ));
        }
        let verdict = admit(&all, &new("c:1"), 8, now);
        assert_eq!(verdict, AdmissionVerdict::InsteadOf("forged 4".to_owned()));
        all.truncate(2);
        assert_eq!(admit(&all, &new("c:1"), 2, now), AdmissionVerdict::Full);
    }

    #[test]
    fn one_sender_leaves_a_quarter_of_the_table_to_others() {
        let now = Instant::now();
        let mut all: Vec<ShareEntry<'_>> = (0..12)
            .map(|number| entry(&number.to_string(), &format!("a:{number}"), number, now))
            .collect();
        all.iter_mut().for_each(|one| one.is_live = true);
        assert_eq!(admit(&all, &new("a:99"), 16, now), AdmissionVerdict::Full);
        assert_eq!(admit(&all, &new("b:1"), 16, now), AdmissionVerdict::Room);
    }

    #[test]
    fn names_of_one_endpoint_exchange_slowly_and_never_the_first() {
        let now = Instant::now();
        let mut all: Vec<ShareEntry<'_>> = (0..16)
            .map(|number| entry(&number.to_string(), "a:1", number, now))
            .collect();
        all[0].is_live = true;
        assert_eq!(admit(&all, &new("a:1"), 1024, now), AdmissionVerdict::Full);
        let later = now + EXCHANGE_AFTER;
        let verdict = admit(&all, &new("a:1"), 1024, later);
        assert_eq!(verdict, AdmissionVerdict::InsteadOf("1".to_owned()));
        assert_eq!(admit(&all, &new("a:2"), 1024, now), AdmissionVerdict::Room);
    }
}
