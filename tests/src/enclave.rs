//! DDS Security: keystores as `ros2 security` lays them out, secured peers, and the traffic on the
//! wire.

use std::{
    fs,
    io::{ErrorKind, Read as _},
    os::unix::fs::PermissionsExt as _,
    path::{Path, PathBuf},
    process::Command,
    time::Duration,
};

use socket2::{Domain, Protocol, Socket, Type};

use crate::{Cell, GROUP, Host, Peer, StartedChild, WIRE, peers::cyclone_uri, program};

/// A keystore with a single certificate authority and the enclaves `/bridge` and `/peer`, which may
/// read and write all topics of all domains.
pub struct Keystore(PathBuf);

const ENCLAVES: [&str; 2] = ["bridge", "peer"];

/// The governance of a domain. The kinds of protection have the names of DDS Security: `NONE`,
/// `SIGN`, `ENCRYPT` and, except for `data`, the last two with `_WITH_ORIGIN_AUTHENTICATION`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Governance {
    /// Discovery of endpoints. With `NONE`, topics are also not announced by the protected builtin
    /// endpoints.
    pub discovery: &'static str,
    /// Liveliness of participants. `NONE` as with `discovery`.
    pub liveliness: &'static str,
    /// RTPS messages as a whole.
    pub rtps: &'static str,
    /// Submessages of the topics.
    pub metadata: &'static str,
    /// Payload of samples.
    pub data: &'static str,
}

impl Governance {
    /// The governance of `ros2 security create_keystore`: everything including discovery is
    /// encrypted, and RTPS messages are signed as a whole.
    pub const SROS2: Self = Self {
        rtps: "SIGN",
        ..Self::all("ENCRYPT")
    };

    /// Returns a governance with the same kind for everything.
    #[must_use]
    pub const fn all(kind: &'static str) -> Self {
        Self {
            discovery: kind,
            liveliness: kind,
            rtps: kind,
            metadata: kind,
            data: kind,
        }
    }

    fn text(&self) -> String {
        let protected = |kind: &str| (kind != "NONE").to_string();
        [
            ("DISCOVERY", self.discovery),
            ("LIVELINESS", self.liveliness),
            ("RTPS", self.rtps),
            ("METADATA", self.metadata),
            ("DATA", self.data),
            ("FOUND", &protected(self.discovery)),
            ("LIVES", &protected(self.liveliness)),
        ]
        .iter()
        .fold(GOVERNANCE.to_owned(), |text, (name, value)| {
            text.replace(&format!(">{name}<"), &format!(">{value}<"))
        })
    }
}

impl Keystore {
    /// Creates a keystore in the cell's folder, with the domain governed by [`Governance::SROS2`].
    ///
    /// # Panics
    /// Panics if `openssl` fails.
    #[must_use]
    pub fn make(cell: &Cell, name: &str) -> Self {
        let keystore = Self(cell.folder().join(name));
        fs::create_dir_all(&keystore.0).unwrap();
        keystore.key("ca.key.pem");
        // The name that sros2 uses; the authorities of two keystores have the same name and
        // different keys.
        keystore.openssl(
            "req -x509 -new -key ca.key.pem -sha256 -days 3650 -subj /CN=sros2CA \
             -addext basicConstraints=critical,CA:TRUE,pathlen:1 -out ca.cert.pem",
        );
        for enclave in ENCLAVES {
            keystore.add(enclave);
        }
        keystore.govern(&Governance::SROS2);
        keystore
    }

    /// Replaces the governance of the domain, for programs that start later.
    ///
    /// # Panics
    /// Panics if `openssl` fails.
    pub fn govern(&self, governance: &Governance) {
        self.sign("governance", &governance.text());
        for enclave in ENCLAVES {
            let own = self.enclave(enclave).join("governance.p7s");
            fs::copy(self.0.join("governance.p7s"), own).unwrap();
        }
    }

    fn add(&self, name: &str) {
        let folder = format!("enclaves/{name}");
        fs::create_dir_all(self.0.join(&folder)).unwrap();
        self.key(&format!("{folder}/key.pem"));
        self.openssl(&format!(
            "req -new -key {folder}/key.pem -subj /CN=\\/{name} -out {folder}/request.pem"
        ));
        self.certify(name, 3650);
        let permissions = PERMISSIONS.replace("NAME", name);
        self.sign(&format!("{folder}/permissions"), &permissions);
        for (from, to) in [
            ("ca.cert.pem", "identity_ca.cert.pem"),
            ("ca.cert.pem", "permissions_ca.cert.pem"),
        ] {
            fs::copy(self.0.join(from), self.enclave(name).join(to)).unwrap();
        }
    }

