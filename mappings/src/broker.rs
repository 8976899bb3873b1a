//! The MQTT broker that carries the NetworkMessages (OPC 10000-14, 7.3.4).

use std::fmt;
use std::path::PathBuf;
use std::time::Duration;

/// Settings of the connection with an MQTT broker.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Broker {
    /// Address of the broker.
    pub address: BrokerAddress,
    /// Protocol version; `None` lets the program try 5.0 and then 3.1.1.
    pub version: Option<MqttVersion>,
    /// First levels of every topic.
    pub prefix: String,
    /// Message mapping of sent messages. Both are received.
    pub encoding: MessageMapping,
    /// Form of the topics of values.
    pub topics: TopicForm,
    /// Whether the broker confirms values (QoS 1). Commands and calls are always sent with QoS 0.
    pub at_least_once: bool,
    /// Age at which a received message is dropped.
    pub within: Duration,
    /// Whether the access rules of the broker decide who may request calls.
    pub acl: bool,
    /// Whether the broker reports the loss of the program, which then alone uses its PublisherId.
    pub will: bool,
    /// Certificates of authorities, as PEM; `None` for the certificates of the system.
    pub ca: Option<PathBuf>,
    /// Own certificate and key, as PEM.
    pub client: Option<(PathBuf, PathBuf)>,
    /// File with the user name in the first line and the password in the second.
    pub credentials: Option<PathBuf>,
    /// Text that begins the ClientId of every program; `None`: `ua-bridge`.
    pub client_id: Option<String>,
}

impl Broker {
    /// Returns whether the text can be the first levels of every topic.
    #[must_use]
    pub fn is_prefix(text: &str) -> bool {
        let is_plain = |c: char| !c.is_control() && !c.is_whitespace() && !matches!(c, '+' | '#');
        let is_level = |level: &str| !level.is_empty() && !level.starts_with('$');
        text.len() <= 128 && text.chars().all(is_plain) && text.split('/').all(is_level)
    }
}

/// Version of MQTT.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum MqttVersion {
    /// MQTT 3.1.1.
    V3_1_1,
    /// MQTT 5.0.
    V5,
}

/// Message mapping of OPC UA PubSub.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum MessageMapping {
    /// UADP (OPC 10000-14, 7.2.4).
    #[default]
    Uadp,
    /// JSON (OPC 10000-14, 7.2.5) with the Verbose encoding of OPC 10000-6, 5.4.
    JsonVerbose,
    /// JSON with the Compact encoding of OPC 10000-6, 5.4.
    JsonCompact,
    /// JSON with the reversible encoding of version 1.04.
    JsonReversible,
    /// JSON with the non-reversible encoding of version 1.04.
    JsonNonReversible,
}

/// Form of the topics of values.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum TopicForm {
    /// The tree of OPC 10000-14, 7.3.4.7, such as `opcua/uadp/data/1/2/10`.
    #[default]
    Tree,
    /// The name of the topic in the space, such as `opcua/ua_1_2_10`.
    Names,
}

/// Address of an MQTT broker.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct BrokerAddress {
    /// Whether TLS protects the connection.
    pub tls: bool,
    /// Name or IP address of the host.
    pub host: String,
    /// TCP port.
    pub port: u16,
}

impl Broker {
    /// Default of [`prefix`](Self::prefix), the default of MqttTopicPrefix.
    pub const PREFIX: &str = "opcua";
    /// Default of [`within`](Self::within).
    pub const WITHIN: Duration = Duration::from_secs(1);

    /// Returns the default settings for a broker.
    #[must_use]
    pub fn new(address: BrokerAddress) -> Self {
        Self {
            address,
            version: None,
            prefix: Self::PREFIX.to_owned(),
            encoding: MessageMapping::Uadp,
            topics: TopicForm::Tree,
            at_least_once: false,
            within: Self::WITHIN,
            acl: false,
            will: false,
            ca: None,
            client: None,
            credentials: None,
            client_id: None,
        }
    }
}

impl BrokerAddress {
    /// Example for messages.
    pub const EXAMPLE: &str = "mqtt://broker.local:1883";

    /// Returns `true` if the URL has a scheme of MQTT.
    #[must_use]
    pub fn is_mqtt(url: &str) -> bool {
        SCHEMES.iter().any(|(scheme, _)| url.starts_with(scheme))
    }

    /// Reads `mqtt://host[:1883]` or `mqtts://host[:8883]`. A URL with a user name or path is not
    /// read.
    #[must_use]
    pub fn parse(url: &str) -> Option<Self> {
        let (rest, tls) = SCHEMES
            .iter()
            .find_map(|(scheme, tls)| Some((url.strip_prefix(scheme)?, *tls)))?;
        let rest = rest.strip_suffix('/').unwrap_or(rest);
        let (host, port) = match rest.strip_prefix('[') {
            Some(v6) => {
                let (host, port) = v6.split_once(']')?;
                (
                    host,
                    port.strip_prefix(':')
                        .or_else(|| port.is_empty().then_some("")),
                )
            }
            None => match rest.split_once(':') {
                Some((host, port)) => (host, Some(port)),
                None => (rest, Some("")),
            },
        };
        let port = match port? {
            "" if rest.ends_with(':') => return None,
            "" if tls => 8883,
            "" => 1883,
            port => port.parse().ok().filter(|port| *port != 0)?,
        };
        let is_plain = |c: char| c.is_ascii_alphanumeric() || matches!(c, '.' | '-' | '_' | ':');
        (!host.is_empty() && host.chars().all(is_plain)).then(|| Self {
            tls,
            host: host.to_owned(),
            port,
        })
    }
}

impl fmt::Display for BrokerAddress {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let scheme = if self.tls { "mqtts" } else { "mqtt" };
        let Self { host, port, .. } = self;
        if host.contains(':') {
            write!(f, "{scheme}://[{host}]:{port}")
        } else {
            write!(f, "{scheme}://{host}:{port}")
        }
    }
}

/// URL schemes, and whether they use TLS. open62541 writes `opc.mqtt`.
const SCHEMES: [(&str, bool); 4] = [
    ("mqtt://", false),
    ("mqtts://", true),
    ("opc.mqtt://", false),
    ("opc.mqtts://", true),
];

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_address_of_a_broker_is_a_scheme_a_host_and_a_port() {
        for (url, shown) in [
            ("mqtt://broker", "mqtt://broker:1883"),
            ("mqtts://broker.local/", "mqtts://broker.local:8883"),
            ("opc.mqtt://10.0.0.1:1884", "mqtt://10.0.0.1:1884"),
            ("mqtt://[::1]:1999", "mqtt://[::1]:1999"),
            ("mqtt://[::1]", "mqtt://[::1]:1883"),
        ] {
            let address = BrokerAddress::parse(url).unwrap();
            assert_eq!(address.to_string(), shown);
        }
        for url in [
            "mqtt://",
            "mqtt://user:secret@broker",
            "mqtt://broker:0",
            "mqtt://broker:",
            "mqtt://broker:70000",
            "mqtt://broker/path",
            "http://broker",
            "mqtt://[::1",
        ] {
            assert_eq!(BrokerAddress::parse(url), None, "{url}");
        }
    }
}
