//! The limit of wrong passwords of clients of other hosts.
//!
//! Pure: times are parameters.

use std::collections::VecDeque;
use std::net::{IpAddr, Ipv6Addr};
use std::time::Duration;

use tokio::time::Instant;

/// The wrong passwords of the last minute, and the passwords that are being checked, oldest first.
#[derive(Debug, Default)]
pub(crate) struct WrongPasswords {
    attempts: VecDeque<PasswordAttempt>,
    next: u64,
}

#[derive(Debug)]
struct PasswordAttempt {
    number: u64,
    at: Instant,
    client: IpAddr,
    /// Whether the password was wrong. It is false during the check, and after a check that did not
    /// end, such as one that panicked.
    is_wrong: bool,
}

/// The decision about the check of a password.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum PasswordCheck {
    /// The password may be checked, by the number of the attempt.
    Check(u64),
    /// Other passwords of the client or its network are being checked, and all of them may be
    /// wrong.
    Busy,
    /// The client or its network has sent too many wrong passwords.
    Locked,
}

impl WrongPasswords {
    /// Begins an attempt, which lasts until [`Self::end`], at most for [`LOCKED_FOR`]. Attempts at
    /// the same time are limited as if all of them were wrong.
    pub(crate) fn begin(&mut self, client: IpAddr, now: Instant) -> PasswordCheck {
        let client = client.to_canonical();
        self.attempts
            .retain(|attempt| now.saturating_duration_since(attempt.at) < LOCKED_FOR);
        let of_client = |attempt: &PasswordAttempt| attempt.client == client;
        let is_v6 = client.is_ipv6();
        let of_network =
            |attempt: &PasswordAttempt| is_v6 && network(attempt.client) == network(client);
        let count = |is_counted: &dyn Fn(&PasswordAttempt) -> bool| {
            let counted = self.attempts.iter().filter(|attempt| is_counted(attempt));
            counted.count()
        };
        if count(&|attempt| attempt.is_wrong && of_client(attempt)) >= MOST_OF_CLIENT
            || count(&|attempt| attempt.is_wrong && of_network(attempt)) >= MOST_OF_NETWORK
        {
            return PasswordCheck::Locked;
        }
        if count(&of_client) >= MOST_OF_CLIENT || count(&of_network) >= MOST_OF_NETWORK {
            return PasswordCheck::Busy;
        }
        if self.attempts.len() >= MOST {
            self.attempts.pop_front();
        }
        let number = self.next;
        self.next = self.next.wrapping_add(1);
        self.attempts.push_back(PasswordAttempt {
            number,
            at: now,
            client,
            is_wrong: false,
        });
        PasswordCheck::Check(number)
    }

    /// Ends an attempt, which counts if the password was wrong.
    pub(crate) fn end(&mut self, number: u64, is_right: bool) {
        let attempt = self
            .attempts
            .iter()
            .rposition(|other| other.number == number);
        let Some(attempt) = attempt else {
            return;
        };
        if is_right {
            self.attempts.remove(attempt);
        } else if let Some(attempt) = self.attempts.get_mut(attempt) {
            attempt.is_wrong = true;
        }
    }
}

/// Returns the address of a client; of an IPv6 address its /64 network, since one host may use all
/// addresses of it.
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
/// Maximum number of wrong passwords of an address in that time.
const MOST_OF_CLIENT: usize = 20;
/// Maximum number of wrong passwords of an IPv6 network in that time.
const MOST_OF_NETWORK: usize = 200;
/// Maximum number of attempts that are known. The oldest gives way.
const MOST: usize = 10_000;

#[cfg(test)]
mod tests {
    use super::*;

    fn address(text: &str) -> IpAddr {
        text.parse().unwrap()
    }

    /// Tries a password. Returns whether it was checked.
    fn try_one(wrong: &mut WrongPasswords, client: IpAddr, now: Instant, is_right: bool) -> bool {
        match wrong.begin(client, now) {
            PasswordCheck::Check(number) => {
                wrong.end(number, is_right);
                true
            }
            PasswordCheck::Locked => false,
            PasswordCheck::Busy => panic!("{client} has another attempt"),
        }
    }

