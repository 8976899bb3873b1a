//! Message security: the SecurityGroups of a mapping and their keys.
//!
//! Every received message passes [`Guard::open`] before its content is used, and every sent message
//! passes [`Guard::seal`]. Messages without a WriterGroupId, such as probes and announcements,
//! belong to the group without namespaces of its own, or else to the first secured group.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use mappings::{GroupMode, GroupPolicy, Replay, SecurityGroup};
use uadp::{
    CountedBy, KeyError, NetworkMessage, NetworkMessageType, Opener, OpenerOptions, Seal,
    SealError, Sealer, SecurityError, SecurityMode, SecurityPolicy, TokenKeys,
};

use crate::counters::Reason;

/// Opens received messages and seals sent messages according to the groups of a mapping.
#[derive(Debug)]
pub struct Guard {
    groups: Vec<Group>,
    by_namespace: BTreeMap<u16, usize>,
    /// The group of the namespaces that no group lists.
    rest: Option<usize>,
    /// The group of messages without a namespace.
    discovery: Option<usize>,
    /// The random part of the nonces of this program instance; nothing is sealed without it.
    mark: Option<[u8; 4]>,
    /// The origin of time for the openers.
    start: Option<Instant>,
}

/// The keys of a group, from a file or from a Security Key Service (OPC 10000-14, 8.3.2).
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct KeyDelivery {
    /// The SecurityTokenId of the first key, which is the current key.
    pub first_token_id: u32,
    /// The current key and the future keys, in their order.
    pub keys: Vec<TokenKeys>,
    /// The time until the second key becomes current. `None` if the first key is used until new
    /// keys are set.
    pub time_to_next: Option<Duration>,
    /// The lifetime of each further key.
    pub lifetime: Duration,
}

/// The state of a group for users.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct GroupState {
    /// The SecurityGroupId.
    pub group: String,
    /// The security mode of its messages.
    pub mode: GroupMode,
    /// The SecurityTokenId of the current key; `None` before the first key.
    pub token_id: Option<u32>,
    /// The SecurityTokenId of the next key, if the next key is known.
    pub next_token_id: Option<u32>,
    /// Whether the lifetime of the current key has passed without a next key.
    pub overdue: bool,
}

/// A rejected message.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Unopened {
    /// The reason, for its counter.
    pub reason: Reason,
    /// The case of the reason.
    pub case: &'static str,
    /// The details for users.
    pub detail: String,
}

#[derive(Debug)]
struct Group {
    described: SecurityGroup,
    /// `None` for a group without security.
    secured: Option<Secured>,
}

#[derive(Debug)]
struct Secured {
    sealer: Sealer,
    opener: Opener,
    /// The time at which the next key becomes current.
    next: Option<Instant>,
    lifetime: Duration,
    overdue: bool,
    /// Whether new keys are needed, because a message used an unknown key or no next key exists.
    /// `told` holds the time of the last request for keys.
    wanted: bool,
    told: Option<Instant>,
}

impl Guard {
    /// Creates a guard for the groups; `None` if no group is secured.
    #[must_use]
    pub fn new(groups: &[SecurityGroup]) -> Option<Self> {
        let mut guard = Self {
            groups: Vec::new(),
            by_namespace: BTreeMap::new(),
            rest: None,
            discovery: None,
            mark: None,
            start: None,
        };
        guard.replace(groups).then_some(guard)
    }

    /// Sets the random bytes of this program instance. Nothing is sealed before. Two programs with
    /// the same bytes would use the same nonces, which breaks the encryption of both.
    pub const fn set_mark(&mut self, mark: [u8; 4]) {
        self.mark = Some(mark);
    }

    /// Replaces the groups. A group that differs only in its namespaces or its key source keeps its
    /// keys and its replay state. Returns false if no group is secured.
    pub fn replace(&mut self, groups: &[SecurityGroup]) -> bool {
        let mut before = std::mem::take(&mut self.groups);
        self.by_namespace.clear();
        self.rest = None;
        for (at, described) in groups.iter().enumerate() {
            if described.namespaces.is_empty() {
                self.rest = Some(at);
            }
            for namespace in &described.namespaces {
                self.by_namespace.insert(*namespace, at);
            }
            let same = before.iter().position(|group| group.is_as(described));
            let secured = match same {
                Some(same) => before.swap_remove(same).secured,
                None => Secured::new(described),
            };
            self.groups.push(Group {
                described: described.clone(),
                secured,
            });
        }
        let first = self.groups.iter().position(|group| group.secured.is_some());
        self.discovery = self.rest.filter(|at| self.secured(*at).is_some()).or(first);
        self.discovery.is_some()
    }

