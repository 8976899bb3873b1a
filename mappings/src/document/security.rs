//! SecurityGroups in the document: permission to write and read the messages.

use crate::read::{Located, choice, document};

document! {
    /// A SecurityGroup of OPC UA PubSub: the programs that have its keys.
    struct GroupEntry {
        /// Its SecurityGroupId, such as cell.
        #[schemars(required, length(min = 1, max = 128))]
        group: String,
        /// Protection of sent messages, and required for received messages: `sign-and-encrypt` (the
        /// default), `sign`, or `none`, which excludes namespaces from a group without
        /// `namespaces`.
        mode: GroupModeEntry,
        /// Length of the keys for encryption: `aes256` (the default) or `aes128`.
        policy: GroupPolicyEntry,
        /// Source of the keys: exactly one of `file`, `credential` and `sks`.
        keys: KeysEntry,
        /// The namespaces with the values, events and calls of the group, such as [2, 3]. Default:
        /// all namespaces that no other group lists, and messages without a namespace, such as
        /// probes and announcements.
        namespaces: Vec<Located<u16>>,
        /// Detection of repeated messages (replay). Default: `sender`.
        replay: ReplayEntry,
    }

    /// Source of the keys of a group.
    struct KeysEntry {
        /// A JSON file with keys, relative to the mapping, that only its owner can read (chmod
        /// 600). `ua-space keys` makes the file.
        #[schemars(length(min = 1))]
        file: String,
        /// The name of such a file among the credentials that systemd gives to the program
        /// (LoadCredential=).
        #[schemars(length(min = 1))]
        credential: String,
        /// A Security Key Service, which provides keys and renews them.
        sks: SksEntry,
    }

    /// A Security Key Service.
    struct SksEntry {
        /// Its endpoint, such as opc.tcp://sks.local:4840. Default: the OPC UA server of the cell,
        /// `server.endpoint`, which then makes the keys.
        #[schemars(regex(pattern = r"^opc\.tcp://"))]
        endpoint: String,
        /// With the server of the cell: lifetime of a key; default 1h.
        #[schemars(regex(pattern = r"^[0-9]+(\.[0-9]+)?(ms|s|min|h)$"))]
        key_lifetime: String,
        /// With the server of the cell: the ApplicationUris, from the certificates, of the programs
        /// that get the keys; `*` at the end matches any characters. The server and the bridges of
        /// the cell always get the keys.
        members: Vec<Located<String>>,
    }
}

choice! {
    enum GroupModeEntry {
        /// Every program of the network can write and read.
        None = "none",
        /// Every program of the network can read; only members can write.
        Sign = "sign",
        /// Only members can write and read.
        SignAndEncrypt = "sign-and-encrypt",
    }

    enum GroupPolicyEntry {
        /// PubSub-Aes128-CTR.
        Aes128 = "aes128",
        /// PubSub-Aes256-CTR.
        Aes256 = "aes256",
    }

    enum ReplayEntry {
        /// A counter for each run of a program, as the programs of this project send it: they may
        /// restart at any time.
        Sender = "sender",
        /// A counter for each PublisherId and WriterGroupId, as in OPC 10000-14: for publishers of
        /// other vendors. Messages of a restarted program are dropped until the keys change.
        Publisher = "publisher",
        /// As `publisher`, and publishers without a counter are accepted, such as open62541 up to
        /// 1.5.7. Any host can repeat their messages.
        Uncounted = "uncounted",
    }
}
