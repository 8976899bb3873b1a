//! The command line arguments of the commands for process modules (MTP).

use std::path::PathBuf;

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
    /// List the objects and connections of the HMI pictures of a manifest, or draw a picture
    Picture(MtpPicture),
    /// Print the alarms of a manifest as a part of a mapping: variables with conditions at
    /// ua-server
    Alarms(MtpAlarms),
    /// Propose process values of modules as inputs of others, as a part of a mapping
    ///
    /// An output fits if it has the kind and the unit of the input, and its scale is not known to
    /// exceed that of the input. Where names do not decide, all outputs that fit are comments.
    Connect(MtpConnect),
    /// Run a procedure of a service once, and print its states and results
    ///
    /// Follows the handshake of VDI/VDE/NAMUR 2658-4. Ctrl-C withdraws a Start without effect, or
    /// stops the service; the command ends when the end of the procedure is known.
    ///
    /// Exit codes: 0 Completed, 1 not Completed, 64 usage, 65 the file is no manifest, 69 the end
    /// is unknown, 74 the file cannot be read or the output cannot be written, 130 stopped by
    /// Ctrl-C.
    Run(MtpRun),
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
pub(crate) struct MtpPicture {
    /// The manifest (.aml, .mtp, .amlx), or - for stdin
    #[arg(value_name = "FILE")]
    pub(crate) file: String,
    /// The name or the ID of a picture. Without it all are listed, and the only one that is not
    /// empty is drawn
    #[arg(value_name = "NAME")]
    pub(crate) name: Option<String>,
    /// Draw the picture into this file: boxes with names for objects, lines for connections. A file
    /// that is there is not replaced
    #[arg(long, value_name = "FILE")]
    pub(crate) svg: Option<PathBuf>,
    /// Print a JSON array of pictures
    #[arg(long, conflicts_with = "svg")]
    pub(crate) json: bool,
}

#[derive(Debug, Args)]
pub(crate) struct MtpRun {
    /// The manifest (.aml, .mtp, .amlx), or - for stdin
    #[arg(value_name = "FILE")]
    pub(crate) file: String,
    /// The name of the service
    #[arg(value_name = "SERVICE")]
    pub(crate) service: String,
    /// Parameters, as Volume=2.5. RunTime is the time in Execute of a procedure that does not
    /// complete by itself
    #[arg(value_name = "NAME=VALUE")]
    pub(crate) parameters: Vec<String>,
    /// The name of the procedure, if the service has several
    #[arg(long, value_name = "NAME")]
    pub(crate) procedure: Option<String>,
    /// The endpoint of the module, if it differs from the manifest
    #[arg(long, value_name = "URL")]
    pub(crate) endpoint: Option<String>,
    /// Take and write the parameters of the configuration too
    #[arg(long)]
    pub(crate) configuration: bool,
    /// Stop the procedure if it takes longer
    #[arg(long, value_name = "SECONDS", value_parser = seconds)]
    pub(crate) run_timeout: Option<f64>,
    /// Print a JSON object for each step, and for the end
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
    /// Write a package (AASX) with the shell and the manifest into this file, in place of JSON to
    /// stdout. A file that is there is not replaced
    #[arg(long, value_name = "FILE")]
    pub(crate) aasx: Option<PathBuf>,
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
pub(crate) struct MtpConnect {
    /// The manifests (.aml, .mtp, .amlx) of two or more modules
    #[arg(value_name = "FILE", num_args = 2.., required = true)]
    pub(crate) files: Vec<String>,
    /// The index of the namespace of the variables, which the mapping lists
    #[arg(long, value_name = "INDEX", default_value = "2", value_parser = clap::value_parser!(u16).range(2..))]
    pub(crate) namespace: u16,
    /// The identifier of the first variable; the next ones follow
    #[arg(long, value_name = "ID", default_value = "1", value_parser = clap::value_parser!(u16).range(1..))]
    pub(crate) first: u16,
    /// The endpoint of a module, if it differs from the manifest; can be repeated
    #[arg(long = "endpoint", value_name = "MODULE=URL")]
    pub(crate) endpoints: Vec<ModuleEndpoint>,
}

/// The endpoint of a module.
#[derive(Debug, Clone)]
pub(crate) struct ModuleEndpoint {
    module: String,
    url: String,
}

impl std::str::FromStr for ModuleEndpoint {
    type Err = &'static str;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let parts = text.split_once('=');
        let parts = parts.filter(|(module, url)| !module.is_empty() && url.contains("://"));
        let (module, url) =
            parts.ok_or("a module with its endpoint, as dosing=opc.tcp://10.0.0.5:4840")?;
        Ok(Self {
            module: module.to_owned(),
            url: url.to_owned(),
        })
    }
}

impl MtpConnect {
    /// Returns the endpoint that the command line gives a module.
    pub(crate) fn endpoint(&self, module: &str) -> Option<&str> {
        let given = self.endpoints.iter().find(|one| one.module == module);
        given.map(|one| one.url.as_str())
    }
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
