//! Who may write and read what is sent, once it is checked.

use std::path::PathBuf;
use std::time::Duration;

use crate::endpoint::Endpoint;
use crate::mapping::Mapping;

/// A SecurityGroup (OPC 10000-14, 8.2): the programs that have its keys.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct SecurityGroup {
    /// Its SecurityGroupId.
    pub id: String,
    /// What is done to what is sent, and demanded of what is heard.
    pub mode: GroupMode,
    /// The SecurityPolicy of its keys.
    pub policy: GroupPolicy,
    /// Where the keys come from; `None` with [`GroupMode::None`].
    pub keys: Option<KeySource>,
    /// The namespaces it has; without any, all that no other group names.
    pub namespaces: Vec<u16>,
    /// How it is told that a message was there before.
    pub replay: Replay,
}

/// What is done to the messages of a group.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum GroupMode {
    /// Nothing.
    None,
    /// They are signed.
    Sign,
    /// They are signed, and all but their headers is encrypted.
    #[default]
    SignAndEncrypt,
}

/// The SecurityPolicy of a group (OPC 10000-7).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum GroupPolicy {
    /// PubSub-Aes128-CTR.
    Aes128,
    /// PubSub-Aes256-CTR.
    #[default]
    Aes256,
}

/// How it is told that a message was there before.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Replay {
    /// By a count for each run of a program.
    #[default]
    Sender,
    /// By a count for each PublisherId and WriterGroupId (OPC 10000-14, 7.2.3).
    Publisher,
    /// As `Publisher`, and publishers that do not count are taken.
    Uncounted,
}

/// Where the keys of a group come from.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum KeySource {
    /// A file, below the folder of the mapping where it is relative.
    File(PathBuf),
    /// The name of a file in the directory of credentials that systemd gives the program.
    Credential(String),
    /// The cell's own server makes them, and hands them out.
    Own(Served),
    /// Another Security Key Service hands them out.
    Sks(Endpoint),
}

/// How the cell's own server makes the keys of a group.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Served {
    /// Where it is.
    pub endpoint: Endpoint,
    /// How long each is used.
    pub lifetime: Duration,
    /// The ApplicationUris of those that get them, where `*` at the end stands for any characters. The cell's
    /// own server and bridges get them in any case.
    pub members: Vec<String>,
}

impl GroupMode {
    /// As it stands in the document.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::None => "none",
            Self::Sign => "sign",
            Self::SignAndEncrypt => "sign-and-encrypt",
        }
    }
}

impl Mapping {
    /// The SecurityGroups, in the order of the document. Without any, everything is sent in clear.
    #[must_use]
    pub fn security(&self) -> &[SecurityGroup] {
        &self.security
    }

    /// The same with those SecurityGroups.
    #[must_use]
    pub fn with_security(mut self, groups: Vec<SecurityGroup>) -> Self {
        self.security = groups;
        self
    }

    /// The group that a namespace belongs to, secured or not.
    #[must_use]
    pub fn group_of(&self, namespace: u16) -> Option<&SecurityGroup> {
        let named = |group: &&SecurityGroup| group.namespaces.contains(&namespace);
        let rest = |group: &&SecurityGroup| group.namespaces.is_empty();
        let found = self.security.iter().find(named);
        found.or_else(|| self.security.iter().find(rest))
    }
}
