//! The limit of wrong passwords of clients of other hosts.
//!
//! Pure: times are parameters.

use std::collections::VecDeque;
use std::net::{IpAddr, Ipv6Addr};
use std::time::Duration;

use tokio::time::Instant;

/// The wrong passwords of the last minute, with the networks of their clients, oldest first.
#[derive(Debug, Default)]
pub(crate) struct WrongPasswords(VecDeque<(Instant, IpAddr)>);

impl WrongPasswords {
    /// Counts an attempt as wrong until [`Self::succeed`], so that attempts at the same time are
    /// limited, too. Returns whether the password may be checked.
    pub(crate) fn may_try(&mut self, client: IpAddr, now: Instant) -> bool {
        let client = network(client);
        self.0
            .retain(|(at, _)| now.saturating_duration_since(*at) < LOCKED_FOR);
        let of_client = self.0.iter().filter(|(_, other)| *other == client);
        if of_client.count() >= MOST_OF_CLIENT {
            return false;
        }
        if self.0.len() >= MOST {
            self.0.pop_front();
        }
        self.0.push_back((now, client));
        true
    }

    /// Forgets the newest attempt of a client, which was right.
    pub(crate) fn succeed(&mut self, client: IpAddr) {
        let client = network(client);
        let newest = self.0.iter().rposition(|(_, other)| *other == client);
        if let Some(newest) = newest {
            self.0.remove(newest);
        }
    }
}

/// Returns the address of a client, or its /64 network in IPv6, whose addresses one host may have.
pub(crate) fn network(client: IpAddr) -> IpAddr {
    match client.to_canonical() {
        IpAddr::V6(address) => {
            let [a, b, c, d, ..] = address.segments();
            IpAddr::V6(Ipv6Addr::new(a, b, c, d, 0, 0, 0, 0))
        }
        address @ IpAddr::V4(_) => address,
    }
}

/// Time for which a wrong password counts.
pub(crate) const LOCKED_FOR: Duration = Duration::from_secs(60);
/// Maximum number of wrong passwords of a client in that time.
const MOST_OF_CLIENT: usize = 20;
/// Maximum number of wrong passwords that are known. The oldest gives way.
const MOST: usize = 10_000;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_client_is_locked_for_a_minute_after_wrong_passwords_and_others_are_not() {
        let mut wrong = WrongPasswords::default();
        let start = Instant::now();
        let at = |seconds: u64| start + Duration::from_secs(seconds);
        let client = |text: &str| text.parse::<IpAddr>().unwrap();
        let bad = client("192.0.2.7");
        for _ in 0..MOST_OF_CLIENT {
            assert!(wrong.may_try(bad, at(0)));
        }
        assert!(!wrong.may_try(bad, at(59)));
        assert!(!wrong.may_try(client("::ffff:192.0.2.7"), at(59)));
        assert!(wrong.may_try(client("192.0.2.8"), at(59)));
        assert!(wrong.may_try(bad, at(60)));
        // A right password does not count.
        for _ in 0..MOST_OF_CLIENT {
            assert!(wrong.may_try(client("192.0.2.9"), at(61)));
            wrong.succeed(client("192.0.2.9"));
        }
        assert!(wrong.may_try(client("192.0.2.9"), at(61)));
    }

    #[test]
    fn addresses_of_one_network_share_their_attempts() {
        let mut wrong = WrongPasswords::default();
        let now = Instant::now();
        for host in 0..MOST_OF_CLIENT {
            let client = format!("2001:db8:0:1::{host}").parse().unwrap();
            assert!(wrong.may_try(client, now), "{host}");
        }
        assert!(!wrong.may_try("2001:db8:0:1:ffff::1".parse().unwrap(), now));
        assert!(wrong.may_try("2001:db8:0:2::1".parse().unwrap(), now));
    }
}
