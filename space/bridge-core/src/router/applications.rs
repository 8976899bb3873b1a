//! Discovery of the applications in the group (OPC 10000-14, 7.2.4.6.12).

use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::time::{Duration, Instant};

use mappings::SpaceId;
use uadp::discovery::{
    ApplicationDescription, Included, List, Probe, ProbeLimits, ProbeStep, ProbeTimer, Subject,
};
use uadp::{NetworkMessage, NetworkMessageType, PublisherId, SecurityHeader};

use super::discovery::Discovery;
use super::{About, Router};
use crate::application::Application;
use crate::counters::Reason;
use crate::output::Output;
use crate::settings::Now;

/// The own application, and the applications of other programs.
#[derive(Debug, Default)]
pub(super) struct Applications {
    own: Option<Application>,
    /// The timer of the probe to all applications.
    asking: Option<ProbeTimer>,
    heard: BTreeMap<(SpaceId, SocketAddr), (Application, Instant)>,
}

impl Applications {
    pub(super) fn poll_timeout(&self) -> Option<Duration> {
        self.asking.as_ref()?.poll_timeout()
    }
}

impl Router {
    /// Sets the description of this program. It is announced once, and in response to probes for
    /// applications or for its Endpoints. The other applications are probed once. A program without
    /// values is discovered by this description.
    pub fn introduce(&mut self, own: Application, now: Now) {
        let discovery = self.discovery(now);
        let since = discovery.since_start(now);
        discovery.applications.own = Some(own);
        let subject = Subject::ApplicationInformation;
        // A planned announcement already contains the information.
        let _planned = discovery
            .announcer
            .announce(subject, Included::default(), since)
            .is_ok();
        self.ask_applications(now);
    }

    /// Probes for all applications once, unless a probe is in progress.
    pub(super) fn ask_applications(&mut self, now: Now) {
        let random = u32::try_from(now.utc.unix_nanos() & 0xFFFF_FFFF).unwrap_or_default();
        let discovery = self.discovery(now);
        let since = discovery.since_start(now);
        let limits = ProbeLimits {
            max_period: Duration::from_secs(1),
            attempts: 1,
        };
        discovery
            .applications
            .asking
            .get_or_insert_with(|| ProbeTimer::new(since, random, limits));
        discovery.reckon();
    }

    /// Returns the known other applications of the group with the space and the address of each.
    pub fn applications(&self) -> impl Iterator<Item = (SpaceId, SocketAddr, &Application)> {
        let heard = self.discovery.iter().flat_map(|of| &of.applications.heard);
        heard.map(|((space, from), (application, _))| (*space, *from, application))
    }

    /// Handles a probe without a particular Publisher. Returns false for all other messages.
    pub(super) fn is_for_all(
        &mut self,
        message: &NetworkMessage<'_>,
        from: SocketAddr,
        now: Now,
    ) -> bool {
        if message.message_type() != NetworkMessageType::Probe
            || !matches!(message.publisher_id(), None | Some(PublisherId::Byte(0)))
            || Probe::decode(message) != Ok(Probe::FindApplications)
        {
            return false;
        }
        let ours = self.values.settings.source.is_some() && self.values.is_source(from);
        if !ours {
            self.is_asked(&Probe::FindApplications, now);
        }
        true
    }

    /// Handles a probe for the own application or for all applications.
    pub(super) fn is_asked(&mut self, probe: &Probe<'_>, now: Now) {
        let discovery = self.discovery(now);
        let since = discovery.since_start(now);
        if discovery.applications.own.is_some() {
            discovery.announcer.handle_probe(probe, since);
        }
        if *probe == Probe::FindApplications
            && let Some(asking) = &mut discovery.applications.asking
        {
            asking.handle_probe(since);
        }
        discovery.reckon();
    }

    /// Sends the probe to all applications if it is due.
    pub(super) fn ask_all(&mut self, discovery: &mut Discovery, (since, random): (Duration, u32)) {
        let Some(asking) = &mut discovery.applications.asking else {
            return;
        };
        match asking.poll(since, random) {
            ProbeStep::Wait => {}
            ProbeStep::Send => {
                let mut bytes = self.values.buffer();
                let encoded =
                    Probe::FindApplications.encode(None, SecurityHeader::NONE, &mut bytes);
                if encoded.is_ok() {
                    self.values.tell(Output::Discovery { bytes });
                }
            }
            ProbeStep::Answered | ProbeStep::GivenUp => discovery.applications.asking = None,
        }
    }

    /// Announces the own application or its Endpoints.
    pub(super) fn tell_application(
        &mut self,
        discovery: &Discovery,
        endpoints: bool,
        sequence_number: u16,
    ) {
        let Some(own) = &discovery.applications.own else {
            return;
        };
        let mut bytes = self.values.buffer();
        let head = (self.values.settings.own, sequence_number);
        let encoded = match endpoints {
            false => own.announce(head, &mut bytes),
            true => own.announce_endpoints(head, &mut bytes),
        };
        let (max_datagram, _) = self.values.sizes();
        match encoded {
            Ok(()) if bytes.len() <= usize::from(max_datagram) => {
                self.values.tell(Output::Discovery { bytes });
            }
            Ok(()) | Err(_) => {
                self.values.recycle(bytes);
                let what = About {
                    topic: None,
                    from: None,
                };
                self.values.count(what, Reason::TooBig, 1, || {
                    "what this program is does not fit a datagram".to_owned()
                });
            }
        }
    }

    /// Stores the announced application of another program.
    pub(super) fn meet_application(
        &mut self,
        (description, capabilities): (&ApplicationDescription<'_>, List<'_, Option<&str>>),
        (space, from): (SpaceId, SocketAddr),
        now: Now,
    ) {
        let Some(application) = Application::read(description, capabilities) else {
            self.values.count(
                About::sender(from),
                (Reason::MetaData, "application"),
                1,
                || {
                    "it says what application it is, in words too long or that cannot be shown"
                        .to_owned()
                },
            );
            return;
        };
        let heard = &mut self.discovery(now).applications.heard;
        let key = (space, from);
        if heard.len() >= MOST_APPLICATIONS && !heard.contains_key(&key) {
            // The program that was received longest ago is most likely to have ended.
            let oldest = heard.iter().min_by_key(|(_, (_, at))| *at);
            if let Some(oldest) = oldest.map(|(key, _)| *key) {
                heard.remove(&oldest);
            }
        }
        heard.insert(key, (application, now.monotonic));
    }
}

/// The maximum number of stored applications. It is limited, because any sender in the group can
/// invent applications.
const MOST_APPLICATIONS: usize = 256;
