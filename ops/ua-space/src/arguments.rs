//! The words of the command line.

use std::path::PathBuf;

use clap::{Args, Parser, Subcommand, ValueEnum};
use mappings::Code;

/// Looks into the space: mappings and what is wrong with them, datagrams of OPC UA PubSub as JSON and back.
#[derive(Debug, Parser)]
#[command(name = "ua-space", version)]
pub(crate) struct Arguments {
    #[command(subcommand)]
    pub(crate) verb: Verb,
}

#[derive(Debug, Subcommand)]
pub(crate) enum Verb {
    /// Tell everything that is wrong with a mapping
    ///
    /// Each finding has a code, its place with the line it is about, and what to do; `ua-space explain CODE` says more of
    /// a code. Nothing is asked of the network: definitions of messages are those of its
    /// type_paths, of ROS_PACKAGE_PATH and AMENT_PREFIX_PATH, and those built in.
    ///
    /// Exit codes: 0 all can run, with or without warnings, 64 usage, 74 a file that cannot be read or an output that
    /// cannot be written, 78 one of them cannot run.
    Check(Check),
    /// Say what the code of a finding means, with an example
    ///
    /// Without a code: all of them, a line each.
    ///
    /// Exit codes: 0 done, 64 a code that there is not, 74 an output that cannot be written.
    Explain(Explain),
    /// Print the JSON Schema of mappings, for editors
    ///
    /// With `# yaml-language-server: $schema=PATH` as a mapping's first line, editors that know YAML schemas complete its
    /// keys and show what they mean.
    Schema,
    /// Show what a datagram, or each datagram of a capture, holds
    ///
    /// Reads a datagram as hexadecimal text or as its bytes, or the UDP datagrams of a pcap or pcapng file. One datagram
    /// is shown as a JSON object, those of a capture as one object a line. What is wrong with a datagram is told on
    /// stderr, with the offset of the byte.
    ///
    /// Exit codes: 0 done, 64 usage, 65 something is malformed or not to be opened, 74 a file that cannot be read or
    /// an output that cannot be written.
    Decode(Decode),
    /// Make datagrams of what `decode` shows
    ///
    /// Writes the datagrams of a JSON object, of several one after the other or of an array, as hexadecimal text, a line
    /// each. Flags and sizes follow from what is there.
    ///
    /// Exit codes: 0 done, 64 usage, 65 JSON that is no datagram, 74 a file that cannot be read or an output that cannot
    /// be written.
    Encode(Encode),
}

#[derive(Debug, Args)]
pub(crate) struct Check {
    /// The mappings, or - for stdin
    #[arg(value_name = "FILE", required = true)]
    pub(crate) files: Vec<String>,
    /// One JSON object a file, with its findings
    #[arg(long)]
    pub(crate) json: bool,
}

#[derive(Debug, Args)]
pub(crate) struct Explain {
    /// Such as M014
    #[arg(value_name = "CODE")]
    pub(crate) code: Option<Code>,
}

#[derive(Debug, Args)]
pub(crate) struct Decode {
    /// The file, or - for stdin
    #[arg(value_name = "FILE")]
    pub(crate) file: String,
    /// Only datagrams from or to this UDP port of a capture. Without it: port 4840, and every other datagram that
    /// is a NetworkMessage without a fault
    #[arg(long, value_name = "PORT")]
    pub(crate) port: Option<u16>,
    /// Every line of hexadecimal text is a datagram
    #[arg(long)]
    pub(crate) lines: bool,
    /// One JSON array instead of one object a line
    #[arg(long)]
    pub(crate) array: bool,
    #[command(flatten)]
    pub(crate) known: Known,
}

#[derive(Debug, Args)]
pub(crate) struct Encode {
    /// The file, or - for stdin
    #[arg(value_name = "FILE")]
    pub(crate) file: String,
    /// The bytes themselves, back to back
    #[arg(long)]
    pub(crate) raw: bool,
    #[command(flatten)]
    pub(crate) known: Known,
}

/// What a reader has to know besides the datagram.
#[derive(Debug, Args)]
pub(crate) struct Known {
    /// Keys of secured messages: a JSON object or an array of objects with policy, securityTokenId, signingKey,
    /// encryptingKey and keyNonce, and optionally publisherId and writerGroupId
    #[arg(long, value_name = "FILE")]
    pub(crate) keys: Option<PathBuf>,
    /// Fields of RawData messages: a JSON array with builtInType, valueRank, arrayDimensions and maxStringLength of
    /// each, or an array of objects with such a metaData and publisherId, writerGroupId or dataSetWriterId
    #[arg(long, value_name = "FILE")]
    pub(crate) metadata: Option<PathBuf>,
    /// How RawData of padded texts and arrays is laid out
    #[arg(long, value_name = "READING", value_enum, default_value_t = RawReading::Standard)]
    pub(crate) raw_reading: RawReading,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum RawReading {
    /// By OPC 10000-14
    Standard,
    /// As open62541 1.5 does it
    Open62541,
}

#[cfg(test)]
mod tests {
    use clap::CommandFactory as _;

    use super::*;

    #[test]
    fn the_command_line_is_well_formed() {
        Arguments::command().debug_assert();
    }
}
