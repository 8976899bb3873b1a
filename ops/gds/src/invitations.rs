//! Invitations: one-time tokens with which an application gets its first certificate without an
//! administrator.
//!
//! A token is a number that finds the invitation, and a secret of 128 random bits of which only the
//! SHA-256 is stored.

use std::time::Duration;

use plant_opcua::enrolment::Token;
use serde::{Deserialize, Serialize};
use trust::Fingerprint;

/// All invitations that may be used.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Invitations {
    all: Vec<Invited>,
}

/// An invitation.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Invited {
    pub(crate) number: String,
    /// The SHA-256 of the secret.
    hash: String,
    /// The ApplicationUri or the name of the application; `None` for any application.
    pub(crate) application: Option<String>,
    /// The last second of validity, in seconds since 1970.
    pub(crate) until: u64,
    /// The application that has used the invitation.
    pub(crate) used: Option<Used>,
}

#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Used {
    pub(crate) uri: String,
    /// The SHA-256 of the application's key.
    key: String,
}

/// An application that presents a token.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Shows<'a> {
    pub(crate) uri: &'a str,
    pub(crate) names: &'a [(String, String)],
    /// The SHA-256 of its key.
    pub(crate) key: Fingerprint,
}

/// The reason why a token is refused.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub(crate) enum Uninvited {
    #[error("unknown token of an invitation")]
    Unknown,
    #[error("the invitation has expired")]
    Expired,
    #[error("another application has used the invitation")]
    Used,
    #[error("the invitation belongs to another application")]
    Another,
}

impl Invitations {
    /// Creates an invitation from these random bytes.
    pub(crate) fn add(
        &mut self,
        random: &[u8; RANDOM],
        application: Option<String>,
        (now, life): (Duration, Duration),
    ) -> Token {
        self.all.retain(|one| one.is_kept(now));
        // The oldest invitations are dropped.
        let excess = (self.all.len() + 1).saturating_sub(MOST);
        self.all.drain(..excess);
        let (number, secret) = random.split_at(NUMBER);
        let digits =
            |bytes: &[u8]| -> String { bytes.iter().map(|byte| format!("{byte:02x}")).collect() };
        let (number, secret) = (digits(number), digits(secret));
        self.all.push(Invited {
            hash: Fingerprint::of(secret.as_bytes()).to_string(),
            application,
            until: (now + life).as_secs(),
            used: None,
            number: number.clone(),
        });
        Token::of(&format!("{number}-{secret}"))
    }

    /// Redeems an invitation and returns its number. The same key may present the token again until
    /// it expires, because the answer may have been lost.
    pub(crate) fn redeem(
        &mut self,
        token: &str,
        shows: Shows<'_>,
        now: Duration,
    ) -> Result<String, Uninvited> {
        let (number, secret) = token.split_once('-').ok_or(Uninvited::Unknown)?;
        let found = self.all.iter_mut().find(|one| {
            let hash = one.hash.parse::<Fingerprint>();
            one.number == number && hash.is_ok_and(|hash| hash.is_of_secret(secret.as_bytes()))
        });
        let invited = found.ok_or(Uninvited::Unknown)?;
        if now.as_secs() > invited.until {
            return Err(Uninvited::Expired);
        }
        let is_for = |application: &String| {
            application == shows.uri || shows.names.iter().any(|(_, name)| name == application)
        };
        if !invited.application.as_ref().is_none_or(is_for) {
            return Err(Uninvited::Another);
        }
        let used = Used {
            uri: shows.uri.to_owned(),
            key: shows.key.to_string(),
        };
        match &invited.used {
            Some(before) if *before != used => Err(Uninvited::Used),
            _ => {
                invited.used = Some(used);
                Ok(number.to_owned())
            }
        }
    }

    /// Withdraws an invitation. Returns false if there is no such invitation.
    pub(crate) fn withdraw(&mut self, number: &str) -> bool {
        let before = self.all.len();
        self.all.retain(|one| one.number != number);
        self.all.len() < before
    }

