//! A registry with its inputs and outputs: received mDNS announcements, probes of endpoints, own
//! mDNS announcements.

use std::collections::BTreeMap;
use std::num::NonZeroU16;
use std::time::{Duration, Instant};

use log_limit::LogLimit;
use registry::{
    AnnouncedServer, ProbeOutcome, RecordSource, RegistryEvent, RegistrySettings, ServerLoss,
    ServerRegistry,
};
use tokio::time::sleep_until;
use tracing::info;

use crate::clock::now;
use crate::liveness::{EndpointReport, Liveness, Try};
use mdns::{Aside, Mdns, MdnsEvent, OwnAnnouncement, same_place};

/// See the module documentation. Call [`step`](Self::step) repeatedly, and take all
/// [`event`](Self::event)s after each step.
pub(crate) struct Keeper {
    pub(crate) registry: ServerRegistry,
    pub(crate) mdns: Option<Mdns>,
    liveness: Liveness,
    /// The next time to remove entries of servers that are no longer watched.
    tidy_at: Instant,
    /// The last time at which this program was known to run.
    awake_at: Instant,
    /// The URL of this program, which is not probed.
    own: Option<String>,
    /// Servers that were lost without a goodbye. mDNS still caches their records, and would not
    /// report an unchanged server that returns.
    asleep: BTreeMap<String, Asleep>,
    /// The time of the last answer of each endpoint.
    answered: BTreeMap<String, Instant>,
    /// The start time of the program behind each endpoint, in 100 ns since 1601, if known.
    started: BTreeMap<String, Started>,
    /// Start times that probes returned and that were not yet taken.
    new_starts: Vec<(String, i64)>,
    /// The numbers in the space of the servers that announce them.
    numbers: BTreeMap<String, NonZeroU16>,
    /// Limits the log messages for servers that cannot be probed.
    untried_log: LogLimit,
    most: usize,
    /// Whether announcements of other servers than discovery servers are ignored.
    lds_only: bool,
}

/// The start time of a program, in 100 ns since 1601.
#[derive(Debug, Clone, Copy)]
struct Started {
    at: i64,
    /// Whether the program announces its start time by mDNS. Other programs are queried.
    tells: bool,
}

/// The event that ended a step.
enum Happened {
    Heard(MdnsEvent),
    Told(EndpointReport),
    Due,
}

#[derive(Debug)]
struct Asleep {
    announcement: AnnouncedServer,
    try_at: Instant,
    /// The time to the next probe, which doubles with each probe.
    pause: Duration,
    longest_pause: Duration,
    forget_at: Instant,
}

impl Keeper {
    /// Creates a keeper. `own` is the URL of the program itself.
    pub(crate) fn new(settings: RegistrySettings, mdns: Option<Mdns>, own: Option<String>) -> Self {
        Self {
            registry: ServerRegistry::new(settings),
            mdns,
            liveness: Liveness::new(),
            tidy_at: now(),
            awake_at: now(),
            own,
            asleep: BTreeMap::new(),
            answered: BTreeMap::new(),
            started: BTreeMap::new(),
            new_starts: Vec::new(),
            numbers: BTreeMap::new(),
            untried_log: LogLimit::every(LOG_EVERY),
            most: settings.most,
            lds_only: false,
        }
    }

    /// Sets whether only discovery servers are watched.
    pub(crate) fn lds_only(self, lds_only: bool) -> Self {
        Self { lds_only, ..self }
    }

    /// Waits for the next event and processes it. Cancel safe.
    pub(crate) async fn step(&mut self) {
        self.notice_standstill();
        self.try_endpoints();
        let due = self.due().map(tokio::time::Instant::from_std);
        let timer = async {
            match due {
                Some(due) => sleep_until(due).await,
                None => std::future::pending().await,
            }
        };
        let heard = async {
            match &mut self.mdns {
                Some(mdns) => mdns.next().await,
                None => std::future::pending().await,
            }
        };
        let happened = tokio::select! {
            heard = heard => Happened::Heard(heard),
            told = self.liveness.next() => Happened::Told(told),
            () = timer => Happened::Due,
        };
        self.notice_standstill();
        match happened {
            Happened::Heard(heard) => self.hear(heard),
            Happened::Told(EndpointReport::Tried { url, outcome }) => self.probed(&url, outcome),
            Happened::Told(EndpointReport::Broken { url }) => self.registry.suspect(&url),
            Happened::Due => self.registry.handle_timeout(now()),
        }
    }

    /// Returns the time of the next action; `None` while a probe has to complete first.
    fn due(&self) -> Option<Instant> {
        let due = self.registry.poll_timeout();
        let asleep = self.asleep.values().map(|asleep| asleep.try_at);
        let due = due.into_iter().chain(asleep).min();
        due.filter(|_| self.liveness.has_room())
    }

    /// Detects that this program was suspended or had no CPU time, so that missing answers are not
    /// counted.
    fn notice_standstill(&mut self) {
        let at = now();
        let late = self
            .due()
            .map(|due| at.saturating_duration_since(due.max(self.awake_at)));
        if let Some(late) = late.filter(|late| *late > LATE) {
            self.registry.stood_still(late);
        }
        self.awake_at = at;
    }

