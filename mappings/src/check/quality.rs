//! Maximum ages of values.

use std::time::Duration;

use super::quantity::duration;
use crate::code::Code;
use crate::document::VariableEntry;
use crate::findings::MappingFindings;
use crate::mapping::Publish;
use crate::quality::Ages;
use crate::read::given;
use crate::topic::SpaceId;
use crate::tree::TextSpan;

/// Returns `None` for a faulty entry, which is noted.
pub(super) fn check(
    entry: &VariableEntry,
    origin: Option<SpaceId>,
    publish: Option<&Publish>,
    findings: &mut MappingFindings,
) -> Option<Ages> {
    let deadline = deadline(entry, publish, findings)?;
    let is_by_clients = origin == Some(SpaceId::UA) && entry.from.is_none();
    let Some(at) = &entry.quality else {
        return Some(Ages {
            uncertain_after: deadline.filter(|_| !is_by_clients),
            deadline,
            ..Ages::default()
        });
    };
    let said = at.value.as_ref()?;
    if is_by_clients {
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
        uncertain_after: duration(&said.uncertain_after, findings),
        bad_after: duration(&said.bad_after, findings),
        deadline,
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
        let uncertain_after = ages.uncertain_after.or(deadline);
        return Some(Ages {
            uncertain_after,
            ..ages
        });
    };
    is_frequent(publish, (after, place), "uncertain_after", findings).then_some(ages)
}

/// Reads the longest time between two values. Returns `None` for a faulty entry, which is noted.
fn deadline(
    entry: &VariableEntry,
    publish: Option<&Publish>,
    findings: &mut MappingFindings,
) -> Option<Option<Duration>> {
    let Some((_, place)) = given(&entry.deadline) else {
        return Some(None);
    };
    let limit = duration(&entry.deadline, findings)?;
    let fits =
        publish.is_none_or(|publish| is_frequent(publish, (limit, place), "deadline", findings));
    fits.then_some(Some(limit))
}

/// Returns whether values are sent more often than after a time. Values that are sent only on
/// change are a warning.
fn is_frequent(
    publish: &Publish,
    (after, place): (Duration, TextSpan),
    key: &str,
    findings: &mut MappingFindings,
) -> bool {
    if publish.on_change {
        findings
            .warning(
                Code::Quality,
                place,
                "the value is sent only on change, so an unchanged value is considered stale",
            )
            .help(format!(
                "remove `publish: on_change` and `deadband`, or `{key}`"
            ));
    } else if publish.period >= after {
        let message = format!(
            "a value is sent at most every {:?}, but considered stale after {after:?}",
            publish.period
        );
        findings
            .error(Code::Quality, place, message)
            .help("use a longer time, or remove `at_most`");
        return false;
    }
    true
}
