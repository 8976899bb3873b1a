//! `ua-space configure`: configures the components of a product.

use std::io::{self, Write as _};

use serde::Deserialize;

use crate::arguments::ProductArguments;
use crate::exit::CommandFailure;
use crate::input::read;
use crate::live::{TextTable, harmless, is_coloured};
use crate::source::change;

/// Runs `ua-space configure`.
pub(crate) fn configure(arguments: &ProductArguments) -> Result<(), CommandFailure> {
    let document = read(&arguments.file)?;
    let path = match arguments.check {
        true => "/configuration?check=true",
        false => "/configuration",
    };
    let answer = change("POST", path, ("application/xml", document), &arguments.at)?;
    let configured: Configured = serde_json::from_str(&answer.body)
        .map_err(|error| CommandFailure::Data(format!("cannot read the response: {error}")))?;
    let mut out = io::stdout().lock();
    if arguments.json {
        writeln!(out, "{}", mappings::harmless_json(answer.body.trim_end()))?;
    } else {
        let columns = ["COMPONENT", "OUTCOME", "REASON"];
        let mut table = TextTable::new(columns.map(str::to_owned));
        for component in &configured.components {
            table.row([
                component.component.clone(),
                component.outcome.clone(),
                component.reason.clone().unwrap_or_else(|| "-".to_owned()),
            ]);
        }
        table.write(&mut out, is_coloured())?;
    }
    configured.end()
}

/// The report of a product configuration.
#[derive(Debug, Deserialize)]
struct Configured {
    outcome: String,
    components: Vec<ConfiguredPart>,
}

#[derive(Debug, Deserialize)]
struct ConfiguredPart {
    component: String,
    outcome: String,
    reason: Option<String>,
}

impl Configured {
    fn end(&self) -> Result<(), CommandFailure> {
        match self.outcome.as_str() {
            "configured" | "checked" => Ok(()),
            "refused" => Err(CommandFailure::Failed(
                "the product is not configured: nothing was set".to_owned(),
            )),
            "set_back" => Err(CommandFailure::Failed(
                "the product is not configured: all components have their values from before"
                    .to_owned(),
            )),
            "unknown" => Err(CommandFailure::Unavailable(
                "it is unknown which values a component has; configure the product again when the \
                 component is back"
                    .to_owned(),
            )),
            other => Err(CommandFailure::Data(format!(
                "the outcome `{}` is unknown to this version",
                harmless(other)
            ))),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_outcome_ends_the_command_in_its_way() {
        let end = |outcome: &str| {
            let configured = Configured {
                outcome: outcome.to_owned(),
                components: Vec::new(),
            };
            configured.end()
        };
        assert!(end("configured").is_ok() && end("checked").is_ok());
        for outcome in ["refused", "set_back"] {
            assert!(matches!(end(outcome), Err(CommandFailure::Failed(_))));
        }
        assert!(matches!(
            end("unknown"),
            Err(CommandFailure::Unavailable(_))
        ));
        assert!(matches!(end("else"), Err(CommandFailure::Data(_))));
    }
}
