//! The services and actions of a graph that are executed for the space. They are named in the
//! mapping, or have the name of a call of the own space (`/ua_1_2_61`).

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use mappings::{Call, CallKind, CallTarget, ExecutedBy, Mapping, SpaceId, TopicId};
use messages::TypeName;

use crate::policy::Policy;

/// The present services or actions, each with its type if that is known.
pub type Present = BTreeMap<String, Option<TypeName>>;

/// A present service or action that is to be executed for other spaces.
#[derive(Debug)]
pub(crate) struct PresentExecutor<'p> {
    pub(crate) topic: TopicId,
    /// Its name in the graph.
    pub(crate) target: &'p str,
    pub(crate) type_name: &'p TypeName,
    /// Its entry in the mapping.
    pub(crate) call: Option<&'p Call>,
}

impl PresentExecutor<'_> {
    /// Returns its display name, its description, and whether it is open to other hosts.
    pub(crate) fn said(&self) -> (String, String, bool) {
        let said = |call: &Call| (call.name.clone(), call.about.clone(), call.open);
        self.call.map(said).unwrap_or_default()
    }
}

/// Returns the call that the name of a service or action denotes.
pub(crate) fn named(policy: &Policy, target: &str) -> Option<TopicId> {
    let topic: TopicId = target.strip_prefix('/')?.parse().ok()?;
    (topic.space == policy.own()).then_some(topic)
}

/// Returns the names in the graph of the services or actions that the mapping has executed in the
/// own space.
pub(crate) fn mapped<'m>(
    mapping: &'m Mapping,
    policy: &Policy,
    kind: CallKind,
) -> BTreeSet<&'m str> {
    let targets = targets(mapping, policy.own(), kind);
    targets.map(|(_, target)| target.name.as_str()).collect()
}

/// Returns the present services or actions, by the mapping or by their names. Excludes
/// targets with another type than the mapping sets.
pub(crate) fn found<'p>(
    policy: &'p Policy,
    present: &'p Present,
    kind: CallKind,
) -> impl Iterator<Item = PresentExecutor<'p>> {
    let mapping = policy.mapping();
    let calls = mapping.executed_in(policy.own());
    let taken: BTreeSet<TopicId> = calls.flat_map(Call::topics).collect();
    let by_name = present.iter().filter_map(move |(target, type_name)| {
        let topic = named(policy, target).filter(|topic| !taken.contains(topic))?;
        Some(PresentExecutor {
            topic,
            target,
            type_name: type_name.as_ref()?,
            call: None,
        })
    });
    let by_mapping = targets(mapping, policy.own(), kind).filter_map(|(call, target)| {
        let there = present.get(&target.name)?;
        let fits = there.as_ref().is_none_or(|is| *is == target.type_name);
        fits.then_some(PresentExecutor {
            topic: call.topic,
            target: &target.name,
            type_name: &target.type_name,
            call: Some(call),
        })
    });
    by_name.chain(by_mapping)
}

/// Logs services or actions with another type than the mapping sets.
pub(crate) fn tell_other_types(policy: &mut Policy, present: &Present, kind: CallKind) {
    let mapping = Arc::clone(policy.mapping());
    let noun = match kind {
        CallKind::Service => "service",
        CallKind::Action => "action",
    };
    for (call, target) in targets(&mapping, policy.own(), kind) {
        if let Some(Some(type_name)) = present.get(&target.name)
            && *type_name != target.type_name
        {
            policy.told.once(&target.name, "other type", || {
                format!(
                    "the {noun} {} is not executed as {}: its type is {type_name}, but the mapping says {}",
                    target.name, call.topic, target.type_name
                )
            });
        }
    }
}

fn targets(
    mapping: &Mapping,
    own: SpaceId,
    kind: CallKind,
) -> impl Iterator<Item = (&Call, &CallTarget)> {
    let calls = mapping
        .executed_in(own)
        .filter(move |call| call.kind == kind);
    calls.filter_map(|call| match &call.executed {
        ExecutedBy::Ros(target) => Some((call, target)),
        ExecutedBy::OpcUa(_) | ExecutedBy::Acknowledging | ExecutedBy::Elsewhere => None,
    })
}
