//! The routes between carriers: which received messages are forwarded, and which are copies.
//!
//! Messages of a publisher go from the carrier that lists its name under `forward` to the other
//! carriers; requests and confirmations for it go back to this carrier. A message therefore never
//! returns to the carrier of its publisher. If another program forwards in the other direction, the
//! copies are recognised by their ids and sequence numbers.

use std::collections::HashMap;
use std::collections::hash_map::RandomState;
use std::hash::{BuildHasher, DefaultHasher, Hash, Hasher};
use std::sync::Arc;
use std::time::{Duration, Instant};

use bridge_core::{Now, is_aged};
use broker::{MessageRole, MessageScope};
use mappings::{
    Broker, CarrierMedium, ConfiguredCarrier, ForwardedName, Lasting, Mapping, SpaceId, TopicId,
    Variable,
};
use tokio::sync::watch;
use transport::{CarrierRules, ForwardTo, Judgement, MessagePath};
use uadp::action::{ActionDialect, ActionKind};
use uadp::{
    DataSetMessage, DecodeError, MessageKind, NetworkMessage, NetworkMessageType, PublisherId,
    Timestamp,
};

use crate::clock::now;
use crate::mapping_file::RunningMapping;

/// The routes of the running mapping.
#[derive(Debug)]
pub(super) struct LiveRoutes {
    routes: Routes,
    /// The changes of the mapping; `None` if it does not change.
    changes: Option<watch::Receiver<RunningMapping>>,
}

impl LiveRoutes {
    pub(super) fn new(
        mapping: &Arc<Mapping>,
        changes: Option<watch::Receiver<RunningMapping>>,
    ) -> Self {
        Self {
            routes: Routes::new(mapping),
            changes,
        }
    }

    /// Adopts the mapping if it has changed.
    fn follow(&mut self) {
        let Some(changes) = &mut self.changes else {
            return;
        };
        // Without its sender, the mapping does not change any more.
        if changes.has_changed().unwrap_or(false) {
            let mapping = Arc::clone(&changes.borrow_and_update().mapping);
            self.routes.adopt(&mapping);
        }
    }
}

impl CarrierRules for LiveRoutes {
    fn sent(&mut self, message: &[u8]) {
        self.routes.sent(message, now().monotonic);
    }

    fn judge(&mut self, message: &[u8], path: MessagePath) -> Judgement {
        self.follow();
        self.routes.judge(message, path, now())
    }
}

/// The routes between the carriers of a mapping.
#[derive(Debug)]
struct Routes {
    ends: Vec<End>,
    mapping: Arc<Mapping>,
    seen: Seen,
    random: RandomState,
}

/// A carrier.
#[derive(Debug)]
struct End {
    medium: CarrierMedium,
    /// Names of publishers at the carrier.
    names: Vec<ForwardedName>,
}

impl End {
    /// Returns the age at which messages of the carrier are late; `None` if it stores no messages.
    const fn within(&self) -> Option<Duration> {
        match &self.medium {
            CarrierMedium::Udp(_) | CarrierMedium::Ethernet(_) | CarrierMedium::SharedMemory(_) => {
                None
            }
            CarrierMedium::Mqtt(broker) => Some(broker.within),
        }
    }

    fn has_space(&self, publisher: u16) -> bool {
        let mut names = self.names.iter();
        names.any(|name| u16::from(name.space().get()) == publisher)
    }
}

impl Routes {
    fn new(mapping: &Arc<Mapping>) -> Self {
        let carriers = mapping.pubsub().carriers.iter();
        let ends = carriers.map(|ConfiguredCarrier { medium, forward }| End {
            medium: medium.clone(),
            names: forward.clone(),
        });
        Self {
            ends: ends.collect(),
            mapping: Arc::clone(mapping),
            seen: Seen::default(),
            random: RandomState::new(),
        }
    }

    /// Adopts the names of a changed mapping. Other carriers take effect at the next start, and the
    /// names with them.
    fn adopt(&mut self, mapping: &Arc<Mapping>) {
        self.mapping = Arc::clone(mapping);
        let carriers = &mapping.pubsub().carriers;
        let media = carriers.iter().map(|carrier| &carrier.medium);
        if !media.eq(self.ends.iter().map(|end| &end.medium)) {
            return;
        }
        for (end, carrier) in self.ends.iter_mut().zip(carriers) {
            end.names.clone_from(&carrier.forward);
        }
    }

