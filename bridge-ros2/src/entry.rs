//! The program `bridge-ros2`, from its command line to its exit code.

use std::collections::BTreeSet;
use std::ffi::OsString;
use std::fmt::Display;
use std::net::{IpAddr, SocketAddr};
use std::ops::RangeInclusive;
use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::LazyLock;

use bridge_core::Local;
use bridge_node::{
    Arguments, Carried, Context, Failure, FailureKind, Program, RedundancyArguments,
    RedundancyRank, SharedProgram,
};
use clap::Parser;
use mappings::{Mapping, SpaceId};
use mdns::{Bridge, TellingArguments, tell_bridge};
#[cfg(feature = "sks")]
use plant_keys::KeyArguments;
use ros2_node::discovery_info::GidLength;
use ros2_node::domain::{DiscoveryRange, DomainError, DomainOptions};
use ros2_node::limits;
use ros2_node::node::NodeOptions;
use ros2_node::security::RequestedSecurity;
use tracing::{info, warn};
use transport::{Interface, InterfaceError};

use crate::NAME;
use crate::ros_args::{RosArgs, usage};
use crate::{Ros2Port, Ros2PortOptions, environment};

/// Runs `bridge-ros2` from its command line to its end. `arguments` begin with the name of the
/// program.
#[must_use]
pub fn run(arguments: Vec<OsString>) -> ExitCode {
    bridge_node::run::<BridgeRos2>(arguments)
}

/// Returns `bridge-ros2` for a process with several programs. `arguments` begin with the name of
/// the program.
///
/// # Errors
/// The exit code if the arguments are invalid or ask for help; the message was printed.
pub fn shared(arguments: Vec<OsString>) -> Result<SharedProgram, ExitCode> {
    SharedProgram::new::<BridgeRos2>(arguments)
}

/// Carries topics between a ROS 2 domain and the space of OPC UA PubSub.
#[derive(Debug, Parser)]
#[command(name = "bridge-ros2", version = version())]
struct BridgeRos2 {
    #[command(flatten)]
    arguments: Arguments,
    #[cfg(feature = "sks")]
    #[command(flatten)]
    keys: KeyArguments,
    #[command(flatten)]
    told: TellingArguments,
    #[command(flatten)]
    redundancy: RedundancyArguments,
    /// The DDS domain to join, or several, such as 2,3. Default: the domain of the space, or of the
    /// only ROS 2 space of the mapping
    #[arg(long, value_name = "N", env = "ROS_DOMAIN_ID", value_delimiter = ',', value_parser = domain_number)]
    domain: Vec<Option<u16>>,
    /// The space of the values of the domain, 2 to 232, or a space for each domain, such as 40,41.
    /// Default: the space of the domain in the mapping, or the space with the number of the domain
    #[arg(long, value_name = "N", env = "UA_SPACE", value_delimiter = ',', value_parser = space_number)]
    space: Vec<Option<u16>>,
    /// The network interface of the ROS 2 side, by name or address. Default: by
    /// `ROS_AUTOMATIC_DISCOVERY_RANGE` and `ROS_LOCALHOST_ONLY`, otherwise all interfaces
    #[arg(long, value_name = "NAME|ADDRESS", env = "UA_ROS_INTERFACE")]
    ros_interface: Option<String>,
    /// A host that multicast does not reach, to which the bridge is announced by unicast; may be
    /// repeated. Default: the hosts in `ROS_STATIC_PEERS`, separated by `;`
    #[arg(long, value_name = "ADDRESS")]
    ros_peer: Vec<String>,
    /// The name of the ROS node of the bridge
    #[arg(long, value_name = "NAME", default_value = NODE_NAME)]
    node_name: String,
    /// The namespace of the ROS node of the bridge
    #[arg(long, value_name = "/NAMESPACE", default_value = "/")]
    node_namespace: String,
    /// Use the time of /clock for timestamps
    #[arg(long)]
    use_sim_time: bool,
    /// Length of a Gid in bytes in the list of readers and writers of the node: 24 up to ROS 2
    /// Humble, 16 from Iron on
    #[arg(long, value_name = "16|24|auto", default_value = "auto", value_parser = gid_length)]
    gid: GidChoice,
    /// Arguments as with `ros2 run`: -r __node:=NAME, -r __ns:=/NAMESPACE, -p use_sim_time:=true,
    /// --enclave /NAME; ends with `--`
    #[arg(
        long,
        value_name = "ROS_ARGS",
        num_args = 0..,
        allow_hyphen_values = true,
        value_terminator = "--"
    )]
    ros_args: Vec<String>,
}