    /// Returns the next event, oldest first. Events for mDNS are processed here.
    pub(crate) fn event(&mut self) -> Option<RegistryEvent> {
        loop {
            let event = self.registry.poll_event()?;
            match (&event, &mut self.mdns) {
                (RegistryEvent::Announce(announcement), Some(mdns)) => mdns.put(OwnAnnouncement {
                    announcement: announcement.clone(),
                    aside: Aside {
                        // An announced start time implies that the server answers during calls.
                        start_time: self
                            .started
                            .get(&announcement.url)
                            .filter(|_| self.registry.is_concurrent(&announcement.url))
                            .map(|known| known.at),
                        number: self.numbers.get(&announcement.url).copied(),
                    },
                }),
                (RegistryEvent::Withdraw { instance }, Some(mdns)) => {
                    drop(mdns.take_back(instance))
                }
                (RegistryEvent::Announce(_) | RegistryEvent::Withdraw { .. }, None) => {}
                (
                    RegistryEvent::Vanished {
                        record,
                        loss: ServerLoss::Unreachable | ServerLoss::Hanging,
                    },
                    _,
                ) if record.source == RecordSource::Multicast => {
                    self.sleeps(record.announcement.clone());
                    return Some(event);
                }
                _ => return Some(event),
            }
        }
    }

    /// Returns and clears the time since the last answer of an endpoint.
    pub(crate) fn silent_for(&mut self, url: &str) -> Option<Duration> {
        let answered = self.answered.remove(url)?;
        Some(now().saturating_duration_since(answered))
    }

    /// Returns the start time of the program behind an endpoint, in 100 ns since 1601, if known.
    pub(crate) fn started(&self, url: &str) -> Option<i64> {
        self.started.get(url).map(|known| known.at)
    }

    /// Returns the number in the space, if announced.
    pub(crate) fn number(&self, url: &str) -> Option<NonZeroU16> {
        self.numbers.get(url).copied()
    }

    /// Takes the start times that probes returned. To be called after each step.
    pub(crate) fn take_started(&mut self) -> Vec<(String, i64)> {
        std::mem::take(&mut self.new_starts)
    }

    fn hear(&mut self, heard: MdnsEvent) {
        let at = now();
        match heard {
            // It may have been a discovery server before.
            MdnsEvent::Announced { announcement, .. }
                if self.lds_only && !is_lds(&announcement.capabilities) =>
            {
                self.asleep.remove(&announcement.instance);
                self.registry.withdrawn(&announcement.instance);
            }
            MdnsEvent::Announced {
                announcement,
                aside: Aside { start_time, number },
            } => {
                self.asleep.remove(&announcement.instance);
                let url = announcement.url.clone();
                match number {
                    Some(number) => keep(&mut self.numbers, self.most, &url, number),
                    // A discovery server that also announces the server may not know its number.
                    None if start_time.is_none() => {}
                    None => drop(self.numbers.remove(&url)),
                }
                let instance = announcement.instance.clone();
                if let Some(start_time) = start_time {
                    let asked = self.started.get(&url).filter(|known| !known.tells);
                    if asked.is_some_and(|known| start_time < known.at.saturating_add(SAME_RUN)) {
                        self.registry.started(&url, start_time);
                    }
                    let started = Started {
                        at: start_time,
                        tells: true,
                    };
                    keep(&mut self.started, self.most, &url, started);
                }
                self.registry.announced(announcement, at);
                if let Some(start_time) = start_time {
                    // A program of this project, which serves requests concurrently.
                    self.registry.answers_during_calls(&url);
                    self.registry.announced_start(&instance, start_time);
                }
            }
            MdnsEvent::Withdrawn { instance } => {
                self.asleep.remove(&instance);
                self.registry.withdrawn(&instance);
            }
            MdnsEvent::Renamed { from, to } => self.registry.renamed(&from, &to, at),
        }
    }

    fn sleeps(&mut self, announcement: AnnouncedServer) {
        if self.asleep.len() < self.most {
            let at = now();
            let had_answered = self.answered.contains_key(&announcement.url);
            let asleep = Asleep {
                announcement,
                try_at: at + TRY_ASLEEP,
                pause: TRY_ASLEEP,
                longest_pause: if had_answered {
                    LONGEST_PAUSE_KNOWN
                } else {
                    LONGEST_PAUSE
                },
                forget_at: at + FORGET_ASLEEP,
            };
            self.asleep
                .insert(asleep.announcement.instance.clone(), asleep);
        }
    }