    /// Records an own message, so that a copy that another program forwards is recognised.
    fn sent(&mut self, message: &[u8], at: Instant) {
        if let Ok(message) = NetworkMessage::decode(message) {
            let identity = self.identity(&message);
            self.seen.note(identity, None, at);
        }
    }

    fn judge(&mut self, message: &[u8], path: MessagePath, now: Now) -> Judgement {
        let Ok(message) = NetworkMessage::decode(message) else {
            // The Router counts it.
            return Judgement::default();
        };
        let Some(scope) = broker::scope(&message) else {
            return Judgement::default();
        };
        let identity = self.identity(&message);
        let sight = self.seen.note(identity, Some(path), now.monotonic);
        let sight = self.sight_of_commands(sight, &message, scope, (path, now.monotonic));
        // Several programs send the same probe.
        if sight == Sight::Copy && scope.role != MessageRole::Probe {
            return Judgement {
                dropped: Some(DOUBLED),
                ..Judgement::default()
            };
        }
        let carriers = self.targets(&message, scope, path.carrier);
        if carriers.is_empty() {
            return Judgement::default();
        }
        let content = self.content(&message, scope);
        let stores = self.ends.get(path.carrier).and_then(End::within);
        let is_request = self.is_request(scope, path.carrier);
        // This program may have been stopped for a while, and no receiver on UDP checks the age.
        let acts = content.is_command() || is_request;
        let judged = stores.or_else(|| acts.then_some(Broker::WITHIN));
        // Probes are forwarded only to carriers of their publisher. The copy of a probe that
        // arrives at such a carrier may be a forwarded one.
        let is_echo = sight == Sight::Copy && self.is_at(path.carrier, scope.publisher);
        let refused = match (sight, judged) {
            // A loop is at least this fast, and a repetition by a program is slower.
            (Sight::Repeated { since }, _) if since < LOOP => Some(LOOPED),
            _ if is_echo => Some(LOOPED),
            // On UDP each repetition of a command has a new time, so that a broker could deliver
            // the command after it was given up.
            (Sight::Repeated { .. }, _) if content.is_command() && stores.is_none() => {
                Some(REPEATED)
            }
            _ if !self.may_cross(&message, scope, path) => Some(NOT_AUTHORIZED),
            (_, Some(within)) => content.refuse(&message, (scope, is_request), within, now.utc),
            (Sight::New | Sight::Copy | Sight::Repeated { .. }, None) => None,
        };
        if refused.is_some() {
            return Judgement {
                not_forwarded: refused,
                ..Judgement::default()
            };
        }
        let limits = carriers
            .iter()
            .filter_map(|to| self.ends.get(*to)?.within());
        let within = limits.chain(content.within()).min();
        let is_value = scope.role == MessageRole::Value;
        Judgement {
            forward: Some(ForwardTo {
                carriers,
                replaceable: is_value
                    && content.is_state()
                    && !content.is_command()
                    && scope.writer.is_some(),
                command: is_value && content.is_command(),
                within,
            }),
            ..Judgement::default()
        }
    }

    /// Returns whether a carrier has names of the publisher.
    fn is_at(&self, carrier: usize, publisher: u16) -> bool {
        let end = self.ends.get(carrier);
        end.is_some_and(|end| end.has_space(publisher))
    }

    /// Returns the sight of a message of several writers: a command that it repeats beside new
    /// values makes it a repetition.
    fn sight_of_commands(
        &mut self,
        sight: Sight,
        message: &NetworkMessage<'_>,
        scope: MessageScope,
        (path, now): (MessagePath, Instant),
    ) -> Sight {
        let mut result = sight;
        for identity in self.commands(message, scope) {
            let of_command = self.seen.note(identity, Some(path), now);
            if sight == Sight::New && matches!(of_command, Sight::Repeated { .. }) {
                result = of_command;
            }
        }
        result
    }

    /// Returns the identities that the commands of a message of several writers have as messages of
    /// their own.
    fn commands(&self, message: &NetworkMessage<'_>, scope: MessageScope) -> Vec<u64> {
        if scope.writer.is_some() || scope.role != MessageRole::Value || is_hidden(message) {
            return Vec::new();
        }
        let mut identities = Vec::new();
        for data in message.messages().filter_map(Result::ok) {
            let variable = data.writer_id.and_then(|of| self.variable(scope, of));
            let is_command = variable.is_some_and(|variable| variable.confirmed_within.is_some());
            if !is_command || data.kind == MessageKind::KeepAlive {
                continue;
            }
            let mut hasher = self.hasher(message);
            if hash_numbers(&data, &mut hasher) {
                identities.push(hasher.finish());
            }
        }
        identities
    }