impl BridgeRos2 {
    fn ros_args(&self) -> Result<RosArgs, Failure> {
        RosArgs::parse(&self.ros_args)
    }

    /// Returns the security settings of the ROS 2 side.
    fn security(&self) -> Result<RequestedSecurity, Failure> {
        let enclave = self.ros_args()?.enclave;
        let variable = |name: &str| std::env::var(name).ok();
        let security = RequestedSecurity::from_env(variable, enclave.as_deref())
            .map_err(|error| Failure::new(FailureKind::Configuration, error.to_string()))?;
        if let RequestedSecurity::Refrained(why) = &security {
            warn!(
                "ROS_SECURITY_ENABLE is true, but the bridge runs WITHOUT security: {why}. Correct this, or \
                 set ROS_SECURITY_STRATEGY=Enforce to refuse such a start"
            );
        }
        Ok(security)
    }

    /// Returns the options of the node; ROS arguments take precedence.
    fn node(&self) -> Result<NodeOptions, Failure> {
        let RosArgs {
            name,
            namespace,
            use_sim_time,
            enclave: _,
        } = self.ros_args()?;
        Ok(NodeOptions {
            namespace: namespace.unwrap_or_else(|| self.node_namespace.clone()),
            name: self
                .redundancy
                .node_name(name.as_deref().unwrap_or(&self.node_name)),
            gid: self.gid.0,
            use_sim_time: use_sim_time.unwrap_or(self.use_sim_time),
        })
    }

    /// Returns the domain to join for the space `own`.
    fn domain(&self, own: SpaceId, mapping: &Mapping) -> u16 {
        let spaces = self.chosen(mapping).unwrap_or_default();
        let asked = spaces.iter().position(|space| *space == own);
        asked
            .and_then(|place| given(&self.domain).get(place).copied())
            .or_else(|| mapping.domain_of(own))
            .unwrap_or_else(|| own.into())
    }

    fn chosen(&self, mapping: &Mapping) -> Result<Vec<SpaceId>, Failure> {
        choose_spaces(&given(&self.space), &given(&self.domain), mapping)
    }

    fn networks(&self) -> Result<Vec<IpAddr>, Failure> {
        if let Some(wanted) = &self.ros_interface {
            let interface = Interface::find(wanted).map_err(|error| {
                let kind = if matches!(error, InterfaceError::List(_)) {
                    FailureKind::Io
                } else {
                    FailureKind::Unavailable
                };
                Failure::new(kind, format!("--ros-interface: {error}"))
            })?;
            return Ok(vec![interface.address.into()]);
        }
        let variable = |name| std::env::var(name).ok();
        DiscoveryRange::from_env(
            variable("ROS_AUTOMATIC_DISCOVERY_RANGE").as_deref(),
            variable("ROS_LOCALHOST_ONLY").as_deref(),
        )
        .map(DiscoveryRange::networks)
        .map_err(|error| Failure::new(FailureKind::Usage, error.to_string()))
    }
}

/// Returns the version of this program and of its RustDDS.
fn version() -> &'static str {
    static VERSION: LazyLock<String> = LazyLock::new(|| {
        format!(
            "{} ({}, {})",
            build_info::version(),
            limits::RUSTDDS,
            limits::SECURITY
        )
    });
    &VERSION
}

/// Returns the given numbers; an empty environment variable gives no number, as in rcl.
fn given(numbers: &[Option<u16>]) -> Vec<u16> {
    numbers.iter().copied().flatten().collect()
}

/// A number of the command line that is outside of its range.
#[derive(Debug, PartialEq, Eq, thiserror::Error)]
#[error("it is {} to {}", .0.start(), .0.end())]
struct NumberOutOfRange(RangeInclusive<u16>);

