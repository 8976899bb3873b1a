//! The command line arguments of the commands about programs, faults and new files.

use std::path::PathBuf;

use clap::{Args, ValueEnum};

use super::live::{GroupArguments, seconds};

#[derive(Debug, Args)]
pub(crate) struct StatusArguments {
    /// Addresses of --metrics of programs on other hosts, as 192.168.0.5:9101
    #[arg(value_name = "URL")]
    pub(crate) urls: Vec<String>,
    /// Time to listen for announcements
    #[arg(long, value_name = "SECONDS", default_value = "2", value_parser = seconds)]
    pub(crate) seconds: f64,
    /// Print a JSON object
    #[arg(long)]
    pub(crate) json: bool,
    #[command(flatten)]
    pub(crate) group: GroupArguments,
}

#[derive(Debug, Args)]
pub(crate) struct Doctor {
    /// Addresses of --metrics of programs on other hosts, as 192.168.0.5:9101
    #[arg(value_name = "URL")]
    pub(crate) urls: Vec<String>,
    /// Make the safe repairs: limits of the kernel, queriers of network bridges. They last until
    /// the host restarts, and need root
    #[arg(long)]
    pub(crate) fix: bool,
    /// Pack versions, configurations without secrets, the log, each status and the findings into
    /// this file (tar.gz), for a report
    #[arg(long, value_name = "FILE")]
    pub(crate) bundle: Option<PathBuf>,
    /// Time to listen in the group
    #[arg(long, value_name = "SECONDS", default_value = "3", value_parser = seconds)]
    pub(crate) seconds: f64,
    /// Print a JSON object with the findings and all facts
    #[arg(long)]
    pub(crate) json: bool,
    #[command(flatten)]
    pub(crate) group: GroupArguments,
}

#[derive(Debug, Args)]
pub(crate) struct NewCellArguments {
    /// The kind of the file
    #[arg(value_name = "KIND", value_enum)]
    pub(crate) template: CellTemplate,
    /// How the skills of a component do their work
    #[arg(long, value_name = "DRIVER", value_enum, default_value_t = DriverTemplate::Simulated)]
    pub(crate) driver: DriverTemplate,
    /// The file, which must not exist. Without it: stdout
    #[arg(short, long, value_name = "FILE")]
    pub(crate) output: Option<PathBuf>,
}

/// The driver in the starting file of a component.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum DriverTemplate {
    /// A simulation
    Simulated,
    /// An action or a service of ROS
    Ros,
    /// An arm with MoveIt 2, of any maker
    Moveit,
    /// A program of your own
    Exec,
    /// The HTTP interface of a device
    Http,
}

/// The kind of a starting file.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum CellTemplate {
    /// A component with two skills, for ua-component
    Component,
    /// A MES with a process, for ua-mes
    Mes,
    /// A mapping with three values, for the bridges and ua-server
    Mapping,
    /// A SysML v2 model with two values, and the metadata for `ua-space init --model`
    Sysml,
    /// The UML profile of the stereotypes for `ua-space init --model`, for Papyrus
    Profile,
}