    fn variable(&self, scope: MessageScope, writer: u16) -> Option<&Variable> {
        let topic = TopicId::new(scope.publisher, scope.group?, writer)?;
        self.mapping.variable(topic)
    }

    /// Returns the carriers that a message of a carrier is forwarded to.
    fn targets(&self, message: &NetworkMessage<'_>, scope: MessageScope, by: usize) -> Vec<usize> {
        let MessageScope {
            publisher,
            group,
            role,
            writer: _,
        } = scope;
        let home = self.home(publisher, scope);
        let others = || (0..self.ends.len()).filter(|to| *to != by).collect();
        let back = |home: Option<usize>| home.filter(|home| *home != by).into_iter().collect();
        match role {
            MessageRole::Value | MessageRole::Response | MessageRole::HiddenCall
                if home == Some(by) =>
            {
                others()
            }
            MessageRole::Request | MessageRole::HiddenCall => back(home),
            MessageRole::Response => requestor(message)
                .map(|of| back(self.home(of, scope)))
                .unwrap_or_default(),
            // An announcement of the whole publisher is needed with each of its topics.
            MessageRole::Announcement => {
                let is_here = match group {
                    Some(_) => home == Some(by),
                    None => self.is_at(by, publisher),
                };
                if is_here { others() } else { Vec::new() }
            }
            MessageRole::Probe => {
                let ends = self.ends.iter().enumerate();
                let homes = ends.filter(|(to, end)| *to != by && end.has_space(publisher));
                homes.map(|(to, _)| to).collect()
            }
            MessageRole::Value => Vec::new(),
        }
    }

    /// Returns whether a message that arrived at a carrier is a request.
    fn is_request(&self, scope: MessageScope, by: usize) -> bool {
        match scope.role {
            MessageRole::Request => true,
            // A hidden message from the carrier of the executor is a response or a confirmation.
            MessageRole::HiddenCall => self.home(scope.publisher, scope) != Some(by),
            MessageRole::Value
            | MessageRole::Announcement
            | MessageRole::Probe
            | MessageRole::Response => false,
        }
    }

    /// Returns whether a request may cross. The executor would treat it as a request of this
    /// program, so its sender is judged here as an executor at the carrier judges it.
    fn may_cross(
        &self,
        message: &NetworkMessage<'_>,
        scope: MessageScope,
        path: MessagePath,
    ) -> bool {
        let is_request = self.is_request(scope, path.carrier);
        let end = self.ends.get(path.carrier);
        let is_stranger = end.is_some_and(|end| match &end.medium {
            CarrierMedium::Udp(_) => !path.from.ip().is_loopback(),
            CarrierMedium::Ethernet(_) => true,
            CarrierMedium::SharedMemory(_) => false,
            CarrierMedium::Mqtt(broker) => !broker.acl,
        });
        let topic = || TopicId::new(scope.publisher, scope.group?, scope.writer?);
        let call = || topic().and_then(|topic| self.mapping.call(topic));
        !is_request || !is_stranger || message.is_sealed() || call().is_some_and(|call| call.open)
    }

    /// Returns the carrier that lists a name of the publisher for the group and writer.
    fn home(&self, publisher: u16, scope: MessageScope) -> Option<usize> {
        let covers = |name: &ForwardedName| name.covers(publisher, scope.group, scope.writer);
        let mut ends = self.ends.iter();
        ends.position(|end| end.names.iter().any(covers))
    }

    /// Returns the statement of the mapping about the contents of a message. A message of several
    /// writers counts as its most urgent command, if it has one.
    fn content(&self, message: &NetworkMessage<'_>, scope: MessageScope) -> Content<'_> {
        let command = || {
            let writers = message.writer_ids().into_iter().flatten();
            let variables = writers.filter_map(|writer| self.variable(scope, writer));
            let commands = variables.filter(|variable| variable.confirmed_within.is_some());
            commands.min_by_key(|variable| variable.confirmed_within)
        };
        let is_readable = scope.role == MessageRole::Value && !is_hidden(message);
        let is_keep_alive = |data: Result<DataSetMessage<'_>, DecodeError>| {
            data.is_ok_and(|data| data.kind == MessageKind::KeepAlive)
        };
        Content {
            variable: match scope.writer {
                Some(writer) => self.variable(scope, writer),
                None => command(),
            },
            has_value: !(is_readable && message.messages().all(is_keep_alive)),
        }
    }