fn domain_number(text: &str) -> Result<Option<u16>, NumberOutOfRange> {
    number(text, 0..=232)
}

fn space_number(text: &str) -> Result<Option<u16>, NumberOutOfRange> {
    number(text, 2..=232)
}

fn number(text: &str, range: RangeInclusive<u16>) -> Result<Option<u16>, NumberOutOfRange> {
    if text.trim().is_empty() {
        return Ok(None);
    }
    let number = text.trim().parse().ok();
    match number.filter(|number| range.contains(number)) {
        Some(number) => Ok(Some(number)),
        None => Err(NumberOutOfRange(range)),
    }
}

/// Returns the addresses of the hosts from the command line, or else from the environment.
async fn peers(given: &[String], variable: Option<&str>) -> Result<Vec<IpAddr>, Failure> {
    let listed = variable.unwrap_or_default().split(';');
    let hosts: Vec<&str> = if given.is_empty() {
        listed
            .map(str::trim)
            .filter(|host| !host.is_empty())
            .collect()
    } else {
        given.iter().map(String::as_str).collect()
    };
    let mut addresses = Vec::with_capacity(hosts.len());
    for host in hosts {
        addresses.push(address(host).await?);
    }
    Ok(addresses)
}

/// Returns the address of a host; RustDDS supports IPv4 only. The other programs of the thread go
/// on while a name is resolved.
async fn address(host: &str) -> Result<IpAddr, Failure> {
    if let Ok(IpAddr::V6(_)) = host.parse() {
        let message = format!("peer {host}: only IPv4 addresses can be reached");
        return Err(Failure::new(FailureKind::Usage, message));
    }
    let unknown =
        |why: &dyn Display| Failure::new(FailureKind::Unavailable, format!("peer {host}: {why}"));
    let mut addresses = tokio::net::lookup_host((host, 0))
        .await
        .map_err(|error| unknown(&error))?;
    addresses
        .find(SocketAddr::is_ipv4)
        .map(|address| address.ip())
        .ok_or_else(|| unknown(&"has no IPv4 address"))
}

impl Program for BridgeRos2 {
    type Port = Ros2Port;

    const NAME: &'static str = NAME;
    // Keys are fetched over OPC UA, and this program logs the outcome.
    #[cfg(feature = "sks")]
    const QUIET: &'static str = plant_keys::QUIET;
    const LOCAL: Local = Local::Cdr;

    fn library() -> Option<&'static str> {
        Some(limits::RUSTDDS)
    }

    fn arguments(&self) -> &Arguments {
        &self.arguments
    }

    fn spaces(&self, mapping: &Mapping) -> Result<Vec<SpaceId>, Failure> {
        self.chosen(mapping)
    }

    fn part(&self) -> BTreeSet<u16> {
        self.redundancy.part()
    }

    fn rank(&self) -> Option<RedundancyRank> {
        self.redundancy.rank
    }

    #[cfg(feature = "sks")]
    fn key_service(
        &self,
        _mapping: &Mapping,
    ) -> Option<std::sync::Arc<dyn bridge_node::KeyService>> {
        Some(self.keys.service(Self::NAME))
    }

    fn tell(&self, carried: &Carried<'_>) -> Option<Box<dyn Send + Sync>> {
        let bridge = Bridge {
            program: Self::NAME.to_owned(),
            uri: carried.application.uri.clone(),
            space: carried.own.into(),
            group: carried.group,
        };
        let told = tell_bridge(&bridge, &self.told.telling, carried.interface)?;
        Some(Box::new(told))
    }

    async fn start(&self, context: Context) -> Result<Ros2Port, Failure> {
        let Context {
            mapping,
            types,
            own,
        } = context;
        let security = self.security()?;
        if self.spaces(&mapping)?.first() == Some(&own) {
            for warning in environment::ignored(|name| std::env::var(name).ok()) {
                warn!("{warning}");
            }
        }
        let options = Ros2PortOptions {
            domain: DomainOptions {
                domain: self.domain(own, &mapping),
                networks: self.networks()?,
                peers: peers(
                    &self.ros_peer,
                    std::env::var("ROS_STATIC_PEERS").ok().as_deref(),
                )
                .await?,
                node: self.node()?,
                enclave: security.enclave().cloned(),
            },
            own,
            mapping,
            types,
            prefixes: std::env::var_os("AMENT_PREFIX_PATH")
                .map(|list| std::env::split_paths(&list).collect::<Vec<PathBuf>>())
                .unwrap_or_default(),
        };
        info!("DDS Security is {}", security.label());
        Ros2Port::start(options).map_err(|error| Failure::new(kind(&error), error.to_string()))
    }
}

