//! Who may write and read: the SecurityGroups of a mapping, and their keys.
//!
//! Everything that is heard goes through [`Guard::open`] before anything of it is believed, and everything that is sent
//! through [`Guard::seal`]. What carries no WriterGroupId, as probes and announcements do, belongs to the group that has no
//! namespaces of its own, or else to the first that is secured.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use mappings::{GroupMode, GroupPolicy, Replay, SecurityGroup};
use uadp::{
    CountedBy, KeyError, Keys, NetworkMessage, NetworkMessageType, Opener, OpenerOptions, Seal,
    SealError, Sealer, SecurityError, SecurityMode, SecurityPolicy,
};

use crate::counters::Reason;

/// Opens what is heard and seals what is sent, by the groups of a mapping.
#[derive(Debug)]
pub struct Guard {
    groups: Vec<Group>,
    by_namespace: BTreeMap<u16, usize>,
    /// The group of the namespaces that none names.
    rest: Option<usize>,
    /// The group of what carries no namespace.
    discovery: Option<usize>,
    /// The random half of the nonces of this run; nothing is sealed without.
    mark: Option<[u8; 4]>,
    /// What times count from.
    start: Option<Instant>,
}

/// Keys of a group, as a file has them or a Security Key Service hands them out (OPC 10000-14, 8.3.2).
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct KeyDelivery {
    /// The SecurityTokenId of the first of them, which is the current one.
    pub first_token_id: u32,
    /// The current key and the future ones, in their order.
    pub keys: Vec<Keys>,
    /// How long until the second of them is used; without it the first is used until there are others.
    pub time_to_next: Option<Duration>,
    /// How long each of the others is used.
    pub lifetime: Duration,
}

/// How a group is, for people.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct GroupState {
    /// Its SecurityGroupId.
    pub group: String,
    /// What is done to its messages.
    pub mode: GroupMode,
    /// The key that is used; `None` before there is one.
    pub token_id: Option<u32>,
    /// The key that comes next, if it is there already.
    pub next_token_id: Option<u32>,
    /// Whether the time of the key that is used is over, and there is no other.
    pub overdue: bool,
}

/// A message that is not taken.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Unopened {
    /// Why, for its counter.
    pub reason: Reason,
    /// Which case of it.
    pub case: &'static str,
    /// For people.
    pub detail: String,
}

#[derive(Debug)]
struct Group {
    described: SecurityGroup,
    /// `None` for a group that is not secured.
    secured: Option<Secured>,
}

#[derive(Debug)]
struct Secured {
    sealer: Sealer,
    opener: Opener,
    /// When the next key is to be used.
    next: Option<Instant>,
    lifetime: Duration,
    overdue: bool,
    /// A key is used that is not known here; when that was told last.
    wanted: bool,
    told: Option<Instant>,
}

impl Guard {
    /// Of those groups; `None` when there is nothing to guard.
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

    /// Gives it random bytes of this run of the program: nothing is sealed before. Two programs with the same ones would give
    /// each other's messages away.
    pub const fn set_mark(&mut self, mark: [u8; 4]) {
        self.mark = Some(mark);
    }

    /// Takes up other groups. One that is as it was, apart from its namespaces and where its keys come from, keeps its keys
    /// and what it has heard. False when nothing is left to guard.
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

    /// Takes in the keys of a group; those of a group that is not there are nobody's.
    ///
    /// # Errors
    /// [`KeyError`]; the keys there were stay.
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
        // A sealer that is ahead of who delivers waits until that is so far too.
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

    /// How each secured group is.
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

    /// Whether what is said in a namespace needs keys.
    #[must_use]
    pub fn is_secured(&self, namespace: u16) -> bool {
        self.of(Some(namespace)).is_some()
    }

    /// Returns the index of the secured group of a namespace; `None` where the namespace is not secured.
    pub(crate) fn group_of(&self, namespace: u16) -> Option<usize> {
        self.of(Some(namespace))
    }

