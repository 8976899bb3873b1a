//! `ua-space goal`: the sequence of actions that reaches a goal, with its proof.

use std::io::{self, Write as _};

use serde::Deserialize;
use uri_text::escaped;

use crate::arguments::GoalArguments;
use crate::ask::refusal;
use crate::exit::CommandFailure;
use crate::http::HttpServer;
use crate::live::{TextTable, harmless, is_coloured};
use crate::survey::look;

/// Runs `ua-space goal`.
pub(crate) fn goal(arguments: &GoalArguments) -> Result<(), CommandFailure> {
    let server = HttpServer::parse(&arguments.at.mes.url)?;
    look(async {
        let path = format!("/goal/{}", escaped(&arguments.goal));
        let answer = server.get(&path).await?;
        if answer.status == 404 {
            return Err(CommandFailure::Usage(format!(
                "{}: there is no such goal; `ua-space ask goals` lists them",
                harmless(&arguments.goal)
            )));
        }
        if answer.status != 200 {
            return Err(refusal(&answer));
        }
        let planned: Planned = serde_json::from_str(&answer.body)
            .map_err(|error| CommandFailure::Data(format!("cannot read the response: {error}")))?;
        let mut out = io::stdout().lock();
        if arguments.json {
            let text = mappings::harmless_json(answer.body.trim_end());
            writeln!(out, "{text}")?;
        } else if planned.reachable {
            let columns = ["STEP", "ACTION", "CAPABILITY", "BECAUSE", "EFFECT"];
            let mut table = TextTable::new(columns.map(str::to_owned));
            for row in planned.rows() {
                table.row(row);
            }
            table.write(&mut out, is_coloured())?;
        }
        if planned.reachable {
            Ok(())
        } else {
            Err(CommandFailure::Failed(format!(
                "the goal cannot be reached: {}",
                harmless(planned.reason.as_deref().unwrap_or_default())
            )))
        }
    })
}

#[derive(Debug, Deserialize)]
struct Planned {
    reachable: bool,
    #[serde(default)]
    steps: Vec<GoalStep>,
    #[serde(default)]
    reached: Vec<Condition>,
    reason: Option<String>,
}

#[derive(Debug, Deserialize)]
struct GoalStep {
    name: String,
    capability: String,
    because: Vec<Condition>,
    adds: Vec<String>,
    removes: Vec<String>,
}

#[derive(Debug, Deserialize)]
struct Condition {
    fact: String,
    holds: bool,
    since: usize,
}

impl Planned {
    /// Returns the rows of the table: the steps, and then the goal.
    fn rows(&self) -> Vec<[String; 5]> {
        let steps = self.steps.iter().zip(1_usize..).map(|(step, number)| {
            let adds = step.adds.iter().map(|fact| format!("+{fact}"));
            let removes = step.removes.iter().map(|fact| format!("-{fact}"));
            [
                number.to_string(),
                step.name.clone(),
                step.capability.clone(),
                conditions(&step.because),
                adds.chain(removes).collect::<Vec<_>>().join(" "),
            ]
        });
        let dash = || "-".to_owned();
        let goal = [
            "goal".to_owned(),
            dash(),
            dash(),
            conditions(&self.reached),
            dash(),
        ];
        steps.chain([goal]).collect()
    }
}

/// Returns conditions as text, each with the step that made it true.
fn conditions(all: &[Condition]) -> String {
    let one = |condition: &Condition| {
        let not = if condition.holds { "" } else { "not " };
        let since = match condition.since {
            0 => "at the start".to_owned(),
            step => format!("by step {step}"),
        };
        format!("{not}{} ({since})", condition.fact)
    };
    all.iter().map(one).collect::<Vec<_>>().join(", ")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_step_is_shown_with_the_steps_that_made_its_conditions_true() {
        let text = r#"{"goal": "urn:g", "reachable": true, "steps": [
            {"action": "urn:a", "name": "grasp", "capability": "urn:c",
             "because": [{"fact": "near", "holds": true, "since": 0}, {"fact": "full", "holds": false, "since": 0}],
             "adds": ["held"], "removes": ["near"]}],
            "reached": [{"fact": "held", "holds": true, "since": 1}]}"#;
        let planned: Planned = serde_json::from_str(text).unwrap_or_else(|error| panic!("{error}"));
        let because = "near (at the start), not full (at the start)";
        let expected = [
            ["1", "grasp", "urn:c", because, "+held -near"],
            ["goal", "-", "-", "held (by step 1)", "-"],
        ];
        assert_eq!(planned.rows(), expected.map(|row| row.map(str::to_owned)));
    }
}