/// Returns the kind of failure, which shows whether the usage, the configuration or the system is
/// at fault.
const fn kind(error: &DomainError) -> FailureKind {
    if matches!(
        error,
        DomainError::Domain(_) | DomainError::NodeName { .. } | DomainError::Peers
    ) {
        FailureKind::Usage
    } else if matches!(
        error,
        DomainError::Security(_) | DomainError::Enclave { .. }
    ) {
        FailureKind::Configuration
    } else {
        FailureKind::Unavailable
    }
}

/// Returns the spaces that a bridge serves, a space for each requested domain.
fn choose_spaces(
    spaces: &[u16],
    domains: &[u16],
    mapping: &Mapping,
) -> Result<Vec<SpaceId>, Failure> {
    if !spaces.is_empty() && !domains.is_empty() && spaces.len() != domains.len() {
        return Err(usage(format!(
            "{} spaces for {} domains: give --space and --domain (ROS_DOMAIN_ID) the same number of values, \
             a space for each domain",
            spaces.len(),
            domains.len()
        )));
    }
    for (what, numbers) in [("domain", domains), ("space", spaces)] {
        if let Some(twice) = repeated(numbers) {
            return Err(usage(format!("{what} {twice} is given twice")));
        }
    }
    let count = spaces.len().max(domains.len()).max(1);
    let chosen: Vec<SpaceId> = (0..count)
        .map(|place| {
            choose_space(
                spaces.get(place).copied(),
                domains.get(place).copied(),
                mapping,
            )
        })
        .collect::<Result<_, _>>()?;
    match repeated(&chosen) {
        Some(twice) => Err(usage(format!(
            "two of the domains belong to space {twice}; give each domain its own space"
        ))),
        None => Ok(chosen),
    }
}

fn repeated<T: Copy + PartialEq>(all: &[T]) -> Option<T> {
    let before = |place: usize| all.iter().take(place);
    all.iter()
        .enumerate()
        .find(|(place, one)| before(*place).any(|other| other == *one))
        .map(|(_, one)| *one)
}

/// Returns the space of a domain: the requested space, else the space of the requested domain, else
/// the only ROS 2 space of the mapping.
fn choose_space(
    space: Option<u16>,
    domain: Option<u16>,
    mapping: &Mapping,
) -> Result<SpaceId, Failure> {
    if let Some(space) = space {
        let id = SpaceId::new(space)
            .filter(|id| id.is_ros2())
            .ok_or_else(|| usage(format!("--space {space}: ROS 2 spaces are 2 to 232")))?;
        let declared = mapping.space(id).and_then(|space| space.domain);
        return match (domain, declared) {
            (Some(asked), Some(declared)) if asked != declared => Err(usage(format!(
                "space {id} is DDS domain {declared} in the mapping, but --domain or ROS_DOMAIN_ID says \
                 {asked}; make both equal"
            ))),
            _ => Ok(id),
        };
    }
    if let Some(domain) = domain {
        return mapping.space_of_domain(domain).ok_or_else(|| {
            let free = (FIRST_FREE..=232).filter_map(SpaceId::new);
            let free = free.filter(|id| mapping.space(*id).is_none()).min();
            let id = free.map_or(FIRST_FREE, u16::from);
            usage(format!(
                "DDS domain {domain} has no space: add `- {{id: {id}, domain: {domain}}}` to `spaces` of \
                 the mapping, or give --space N (2 to 232)"
            ))
        });
    }
    let mut declared = mapping
        .spaces()
        .iter()
        .map(|space| space.id)
        .filter(|id| id.is_ros2());
    match (declared.next(), declared.next()) {
        (Some(only), None) => Ok(only),
        (Some(_), Some(_)) => Err(usage(
            "the mapping has several ROS 2 spaces: choose with --space N, or --space N,M for several in one program"
                .to_owned(),
        )),
        (None, _) => Err(usage(
            "the DDS domain is not given: add `- {id: 2}` to `spaces` of the mapping (space 2 in DDS domain \
             2; `- {id: 2, domain: 0}` for domain 0), or give --domain N (or set ROS_DOMAIN_ID)"
                .to_owned(),
        )),
    }
}

