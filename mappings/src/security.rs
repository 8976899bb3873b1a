//! Permission to write and read the messages of the cell, checked.

use std::path::PathBuf;
use std::time::Duration;

use crate::endpoint::Endpoint;

/// SecurityGroup (OPC 10000-14, 8.2): the programs that have its keys.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct SecurityGroup {
    /// SecurityGroupId.
    pub id: String,
    /// Security of the messages that are sent, and required of the messages that are received.
    pub mode: GroupMode,
    /// SecurityPolicy of its keys.
    pub policy: GroupPolicy,
    /// Source of the keys; `None` with [`GroupMode::None`].
    pub keys: Option<KeySource>,
    /// Namespaces of the group; an empty list means all namespaces that no other group names.
    pub namespaces: Vec<u16>,
    /// Detection of repeated messages.
    pub replay: Replay,
}

/// Security of the messages of a group.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum GroupMode {
    /// Neither signed nor encrypted.
    None,
    /// Signed.
    Sign,
    /// Signed, and encrypted except for the headers.
    #[default]
    SignAndEncrypt,
}

/// SecurityPolicy of a group (OPC 10000-7).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum GroupPolicy {
    /// PubSub-Aes128-CTR.
    Aes128,
    /// PubSub-Aes256-CTR.
    #[default]
    Aes256,
}

/// Detection of repeated messages.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Replay {
    /// By a counter for each run of a program.
    #[default]
    Sender,
    /// By a counter for each PublisherId and WriterGroupId (OPC 10000-14, 7.2.3).
    Publisher,
    /// As `Publisher`, and messages of publishers without a counter are accepted.
    Uncounted,
}

/// Source of the keys of a group.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum KeySource {
    /// A file; a relative path is below the folder of the mapping.
    File(PathBuf),
    /// Name of a file in the credentials directory that systemd provides to the program.
    Credential(String),
    /// The cell's own server, which makes and distributes the keys.
    Own(ServedKeys),
    /// Another Security Key Service, which distributes the keys.
    Sks(Endpoint),
}

/// Settings for the keys of a group that the cell's own server makes.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ServedKeys {
    /// Endpoint of the server.
    pub endpoint: Endpoint,
    /// Lifetime of each key.
    pub lifetime: Duration,
    /// ApplicationUris of the programs that get the keys; `*` at the end stands for any characters.
    /// The cell's own server and bridges get the keys in any case.
    pub members: Vec<String>,
}

impl GroupMode {
    /// Returns the name in the document.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::None => "none",
            Self::Sign => "sign",
            Self::SignAndEncrypt => "sign-and-encrypt",
        }
    }
}