    /// Renews the certificate of an enclave, valid for `days` days from the present.
    ///
    /// # Panics
    /// Panics if `openssl` fails.
    pub fn certify(&self, name: &str, days: i32) {
        self.openssl(&format!(
            "x509 -req -in enclaves/{name}/request.pem -CA ca.cert.pem -CAkey ca.key.pem -CAcreateserial -sha256 \
             -days {days} -out enclaves/{name}/cert.pem"
        ));
    }

    /// Returns the value of `ROS_SECURITY_KEYSTORE`.
    #[must_use]
    pub fn path(&self) -> &Path {
        &self.0
    }

    /// Returns the folder of an enclave; `name` has no leading slash.
    #[must_use]
    pub fn enclave(&self, name: &str) -> PathBuf {
        self.0.join("enclaves").join(name)
    }

    /// Creates a key as `ros2 security` does, readable by its owner only.
    fn key(&self, file: &str) {
        self.openssl(&format!(
            "genpkey -algorithm EC -pkeyopt ec_paramgen_curve:P-256 -out {file}"
        ));
        fs::set_permissions(self.0.join(file), fs::Permissions::from_mode(0o600)).unwrap();
    }

    fn sign(&self, file: &str, text: &str) {
        fs::write(self.0.join(format!("{file}.xml")), text).unwrap();
        self.openssl(&format!(
            "smime -sign -text -in {file}.xml -signer ca.cert.pem -inkey ca.key.pem -out {file}.p7s"
        ));
    }

    fn openssl(&self, arguments: &str) {
        let output = Command::new("openssl")
            .current_dir(&self.0)
            .args(arguments.split_whitespace())
            .output()
            .unwrap_or_else(|error| panic!("`openssl` does not start: {error}"));
        assert!(
            output.status.success(),
            "openssl {arguments}: {}",
            String::from_utf8_lossy(&output.stderr)
        );
    }
}

/// Returns whether bridge-ros2 was built with DDS Security.
///
/// # Panics
/// Panics if bridge-ros2 does not print its version.
#[must_use]
pub fn has_security() -> bool {
    let version = Command::new(program("bridge-ros2"))
        .arg("--version")
        .output();
    let version = String::from_utf8(version.unwrap().stdout).unwrap();
    let [with, without] =
        ["with", "without"].map(|it| version.contains(&format!(", {it} DDS Security)")));
    assert!(with != without, "{version}");
    with
}

impl Cell {
    /// Creates a cell as [`Self::with`], or skips the test if bridge-ros2 was built without DDS
    /// Security.
    #[must_use]
    pub fn secured(peers: &[Peer]) -> Option<Self> {
        if !has_security() {
            Self::skip("bridge-ros2 is built without its feature `security`");
            return None;
        }
        Self::with(peers)
    }

    /// Returns bridge-ros2 in domain 2, which starts only as the enclave `/bridge`. Not started
    /// yet.
    #[must_use]
    pub fn secured_bridge(&self, keystore: &Keystore, args: &[&str]) -> StartedChild {
        self.bridge_ros2_started(args)
            .args(["--ros-args", "--enclave", "/bridge", "--"])
            .env("ROS_SECURITY_ENABLE", "true")
            .env("ROS_SECURITY_STRATEGY", "Enforce")
            .env("ROS_SECURITY_KEYSTORE", keystore.path())
    }

    /// Returns the Cyclone DDS peer in C as the enclave `/peer`, not started yet.
    #[must_use]
    pub fn secured_cyclone(&self, keystore: &Keystore, args: &[&str]) -> StartedChild {
        let started = self.cyclone_c_started(args);
        Self::as_peer(started, keystore, &cyclone_uri("lo", ""))
    }

    /// Returns the Cyclone DDS peer in C as the enclave `/peer` on another host, not started yet.
    #[must_use]
    pub fn secured_cyclone_on(
        &self,
        host: &Host,
        keystore: &Keystore,
        args: &[&str],
    ) -> StartedChild {
        let started = host.cyclone_c_started(self, args);
        Self::as_peer(started, keystore, &cyclone_uri(WIRE, ""))
    }

    /// Adds the enclave to the configuration.
    fn as_peer(started: StartedChild, keystore: &Keystore, configuration: &str) -> StartedChild {
        let folder = keystore.enclave("peer");
        let file = |name: &str| format!("file:{}", folder.join(name).display());
        let library = |kind: &str, call: &str| {
            let path = plugin(&format!("dds_security_{kind}"));
            format!(
                "<Library initFunction=\"init_{call}\" finalizeFunction=\"finalize_{call}\" path=\"{path}\"/>"
            )
        };
        let security = format!(
            "<Security><Authentication>{}<IdentityCA>{}</IdentityCA><IdentityCertificate>{}</IdentityCertificate>\
             <PrivateKey>{}</PrivateKey></Authentication><Cryptographic>{}</Cryptographic><AccessControl>{}\
             <PermissionsCA>{}</PermissionsCA><Governance>{}</Governance><Permissions>{}</Permissions>\
             </AccessControl></Security></Domain>",
            library("auth", "authentication"),
            file("identity_ca.cert.pem"),
            file("cert.pem"),
            file("key.pem"),
            library("crypto", "crypto"),
            library("ac", "access_control"),
            file("permissions_ca.cert.pem"),
            file("governance.p7s"),
            file("permissions.p7s"),
        );
        started.env(
            "CYCLONEDDS_URI",
            configuration.replace("</Domain>", &security),
        )
    }

