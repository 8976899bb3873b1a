//! The options of a node: its name, the address of its master, and its own address for other nodes.

use std::net::{IpAddr, Ipv4Addr, Ipv6Addr};

use thiserror::Error;

use crate::names::{self, NameResolver, ResourceNameError};
use crate::parameters::{self, ParamError, ParamValue};
use crate::rpc::RpcEndpoint;

/// The settings of a node before its start.
#[derive(Clone, Debug, PartialEq)]
pub struct NodeOptions {
    /// Name without namespace, such as `bridge`.
    pub name: String,
    /// Namespace of the node's name and of relative topics, such as `/` or `/cell`.
    pub namespace: String,
    /// URI of the master, such as `http://localhost:11311`.
    pub master_uri: String,
    /// Host name or address that is announced to other nodes.
    pub hostname: String,
    /// Address the node listens on.
    pub bind: IpAddr,
    /// Pairs of names: uses of the first name resolve to the second name.
    pub remappings: Vec<(String, String)>,
    /// Private parameters by their names without `~`. They are set at the master before the node
    /// counts as registered. After a restart of the master, parameters that are not set are set
    /// again.
    pub parameters: Vec<(String, ParamValue)>,
    /// Whether the IPv6 addresses of a host are tried before its IPv4 addresses (`ROS_IPV6=on`).
    pub ipv6: bool,
    /// Maximum length of a message from a publisher, in bytes. A longer message closes its
    /// connection.
    pub max_message: usize,
}

impl NodeOptions {
    /// Reads `ROS_MASTER_URI`, `ROS_HOSTNAME`, `ROS_IP`, `ROS_NAMESPACE` and `ROS_IPV6`. Unset
    /// variables have the defaults of ROS: port 11311 on this host, and the name of this machine
    /// (`wiki.ros.org/ROS/EnvironmentVariables`).
    pub fn from_env(name: &str) -> Self {
        Self::from_lookup(name, |key| std::env::var(key).ok())
    }

    fn from_lookup(name: &str, lookup: impl Fn(&str) -> Option<String>) -> Self {
        let set = |key| lookup(key).filter(|value| !value.is_empty());
        let hostname = set("ROS_HOSTNAME")
            .or_else(|| set("ROS_IP"))
            .unwrap_or_else(|| gethostname::gethostname().to_string_lossy().into_owned());
        let ipv6 = set("ROS_IPV6").as_deref() == Some("on");
        Self {
            name: name.to_owned(),
            namespace: set("ROS_NAMESPACE").unwrap_or_else(|| "/".to_owned()),
            master_uri: set("ROS_MASTER_URI")
                .unwrap_or_else(|| "http://localhost:11311".to_owned()),
            bind: bind_for(&hostname, ipv6),
            hostname,
            remappings: Vec::new(),
            parameters: Vec::new(),
            ipv6,
            max_message: DEFAULT_MAX_MESSAGE,
        }
    }

    /// Applies the arguments of ROS: `__name:=`, `__ns:=`, `__ip:=`, `__hostname:=`, `__master:=`,
    /// `__log:=` (without effect: this crate writes no log file), `from:=to` and
    /// `_parameter:=value` (`wiki.ros.org/Remapping Arguments`). Returns the other arguments in
    /// order, including unknown `__` arguments.
    ///
    /// # Errors
    /// Fails if the name of a remapping or parameter is not a valid ROS name, or if a parameter is
    /// an integer of more than 32 bits.
    pub fn apply_arguments<S: AsRef<str>>(
        &mut self,
        arguments: &[S],
    ) -> Result<Vec<String>, ArgumentError> {
        let mut others = Vec::new();
        // `__hostname` takes precedence over `__ip`, regardless of their order.
        let mut named = false;
        for argument in arguments {
            let argument = argument.as_ref();
            match argument.split_once(":=") {
                Some(("__name", value)) => value.clone_into(&mut self.name),
                Some(("__ns", value)) => value.clone_into(&mut self.namespace),
                Some(("__master", value)) => value.clone_into(&mut self.master_uri),
                Some(("__hostname", value)) => {
                    self.advertise_as(value);
                    named = true;
                }
                Some(("__ip", value)) if !named => self.advertise_as(value),
                Some(("__ip" | "__log", _)) => {}
                Some((from, to)) if !from.starts_with("__") => {
                    self.assign(from, to)
                        .map_err(|reason| ArgumentError::new(argument, reason))?;
                }
                _ => others.push(argument.to_owned()),
            }
        }
        Ok(others)
    }

    fn assign(&mut self, from: &str, to: &str) -> Result<(), ParamError> {
        if let Some(parameter) = from.strip_prefix('_') {
            if parameter.is_empty() {
                return Err(ResourceNameError::Invalid(from.to_owned()).into());
            }
            names::check(&format!("~{parameter}"))?;
            let value = parameters::argument_value(to)?;
            self.parameters.push((parameter.to_owned(), value));
        } else {
            names::check(from)?;
            names::check(to)?;
            self.remappings.push((from.to_owned(), to.to_owned()));
        }
        Ok(())
    }

    /// Sets the announced address, and with it the address to listen on: all interfaces, or
    /// loopback only.
    pub fn advertise_as(&mut self, hostname: &str) {
        hostname.clone_into(&mut self.hostname);
        self.bind = bind_for(hostname, self.ipv6);
    }

    pub(crate) fn names(&self) -> Result<NameResolver, ResourceNameError> {
        NameResolver::new(&self.name, &self.namespace, &self.remappings)
    }

