//! The applications in the group (OPC 10000-14, 7.2.4.6.12).

use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::time::{Duration, Instant};

use mappings::SpaceId;
use uadp::EncodeError;
use uadp::discovery::{ProbeLimits, ProbeStep, ProbeTimer};

use crate::application::Application;

/// The own application, and the applications of other programs.
#[derive(Debug, Default)]
pub(super) struct Applications {
    own: Option<Application>,
    /// The timer of the probe to all applications.
    asking: Option<ProbeTimer>,
    heard: BTreeMap<(SpaceId, SocketAddr), (Application, Instant)>,
}

impl Applications {
    /// Sets the description of this program.
    pub(super) fn introduce(&mut self, own: Application) {
        self.own = Some(own);
    }

    /// Returns whether this program has a description.
    pub(super) const fn is_introduced(&self) -> bool {
        self.own.is_some()
    }

    /// Plans a probe for all applications, unless such a probe is in progress.
    pub(super) fn plan_probe(&mut self, (since, random): (Duration, u32)) {
        let limits = ProbeLimits {
            max_period: Duration::from_secs(1),
            attempts: 1,
        };
        self.asking
            .get_or_insert_with(|| ProbeTimer::new(since, random, limits));
    }

    /// Records the probe of another program for all applications.
    pub(super) fn handle_probe(&mut self, since: Duration) {
        if let Some(asking) = &mut self.asking {
            asking.handle_probe(since);
        }
    }

    pub(super) fn poll_timeout(&self) -> Option<Duration> {
        self.asking.as_ref()?.poll_timeout()
    }

    /// Returns whether the probe for all applications is due.
    pub(super) fn poll(&mut self, (since, random): (Duration, u32)) -> bool {
        let Some(asking) = &mut self.asking else {
            return false;
        };
        match asking.poll(since, random) {
            ProbeStep::Wait => false,
            ProbeStep::Send => true,
            ProbeStep::Answered | ProbeStep::GivenUp => {
                self.asking = None;
                false
            }
        }
    }

    /// Appends the announcement of the own application or of its Endpoints. Returns `None` without
    /// an own application.
    pub(super) fn write(
        &self,
        endpoints: bool,
        head: (SpaceId, u16),
        bytes: &mut Vec<u8>,
    ) -> Option<Result<(), EncodeError>> {
        let own = self.own.as_ref()?;
        Some(if endpoints {
            own.announce_endpoints(head, bytes)
        } else {
            own.announce(head, bytes)
        })
    }

    /// Returns the applications of other programs with the space and the address of each.
    pub(super) fn heard(&self) -> impl Iterator<Item = (SpaceId, SocketAddr, &Application)> {
        let heard = self.heard.iter();
        heard.map(|((space, from), (application, _))| (*space, *from, application))
    }

    /// Stores the announced application of another program.
    pub(super) fn meet(
        &mut self,
        key: (SpaceId, SocketAddr),
        application: Application,
        now: Instant,
    ) {
        let heard = &mut self.heard;
        if heard.len() >= MOST_APPLICATIONS && !heard.contains_key(&key) {
            // The program that was received longest ago is most likely to have ended.
            let oldest = heard.iter().min_by_key(|(_, (_, at))| *at);
            if let Some(oldest) = oldest.map(|(key, _)| *key) {
                heard.remove(&oldest);
            }
        }
        heard.insert(key, (application, now));
    }
}

/// The maximum number of stored applications. It is limited, because any sender in the group can
/// invent applications.
const MOST_APPLICATIONS: usize = 256;
