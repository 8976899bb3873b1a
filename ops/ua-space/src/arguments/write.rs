//! The command line arguments of `ua-space write`.

use std::path::PathBuf;

use clap::Args;

use super::live::{GroupArguments, NamedTarget, seconds};

#[derive(Debug, Args)]
pub(crate) struct Write {
    /// The topic, as ua_0_2_30, or its name, as Line.Speed or /cmd_vel
    #[arg(value_name = "TOPIC|NAME")]
    pub(crate) target: NamedTarget,
    /// The value, as 0.5, true, text or [1, 2]. Parts of a message as linear.x=0.5, or as YAML or
    /// JSON, '{linear: {x: 0.5}}'. Parts that are left out are zero, and a stamp is the present
    /// time
    #[arg(value_name = "VALUE", required = true, allow_negative_numbers = true)]
    pub(crate) values: Vec<String>,
    /// Write the value again at this rate, until Ctrl-C or --count
    #[arg(long, value_name = "HZ", value_parser = rate)]
    pub(crate) rate: Option<f64>,
    /// End after this number of values
    #[arg(
        long,
        value_name = "N",
        requires = "rate",
        value_parser = clap::value_parser!(u64).range(1..)
    )]
    pub(crate) count: Option<u64>,
    /// The mapping of the cell. Without a ua-server the value is sent by it
    #[arg(long, value_name = "MAPPING", env = "UA_MAPPING")]
    pub(crate) mapping: Option<PathBuf>,
    /// Write at this ua-server, as opc.tcp://192.168.0.5:4840. Without it: at the server that
    /// announces the value
    #[arg(long, value_name = "URL")]
    pub(crate) server: Option<String>,
    /// The user of ua-server; the password is in UA_PASSWORD
    #[arg(long, value_name = "NAME", env = "UA_USER")]
    pub(crate) user: Option<String>,
    #[arg(long, hide = true, env = "UA_PASSWORD", hide_env_values = true)]
    pub(crate) password: Option<String>,
    /// The certificate store for a signed and encrypted session with ua-server. Without it and
    /// without --user the session has no security
    #[arg(long, value_name = "DIR")]
    pub(crate) pki: Option<PathBuf>,
    /// Time to wait for the announcement of the value
    #[arg(long, value_name = "SECONDS", default_value = "3", value_parser = seconds)]
    pub(crate) wait: f64,
    /// Time to wait for the answer of ua-server
    #[arg(long, value_name = "SECONDS", default_value = "10", value_parser = seconds)]
    pub(crate) timeout: f64,
    /// Print a JSON object for each value
    #[arg(long)]
    pub(crate) json: bool,
    #[command(flatten)]
    pub(crate) group: GroupArguments,
}

fn rate(text: &str) -> Result<f64, &'static str> {
    let rate = text.parse().ok();
    rate.filter(|rate| (0.001..=1000.0).contains(rate))
        .ok_or("values per second, from 0.001 to 1000")
}