/// A fixed length, or the length that most other participants write.
#[derive(Debug, Clone, Copy)]
struct GidChoice(Option<GidLength>);

fn gid_length(text: &str) -> Result<GidChoice, &'static str> {
    match text {
        "16" => Ok(GidChoice(Some(GidLength::Bytes16))),
        "24" => Ok(GidChoice(Some(GidLength::Bytes24))),
        "auto" => Ok(GidChoice(None)),
        _ => Err("expected 16, 24 or auto"),
    }
}

/// The first number that is proposed for the space of another domain. Lower numbers are kept for
/// domains of the same number.
const FIRST_FREE: u16 = 40;
/// The name of the bridge in `ros2 node list`.
const NODE_NAME: &str = "ua_bridge_ros2";

#[cfg(test)]
mod tests {
    use super::*;
    use clap::CommandFactory;

    #[test]
    fn the_command_line_is_well_formed() {
        BridgeRos2::command().debug_assert();
    }

    #[test]
    fn the_node_is_what_ros_arguments_say() {
        let line =
            "bridge-ros2 cell.yaml --ros-args -r __node:=left -p use_sim_time:=true -- --check";
        let bridge = BridgeRos2::try_parse_from(line.split(' ')).unwrap();
        let node = bridge.node().unwrap();
        assert_eq!(
            (node.full_name().as_str(), node.use_sim_time),
            ("/left", true)
        );
        assert!(bridge.arguments.check && bridge.arguments.mapping.is_some());
    }

    #[test]
    fn a_domain_is_the_space_of_its_number() {
        let space = choose_space(None, Some(7), &Mapping::default()).unwrap();
        assert_eq!(space.get(), 7);
    }

    #[test]
    fn a_variable_that_is_set_to_nothing_names_no_domain() {
        assert_eq!(domain_number(""), Ok(None));
        assert_eq!(domain_number("232"), Ok(Some(232)));
        assert!(domain_number("233").is_err() && space_number("1").is_err());
        assert!(domain_number("two").is_err());
    }

    #[test]
    fn several_domains_are_several_spaces() {
        let none = Mapping::default();
        let numbers = |spaces: Vec<SpaceId>| spaces.iter().map(|id| id.get()).collect::<Vec<_>>();
        assert_eq!(numbers(choose_spaces(&[], &[7, 8], &none).unwrap()), [7, 8]);
        let both = choose_spaces(&[40, 41], &[0, 1], &none);
        assert_eq!(numbers(both.unwrap()), [40, 41]);
        for (spaces, domains, why) in [
            (&[40][..], &[0, 1][..], "1 spaces for 2 domains"),
            (&[], &[7, 7], "domain 7 is given twice"),
            (&[40, 40], &[], "space 40 is given twice"),
        ] {
            let error = choose_spaces(spaces, domains, &none)
                .unwrap_err()
                .to_string();
            assert!(error.contains(why), "{error}");
        }
    }

    #[test]
    fn domain_0_needs_a_space() {
        let error = choose_space(None, Some(0), &Mapping::default())
            .unwrap_err()
            .to_string();
        assert!(error.contains("--space"), "{error}");
        assert_eq!(
            choose_space(Some(40), Some(0), &Mapping::default())
                .unwrap()
                .get(),
            40
        );
    }

    #[test]
    fn without_a_domain_or_a_mapping_nothing_is_guessed() {
        let error = choose_space(None, None, &Mapping::default())
            .unwrap_err()
            .to_string();
        assert!(error.contains("--domain"), "{error}");
        assert!(error.contains("`- {id: 2}`"), "{error}");
    }
}
