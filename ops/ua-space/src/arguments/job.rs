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
    /// `ua-space job list` shows the end of the job. The components of a job with an unknown outcome
    /// are given back, so that other jobs can use them: look at the machines first.
    Stop {
        /// The number of the job
        #[arg(value_name = "NUMBER")]
        number: u64,
        #[command(flatten)]
        at: SourceAt,
    },
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
