//! Which services and actions of a graph are executed for the space: those that the mapping names,
//! and those that have the name of a call of our own space (`/ua_1_2_61`).

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use mappings::{Call, CallKind, CallTarget, ExecutedBy, Mapping, SpaceId, TopicId};
use messages::TypeName;

use crate::policy::Policy;

/// The services or actions there are, each with its type as far as that is known.
pub type Present = BTreeMap<String, Option<TypeName>>;

/// One that is there and is to be executed for others.
#[derive(Debug)]
pub(crate) struct Found<'p> {
    pub(crate) topic: TopicId,
    /// Its name in the graph.
    pub(crate) target: &'p str,
    pub(crate) type_name: &'p TypeName,
    /// What the mapping says of it.
    pub(crate) call: Option<&'p Call>,
}

impl Found<'_> {
    /// Its name and what it is, for people, and whether it is open to other hosts.
    pub(crate) fn said(&self) -> (String, String, bool) {
        let said = |call: &Call| (call.name.clone(), call.about.clone(), call.open);
        self.call.map(said).unwrap_or_default()
    }
}

/// The call that a service or action is by its name.
pub(crate) fn named(policy: &Policy, target: &str) -> Option<TopicId> {
    let topic: TopicId = target.strip_prefix('/')?.parse().ok()?;
    (topic.space == policy.own()).then_some(topic)
}

/// The names in the graph of those that the mapping has executed in our own space.
pub(crate) fn mapped<'m>(
    mapping: &'m Mapping,
    policy: &Policy,
    kind: CallKind,
) -> BTreeSet<&'m str> {
    let targets = targets(mapping, policy.own(), kind);
    targets.map(|(_, target)| target.name.as_str()).collect()
}

/// Those of that kind that are there, by the mapping or by their names. One of another type than
/// the mapping says is not.
pub(crate) fn found<'p>(
    policy: &'p Policy,
    present: &'p Present,
    kind: CallKind,
) -> impl Iterator<Item = Found<'p>> {
    let mapping = policy.mapping();
    let calls = mapping.executed_in(policy.own());
    let taken: BTreeSet<TopicId> = calls.flat_map(Call::topics).collect();
    let by_name = present.iter().filter_map(move |(target, type_name)| {
        let topic = named(policy, target).filter(|topic| !taken.contains(topic))?;
        Some(Found {
            topic,
            target,
            type_name: type_name.as_ref()?,
            call: None,
        })
    });
    let by_mapping = targets(mapping, policy.own(), kind).filter_map(|(call, target)| {
        let there = present.get(&target.name)?;
        let fits = there.as_ref().is_none_or(|is| *is == target.type_name);
        fits.then_some(Found {
            topic: call.topic,
            target: &target.name,
            type_name: &target.type_name,
            call: Some(call),
        })
    });
    by_name.chain(by_mapping)
}

/// Tells of those that are of other types than the mapping says.
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
                    "the {noun} {} is not executed as {}: it is of type {type_name}, and the mapping says {}",
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
        ExecutedBy::OpcUa(_) | ExecutedBy::Elsewhere => None,
    })
}
