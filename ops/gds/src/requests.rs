//! Requests for certificates in a file. An administrator decides on them with the command line. The
//! answer to a client is kept until it expires, because the client may not have received it.

use std::time::Duration;

use serde::{Deserialize, Serialize};
use trust::{Certificate, CertificateSigningRequest, Fingerprint};

use crate::records::GdsRecord;

/// All requests, oldest first.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct SigningRequests {
    last: u32,
    all: Vec<SigningRequest>,
}

/// A request for a certificate.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct SigningRequest {
    pub(crate) number: u32,
    /// The ApplicationUri.
    pub(crate) uri: String,
    /// The SHA-256 of the key.
    pub(crate) key: String,
    /// The record to be registered; `None` for a registered application.
    pub(crate) record: Option<GdsRecord>,
    /// The request in hexadecimal digits, without a challengePassword.
    request: String,
    /// Time of the request, of the decision, or of the issue, in seconds since 1970.
    since: u64,
    pub(crate) state: RequestState,
}

/// The state of a request.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(crate) enum RequestState {
    /// An administrator has not decided.
    Waiting,
    /// The certificate is issued when the client fetches it.
    Approved {
        /// The user or invitation that approved.
        by: String,
    },
    /// An administrator has refused the request.
    Refused,
    /// The certificate, in hexadecimal digits.
    Issued { certificate: String },
}

/// A new request.
#[derive(Debug, Clone)]
pub(crate) struct NewRequest {
    pub(crate) request: CertificateSigningRequest,
    pub(crate) record: Option<GdsRecord>,
    /// The user or invitation that has approved the request.
    pub(crate) approved: Option<String>,
}

/// The reason why a request is not stored.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub(crate) enum Unkept {
    #[error(
        "{MOST} requests are waiting: `ua-gds requests` lists them, `ua-gds reject NUMBER` removes one"
    )]
    Full,
}

impl SigningRequests {
    /// Stores a request and returns its number. A repeated request of the same key for the same
    /// names keeps its number and its decision.
    pub(crate) fn put(&mut self, wanted: NewRequest, now: Duration) -> Result<u32, Unkept> {
        self.all.retain(|one| one.is_kept(now));
        let request = &wanted.request;
        let key = request.key_fingerprint().to_string();
        let same = self.all.iter_mut().find(|one| {
            let is_open = matches!(
                one.state,
                RequestState::Waiting | RequestState::Approved { .. } | RequestState::Refused
            );
            is_open
                && one.key == key
                && one.uri == request.application_uri()
                && one.is_like(request)
        });
        if let Some(same) = same {
            if let Some(by) = wanted.approved {
                same.state = RequestState::Approved { by };
            }
            same.record = wanted.record.or_else(|| same.record.take());
            return Ok(same.number);
        }
        let is_approved = wanted.approved.is_some();
        if self.all.len() >= MOST {
            // Requests that wait never displace each other; an approved request displaces the
            // oldest that waits.
            let oldest = self
                .all
                .iter()
                .position(|one| one.state == RequestState::Waiting);
            let displaced = oldest.filter(|_| is_approved).ok_or(Unkept::Full)?;
            self.all.remove(displaced);
        }
        self.last = self.last.wrapping_add(1);
        self.all.push(SigningRequest {
            number: self.last,
            uri: request.application_uri().to_owned(),
            key,
            record: wanted.record,
            request: hex(request.der()),
            since: now.as_secs(),
            state: match wanted.approved {
                Some(by) => RequestState::Approved { by },
                None => RequestState::Waiting,
            },
        });
        Ok(self.last)
    }

    /// Stores a certificate that was issued at once. The request itself is not stored, because it
    /// contains a secret.
    pub(crate) fn put_issued(
        &mut self,
        (request, certificate): (&CertificateSigningRequest, &Certificate),
        now: Duration,
    ) -> u32 {
        self.all.retain(|one| one.is_kept(now));
        if self.all.len() >= MOST {
            let oldest = self
                .all
                .iter()
                .position(|one| one.state == RequestState::Waiting);
            self.all.remove(oldest.unwrap_or_default());
        }
        self.last = self.last.wrapping_add(1);
        self.all.push(SigningRequest {
            number: self.last,
            uri: request.application_uri().to_owned(),
            key: request.key_fingerprint().to_string(),
            record: None,
            request: String::new(),
            since: now.as_secs(),
            state: RequestState::Issued {
                certificate: hex(certificate.der()),
            },
        });
        self.last
    }

    /// Returns the request with a number.
    pub(crate) fn get(&self, number: u32, now: Duration) -> Option<&SigningRequest> {
        let mut kept = self.kept(now);
        kept.find(|one| one.number == number)
    }

    /// Lists the requests that have not expired.
    pub(crate) fn kept(&self, now: Duration) -> impl Iterator<Item = &SigningRequest> {
        self.all.iter().filter(move |one| one.is_kept(now))
    }

    /// Approves or refuses a request without an issued certificate, and returns the request.
    pub(crate) fn decide(
        &mut self,
        number: u32,
        state: RequestState,
        now: Duration,
    ) -> Option<&SigningRequest> {
        let mut all = self.all.iter_mut().filter(|one| one.is_kept(now));
        let one = all.find(|one| one.number == number)?;
        if matches!(one.state, RequestState::Issued { .. }) {
            return None;
        }
        one.state = state;
        // The time limit for fetching the certificate starts at the decision.
        one.since = now.as_secs();
        Some(one)
    }

