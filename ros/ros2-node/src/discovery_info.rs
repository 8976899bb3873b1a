//! `ros_discovery_info`: assigns the readers and writers of a participant to its ROS nodes.
//!
//! DDS knows participants and endpoints; nodes are a ROS concept. Each participant publishes its
//! complete list of nodes as messages of a single type
//! (`rmw_dds_common/msg/ParticipantEntitiesInfo`). An entity is identified by its RTPS GUID in a
//! `Gid`. A `Gid` has 24 bytes up to ROS 2 Humble, the last 8 of them zero, and 16 bytes since
//! Iron. Both have the same DDS type name, so a reader detects the length: only the right length
//! consumes the whole payload.

use bytes::{BufMut, Bytes, BytesMut};
use thiserror::Error;

/// A GUID in the wire format of RTPS: 12 bytes of participant prefix, 4 of entity id (RTPS 2.5,
/// 9.3.1).
pub type GuidBytes = [u8; 16];

/// The nodes of a participant: `rmw_dds_common/msg/ParticipantEntitiesInfo`.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct ParticipantEntitiesInfo {
    /// The GUID of the participant.
    pub participant: GuidBytes,
    /// The nodes of the participant.
    pub nodes: Vec<NodeEntities>,
}

/// A ROS node: `rmw_dds_common/msg/NodeEntitiesInfo`.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct NodeEntities {
    /// The namespace, `/` or `/name/...`.
    pub namespace: String,
    /// The name without its namespace.
    pub name: String,
    /// The readers of the node.
    pub readers: Vec<GuidBytes>,
    /// The writers of the node.
    pub writers: Vec<GuidBytes>,
}

impl NodeEntities {
    /// Returns the name with its namespace, such as `/cell/camera`.
    #[must_use]
    pub fn full_name(&self) -> String {
        format!("{}/{}", self.namespace.trim_end_matches('/'), self.name)
    }
}

/// The length of a `Gid`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Default)]
pub enum GidLength {
    /// The length since ROS 2 Iron.
    #[default]
    Bytes16,
    /// The length up to ROS 2 Humble.
    Bytes24,
}

impl GidLength {
    const fn zeros(self) -> usize {
        match self {
            Self::Bytes16 => 0,
            Self::Bytes24 => 8,
        }
    }
}

/// The sample is not a `ParticipantEntitiesInfo` of either length.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Error)]
#[error("not a list of nodes with Gids of 16 or 24 bytes")]
pub struct NoDiscoveryInfo;

impl ParticipantEntitiesInfo {
    /// Decodes a serialized payload after its encapsulation header, in either byte order. A length
    /// of `Gid` fits only if nothing but padding remains.
    ///
    /// # Errors
    /// [`NoDiscoveryInfo`] if neither length fits.
    pub fn decode(payload: &[u8]) -> Result<(Self, GidLength), NoDiscoveryInfo> {
        [GidLength::Bytes16, GidLength::Bytes24]
            .into_iter()
            .find_map(|length| Some((Cursor::new(payload, length)?.info()?, length)))
            .ok_or(NoDiscoveryInfo)
    }

    /// Returns the serialized payload, little endian.
    #[must_use]
    pub fn encode(&self, length: GidLength) -> Bytes {
        let mut out = Cdr::new();
        let gid = |out: &mut Cdr, gid: &GuidBytes| {
            out.0.put_slice(gid);
            out.0.put_bytes(0, length.zeros());
        };
        gid(&mut out, &self.participant);
        out.count(self.nodes.len());
        for node in &self.nodes {
            out.string(&node.namespace);
            out.string(&node.name);
            for gids in [&node.readers, &node.writers] {
                out.count(gids.len());
                for each in gids {
                    gid(&mut out, each);
                }
            }
        }
        out.0.freeze()
    }
}

/// A buffer of little-endian CDR, which starts with the encapsulation header.
#[derive(Debug)]
pub(crate) struct Cdr(pub(crate) BytesMut);

impl Cdr {
    pub(crate) fn new() -> Self {
        Self(BytesMut::from(&[0, 1, 0, 0][..]))
    }

    /// Aligns to 4 bytes. The header is as long as the widest alignment in the message, so
    /// positions may include the header.
    fn align(&mut self) {
        let padding = self.0.len().next_multiple_of(4) - self.0.len();
        self.0.put_bytes(0, padding);
    }

    pub(crate) fn u32(&mut self, value: u32) {
        self.align();
        self.0.put_u32_le(value);
    }

    /// Writes the length of a sequence.
    fn count(&mut self, len: usize) {
        // No sequence in memory reaches this length.
        self.u32(u32::try_from(len).unwrap_or(u32::MAX));
    }

    pub(crate) fn string(&mut self, text: &str) {
        self.count(text.len() + 1);
        self.0.put_slice(text.as_bytes());
        self.0.put_u8(0);
    }
}