    /// Returns the identity of a message, which its copies share, also if a broker had the copy as
    /// JSON.
    fn identity(&self, message: &NetworkMessage<'_>) -> u64 {
        let mut hasher = self.hasher(message);
        let is_plain = message.message_type() == NetworkMessageType::DataSet
            && !(is_hidden(message) || message.is_action());
        let mut is_numbered = is_plain;
        if is_plain {
            for data in message.messages() {
                let Ok(data) = data else {
                    is_numbered = false;
                    break;
                };
                is_numbered &= hash_numbers(&data, &mut hasher);
            }
        }
        if !is_numbered {
            message.payload().hash(&mut hasher);
        }
        hasher.finish()
    }

    /// Returns a hasher that has the publisher and the group of a message.
    fn hasher(&self, message: &NetworkMessage<'_>) -> DefaultHasher {
        let mut hasher = self.random.build_hasher();
        format_id(message.publisher_id()).hash(&mut hasher);
        let group = message.group().and_then(|group| group.writer_group_id);
        group.hash(&mut hasher);
        hasher
    }
}

/// Hashes the ids and numbers of a DataSetMessage. Returns whether it has a number or a time, which
/// distinguishes it from other messages of its writer.
fn hash_numbers(data: &DataSetMessage<'_>, hasher: &mut DefaultHasher) -> bool {
    let header = data.header();
    let time = header.timestamp.map(|time| time.0);
    let is_keep_alive = data.kind == MessageKind::KeepAlive;
    (data.writer_id, header.sequence_number, time, is_keep_alive).hash(hasher);
    header.sequence_number.is_some() || time.is_some()
}

/// Returns the number of a PublisherId, or a hash of its text.
fn format_id(id: Option<PublisherId<'_>>) -> Option<(u64, String)> {
    Some(match id? {
        PublisherId::Byte(id) => (id.into(), String::new()),
        PublisherId::UInt16(id) => (id.into(), String::new()),
        PublisherId::UInt32(id) => (id.into(), String::new()),
        PublisherId::UInt64(id) => (id, String::new()),
        PublisherId::String(id) => (0, format!("{id:?}")),
    })
}

/// Returns the space that has requested a response, or sent the command that it confirms.
fn requestor(message: &NetworkMessage<'_>) -> Option<u16> {
    let first = message
        .actions(ActionDialect::Standard)
        .ok()?
        .next()?
        .ok()?;
    let PublisherId::UInt16(id) = first.action.requestor_id? else {
        return None;
    };
    (first.action.kind == ActionKind::Response).then_some(id)
}

/// Returns whether the contents of a message cannot be read.
fn is_hidden(message: &NetworkMessage<'_>) -> bool {
    message.is_sealed() || message.is_chunk()
}

/// The contents of a message.
#[derive(Clone, Copy)]
struct Content<'m> {
    /// The variable; `None` if the mapping has none.
    variable: Option<&'m Variable>,
    /// Whether the message may have a value. A keep-alive has none.
    has_value: bool,
}

