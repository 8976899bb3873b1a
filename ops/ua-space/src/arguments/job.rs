//! The command line arguments of the commands for goals and jobs: runs of processes.

use clap::{Args, Subcommand};

use super::live::SourceAt;

#[derive(Debug, Args)]
pub(crate) struct JobArguments {
    #[command(subcommand)]
    pub(crate) verb: JobVerb,
}

#[derive(Debug, Subcommand)]
pub(crate) enum JobVerb {
    /// Start a process, and print the number of its job
    ///
    /// Several jobs run at a time. A component does the work of one job at a time; a job waits for
    /// the components that it needs.
    Start {
        /// The IRI of the process
        #[arg(value_name = "PROCESS")]
        process: String,
        /// Wait for the end, and print the steps
        #[arg(long)]
        wait: bool,
        #[command(flatten)]
        at: SourceAt,
    },
    /// List the jobs with their steps and outcomes
    List {
        /// Print the response unchanged
        #[arg(long)]
        json: bool,
        #[command(flatten)]
        at: SourceAt,
    },
    /// Stop a job
    ///
    /// The running skill is halted; nothing is compensated. The command does not wait for the halt:
    /// `ua-space job list` shows the end of the job. The components of a job with an unknown
    /// outcome are given back, so that other jobs can use them: look at the machines first.
    Stop {
        /// The number of the job
        #[arg(value_name = "NUMBER")]
        number: u64,
        #[command(flatten)]
        at: SourceAt,
    },
}

#[derive(Debug, Args)]
pub(crate) struct ProcessArguments {
    #[command(subcommand)]
    pub(crate) verb: ProcessVerb,
}

#[derive(Debug, Subcommand)]
pub(crate) enum ProcessVerb {
    /// Add the processes of a recipe of BatchML or BPMN to ua-mes, and print what is left out
    ///
    /// A recipe that no process can have is refused; each of its elements that has no place in a
    /// process is printed with its line. `ua-space plan` shows which skills would do the steps.
    Import {
        /// The recipe, or - for stdin
        #[arg(value_name = "FILE")]
        file: String,
        /// A name of the recipe, and what it stands for: the IRI of a capability, a type of skills,
        /// a parameter or a unit, as Sekunde=s; can be repeated
        #[arg(long = "name", value_name = "NAME=NAME")]
        names: Vec<String>,
        /// The name of the source; the name of the file unless given
        #[arg(long = "as", value_name = "NAME")]
        source: Option<String>,
        #[command(flatten)]
        at: SourceAt,
    },
}

#[derive(Debug, Args)]
pub(crate) struct ProductArguments {
    /// The AutomationML file, or - for stdin
    #[arg(value_name = "FILE")]
    pub(crate) file: String,
    /// Only check the fields: nothing is set
    #[arg(long)]
    pub(crate) check: bool,
    /// Print the response unchanged
    #[arg(long)]
    pub(crate) json: bool,
    #[command(flatten)]
    pub(crate) at: SourceAt,
}

#[derive(Debug, Args)]
pub(crate) struct GoalArguments {
    /// The IRI of the goal
    #[arg(value_name = "GOAL")]
    pub(crate) goal: String,
    /// Print the response unchanged
    #[arg(long)]
    pub(crate) json: bool,
    #[command(flatten)]
    pub(crate) at: SourceAt,
}
