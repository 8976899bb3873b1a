//! SecurityGroups in the document: permission to write and read the messages.

use crate::read::{At, choice, document};

document! {
    /// A SecurityGroup of OPC UA PubSub: the programs that have its keys.
    struct GroupEntry {
        /// Its SecurityGroupId, as cell.
        #[schemars(required, length(min = 1, max = 128))]
        group: String,
        /// What is done to what is sent, and demanded of what is heard: `sign-and-encrypt` (the default), `sign`, or `none`, by
        /// which namespaces are left out that a group without `namespaces` would have.
        mode: GroupModeEntry,
        /// How long the keys for encryption are: `aes256` (the default) or `aes128`.
        policy: GroupPolicyEntry,
        /// Where the keys come from: exactly one of `file`, `credential` and `sks`.
        keys: KeysEntry,
        /// The namespaces whose values, events and calls are the group's, as [2, 3]. Left out: all that no other group names,
        /// and what belongs to none, as questions and announcements.
        namespaces: Vec<At<u16>>,
        /// How it is told that a message was there before. Default: `sender`.
        replay: ReplayEntry,
    }

    /// Where the keys of a group come from.
    struct KeysEntry {
        /// A JSON file with keys, relative to the mapping, that only its owner can read (chmod 600). `ua-space keys` makes one.
        #[schemars(length(min = 1))]
        file: String,
        /// The name of such a file among the credentials that systemd hands to the program (LoadCredential=).
        #[schemars(length(min = 1))]
        credential: String,
        /// A Security Key Service, which hands keys out and replaces them from time to time.
        sks: SksEntry,
    }

    /// A Security Key Service.
    struct SksEntry {
        /// Where it is, as opc.tcp://sks.local:4840. Left out: the cell's own OPC UA server, `server.endpoint`, which then makes
        /// the keys.
        #[schemars(regex(pattern = r"^opc\.tcp://"))]
        endpoint: String,
        /// With the cell's own server: how long a key is used before the next one; default 1h.
        #[schemars(regex(pattern = r"^[0-9]+(\.[0-9]+)?(ms|s|min|h)$"))]
        key_lifetime: String,
        /// With the cell's own server: the ApplicationUris of the programs that get the keys, as they stand in their certificates;
        /// `*` at the end stands for any characters. The cell's own server and bridges get them in any case.
        members: Vec<At<String>>,
    }
}

choice! {
    enum GroupModeEntry {
        /// Anybody can write and read.
        None = "none",
        /// Anybody can read, members alone can write.
        Sign = "sign",
        /// Members alone can write and read.
        SignAndEncrypt = "sign-and-encrypt",
    }

    enum GroupPolicyEntry {
        /// PubSub-Aes128-CTR.
        Aes128 = "aes128",
        /// PubSub-Aes256-CTR.
        Aes256 = "aes256",
    }

    enum ReplayEntry {
        /// By a count for each run of a program, as the programs of this project send: they may restart at any time.
        Sender = "sender",
        /// By a count for each PublisherId and WriterGroupId, as OPC 10000-14 has it: with publishers of other makers. Of a
        /// program that restarts nothing is taken until there are other keys.
        Publisher = "publisher",
        /// As `publisher`, and those that do not count are taken, as open62541 up to 1.5.7. Their messages can be sent again
        /// by anybody.
        Uncounted = "uncounted",
    }
}
