//! The command line arguments of the commands for process modules (MTP).

use clap::{Args, Subcommand};

use super::live::seconds;

#[derive(Debug, Args)]
pub(crate) struct MtpArguments {
    #[command(subcommand)]
    pub(crate) verb: MtpVerb,
}

#[derive(Debug, Subcommand)]
pub(crate) enum MtpVerb {
    /// Count the contents of manifests, and print each element that is left out with its line
    Check(MtpCheck),
    /// Print a manifest as RDF: N-Triples
    Rdf(MtpRdf),
    /// List the procedures of a manifest with their parameters and outputs
    Skills(MtpSkills),
    /// Print the alarms of a manifest as a part of a mapping: variables with conditions at ua-server
    Alarms(MtpAlarms),
}

#[derive(Debug, Args)]
pub(crate) struct MtpCheck {
    /// The manifests (.aml, .mtp, .amlx), or - for stdin
    #[arg(value_name = "FILE", required = true)]
    pub(crate) files: Vec<String>,
    /// Print a JSON object per file
    #[arg(long)]
    pub(crate) json: bool,
}

#[derive(Debug, Args)]
pub(crate) struct MtpRdf {
    /// The manifest (.aml, .mtp, .amlx), or - for stdin
    #[arg(value_name = "FILE")]
    pub(crate) file: String,
    /// The IRI of the module, with which all other IRIs begin. Without it
    /// urn:ua-bridge:mtp:<name of the file>
    #[arg(long, value_name = "IRI", value_parser = iri)]
    pub(crate) base: Option<String>,
    /// Print a JSON array of statements
    #[arg(long)]
    pub(crate) json: bool,
}

#[derive(Debug, Args)]
pub(crate) struct MtpSkills {
    /// The manifest (.aml, .mtp, .amlx), or - for stdin
    #[arg(value_name = "FILE")]
    pub(crate) file: String,
    /// Print a JSON array
    #[arg(long)]
    pub(crate) json: bool,
}

#[derive(Debug, Args)]
pub(crate) struct AasArguments {
    /// The manifest (.aml, .mtp, .amlx)
    #[arg(value_name = "FILE")]
    pub(crate) file: String,
    /// The IRI of the asset, with which the IRIs of the shell and its submodels begin. Without it
    /// urn:ua-bridge:mtp:<name of the file>
    #[arg(long, value_name = "IRI", value_parser = iri)]
    pub(crate) id: Option<String>,
    /// A field of the nameplate that the manifest does not have, as ManufacturerName=Maker; can be
    /// repeated. Without all mandatory fields the nameplate is left out
    #[arg(long, value_name = "NAME=VALUE")]
    pub(crate) nameplate: Vec<String>,
}

#[derive(Debug, Args)]
pub(crate) struct MtpAlarms {
    /// The manifest (.aml, .mtp, .amlx), or - for stdin
    #[arg(value_name = "FILE")]
    pub(crate) file: String,
    /// The index of the namespace of the variables, which the mapping lists
    #[arg(long, value_name = "INDEX", default_value = "2", value_parser = clap::value_parser!(u16).range(2..))]
    pub(crate) namespace: u16,
    /// The identifier of the first variable; the next ones follow
    #[arg(long, value_name = "ID", default_value = "1", value_parser = clap::value_parser!(u16).range(1..))]
    pub(crate) first: u16,
    /// The endpoint of the module, if it differs from the manifest
    #[arg(long, value_name = "URL")]
    pub(crate) endpoint: Option<String>,
}

#[derive(Debug, Args)]
pub(crate) struct PeaArguments {
    /// The manifest (.aml, .mtp, .amlx)
    #[arg(value_name = "FILE")]
    pub(crate) file: String,
    /// The endpoint of the server; port 0 selects a free port
    #[arg(long, value_name = "URL", default_value = "opc.tcp://127.0.0.1:4841")]
    pub(crate) listen: String,
    /// The duration of acting states, such as Starting
    #[arg(long, value_name = "SECONDS", default_value = "0.5", value_parser = seconds)]
    pub(crate) acting: f64,
    /// The duration of Execute of procedures that complete by themselves
    #[arg(long, value_name = "SECONDS", default_value = "3", value_parser = seconds)]
    pub(crate) executing: f64,
    /// Never clear CommandExt
    #[arg(long)]
    pub(crate) keeps_command: bool,
    /// Start with CommandEn 0, until the mode is automatic and external
    #[arg(long)]
    pub(crate) enables_late: bool,
    /// Show this word as StateCur in the state Resetting, as 32678
    #[arg(long, value_name = "WORD")]
    pub(crate) resetting_word: Option<u32>,
    /// Ignore requests of automatic mode
    #[arg(long)]
    pub(crate) operator_mode: bool,
    /// Ignore the selection of procedures
    #[arg(long)]
    pub(crate) ignores_procedure: bool,
    /// Never leave this state, as Starting
    #[arg(long, value_name = "STATE")]
    pub(crate) stuck_in: Option<String>,
}

fn iri(text: &str) -> Result<String, &'static str> {
    let is_plain = text.contains(':')
        && !text
            .chars()
            .any(|c| c.is_whitespace() || c.is_control() || "<>\"{}|\\^`".contains(c));
    is_plain
        .then(|| text.to_owned())
        .ok_or("an IRI, as urn:example:dosing")
}