    /// Starts the probes that are due.
    fn try_endpoints(&mut self) {
        let at = now();
        self.asleep.retain(|_, asleep| at < asleep.forget_at);
        if self.tidy_at <= at {
            self.tidy_at = at + TIDY_EVERY;
            let sleeping = |url: &str| {
                let mut all = self.asleep.values();
                all.any(|asleep| asleep.announcement.url == url)
            };
            let is_wanted = |url: &str| self.registry.watches(url) || sleeping(url);
            self.liveness.keep(is_wanted);
            self.answered.retain(|url, _| is_wanted(url));
            self.started.retain(|url, _| is_wanted(url));
            self.numbers.retain(|url, _| is_wanted(url));
        }
        while self.liveness.has_room() {
            let next = self.asleep.values_mut().find(|asleep| asleep.try_at <= at);
            let url = match next {
                Some(asleep) => {
                    asleep.pause = (asleep.pause * 2).min(asleep.longest_pause);
                    asleep.try_at = at + asleep.pause;
                    asleep.announcement.url.clone()
                }
                None => match self.registry.poll_probe(at) {
                    Some(probe) => probe.url,
                    None => break,
                },
            };
            if self.own.as_ref().is_some_and(|own| same_place(own, &url)) {
                let alive = ProbeOutcome::Alive { start_time: None };
                self.registry.probed(&url, alive, at);
                continue;
            }
            let tells = self.started.get(&url).is_some_and(|known| known.tells);
            self.liveness.attempt(&url, Try { ask_start: !tells });
        }
    }

    fn probed(&mut self, url: &str, outcome: ProbeOutcome) {
        let at = now();
        if outcome == ProbeOutcome::Untried
            && let Some(suppressed) = self.untried_log.admit(url, at)
        {
            info!(
                url,
                suppressed,
                "cannot probe a server: its host name does not resolve on this host, or its URL is not opc.tcp; it stays listed"
            );
        }
        if let ProbeOutcome::Alive { start_time } = outcome {
            keep(&mut self.answered, self.most, url, at);
            if let Some(at) = start_time {
                let started = Started { at, tells: false };
                let before = self.started.get(url).map(|known| known.at);
                keep(&mut self.started, self.most, url, started);
                if before.is_none() {
                    self.new_starts.push((url.to_owned(), at));
                }
            }
            let back = self
                .asleep
                .iter()
                .find(|(_, asleep)| asleep.announcement.url == url);
            if let Some(instance) = back.map(|(instance, _)| instance.clone())
                && let Some(asleep) = self.asleep.remove(&instance)
            {
                self.registry.announced(asleep.announcement, at);
            }
        }
        self.registry.probed(url, outcome, at);
    }
}

/// Returns whether the capabilities are those of a Local Discovery Server (OPC 10000-12, Annex D).
pub(crate) fn is_lds(capabilities: &[String]) -> bool {
    let mut codes = capabilities.iter();
    codes.any(|code| code.eq_ignore_ascii_case("LDS"))
}

/// Stores a value of an endpoint, up to a limit of entries. Entries of endpoints that are no longer
/// watched are removed every second.
fn keep<T>(map: &mut BTreeMap<String, T>, most: usize, url: &str, value: T) {
    if map.len() < 4 * most || map.contains_key(url) {
        map.insert(url.to_owned(), value);
    }
}

/// Largest delay of a step on a busy machine. A longer delay counts as a standstill of this
/// program.
const LATE: Duration = Duration::from_millis(500);
/// The largest delay of an announced start time after the start time that the server itself
/// reports, in 100 ns. The start of another run is later.
const SAME_RUN: i64 = 20_000_000;
const TIDY_EVERY: Duration = Duration::from_secs(1);
/// Shortest interval between log messages for the same server that cannot be probed.
const LOG_EVERY: Duration = Duration::from_secs(600);
const TRY_ASLEEP: Duration = Duration::from_secs(1);
/// The longest pause between probes of an endpoint that answered before its loss.
const LONGEST_PAUSE_KNOWN: Duration = Duration::from_secs(2);
/// The longest pause between probes of an endpoint that never answered.
const LONGEST_PAUSE: Duration = Duration::from_secs(64);
/// The caches of mDNS have expired by then, so that mDNS reports a returning server.
const FORGET_ASLEEP: Duration = Duration::from_secs(150);

#[cfg(test)]
mod tests {
    use super::*;

    fn keeper() -> Keeper {
        Keeper::new(RegistrySettings::default(), None, None)
    }

    fn announced(instance: &str, capability: &str) -> MdnsEvent {
        MdnsEvent::Announced {
            announcement: AnnouncedServer {
                instance: instance.to_owned(),
                url: "opc.tcp://127.0.0.1:4840/".to_owned(),
                capabilities: vec![capability.to_owned()],
            },
            aside: Aside::default(),
        }
    }

    /// Returns whether an endpoint is watched after these announcements.
    fn watches(mut keeper: Keeper, announcements: &[(&str, &str)]) -> bool {
        for (instance, capability) in announcements {
            keeper.hear(announced(instance, capability));
        }
        while keeper.event().is_some() {}
        keeper.registry.watches("opc.tcp://127.0.0.1:4840/")
    }

    #[test]
    fn a_program_that_looks_for_a_discovery_server_probes_no_other_server() {
        assert!(watches(keeper(), &[("arm", "DA")]));
        assert!(!watches(keeper().lds_only(true), &[("arm", "DA")]));
        assert!(watches(keeper().lds_only(true), &[("lds", "lds")]));
        let no_longer = [("lds", "LDS"), ("lds", "DA")];
        assert!(!watches(keeper().lds_only(true), &no_longer));
    }
}