    pub(crate) fn master(&self) -> Option<RpcEndpoint> {
        RpcEndpoint::parse(&self.master_uri).map(|endpoint| endpoint.ipv6_first(self.ipv6))
    }
}

/// Returns the address to listen on so that other nodes reach this host name: all interfaces, or
/// loopback only. Listening on `::` includes IPv4.
fn bind_for(hostname: &str, ipv6: bool) -> IpAddr {
    match hostname.parse::<IpAddr>() {
        Ok(address) if address.is_loopback() => address,
        Err(_) if hostname == "localhost" && ipv6 => Ipv6Addr::LOCALHOST.into(),
        Err(_) if hostname == "localhost" => Ipv4Addr::LOCALHOST.into(),
        Ok(IpAddr::V6(_)) => Ipv6Addr::UNSPECIFIED.into(),
        _ if ipv6 => Ipv6Addr::UNSPECIFIED.into(),
        _ => Ipv4Addr::UNSPECIFIED.into(),
    }
}

/// Error for an invalid remapping or private parameter on the command line.
#[derive(Debug, Error)]
#[error(
    "`{word}` is neither a remapping (from:=to) nor a private parameter (_name:=value): {reason}"
)]
pub struct ArgumentError {
    word: String,
    #[source]
    reason: ParamError,
}

impl ArgumentError {
    fn new(word: &str, reason: ParamError) -> Self {
        Self {
            word: word.to_owned(),
            reason,
        }
    }

    /// Returns the argument.
    pub fn word(&self) -> &str {
        &self.word
    }
}

/// Suffices for a point cloud or an uncompressed image, and is a quarter of the limit of roscpp.
const DEFAULT_MAX_MESSAGE: usize = 256 * 1024 * 1024;

#[cfg(test)]
mod tests {
    use super::*;

    fn from(set: &[(&str, &str)]) -> NodeOptions {
        NodeOptions::from_lookup("cell", |key| {
            set.iter()
                .find(|(name, _)| *name == key)
                .map(|(_, value)| (*value).to_owned())
        })
    }

    #[test]
    fn the_host_name_wins_over_the_address() {
        let both = from(&[("ROS_IP", "10.0.0.7"), ("ROS_HOSTNAME", "robot.local")]);
        assert_eq!(both.hostname, "robot.local");
        assert_eq!(
            from(&[("ROS_IP", "10.0.0.7"), ("ROS_HOSTNAME", "")]).hostname,
            "10.0.0.7"
        );
        assert_eq!(both.master_uri, "http://localhost:11311");
    }

    #[test]
    fn a_node_known_by_loopback_listens_there_only() {
        assert_eq!(
            from(&[("ROS_HOSTNAME", "localhost")]).bind,
            Ipv4Addr::LOCALHOST
        );
        assert_eq!(
            from(&[("ROS_IP", "127.0.1.1")]).bind,
            Ipv4Addr::new(127, 0, 1, 1)
        );
        assert_eq!(from(&[("ROS_IP", "10.0.0.7")]).bind, Ipv4Addr::UNSPECIFIED);
    }

    #[test]
    fn the_arguments_of_ros_are_taken_and_the_others_returned() {
        let mut options = from(&[]);
        let rest = options.apply_arguments(&[
            "map.yaml",
            "__name:=b",
            "__ns:=/line",
            "a:=/x",
            "__hostname:=localhost",
            "__ip:=10.0.0.9",
            "_rate:=5",
            "__log:=/tmp/x.log",
            "__what:=1",
            "~out:=/y",
        ]);
        assert_eq!(rest.unwrap(), ["map.yaml", "__what:=1"]);
        assert_eq!(options.parameters, [("rate".to_owned(), 5.into())]);
        assert_eq!(
            (options.hostname.as_str(), options.bind.is_loopback()),
            ("localhost", true)
        );
        let names = options.names().unwrap();
        assert_eq!(names.node(), "/line/b");
        assert_eq!(names.resolve("a").unwrap(), "/x");
        assert_eq!(names.resolve("~out").unwrap(), "/y");
    }

    #[test]
    fn a_word_that_remaps_no_name_is_refused_and_named() {
        for word in [
            "1a:=b",
            "a:=b c",
            "a:=",
            ":=b",
            "_:=1",
            "_a-b:=1",
            "_n:=2147483648",
        ] {
            let error = from(&[]).apply_arguments(&[word]).unwrap_err();
            assert_eq!(error.word(), word);
            assert!(error.to_string().contains(word), "{error}");
        }
    }

    #[test]
    fn with_ipv6_a_node_listens_on_both_families_and_on_the_loopback_it_is_known_by() {
        let v6 = |more: &[(&str, &str)]| from(&[&[("ROS_IPV6", "on")], more].concat());
        assert_eq!(v6(&[]).bind, Ipv6Addr::UNSPECIFIED);
        assert_eq!(v6(&[("ROS_IP", "10.0.0.7")]).bind, Ipv6Addr::UNSPECIFIED);
        assert_eq!(
            v6(&[("ROS_HOSTNAME", "localhost")]).bind,
            Ipv6Addr::LOCALHOST
        );
        assert_eq!(v6(&[("ROS_IP", "127.0.0.1")]).bind, Ipv4Addr::LOCALHOST);
        assert_eq!(from(&[("ROS_IP", "::1")]).bind, Ipv6Addr::LOCALHOST);
        assert_eq!(from(&[("ROS_IPV6", "off")]).bind, Ipv4Addr::UNSPECIFIED);
    }
}
