//! The command line arguments of `ua-space discover`.

use clap::Args;
use discovery::scan::Range;

use super::GroupArguments;
use super::live::seconds;

#[derive(Debug, Args)]
pub(crate) struct Discover {
    #[command(flatten)]
    pub(crate) look: DiscoverArguments,
    /// Print a JSON array
    #[arg(long)]
    pub(crate) json: bool,
}

/// How to look around.
#[derive(Debug, Default, Args)]
pub(crate) struct DiscoverArguments {
    /// Time to listen
    #[arg(long, value_name = "SECONDS", default_value = "3", value_parser = seconds)]
    pub(crate) seconds: f64,
    /// Also ask this discovery server, beside the server of this host and the announced servers.
    /// May be repeated
    #[arg(long, value_name = "URL")]
    pub(crate) lds: Vec<String>,
    /// Try these addresses, as 192.168.0.0/24, for servers that do not announce themselves. /16 is
    /// the widest. May be repeated
    #[arg(long, value_name = "CIDR")]
    pub(crate) scan: Vec<Range>,
    /// The ports to try at the addresses of --scan
    #[arg(long, value_name = "PORT", value_delimiter = ',', default_value = "4840", requires = "scan", num_args = 1..=16,
        value_parser = clap::value_parser!(u16).range(1..))]
    pub(crate) port: Vec<u16>,
    /// Largest number of addresses to try in a second
    #[arg(long, value_name = "N", default_value_t = 200, requires = "scan", value_parser = clap::value_parser!(u32).range(1..=1000))]
    pub(crate) rate: u32,
    #[command(flatten)]
    pub(crate) group: GroupArguments,
}
