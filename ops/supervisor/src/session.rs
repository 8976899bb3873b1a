//! The sessions of signed-in users, and the limits of attempts to sign in.
//!
//! Pure: random tokens and times are parameters.

use std::collections::{HashMap, VecDeque};
use std::time::Duration;

/// The sessions of browsers.
#[derive(Debug, Default)]
pub(crate) struct BrowserSessions {
    open: HashMap<String, BrowserSession>,
    /// The failed attempts of the last minute, oldest first.
    failed: VecDeque<(Duration, String)>,
}

/// The session of a user.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct BrowserSession {
    pub(crate) user: String,
    /// The token that each changing request repeats in a header.
    pub(crate) csrf: String,
    used: Duration,
    began: Duration,
}

/// Too many attempts to sign in have failed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("too many attempts have failed: try again in {} s", LOCKED_FOR.as_secs())]
pub(crate) struct Locked;

impl BrowserSessions {
    /// Checks whether a user may attempt to sign in.
    ///
    /// # Errors
    /// Returns [`Locked`] if too many attempts have failed.
    pub(crate) fn may_try(&mut self, user: &str, now: Duration) -> Result<(), Locked> {
        self.failed.retain(|(at, _)| now < *at + LOCKED_FOR);
        let of_user = self.failed.iter().filter(|(_, failed)| failed == user);
        if of_user.count() >= MOST_FAILED_OF_USER || self.failed.len() >= MOST_FAILED {
            return Err(Locked);
        }
        Ok(())
    }

    /// Counts a failed attempt.
    pub(crate) fn fail(&mut self, user: &str, now: Duration) {
        if self.failed.len() >= MOST_FAILED {
            self.failed.pop_front();
        }
        self.failed.push_back((now, crate::value::cut(user, 64)));
    }

    /// Forgets the newest failed attempt of a user, which was not wrong.
    pub(crate) fn forgive(&mut self, user: &str) {
        let user = crate::value::cut(user, 64);
        let newest = self.failed.iter().rposition(|(_, failed)| *failed == user);
        if let Some(newest) = newest {
            self.failed.remove(newest);
        }
    }

    /// Forgets the failed attempts of a user after a sign-in.
    pub(crate) fn succeed(&mut self, user: &str) {
        self.failed.retain(|(_, failed)| failed != user);
    }

    /// Opens a session; the longest unused session gives way if there are too many.
    pub(crate) fn open(
        &mut self,
        user: &str,
        [token, csrf]: [String; 2],
        now: Duration,
    ) -> BrowserSession {
        self.expire(now);
        if self.open.len() >= MOST_SESSIONS {
            let oldest = self.open.iter().min_by_key(|(_, session)| session.used);
            if let Some(token) = oldest.map(|(token, _)| token.clone()) {
                self.open.remove(&token);
            }
        }
        let session = BrowserSession {
            user: user.to_owned(),
            csrf,
            used: now,
            began: now,
        };
        self.open.insert(token, session.clone());
        session
    }

    /// Returns the session of a token.
    pub(crate) fn find(&mut self, token: &str, now: Duration) -> Option<BrowserSession> {
        self.expire(now);
        let session = self.open.get_mut(token)?;
        session.used = now;
        Some(session.clone())
    }

    /// Returns the user of a session, without prolonging the session.
    pub(crate) fn user(&mut self, token: &str, now: Duration) -> Option<String> {
        self.expire(now);
        self.open.get(token).map(|session| session.user.clone())
    }

    /// Closes a session.
    pub(crate) fn close(&mut self, token: &str) {
        self.open.remove(token);
    }

    fn expire(&mut self, now: Duration) {
        self.open
            .retain(|_, session| now < session.used + IDLE && now < session.began + LONGEST);
    }
}

/// The browser of an event stream.
#[derive(Debug)]
pub(crate) struct EventStreamBrowser {
    pub(crate) token: String,
    /// Whether only a signed-in user may read.
    pub(crate) must_sign_in: bool,
}

/// Returns the value of a cookie in the Cookie header.
pub(crate) fn cookie<'h>(header: &'h str, name: &str) -> Option<&'h str> {
    let mut pairs = header.split(';').take(MOST_COOKIES);
    pairs.find_map(|pair| {
        let (found, value) = pair.trim().split_once('=')?;
        (found == name).then_some(value)
    })
}

/// The number of open sessions.
const MOST_SESSIONS: usize = 64;
const MOST_FAILED_OF_USER: usize = 5;
const MOST_FAILED: usize = 30;
const LOCKED_FOR: Duration = Duration::from_secs(60);
/// A session ends after this time without a request.
const IDLE: Duration = Duration::from_secs(8 * 3600);
const LONGEST: Duration = Duration::from_secs(24 * 3600);
const MOST_COOKIES: usize = 64;

#[cfg(test)]
mod tests {
    use super::*;

    fn at(seconds: u64) -> Duration {
        Duration::from_secs(seconds)
    }

    fn tokens(number: usize) -> [String; 2] {
        [format!("token{number}"), format!("csrf{number}")]
    }

    #[test]
    fn a_session_is_found_by_its_token_until_it_is_closed_or_old() {
        let mut sessions = BrowserSessions::default();
        sessions.open("anna", tokens(1), at(0));
        assert_eq!(sessions.find("token1", at(1)).unwrap().user, "anna");
        assert_eq!(sessions.find("token2", at(1)), None);
        sessions.close("token1");
        assert_eq!(sessions.find("token1", at(2)), None);
        sessions.open("anna", tokens(1), at(0));
        assert_eq!(sessions.find("token1", IDLE), None);
    }

    #[test]
    fn the_number_of_sessions_is_bounded() {
        let mut sessions = BrowserSessions::default();
        for number in 0..=MOST_SESSIONS {
            let now = at(u64::try_from(number).unwrap());
            sessions.open("anna", tokens(number), now);
        }
        assert_eq!(sessions.open.len(), MOST_SESSIONS);
        assert_eq!(sessions.find("token0", at(70)), None);
    }

    #[test]
    fn a_user_is_locked_after_failures_and_others_are_not() {
        let mut sessions = BrowserSessions::default();
        for _ in 0..MOST_FAILED_OF_USER {
            assert_eq!(sessions.may_try("anna", at(0)), Ok(()));
            sessions.fail("anna", at(0));
        }
        assert!(sessions.may_try("anna", at(1)).is_err());
        assert_eq!(sessions.may_try("bert", at(1)), Ok(()));
        assert_eq!(sessions.may_try("anna", at(61)), Ok(()));
        for _ in 0..MOST_FAILED_OF_USER {
            sessions.fail("anna", at(99));
        }
        sessions.forgive("anna");
        assert_eq!(sessions.may_try("anna", at(99)), Ok(()));
        sessions.fail("anna", at(99));
        assert!(sessions.may_try("anna", at(99)).is_err());
        sessions.succeed("anna");
        for number in 0..MOST_FAILED {
            sessions.fail(&number.to_string(), at(100));
        }
        assert!(sessions.may_try("bert", at(101)).is_err());
    }

    #[test]
    fn a_cookie_has_the_exact_name() {
        let header = "a=1; ua-session-9100=x; ua-session-91000=y";
        assert_eq!(cookie(header, "ua-session-9100"), Some("x"));
        assert_eq!(cookie(header, "ua-session"), None);
    }
}