    /// Sets the keys of a group. Keys of unknown groups are ignored.
    ///
    /// # Errors
    /// Returns a [`KeyError`]; the previous keys stay in use.
    pub fn set_keys(
        &mut self,
        group: &str,
        delivery: &KeyDelivery,
        now: Instant,
    ) -> Result<(), KeyError> {
        let groups = self.groups.iter_mut();
        let mut of = groups.filter(|each| each.described.id == group);
        let Some(secured) = of.next().and_then(|group| group.secured.as_mut()) else {
            return Ok(());
        };
        let (first, keys) = (delivery.first_token_id, &delivery.keys);
        secured.opener.update_keys(first, keys.iter().cloned())?;
        secured.sealer.update_keys(first, keys.iter().cloned())?;
        secured.lifetime = delivery.lifetime;
        // If the sealer is ahead of the delivered keys, its next key change waits until the key
        // source has caught up.
        let ahead = secured.sealer.current_token_id().and_then(|current| {
            let mut tokens = (0_u32..).zip(tokens(first)).take(keys.len());
            Some(tokens.find(|(_, token)| *token == current)?.0)
        });
        if let Some(ahead) = ahead {
            let until = |time| now + time + delivery.lifetime.saturating_mul(ahead);
            secured.next = delivery.time_to_next.map(until);
        }
        secured.overdue = false;
        Ok(())
    }

    /// Returns the state of each secured group.
    pub fn states(&self) -> impl Iterator<Item = GroupState> {
        self.groups.iter().filter_map(|group| {
            let secured = group.secured.as_ref()?;
            Some(GroupState {
                group: group.described.id.clone(),
                mode: group.described.mode,
                token_id: secured.sealer.current_token_id(),
                next_token_id: secured.sealer.next_token_id(),
                overdue: secured.overdue,
            })
        })
    }

    /// Returns whether messages in a namespace are secured.
    #[must_use]
    pub fn is_secured(&self, namespace: u16) -> bool {
        self.of(Some(namespace)).is_some()
    }

    /// Returns the index of the secured group of a namespace; `None` if the namespace is not
    /// secured.
    pub(crate) fn group_of(&self, namespace: u16) -> Option<usize> {
        self.of(Some(namespace))
    }

    /// Returns whether both namespaces belong to the same secured group, or are both not secured.
    pub(crate) fn is_alike(&self, one: u16, other: u16) -> bool {
        self.of(Some(one)) == self.of(Some(other))
    }

    /// Returns whether any namespace is not secured.
    fn is_mixed(&self) -> bool {
        let open = |at: &usize| self.secured(*at).is_none();
        self.rest.is_none_or(|at| open(&at)) || self.by_namespace.values().any(open)
    }

    fn secured(&self, at: usize) -> Option<&Secured> {
        self.groups.get(at)?.secured.as_ref()
    }

    /// Returns the secured group of messages in a namespace, or without a namespace.
    fn of(&self, namespace: Option<u16>) -> Option<usize> {
        let at = match namespace {
            Some(namespace) => self.by_namespace.get(&namespace).copied().or(self.rest),
            None => self.discovery,
        };
        at.filter(|at| self.secured(*at).is_some())
    }