/// Reads CDR in order; returns `None` if it ends too soon.
struct Cursor<'a> {
    body: &'a [u8],
    at: usize,
    big_endian: bool,
    length: GidLength,
}

impl<'a> Cursor<'a> {
    fn new(payload: &'a [u8], length: GidLength) -> Option<Self> {
        let (header, body) = payload.split_at_checked(4)?;
        let big_endian = match header {
            [0, 0, ..] => true,
            [0, 1, ..] => false,
            _ => return None,
        };
        Some(Self {
            body,
            at: 0,
            big_endian,
            length,
        })
    }

    fn info(mut self) -> Option<ParticipantEntitiesInfo> {
        let participant = self.gid()?;
        let count = self.u32()?;
        let mut nodes = Vec::new();
        // Nothing is reserved for a count, and each node consumes some of the remaining bytes.
        for _ in 0..count {
            nodes.push(NodeEntities {
                namespace: self.string()?,
                name: self.string()?,
                readers: self.gids()?,
                writers: self.gids()?,
            });
        }
        let left = self.body.len() - self.at;
        (left < 4).then_some(ParticipantEntitiesInfo { participant, nodes })
    }

    fn take(&mut self, len: usize) -> Option<&'a [u8]> {
        let end = self.at.checked_add(len)?;
        let taken = self.body.get(self.at..end)?;
        self.at = end;
        Some(taken)
    }

    fn u32(&mut self) -> Option<u32> {
        self.take(self.at.next_multiple_of(4) - self.at)?;
        let word = self.take(4)?.try_into().ok()?;
        Some(if self.big_endian {
            u32::from_be_bytes(word)
        } else {
            u32::from_le_bytes(word)
        })
    }

    fn string(&mut self) -> Option<String> {
        let len = usize::try_from(self.u32()?).ok()?;
        let text = self.take(len)?;
        let text = text.strip_suffix(&[0]).unwrap_or(text);
        if text.len() > MAX_NAME {
            return None;
        }
        String::from_utf8(text.to_vec()).ok()
    }

    fn gid(&mut self) -> Option<GuidBytes> {
        let guid = self.take(16)?.try_into().ok()?;
        self.take(self.length.zeros())?;
        Some(guid)
    }

    fn gids(&mut self) -> Option<Vec<GuidBytes>> {
        let count = self.u32()?;
        let mut gids = Vec::new();
        for _ in 0..count {
            gids.push(self.gid()?);
        }
        Some(gids)
    }
}

/// The topic of the node lists.
pub(crate) const TOPIC: &str = "ros_discovery_info";
/// The DDS type of the topic.
pub(crate) const TYPE: &str = "rmw_dds_common::msg::dds_::ParticipantEntitiesInfo_";
/// The bound of both names in the message.
const MAX_NAME: usize = 256;

#[cfg(test)]
mod tests {
    use super::*;

    fn info(nodes: usize) -> ParticipantEntitiesInfo {
        let node = |number: u8| NodeEntities {
            namespace: "/".into(),
            name: format!("node_{number}"),
            readers: vec![[number; 16]; usize::from(number)],
            writers: vec![[number + 1; 16]],
        };
        ParticipantEntitiesInfo {
            participant: [0xA5; 16],
            nodes: (1..).map(node).take(nodes).collect(),
        }
    }

    #[test]
    fn the_length_of_a_gid_is_found_by_what_comes_out_even() {
        for nodes in 0..20 {
            for length in [GidLength::Bytes16, GidLength::Bytes24] {
                let info = info(nodes);
                let mut payload = info.encode(length).to_vec();
                assert_eq!(
                    ParticipantEntitiesInfo::decode(&payload),
                    Ok((info.clone(), length)),
                    "{nodes} nodes"
                );
                payload.resize(payload.len().next_multiple_of(4), 0);
                assert_eq!(
                    ParticipantEntitiesInfo::decode(&payload),
                    Ok((info, length))
                );
            }
        }
    }

    #[test]
    fn what_is_cut_short_or_overlong_is_refused() {
        let whole = info(3).encode(GidLength::Bytes16);
        for len in 0..whole.len() {
            assert!(ParticipantEntitiesInfo::decode(&whole[..len]).is_err());
        }
        let longer = [&whole[..], &[0; 4]].concat();
        assert!(ParticipantEntitiesInfo::decode(&longer).is_err());
    }

    #[test]
    fn counts_that_the_sample_cannot_hold_are_refused() {
        let mut payload = vec![0, 1, 0, 0];
        payload.extend([7; 16]);
        payload.extend(u32::MAX.to_le_bytes());
        payload.extend([0; 64]);
        assert!(ParticipantEntitiesInfo::decode(&payload).is_err());
    }

    #[test]
    fn a_name_has_its_namespace_before_it() {
        let mut node = info(1).nodes.remove(0);
        assert_eq!(node.full_name(), "/node_1");
        node.namespace = "/cell".into();
        assert_eq!(node.full_name(), "/cell/node_1");
    }
}
