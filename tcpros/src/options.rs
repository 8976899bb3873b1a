//! How a node is called, where its master is, and under which address others reach it.

use std::net::{IpAddr, Ipv4Addr, Ipv6Addr};

use crate::names::{NameError, Names};
use crate::rpc::Endpoint;

/// What a node needs to know before it starts.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct NodeOptions {
    /// Name without namespace, such as `bridge`.
    pub name: String,
    /// Namespace of the node's name and of relative topics, such as `/` or `/cell`.
    pub namespace: String,
    /// Such as `http://localhost:11311`.
    pub master_uri: String,
    /// Host name or address that other nodes are told.
    pub hostname: String,
    /// Address the node listens on.
    pub bind: IpAddr,
    /// Pairs of names: who uses the first gets the second.
    pub remappings: Vec<(String, String)>,
    /// Longest message taken from a publisher, in bytes. A longer one closes its connection.
    pub max_message: usize,
}

impl NodeOptions {
    /// Reads `ROS_MASTER_URI`, `ROS_HOSTNAME`, `ROS_IP` and `ROS_NAMESPACE`, with the defaults of ROS for those that
    /// are not set: port 11311 here, and the name of this machine.
    pub fn from_env(name: &str) -> Self {
        Self::from_lookup(name, |key| std::env::var(key).ok())
    }

    fn from_lookup(name: &str, lookup: impl Fn(&str) -> Option<String>) -> Self {
        let set = |key| lookup(key).filter(|value| !value.is_empty());
        let hostname = set("ROS_HOSTNAME")
            .or_else(|| set("ROS_IP"))
            .unwrap_or_else(|| gethostname::gethostname().to_string_lossy().into_owned());
        Self {
            name: name.to_owned(),
            namespace: set("ROS_NAMESPACE").unwrap_or_else(|| "/".to_owned()),
            master_uri: set("ROS_MASTER_URI")
                .unwrap_or_else(|| "http://localhost:11311".to_owned()),
            bind: bind_for(&hostname),
            hostname,
            remappings: Vec::new(),
            max_message: DEFAULT_MAX_MESSAGE,
        }
    }

    /// Takes the arguments that ROS gives a meaning to: `__name:=`, `__ns:=`, `__ip:=`, `__hostname:=`, `__master:=`
    /// and `from:=to`. Returns the others in their order; private parameters (`_name:=value`) and unknown `__`
    /// words are among them.
    pub fn apply_arguments<S: AsRef<str>>(&mut self, arguments: &[S]) -> Vec<String> {
        let mut others = Vec::new();
        // An address given by name wins over `__ip`, whatever their order.
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
                Some(("__ip", _)) => {}
                Some((from, to)) if !from.starts_with('_') => {
                    self.remappings.push((from.to_owned(), to.to_owned()));
                }
                _ => others.push(argument.to_owned()),
            }
        }
        others
    }

    /// Sets the address that others are told, and with it the one to listen on: all, or loopback alone.
    pub fn advertise_as(&mut self, hostname: &str) {
        hostname.clone_into(&mut self.hostname);
        self.bind = bind_for(hostname);
    }

    pub(crate) fn names(&self) -> Result<Names, NameError> {
        Names::new(&self.name, &self.namespace, &self.remappings)
    }

    pub(crate) fn master(&self) -> Option<Endpoint> {
        Endpoint::parse(&self.master_uri)
    }
}

fn bind_for(hostname: &str) -> IpAddr {
    match hostname.parse::<IpAddr>() {
        Ok(address) if address.is_loopback() => address,
        Ok(IpAddr::V6(_)) => Ipv6Addr::UNSPECIFIED.into(),
        Err(_) if hostname == "localhost" => Ipv4Addr::LOCALHOST.into(),
        _ => Ipv4Addr::UNSPECIFIED.into(),
    }
}

/// As much as a point cloud or an uncompressed image takes, and a quarter of where roscpp stops.
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
        ]);
        assert_eq!(rest, ["map.yaml", "_rate:=5"]);
        assert_eq!(
            (options.hostname.as_str(), options.bind.is_loopback()),
            ("localhost", true)
        );
        let names = options.names().unwrap();
        assert_eq!(names.node(), "/line/b");
        assert_eq!(names.resolve("a").unwrap(), "/x");
    }
}
