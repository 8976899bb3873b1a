//! The arguments of recordings.

use std::net::IpAddr;
use std::path::PathBuf;

use clap::Args;
use mappings::SpaceId;

use super::live::{GroupArguments, seconds};
use crate::live::ModelSource;

/// The models of robots that viewers show.
#[derive(Debug, Args)]
pub(crate) struct Models {
    /// The model (URDF) of a robot for viewers: a file, or a ROS 1 master with the parameter
    /// robot_description, as http://localhost:11311 or
    /// http://localhost:11311/arm/robot_description. The topic is /robot_description, the name of
    /// the parameter, or TOPIC. May be repeated
    #[arg(long, value_name = "[TOPIC=]FILE|URL")]
    pub(crate) model: Vec<ModelSource>,
}

#[derive(Debug, Args)]
pub(crate) struct RecordArguments {
    /// The new file: cell.pcapng for all messages, or cell.mcap for values
    #[arg(value_name = "FILE")]
    pub(crate) file: PathBuf,
    /// End after this time. Without it, --count and --size: at Ctrl-C
    #[arg(long = "for", value_name = "SECONDS", value_parser = seconds)]
    pub(crate) seconds: Option<f64>,
    /// End after this number of messages
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..))]
    pub(crate) count: Option<u64>,
    /// End when the messages have this size together
    #[arg(long, value_name = "MIB", value_parser = clap::value_parser!(u64).range(1..=1_000_000))]
    pub(crate) size: Option<u64>,
    /// Print the summary as a JSON object
    #[arg(long)]
    pub(crate) json: bool,
    #[command(flatten)]
    pub(crate) models: Models,
    #[command(flatten)]
    pub(crate) group: GroupArguments,
}

#[derive(Debug, Args)]
pub(crate) struct ReplayArguments {
    /// A recording of `ua-space record`, .pcapng or .mcap, or another capture of pcap or pcapng
    #[arg(value_name = "FILE")]
    pub(crate) file: PathBuf,
    /// How many times faster than it was recorded
    #[arg(long, value_name = "N", default_value = "1", value_parser = speed)]
    pub(crate) speed: f64,
    /// Only messages of these spaces, as 1,2
    #[arg(long, value_name = "SPACE", value_delimiter = ',', value_parser = super::space)]
    pub(crate) space: Vec<SpaceId>,
    /// Also send commands and calls. Robots and machines that hear them move
    #[arg(long)]
    pub(crate) commands: bool,
    /// Send although live programs of the same spaces are in the group
    #[arg(long)]
    pub(crate) onto_live: bool,
    /// Show the topics of the recording, and what is left out, and send nothing
    #[arg(long)]
    pub(crate) dry_run: bool,
    /// Print the summary as a JSON object
    #[arg(long)]
    pub(crate) json: bool,
    #[command(flatten)]
    pub(crate) group: GroupArguments,
}

#[derive(Debug, Args)]
pub(crate) struct Viewers {
    /// The TCP port for viewers
    #[arg(long, value_name = "PORT", default_value_t = 8765)]
    pub(crate) port: u16,
    /// The address to listen at. Other hosts than this one see all values without sign-in
    #[arg(long, value_name = "ADDRESS", default_value = "127.0.0.1")]
    pub(crate) host: IpAddr,
    /// Admit viewers in web pages of this origin, as https://viewer.example; * for all. May be
    /// repeated
    #[arg(long, value_name = "ORIGIN")]
    pub(crate) origin: Vec<String>,
    #[command(flatten)]
    pub(crate) models: Models,
    /// End after this time. Without it: at Ctrl-C
    #[arg(long, value_name = "SECONDS", value_parser = seconds)]
    pub(crate) seconds: Option<f64>,
    #[command(flatten)]
    pub(crate) group: GroupArguments,
}

fn speed(text: &str) -> Result<f64, &'static str> {
    let speed = text.parse().ok();
    speed
        .filter(|speed| (0.01..=100.0).contains(speed))
        .ok_or("a number from 0.01 to 100, as 0.5")
}