    #[test]
    fn a_client_is_locked_for_a_minute_after_wrong_passwords_and_others_are_not() {
        let mut wrong = WrongPasswords::default();
        let start = Instant::now();
        let at = |seconds: u64| start + Duration::from_secs(seconds);
        let bad = address("192.0.2.7");
        for _ in 0..MOST_OF_CLIENT {
            assert!(try_one(&mut wrong, bad, at(0), false));
        }
        assert!(!try_one(&mut wrong, bad, at(59), true));
        let mapped = address("::ffff:192.0.2.7");
        assert!(!try_one(&mut wrong, mapped, at(59), true));
        assert!(try_one(&mut wrong, address("192.0.2.8"), at(59), false));
        assert!(try_one(&mut wrong, bad, at(60), false));
        // A right password does not count.
        for _ in 0..=MOST_OF_CLIENT {
            assert!(try_one(&mut wrong, address("192.0.2.9"), at(61), true));
        }
    }

    #[test]
    fn attempts_at_the_same_time_are_limited_and_do_not_lock() {
        let mut wrong = WrongPasswords::default();
        let (client, start) = (address("192.0.2.7"), Instant::now());
        let numbers: Vec<u64> = (0..MOST_OF_CLIENT)
            .map(|_| match wrong.begin(client, start) {
                PasswordCheck::Check(number) => number,
                PasswordCheck::Busy | PasswordCheck::Locked => panic!("it is not checked"),
            })
            .collect();
        assert_eq!(wrong.begin(client, start), PasswordCheck::Busy);
        wrong.end(numbers[3], true);
        let next = wrong.begin(client, start);
        assert!(matches!(next, PasswordCheck::Check(_)), "{next:?}");
        for number in numbers {
            wrong.end(number, false);
        }
        // One was right, and another is being checked.
        assert_eq!(wrong.begin(client, start), PasswordCheck::Busy);
        let PasswordCheck::Check(number) = next else {
            panic!("{next:?}")
        };
        wrong.end(number, false);
        assert_eq!(wrong.begin(client, start), PasswordCheck::Locked);
        // An attempt whose check does not end is removed after a minute.
        assert!(try_one(&mut wrong, client, start + LOCKED_FOR, false));
    }

    #[test]
    fn a_host_locks_its_address_and_many_addresses_lock_their_network() {
        let mut wrong = WrongPasswords::default();
        let now = Instant::now();
        let host = |host: usize| address(&format!("2001:db8:0:1::{host:x}"));
        let hosts = MOST_OF_NETWORK / MOST_OF_CLIENT;
        for number in 0..hosts {
            for _ in 0..MOST_OF_CLIENT {
                assert!(try_one(&mut wrong, host(number), now, false), "{number}");
            }
            assert!(!try_one(&mut wrong, host(number), now, true), "{number}");
        }
        assert!(!try_one(&mut wrong, host(hosts), now, true));
        assert!(!try_one(
            &mut wrong,
            address("2001:db8:0:1:ffff::1"),
            now,
            true
        ));
        assert!(try_one(&mut wrong, address("2001:db8:0:2::1"), now, true));
    }

    #[test]
    fn the_oldest_of_too_many_attempts_gives_way() {
        let mut wrong = WrongPasswords::default();
        let now = Instant::now();
        let first = address("192.0.2.7");
        for _ in 0..MOST_OF_CLIENT {
            assert!(try_one(&mut wrong, first, now, false));
        }
        let other = |number: usize| address(&format!("10.{}.{}.1", number / 250, number % 250));
        for number in MOST_OF_CLIENT..MOST {
            assert!(try_one(&mut wrong, other(number), now, false));
        }
        assert!(!try_one(&mut wrong, first, now, false));
        assert!(try_one(&mut wrong, other(0), now, false));
        assert!(try_one(&mut wrong, first, now, false));
        assert_eq!(wrong.attempts.len(), MOST);
    }
}
