//! Maximum ages of values.

use super::network;
use crate::code::Code;
use crate::document::VariableEntry;
use crate::findings::Findings;
use crate::mapping::Publish;
use crate::quality::Ages;
use crate::read::given;
use crate::topic::SpaceId;

/// Returns `None` for a faulty entry, which is noted.
pub(super) fn check(
    entry: &VariableEntry,
    origin: Option<SpaceId>,
    publish: Option<&Publish>,
    findings: &mut Findings,
) -> Option<Ages> {
    let Some(at) = &entry.quality else {
        return Some(Ages::default());
    };
    let said = at.value.as_ref()?;
    if origin == Some(SpaceId::UA) && entry.from.is_none() {
        findings
            .error(
                Code::Quality,
                at.place,
                "the value comes from clients of the server, so it does not become stale",
            )
            .help("`quality` requires a value of another space, or a value with `from`");
        return None;
    }
    let ages = Ages {
        uncertain_after: network::duration(&said.uncertain_after, findings),
        bad_after: network::duration(&said.bad_after, findings),
    };
    let faulty = (said.uncertain_after.is_some() && ages.uncertain_after.is_none())
        || (said.bad_after.is_some() && ages.bad_after.is_none());
    if faulty {
        return None;
    }
    let Some((publish, (after, place))) = publish.zip(
        ages.uncertain_after
            .zip(given(&said.uncertain_after).map(|(_, place)| place)),
    ) else {
        return Some(ages);
    };
    if publish.on_change {
        findings
            .warning(
                Code::Quality,
                place,
                "the value is sent only on change, so an unchanged value is considered stale",
            )
            .help("remove `publish: on_change` and `deadband`, or `uncertain_after`");
    } else if publish.period >= after {
        let message = format!(
            "a value is sent at most every {:?}, but considered stale after {after:?}",
            publish.period
        );
        findings
            .error(Code::Quality, place, message)
            .help("use a longer time, or remove `at_most`");
        return None;
    }
    Some(ages)
}