    /// Opens a received message into `scratch` if it is secured. Returns `None` for an unsecured
    /// message that is allowed. Unsecured announcements and probes pass if any namespace is not
    /// secured; the caller checks whether they concern such a namespace.
    ///
    /// # Errors
    /// Returns the reason of the rejection. The content must not be used then.
    pub fn open<'a>(
        &mut self,
        message: &NetworkMessage<'a>,
        now: Instant,
        scratch: &'a mut Vec<u8>,
    ) -> Result<Option<NetworkMessage<'a>>, Unopened> {
        let data = message.message_type() == NetworkMessageType::DataSet;
        let namespace = message.group().and_then(|group| group.writer_group_id);
        let Some(at) = self.of(namespace.filter(|_| data)) else {
            return Ok(None);
        };
        if !data && !message.is_sealed() && !message.is_chunk() && self.is_mixed() {
            return Ok(None);
        }
        let start = *self.start.get_or_insert(now);
        let since = now.saturating_duration_since(start);
        // The receiver filters own messages by their address before this point, so the own nonce
        // shows a replay by another sender.
        let nonce = message.security().map_or(&[][..], |header| header.nonce);
        if let Some(mark) = self.mark
            && nonce.starts_with(&mark)
        {
            return Err(Unopened {
                reason: Reason::Replayed,
                case: "own",
                detail: "another program repeats a message of this program (replay)".to_owned(),
            });
        }
        let Some(Group {
            described,
            secured: Some(secured),
        }) = self.groups.get_mut(at)
        else {
            return Ok(None);
        };
        match secured.opener.open(message, since, scratch) {
            Ok(opened) => {
                // Another sender uses a newer key, so the own sealer switches to this key too, if
                // it has not yet.
                if opened.key_changed
                    && let Some(used) = secured.opener.current_token_id()
                    && secured.sealer.move_to(used)
                {
                    // Keys from a file have no lifetime and are used until new keys are set.
                    let timed = secured.lifetime > Duration::ZERO;
                    secured.next = timed.then(|| now + secured.lifetime);
                    secured.overdue = false;
                }
                secured.wanted |= opened.force_key_reset;
                Ok(Some(opened.message))
            }
            Err(error) => {
                secured.wanted |= matches!(error, SecurityError::UnknownToken(_));
                Err(unopened(error, &described.id))
            }
        }
    }

    /// Appends the sealed message to `out`. Returns false without appending if the message is sent
    /// unsecured.
    ///
    /// # Errors
    /// Returns the reason why the message cannot be sent.
    pub fn seal(&mut self, datagram: &[u8], out: &mut Vec<u8>) -> Result<bool, Unopened> {
        // A message of an unknown group is not sent unsecured either.
        let message = NetworkMessage::decode(datagram).map_err(|error| Unopened {
            reason: Reason::Malformed,
            case: "seal",
            detail: format!("cannot secure a malformed message: {error}"),
        })?;
        let data = message.message_type() == NetworkMessageType::DataSet;
        let namespace = message.group().and_then(|group| group.writer_group_id);
        let Some(at) = self.of(namespace.filter(|_| data)) else {
            return Ok(false);
        };
        let Some(mark) = self.mark else {
            return Err(Unopened {
                reason: Reason::NoKeys,
                case: "mark",
                detail: "no random bytes for securing the message".to_owned(),
            });
        };
        let Some(Group {
            described,
            secured: Some(secured),
        }) = self.groups.get_mut(at)
        else {
            return Ok(false);
        };
        let failed = |detail: String| Unopened {
            reason: Reason::NoKeys,
            case: "seal",
            detail,
        };
        let seal = secured.sealer.seal(mark).map_err(|error| {
            failed(if error == SealError::NoKeys {
                format!(
                    "no keys of the group `{}` yet, so this program sends nothing in it",
                    described.id
                )
            } else {
                error.to_string()
            })
        })?;
        let sealed = seal.secure(datagram, out);
        sealed.map_err(|error| failed(error.to_string()))?;
        Ok(true)
    }

    /// The maximum number of bytes by which sealing makes a message longer.
    pub const OVERHEAD: usize = Seal::OVERHEAD;

    /// Returns the time of the next [`turn`](Self::turn).
    pub(crate) fn due(&self) -> Option<Instant> {
        let groups = self.groups.iter();
        groups
            .filter_map(|group| group.secured.as_ref()?.next)
            .min()
    }

    /// Switches to the next key of each group if its time has come. If there is no next key, the
    /// last key stays in use.
    pub fn turn(&mut self, now: Instant) {
        let groups = self.groups.iter_mut();
        for secured in groups.filter_map(|group| group.secured.as_mut()) {
            if secured.next.is_some_and(|next| next <= now) {
                let turned = secured.sealer.next_key();
                secured.overdue = !turned;
                secured.wanted |= !turned;
                secured.next = turned.then(|| now + secured.lifetime);
            }
        }
    }

    /// Returns a group with keys that are out of date: a message used an unknown key, or the next
    /// key is missing. A group is not returned again for some time, because any sender can cause
    /// this.
    pub fn wanted(&mut self, now: Instant) -> Option<String> {
        self.groups.iter_mut().find_map(|group| {
            let secured = group.secured.as_mut()?;
            let rests = secured.told.is_some_and(|told| now < told + ASK_AGAIN);
            if !secured.wanted || rests {
                return None;
            }
            secured.wanted = false;
            secured.told = Some(now);
            Some(group.described.id.clone())
        })
    }
}