    /// Stores the certificate that was issued for a request.
    pub(crate) fn issued(&mut self, number: u32, certificate: &Certificate, now: Duration) {
        if let Some(one) = self.all.iter_mut().find(|one| one.number == number) {
            one.state = RequestState::Issued {
                certificate: hex(certificate.der()),
            };
            one.since = now.as_secs();
        }
    }
}

impl SigningRequest {
    /// Reads the request.
    pub(crate) fn request(&self) -> Option<CertificateSigningRequest> {
        CertificateSigningRequest::read(&unhex(&self.request)?).ok()
    }

    /// Reads the issued certificate.
    pub(crate) fn certificate(&self) -> Option<Certificate> {
        let RequestState::Issued { certificate } = &self.state else {
            return None;
        };
        Certificate::read(&unhex(certificate)?).ok()
    }

    /// Returns true if the request is of that key.
    pub(crate) fn is_of_key(&self, key: Fingerprint) -> bool {
        self.key.parse() == Ok(key)
    }

    fn is_like(&self, other: &CertificateSigningRequest) -> bool {
        self.request().is_some_and(|own| {
            own.application_uri() == other.application_uri() && own.hosts() == other.hosts()
        })
    }

    fn is_kept(&self, now: Duration) -> bool {
        let life = match self.state {
            RequestState::Waiting | RequestState::Approved { .. } => KEPT_OPEN,
            RequestState::Refused => KEPT_REFUSED,
            RequestState::Issued { .. } => KEPT_ISSUED,
        };
        now.saturating_sub(Duration::from_secs(self.since)) < life
    }
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

fn unhex(digits: &str) -> Option<Vec<u8>> {
    let (pairs, []) = digits.as_bytes().as_chunks::<2>() else {
        return None;
    };
    let byte = |pair: &[u8; 2]| u8::from_str_radix(std::str::from_utf8(pair).ok()?, 16).ok();
    pairs.iter().map(byte).collect()
}

/// The file of the requests, in the folder of the authority.
pub(crate) const FILE: &str = "requests.json";
const MOST: usize = 100;
const DAY: Duration = Duration::from_secs(86_400);
const KEPT_OPEN: Duration = DAY.saturating_mul(7);
const KEPT_REFUSED: Duration = Duration::from_secs(3600);
/// Time for a client to fetch an answer again that it has not received.
const KEPT_ISSUED: Duration = DAY;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::store::new_key;

    const NOW: Duration = Duration::from_secs(1_795_000_000);

    fn wanted(key: &[u8], uri: &str, host: &str, approved: Option<&str>) -> NewRequest {
        let hosts = [host.to_owned()];
        NewRequest {
            request: CertificateSigningRequest::make(key, uri, ("Robot", ""), &hosts).unwrap(),
            record: None,
            approved: approved.map(str::to_owned),
        }
    }

    #[test]
    fn a_repeated_request_keeps_its_number_and_decision_and_another_host_asks_anew() {
        let key = new_key(2048).unwrap();
        let mut all = SigningRequests::default();
        let first = all.put(wanted(&key, "urn:a", "robot", None), NOW).unwrap();
        let by = "sara".to_owned();
        all.decide(first, RequestState::Approved { by }, NOW)
            .unwrap();
        let again = all.put(wanted(&key, "urn:a", "robot", None), NOW).unwrap();
        assert_eq!(again, first);
        let state = &all.get(first, NOW).unwrap().state;
        assert!(matches!(state, RequestState::Approved { .. }), "{state:?}");
        let other = all.put(wanted(&key, "urn:a", "other", None), NOW).unwrap();
        assert_ne!(other, first);
        assert_eq!(all.get(other, NOW).unwrap().state, RequestState::Waiting);
    }

    #[test]
    fn a_request_is_kept_for_a_week_and_its_certificate_for_a_day() {
        let key = new_key(2048).unwrap();
        let mut all = SigningRequests::default();
        let number = all.put(wanted(&key, "urn:a", "robot", None), NOW).unwrap();
        let text = serde_json::to_string(&all).unwrap();
        let mut all: SigningRequests = serde_json::from_str(&text).unwrap();
        let later = NOW + DAY * 6;
        assert_eq!(all.get(number, later).unwrap().uri, "urn:a");
        assert!(all.get(number, NOW + DAY * 7).is_none());
        let by = "sara".to_owned();
        assert!(
            all.decide(number, RequestState::Approved { by }, later)
                .is_some()
        );
        assert!(all.get(number, later + DAY * 6).is_some());
        let life = (NOW, NOW + DAY * 365);
        let issue = trust::Issue {
            serial: trust::Serial::random([7; 16]),
            from: life.0,
            until: life.1,
        };
        let authority = trust::CertificateAuthority::make(&key, ("Plant", ""), &issue).unwrap();
        all.issued(number, authority.certificate(), later);
        let kept = all.get(number, later + DAY / 2).unwrap();
        assert_eq!(kept.certificate().as_ref(), Some(authority.certificate()));
        assert!(all.decide(number, RequestState::Refused, later).is_none());
        assert!(all.get(number, later + DAY).is_none());
    }

    #[test]
    fn strangers_fill_the_list_and_displace_no_other_request() {
        let key = new_key(2048).unwrap();
        let mut all = SigningRequests::default();
        for number in 0..MOST {
            let uri = format!("urn:{number}");
            all.put(wanted(&key, &uri, "robot", None), NOW).unwrap();
        }
        let full = all.put(wanted(&key, "urn:new", "robot", None), NOW);
        assert_eq!(full, Err(Unkept::Full));
        let invited = all.put(wanted(&key, "urn:new", "robot", Some("invitation")), NOW);
        assert!(invited.is_ok());
        assert_eq!(all.kept(NOW).count(), MOST);
    }
}
