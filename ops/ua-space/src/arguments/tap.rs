//! The command line arguments of `ua-space tap`.

use clap::Args;

use super::live::{NamedTarget, seconds};

#[derive(Debug, Args)]
pub(crate) struct TapArguments {
    /// The topic, as ua_1_2_10, or its name, as JointStates or /joint_states
    #[arg(value_name = "TOPIC|NAME")]
    pub(crate) target: NamedTarget,
    /// Ask the program with this address of --metrics. May be repeated. Without it: all programs of
    /// this host with --metrics
    #[arg(long, value_name = "URL")]
    pub(crate) metrics: Vec<String>,
    /// Only dropped samples
    #[arg(long)]
    pub(crate) drops: bool,
    /// End after this number of lines
    #[arg(short = 'n', long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..))]
    pub(crate) count: Option<u64>,
    /// End after this time. Without it and -n: at Ctrl-C
    #[arg(long, value_name = "SECONDS", value_parser = seconds)]
    pub(crate) seconds: Option<f64>,
    /// Print a JSON object per line
    #[arg(long)]
    pub(crate) json: bool,
}