    /// Lists the invitations that have not expired.
    pub(crate) fn open(&self, now: Duration) -> impl Iterator<Item = &Invited> {
        self.all.iter().filter(move |one| one.is_kept(now))
    }
}

impl Invited {
    fn is_kept(&self, now: Duration) -> bool {
        now.as_secs() <= self.until
    }
}

/// The file of the invitations, in the folder of the authority.
pub(crate) const FILE: &str = "invitations.json";
/// Number of random bytes of a token.
pub(crate) const RANDOM: usize = NUMBER + 16;
/// Number of bytes of the token's number.
const NUMBER: usize = 4;
const MOST: usize = 1000;

#[cfg(test)]
mod tests {
    use super::*;

    const NOW: Duration = Duration::from_secs(1_795_000_000);
    const HOUR: Duration = Duration::from_secs(3600);

    fn shows<'a>(uri: &'a str, names: &'a [(String, String)], key: &str) -> Shows<'a> {
        let key = Fingerprint::of(key.as_bytes());
        Shows { uri, names, key }
    }

    #[test]
    fn a_token_is_used_by_one_key_and_its_secret_is_not_stored() {
        let mut all = Invitations::default();
        let token = all.add(&[7; RANDOM], None, (NOW, HOUR));
        let stored = serde_json::to_string(&all).unwrap();
        let (number, secret) = token.secret().split_once('-').unwrap();
        assert!(
            stored.contains(number) && !stored.contains(secret),
            "{stored}"
        );
        let used =
            |all: &mut Invitations, uri, key| all.redeem(token.secret(), shows(uri, &[], key), NOW);
        assert_eq!(used(&mut all, "urn:a", "key"), Ok(number.to_owned()));
        let again = used(&mut all, "urn:a", "key");
        assert_eq!(again, Ok(number.to_owned()), "the answer was lost");
        assert_eq!(used(&mut all, "urn:a", "other"), Err(Uninvited::Used));
        assert_eq!(used(&mut all, "urn:b", "key"), Err(Uninvited::Used));
    }

    #[test]
    fn a_token_expires_and_may_be_withdrawn() {
        let mut all = Invitations::default();
        let token = all.add(&[7; RANDOM], None, (NOW, HOUR));
        let at = |all: &mut Invitations, now| {
            let used = all.redeem(token.secret(), shows("urn:a", &[], "key"), now);
            used.map(drop)
        };
        assert_eq!(at(&mut all, NOW + HOUR * 2), Err(Uninvited::Expired));
        assert_eq!(at(&mut all, NOW + HOUR), Ok(()));
        assert_eq!(all.open(NOW).count(), 1);
        assert_eq!(all.open(NOW + HOUR * 2).count(), 0);
        let number = token.secret().split_once('-').unwrap().0;
        assert!(all.withdraw(number) && !all.withdraw(number));
        assert_eq!(at(&mut all, NOW), Err(Uninvited::Unknown));
    }

    #[test]
    fn a_token_is_for_the_application_that_it_was_made_for() {
        let mut all = Invitations::default();
        let names = [("en".to_owned(), "gripper".to_owned())];
        let mut used = |application: &str, seed, uri, key| {
            let token = all.add(&[seed; RANDOM], Some(application.to_owned()), (NOW, HOUR));
            let used = all.redeem(token.secret(), shows(uri, &names, key), NOW);
            used.map(drop)
        };
        assert_eq!(used("urn:gripper", 1, "urn:gripper", "key"), Ok(()));
        assert_eq!(used("gripper", 2, "urn:gripper", "key"), Ok(()));
        let another = used("urn:welder", 3, "urn:gripper", "key");
        assert_eq!(another, Err(Uninvited::Another));
    }

    #[test]
    fn a_wrong_secret_finds_nothing() {
        let mut all = Invitations::default();
        let token = all.add(&[7; RANDOM], None, (NOW, HOUR));
        let wrong = token.secret().replace("-07", "-08");
        for text in [&wrong[..], "", "-", "07070707", "07070707-"] {
            let used = all.redeem(text, shows("urn:a", &[], "key"), NOW);
            assert_eq!(used, Err(Uninvited::Unknown), "{text}");
        }
    }
}
