//! A relay between two multicast groups that loses, duplicates and delays datagrams.
//!
//! `tc netem` does the same on kernels that have it. Programs of both groups stay on loopback,
//! where calls are executed without being opened.

use std::cmp::Reverse;
use std::collections::BinaryHeap;
use std::net::{Ipv4Addr, SocketAddr, SocketAddrV4, UdpSocket};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use socket2::SockRef;

use crate::{GROUP, group_member};

/// The group on the other side of a [`GroupRelay`].
pub const OTHER_GROUP: SocketAddrV4 = SocketAddrV4::new(Ipv4Addr::new(239, 192, 0, 41), 4840);

/// The effect of a relay on datagrams, in each direction. Shares are 0 to 1.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Weather {
    /// Share of datagrams that never arrive.
    pub lost: f64,
    /// Share of datagrams that arrive twice, the second time late.
    pub doubled: f64,
    /// Share of datagrams that arrive late, behind later datagrams.
    pub late: f64,
    /// The maximum delay.
    pub delay: Duration,
}

/// Carries datagrams between [`GROUP`] and [`OTHER_GROUP`] until it is dropped.
pub struct GroupRelay {
    stop: Arc<AtomicBool>,
    silent: Arc<AtomicBool>,
    bad: Arc<AtomicU32>,
    threads: Vec<JoinHandle<()>>,
}

struct Direction {
    from: UdpSocket,
    to: UdpSocket,
    group: SocketAddrV4,
    /// The addresses this relay itself sends from.
    own: [SocketAddr; 2],
    weather: Weather,
    /// If set, no datagram arrives.
    silent: Arc<AtomicBool>,
    random: u64,
    under_way: BinaryHeap<Reverse<(Instant, Vec<u8>)>>,
}

impl Weather {
    /// Every datagram arrives at once.
    pub const FAIR: Self = Self {
        lost: 0.0,
        doubled: 0.0,
        late: 0.0,
        delay: Duration::ZERO,
    };
}

impl GroupRelay {
    /// Starts the relay.
    ///
    /// # Panics
    /// Panics if the sockets cannot be created.
    #[must_use]
    pub fn start(weather: Weather) -> Self {
        let (stop, bad) = (Arc::<AtomicBool>::default(), Arc::<AtomicU32>::default());
        let silent = Arc::<AtomicBool>::default();
        let silences = [Arc::clone(&silent), Arc::default()];
        let senders = [sender(), sender()];
        let own = senders
            .each_ref()
            .map(|socket| socket.local_addr().unwrap());
        let ways = [(GROUP, OTHER_GROUP), (OTHER_GROUP, GROUP)];
        let mut threads = Vec::new();
        for ((sender, (from, to)), silent) in senders.into_iter().zip(ways).zip(silences) {
            let mut direction = Direction {
                from: group_member(from),
                to: sender,
                group: to,
                own,
                weather,
                silent,
                random: 0x2545_f491 + u64::from(u32::from(*from.ip())),
                under_way: BinaryHeap::new(),
            };
            let (stop, bad) = (Arc::clone(&stop), Arc::clone(&bad));
            threads.push(std::thread::spawn(move || direction.carry(&stop, &bad)));
        }
        Self {
            stop,
            silent,
            bad,
            threads,
        }
    }

    /// Sets whether all datagrams of [`GROUP`] are lost on their way to [`OTHER_GROUP`].
    pub fn hush(&self, silent: bool) {
        self.silent.store(silent, Ordering::Relaxed);
    }

    /// Returns the number of datagrams that were lost, duplicated or delayed.
    #[must_use]
    pub fn disturbed(&self) -> u32 {
        self.bad.load(Ordering::Relaxed)
    }
}

impl Drop for GroupRelay {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        for thread in self.threads.drain(..) {
            if thread.join().is_err() && !std::thread::panicking() {
                panic!("the relay has failed");
            }
        }
    }
}

fn sender() -> UdpSocket {
    let socket = UdpSocket::bind((Ipv4Addr::LOCALHOST, 0)).unwrap();
    let options = SockRef::from(&socket);
    options.set_multicast_if_v4(&Ipv4Addr::LOCALHOST).unwrap();
    options.set_multicast_loop_v4(true).unwrap();
    socket
}

impl Direction {
    fn carry(&mut self, stop: &AtomicBool, bad: &AtomicU32) {
        let mut buffer = vec![0; 65_536];
        while !stop.load(Ordering::Relaxed) {
            let due = self.under_way.peek().map_or(LOOK_UP, |Reverse((due, _))| {
                due.saturating_duration_since(Instant::now())
            });
            let wait = due.clamp(Duration::from_micros(200), LOOK_UP);
            self.from.set_read_timeout(Some(wait)).unwrap();
            match self.from.recv_from(&mut buffer) {
                Ok((_, source)) if self.own.contains(&source) => {}
                Ok((length, _)) => self.take(&buffer[..length], bad),
                Err(error) if error.kind() == std::io::ErrorKind::WouldBlock => {}
                Err(error) => panic!("the group cannot be read: {error}"),
            }
            while let Some(Reverse((due, datagram))) = self.under_way.pop() {
                if due > Instant::now() {
                    self.under_way.push(Reverse((due, datagram)));
                    break;
                }
                self.to.send_to(&datagram, self.group).unwrap();
            }
        }
    }

    fn take(&mut self, datagram: &[u8], bad: &AtomicU32) {
        let Weather {
            lost,
            doubled,
            late,
            delay,
        } = self.weather;
        let (now, chance) = (Instant::now(), self.chance());
        let later = now + delay.mul_f64(self.chance());
        let arrive: &[Instant] = if chance < lost || self.silent.load(Ordering::Relaxed) {
            &[]
        } else if chance < lost + doubled {
            &[now, later]
        } else if chance < lost + doubled + late {
            &[later]
        } else {
            &[now]
        };
        if arrive != [now] {
            bad.fetch_add(1, Ordering::Relaxed);
        }
        let arrivals = arrive.iter().map(|due| Reverse((*due, datagram.to_vec())));
        self.under_way.extend(arrivals);
    }

    /// Returns a number from 0 to 1, by xorshift64.
    fn chance(&mut self) -> f64 {
        self.random ^= self.random << 13;
        self.random ^= self.random >> 7;
        self.random ^= self.random << 17;
        (self.random >> 11) as f64 / (1_u64 << 53) as f64
    }
}

/// Interval in which a direction checks its orders.
const LOOK_UP: Duration = Duration::from_millis(20);