    /// Returns the Fast DDS peer as the enclave `/peer`, not started yet.
    #[must_use]
    pub fn secured_fastdds(&self, keystore: &Keystore, args: &[&str]) -> StartedChild {
        self.fastdds_started(args)
            .args(["--enclave".into(), keystore.enclave("peer")])
    }
}

/// Returns the path of a plugin of Cyclone DDS in the folder of Debian and Ubuntu, which the loader
/// does not search. Returns the bare name if there is no such file.
fn plugin(name: &str) -> String {
    let folders = fs::read_dir("/usr/lib").into_iter().flatten().flatten();
    folders
        .map(|entry| entry.path().join(format!("libddsc0debian/lib{name}.so")))
        .find(|path| path.is_file())
        .map_or_else(|| name.to_owned(), |path| path.display().to_string())
}

/// Captures every UDP datagram of a cell except the datagrams of the UADP group.
pub struct Wiretap(Socket);

impl Wiretap {
    /// Starts the capture.
    ///
    /// # Panics
    /// Panics if the socket cannot be created.
    #[must_use]
    pub fn tap() -> Self {
        let socket = Socket::new(Domain::IPV4, Type::RAW, Some(Protocol::UDP)).unwrap();
        socket.set_recv_buffer_size(8 << 20).unwrap();
        socket
            .set_read_timeout(Some(Duration::from_millis(1)))
            .unwrap();
        Self(socket)
    }

    /// Returns the IPv4 packets captured after the last call.
    ///
    /// # Panics
    /// Panics if reading fails.
    #[must_use]
    pub fn heard(&mut self) -> Vec<Vec<u8>> {
        let mut packets = Vec::new();
        let mut buffer = vec![0; 65_536];
        loop {
            match self.0.read(&mut buffer) {
                Ok(length) => packets.push(buffer[..length].to_vec()),
                Err(error) if error.kind() == ErrorKind::WouldBlock => break,
                Err(error) => panic!("the wire cannot be heard: {error}"),
            }
        }
        packets.retain(|packet: &Vec<u8>| packet.get(22..24) != Some(&GROUP.port().to_be_bytes()));
        packets
    }
}

const GOVERNANCE: &str = r#"<?xml version="1.0" encoding="utf-8"?>
<dds xmlns:xsi="http://www.w3.org/2001/XMLSchema-instance"
    xsi:noNamespaceSchemaLocation="http://www.omg.org/spec/DDS-SECURITY/20170901/omg_shared_ca_governance.xsd">
  <domain_access_rules>
    <domain_rule>
      <domains><id_range><min>0</min><max>230</max></id_range></domains>
      <allow_unauthenticated_participants>false</allow_unauthenticated_participants>
      <enable_join_access_control>true</enable_join_access_control>
      <discovery_protection_kind>DISCOVERY</discovery_protection_kind>
      <liveliness_protection_kind>LIVELINESS</liveliness_protection_kind>
      <rtps_protection_kind>RTPS</rtps_protection_kind>
      <topic_access_rules>
        <topic_rule>
          <topic_expression>*</topic_expression>
          <enable_discovery_protection>FOUND</enable_discovery_protection>
          <enable_liveliness_protection>LIVES</enable_liveliness_protection>
          <enable_read_access_control>true</enable_read_access_control>
          <enable_write_access_control>true</enable_write_access_control>
          <metadata_protection_kind>METADATA</metadata_protection_kind>
          <data_protection_kind>DATA</data_protection_kind>
        </topic_rule>
      </topic_access_rules>
    </domain_rule>
  </domain_access_rules>
</dds>
"#;

const PERMISSIONS: &str = r#"<?xml version="1.0" encoding="utf-8"?>
<dds xmlns:xsi="http://www.w3.org/2001/XMLSchema-instance"
    xsi:noNamespaceSchemaLocation="http://www.omg.org/spec/DDS-SECURITY/20170901/omg_shared_ca_permissions.xsd">
  <permissions>
    <grant name="/NAME">
      <subject_name>CN=/NAME</subject_name>
      <validity>
        <not_before>2020-01-01T00:00:00</not_before>
        <not_after>2037-01-01T00:00:00</not_after>
      </validity>
      <allow_rule>
        <domains><id_range><min>0</min><max>230</max></id_range></domains>
        <publish><topics><topic>*</topic></topics></publish>
        <subscribe><topics><topic>*</topic></topics></subscribe>
      </allow_rule>
      <default>DENY</default>
    </grant>
  </permissions>
</dds>
"#;