impl Content<'_> {
    fn is_command(self) -> bool {
        self.within().is_some()
    }

    fn is_state(self) -> bool {
        let is_state = |variable: &Variable| variable.lasting == Lasting::State;
        self.has_value && self.variable.is_some_and(is_state)
    }

    /// Returns the time for which a command counts.
    fn within(self) -> Option<Duration> {
        self.variable.filter(|_| self.has_value)?.confirmed_within
    }

    /// Returns the reason why a message that a broker delivered is late.
    fn refuse(
        self,
        message: &NetworkMessage<'_>,
        (scope, is_request): (MessageScope, bool),
        within: Duration,
        now: Timestamp,
    ) -> Option<&'static str> {
        let header = message.header();
        let sent = header.timestamp.map(|time| Timestamp {
            time,
            picoseconds: header.picoseconds.unwrap_or_default(),
        });
        let own = match scope.role {
            MessageRole::Request => hint(message),
            MessageRole::Value => self.within(),
            MessageRole::Announcement
            | MessageRole::Probe
            | MessageRole::Response
            | MessageRole::HiddenCall => None,
        };
        let limit = own.map_or(within, |own| own.min(within));
        if sent.is_some_and(|sent| is_aged(sent, now, limit)) {
            return Some(LATE);
        }
        let taken = || self.taken(message);
        let is_timed = match scope.role {
            MessageRole::Request | MessageRole::HiddenCall => !is_request || sent.is_some(),
            MessageRole::Value if self.is_command() => {
                if taken().is_some_and(|taken| is_aged(taken, now, limit)) {
                    return Some(LATE);
                }
                sent.is_some() || taken().is_some()
            }
            MessageRole::Value if self.has_value && !self.is_state() && sent.is_none() => {
                match taken() {
                    Some(taken) if is_aged(taken, now, limit) => return Some(LATE),
                    taken => taken.is_some(),
                }
            }
            MessageRole::Value
            | MessageRole::Announcement
            | MessageRole::Probe
            | MessageRole::Response => true,
        };
        (!is_timed).then_some(UNTIMED)
    }

    /// Returns the time at which the only sample of a message was taken. Clients of an OPC UA
    /// server have their own clocks, so their times do not count.
    fn taken(self, message: &NetworkMessage<'_>) -> Option<Timestamp> {
        let is_by_clients = self
            .variable
            .is_some_and(|variable| variable.topic.space == SpaceId::UA);
        if is_by_clients || is_hidden(message) {
            return None;
        }
        let first = message.messages().next()?.ok()?;
        let time = first.header().timestamp?;
        Some(Timestamp::from(time))
    }
}

/// Returns the time for which the requestor waits.
fn hint(message: &NetworkMessage<'_>) -> Option<Duration> {
    let first = message
        .actions(ActionDialect::Standard)
        .ok()?
        .next()?
        .ok()?;
    first.action.timeout()
}

/// The messages of the last seconds, by identity.
#[derive(Debug, Default)]
struct Seen {
    young: HashMap<u64, Entry>,
    old: HashMap<u64, Entry>,
    turned: Option<Instant>,
}

#[derive(Debug, Clone, Copy)]
struct Entry {
    /// The way of the first copy; `None` for an own message.
    path: Option<MessagePath>,
    /// The time of the last copy that arrived in this way.
    last: Instant,
}

/// The relation of a message to earlier messages.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Sight {
    New,
    /// The message arrived in the same way before, the last time `since` ago.
    Repeated {
        since: Duration,
    },
    /// The message arrived in another way, or is an own message.
    Copy,
}

impl Seen {
    fn note(&mut self, identity: u64, path: Option<MessagePath>, now: Instant) -> Sight {
        let turned = *self.turned.get_or_insert(now);
        if self.young.len() >= MOST_SEEN || now.saturating_duration_since(turned) >= REMEMBERED {
            self.old = std::mem::take(&mut self.young);
            self.turned = Some(now);
        }
        let known = self
            .young
            .get(&identity)
            .or_else(|| self.old.get(&identity));
        let known = known.map(|entry| (*entry, now.saturating_duration_since(entry.last)));
        let (entry, sight) = match known {
            Some((entry, since)) if entry.path == path => {
                (Entry { last: now, ..entry }, Sight::Repeated { since })
            }
            // An own message that is sent again is not a copy. Neither is a message of a publisher
            // that has moved.
            Some((entry, since)) if path.is_some() && since < COPIED => (entry, Sight::Copy),
            Some(_) | None => (Entry { path, last: now }, Sight::New),
        };
        self.young.insert(identity, entry);
        sight
    }
}

/// A message that another carrier delivered before, or an own message.
const DOUBLED: &str = "doubled";
/// A message of a route that was forwarded immediately before.
const LOOPED: &str = "not_forwarded_looped";
/// The repetition of a command.
const REPEATED: &str = "not_forwarded_repeated_command";
const LATE: &str = "not_forwarded_late";
const UNTIMED: &str = "not_forwarded_untimed";
/// A request of an unknown sender.
const NOT_AUTHORIZED: &str = "not_forwarded_unauthorized";
/// The shortest time between repetitions that are forwarded.
const LOOP: Duration = Duration::from_millis(50);
/// The time in which a message by another way is a copy.
const COPIED: Duration = Duration::from_secs(3);
/// The shortest time for which messages are remembered.
const REMEMBERED: Duration = Duration::from_secs(10);
/// The number of remembered messages in each half.
const MOST_SEEN: usize = 16_384;

#[cfg(test)]
mod tests;