    /// Whether what is said in one namespace is as well secured as what is said in the other.
    pub(crate) fn is_alike(&self, one: u16, other: u16) -> bool {
        self.of(Some(one)) == self.of(Some(other))
    }

    /// Whether anything is left that anybody may say.
    fn is_mixed(&self) -> bool {
        let open = |at: &usize| self.secured(*at).is_none();
        self.rest.is_none_or(|at| open(&at)) || self.by_namespace.values().any(open)
    }

    fn secured(&self, at: usize) -> Option<&Secured> {
        self.groups.get(at)?.secured.as_ref()
    }

    /// The secured group of what is said in a namespace, or in none.
    fn of(&self, namespace: Option<u16>) -> Option<usize> {
        let at = match namespace {
            Some(namespace) => self.by_namespace.get(&namespace).copied().or(self.rest),
            None => self.discovery,
        };
        at.filter(|at| self.secured(*at).is_some())
    }

    /// What is heard, opened into `scratch` where it is secured; `None` for what is in clear and may be. Announcements and
    /// probes in clear pass where something is left that anybody may say: whether that is what they are about is for who reads
    /// them.
    ///
    /// # Errors
    /// What is wrong with it. Nothing of it is to be believed then.
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
        // Our own comes from our own address, and is not looked at there.
        let nonce = message.security().map_or(&[][..], |header| header.nonce);
        if let Some(mark) = self.mark
            && nonce.starts_with(&mark)
        {
            return Err(Unopened {
                reason: Reason::Replayed,
                case: "own",
                detail: "somebody sends again what this program has sent".to_owned(),
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
                // Others went on to a newer key, so its time has come, where it has not come here already.
                if opened.key_changed
                    && let Some(used) = secured.opener.current_token_id()
                    && secured.sealer.move_to(used)
                {
                    // Keys of a file are used until there are others.
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

    /// Appends what is sent to `out`, sealed; false where it goes in clear, and nothing was appended.
    ///
    /// # Errors
    /// Why it cannot be sent.
    pub fn seal(&mut self, datagram: &[u8], out: &mut Vec<u8>) -> Result<bool, Unopened> {
        // What nobody knows the group of is not said in clear either.
        let message = NetworkMessage::decode(datagram).map_err(|error| Unopened {
            reason: Reason::Malformed,
            case: "seal",
            detail: format!("what is to be sent is no message: {error}"),
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
                detail: "no random bytes to seal with".to_owned(),
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
                    "there are no keys of the group `{}` yet, so nothing is sent in it",
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

    /// Bytes that a message may be longer by, once it is sealed.
    pub const OVERHEAD: usize = Seal::OVERHEAD;

    /// When [`turn`](Self::turn) is wanted next.
    pub(crate) fn due(&self) -> Option<Instant> {
        let groups = self.groups.iter();
        groups
            .filter_map(|group| group.secured.as_ref()?.next)
            .min()
    }

    /// Goes on to the next keys whose time has come. Where there is none, the last goes on.
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

    /// A group whose keys are out of date: somebody uses one that is not known here, or there is no next one. Not told again
    /// for some time: anybody can send what looks so.
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

/// The SecurityTokenIds from one on. Behind the highest comes 1.
fn tokens(first: u32) -> impl Iterator<Item = u32> {
    std::iter::successors(Some(first), |token| Some(token.checked_add(1).unwrap_or(1)))
}

/// The policy whose keys a group has.
#[must_use]
pub const fn policy_of(policy: GroupPolicy) -> SecurityPolicy {
    match policy {
        GroupPolicy::Aes128 => SecurityPolicy::PubSubAes128Ctr,
        GroupPolicy::Aes256 => SecurityPolicy::PubSubAes256Ctr,
    }
}

/// What is told of a message that is not opened, and as what it counts.
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
        detail: format!("{error}, and what is sent in it belongs to the group `{group}`"),
    }
}

/// Runs of programs, with each of their namespaces, that are followed for each key: nothing of them can be sent again by others.
const MAX_SENDERS: usize = 4_096;
/// So long a group is not asked for anew.
const ASK_AGAIN: Duration = Duration::from_secs(5);
