//! Which applications there are in the group: asked for and answered (OPC 10000-14, 7.2.4.6.12).

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

/// Our own application, and those of others.
#[derive(Debug, Default)]
pub(super) struct Applications {
    own: Option<Application>,
    /// When all are asked.
    asking: Option<ProbeTimer>,
    heard: BTreeMap<(SpaceId, SocketAddr), (Application, Instant)>,
}

impl Applications {
    pub(super) fn poll_timeout(&self) -> Option<Duration> {
        self.asking.as_ref()?.poll_timeout()
    }
}

impl Router {
    /// Takes the description of this program: it is announced once, and to everyone who asks for applications or for its
    /// Endpoints, and the other applications are asked for once. A program without values is known to others by it.
    pub fn introduce(&mut self, own: Application, now: Now) {
        let discovery = self.discovery(now);
        let since = discovery.since_start(now);
        discovery.applications.own = Some(own);
        let subject = Subject::ApplicationInformation;
        // An announcement that is planned already says it all.
        let _planned = discovery
            .announcer
            .announce(subject, Included::default(), since)
            .is_ok();
        self.ask_applications(now);
    }

    /// Asks once which applications there are, unless they are just being asked.
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

    /// The other applications of the group that were heard of: the space each publishes for, and where it is.
    pub fn applications(&self) -> impl Iterator<Item = (SpaceId, SocketAddr, &Application)> {
        let heard = self.discovery.iter().flat_map(|of| &of.applications.heard);
        heard.map(|((space, from), (application, _))| (*space, *from, application))
    }

    /// Takes a question that is for no Publisher in particular. False for all else.
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
        let ours = self.settings.source.is_some() && self.is_source(from);
        if !ours {
            self.is_asked(&Probe::FindApplications, now);
        }
        true
    }

    /// Somebody asks what we are, or all.
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

    /// Asks who there is, when it is time.
    pub(super) fn ask_all(&mut self, discovery: &mut Discovery, (since, random): (Duration, u32)) {
        let Some(asking) = &mut discovery.applications.asking else {
            return;
        };
        match asking.poll(since, random) {
            ProbeStep::Wait => {}
            ProbeStep::Send => {
                let mut bytes = self.buffer();
                let encoded =
                    Probe::FindApplications.encode(None, SecurityHeader::NONE, &mut bytes);
                if encoded.is_ok() {
                    self.tell(Output::Discovery { bytes });
                }
            }
            ProbeStep::Answered | ProbeStep::GivenUp => discovery.applications.asking = None,
        }
    }

    /// Tells what we are, or where our Endpoints are.
    pub(super) fn tell_application(
        &mut self,
        discovery: &Discovery,
        endpoints: bool,
        sequence_number: u16,
    ) {
        let Some(own) = &discovery.applications.own else {
            return;
        };
        let mut bytes = self.buffer();
        let head = (self.settings.own, sequence_number);
        let encoded = match endpoints {
            false => own.announce(head, &mut bytes),
            true => own.announce_endpoints(head, &mut bytes),
        };
        let (max_datagram, _) = self.sizes();
        match encoded {
            Ok(()) if bytes.len() <= usize::from(max_datagram) => {
                self.tell(Output::Discovery { bytes });
            }
            Ok(()) | Err(_) => {
                self.recycle(bytes);
                let what = About {
                    topic: None,
                    from: None,
                };
                self.count(what, Reason::TooBig, 1, || {
                    "what this program is does not fit a datagram".to_owned()
                });
            }
        }
    }

    /// Takes in what another says it is.
    pub(super) fn meet_application(
        &mut self,
        (description, capabilities): (&ApplicationDescription<'_>, List<'_, Option<&str>>),
        (space, from): (SpaceId, SocketAddr),
        now: Now,
    ) {
        let Some(application) = Application::read(description, capabilities) else {
            self.count(
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
            // Whoever was heard longest ago is most likely gone.
            let oldest = heard.iter().min_by_key(|(_, (_, at))| *at);
            if let Some(oldest) = oldest.map(|(key, _)| *key) {
                heard.remove(&oldest);
            }
        }
        heard.insert(key, (application, now.monotonic));
    }
}

/// Whoever can send to the group can make applications up.
const MOST_APPLICATIONS: usize = 256;