impl Group {
    fn is_as(&self, other: &SecurityGroup) -> bool {
        let SecurityGroup {
            id,
            mode,
            policy,
            keys: _,
            namespaces: _,
            replay,
        } = &self.described;
        (id, mode, policy, replay) == (&other.id, &other.mode, &other.policy, &other.replay)
    }
}

impl Secured {
    fn new(group: &SecurityGroup) -> Option<Self> {
        let mode = match group.mode {
            GroupMode::None => return None,
            GroupMode::Sign => SecurityMode::Sign,
            GroupMode::SignAndEncrypt => SecurityMode::SignAndEncrypt,
        };
        let options = OpenerOptions {
            counted_by: match group.replay {
                Replay::Sender => CountedBy::Sender,
                Replay::Publisher | Replay::Uncounted => CountedBy::PublisherOrSender,
            },
            accept_constant_sequence: group.replay == Replay::Uncounted,
            max_streams: MAX_SENDERS,
            ..OpenerOptions::default()
        };
        Some(Self {
            sealer: Sealer::new(mode),
            opener: Opener::with(mode, options),
            next: None,
            lifetime: Duration::ZERO,
            overdue: false,
            wanted: false,
            told: None,
        })
    }
}

/// Returns the SecurityTokenIds from `first` on. The highest id is followed by 1.
fn tokens(first: u32) -> impl Iterator<Item = u32> {
    std::iter::successors(Some(first), |token| Some(token.checked_add(1).unwrap_or(1)))
}

/// Returns the SecurityPolicy of the keys of a group.
#[must_use]
pub const fn policy_of(policy: GroupPolicy) -> SecurityPolicy {
    match policy {
        GroupPolicy::Aes128 => SecurityPolicy::PubSubAes128Ctr,
        GroupPolicy::Aes256 => SecurityPolicy::PubSubAes256Ctr,
    }
}

/// Returns the reason, case and details of a rejected message.
#[expect(
    clippy::wildcard_enum_match_arm,
    reason = "the rest is told by its own words"
)]
fn unopened(error: SecurityError, group: &str) -> Unopened {
    let (reason, case) = match error {
        SecurityError::Unsecured => (Reason::Unsecured, "clear"),
        SecurityError::Unsigned => (Reason::Downgraded, "unsigned"),
        SecurityError::Unencrypted => (Reason::Downgraded, "unencrypted"),
        SecurityError::UnknownToken(_) => (Reason::UnknownKey, "unknown"),
        SecurityError::RetiredToken(_) => (Reason::UnknownKey, "retired"),
        SecurityError::Signature => (Reason::Signature, ""),
        SecurityError::Replayed(_) => (Reason::Replayed, "again"),
        SecurityError::TooOld { .. } => (Reason::Replayed, "old"),
        SecurityError::TooFarAhead { .. } => (Reason::Replayed, "ahead"),
        SecurityError::TooManyPublishers => (Reason::TooManyPublishers, "secured"),
        _ => (Reason::Malformed, "secured"),
    };
    Unopened {
        reason,
        case,
        detail: format!("{error}; its content belongs to the secured group `{group}`"),
    }
}

/// The maximum number of senders per key with replay detection. Each program instance counts once
/// for each of its namespaces.
const MAX_SENDERS: usize = 4_096;
/// The minimum time between two requests for the keys of a group.
const ASK_AGAIN: Duration = Duration::from_secs(5);
