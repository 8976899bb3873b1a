//! `ua-space skills start`: resets a skill if necessary, and runs it.

use super::info::not_found;
use super::{ListenEnd, Skill, hear, in_group};
use crate::arguments::{CallArguments, GroupArguments, NamedTarget};
use crate::exit::CommandFailure;
use crate::live::call::{call, call_quietly};

pub(super) fn start(arguments: &CallArguments) -> Result<(), CommandFailure> {
    let NamedTarget::Name(wanted) = &arguments.target else {
        // A topic of Start is called directly, without a Reset.
        return call(arguments);
    };
    let wanted = wanted.strip_suffix(".Start").unwrap_or(wanted);
    let (state, reset) = in_group(&arguments.group, async |mut live| {
        let one = |found: &[Skill]| {
            let mut found = found.iter();
            let one = found.find(|skill| skill.name() == wanted)?;
            let both = (one.state.clone()?, one.calls.get("Reset").cloned());
            one.calls.contains_key("Start").then_some(both)
        };
        let is_whole = |found: &[Skill]| one(found).is_some();
        let (found, ended) = hear(&mut live, arguments.wait, &is_whole).await?;
        match one(&found) {
            Some(both) => Ok(both),
            None if ended == ListenEnd::Interrupted => Err(CommandFailure::Interrupted),
            None => Err(not_found(wanted, &found, arguments.wait)),
        }
    })?;
    if state == HALTED
        && let Some(reset) = reset.and_then(|topic| topic.parse().ok())
    {
        call_quietly(&CallArguments {
            target: NamedTarget::Topic(reset),
            parameters: Vec::new(),
            run_timeout: None,
            no_wait: true,
            group: same(&arguments.group),
            ..*arguments
        })?;
    }
    call(arguments)
}

fn same(group: &GroupArguments) -> GroupArguments {
    GroupArguments {
        interface: group.interface.clone(),
        address: group.address.clone(),
        broker: group.broker.clone(),
        cell: group.cell.clone(),
        keys: group.keys.clone(),
        sign: group.sign,
    }
}

const HALTED: &str = "Halted";
