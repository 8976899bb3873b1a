//! The display names of topics and calls.

use std::time::Instant;

use mappings::TopicId;

use super::Router;

/// The origin of a display name.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum NameSource {
    /// The mapping or the local side.
    Own,
    /// The announcement of another program.
    Announcement,
}

impl Router {
    /// Returns the display name of a topic or call: from the mapping, from the local side, or from
    /// the announcement of its writer or executor. Returns `None` without a name.
    #[must_use]
    pub fn name_of(&self, topic: TopicId) -> Option<&str> {
        self.name_with_source(topic).map(|(name, _)| name)
    }

    /// Returns the display name of a topic or call, if another program has announced it.
    #[must_use]
    pub fn announced_name_of(&self, topic: TopicId) -> Option<&str> {
        let named = self.name_with_source(topic);
        named.and_then(|(name, source)| (source == NameSource::Announcement).then_some(name))
    }

    fn name_with_source(&self, topic: TopicId) -> Option<(&str, NameSource)> {
        let (mapping, own) = (&self.values.mapping, NameSource::Own);
        let of = |source: NameSource| move |name| (name, source);
        let is_given = |(name, _): &(&str, NameSource)| !name.is_empty();
        let mapped = mapping
            .variable(topic)
            .map(|variable| variable.name.as_str());
        let said = || {
            let of = self.values.topics.get(&topic)?;
            of.said.as_ref().map(|said| said.name.as_str())
        };
        let announced = || self.values.layouts.last(topic).map(|of| of.name());
        let call = || self.calls.as_ref()?.name_of(topic);
        let mapped_call = || mapping.call(topic).map(|call| call.name.as_str());
        let value = mapped.or_else(said).map(of(own)).filter(is_given);
        let announced = || announced().map(of(NameSource::Announcement));
        let value = value.or_else(|| announced().filter(is_given));
        let mapped_call = || mapped_call().map(of(own));
        let call = || call().filter(is_given).or_else(mapped_call);
        value.or_else(call).filter(is_given)
    }

    /// Returns the names of topics that have had no value here: variables of the mapping, and
    /// topics that other programs announce at the moment, in no particular order.
    pub fn names_without_values(&self, now: Instant) -> impl Iterator<Item = (TopicId, &str)> {
        let mapping = &self.values.mapping;
        let mapped = mapping.variables().iter();
        let mapped = mapped.map(|variable| (variable.topic, variable.name.as_str()));
        let announced = self.values.layouts.iter(now);
        let announced = announced
            .filter(|(topic, _)| mapping.variable(*topic).is_none())
            .map(|(topic, layout)| (topic, layout.name()));
        let names = mapped.chain(announced);
        names.filter(|(topic, name)| !name.is_empty() && self.values.topics.get(topic).is_none())
    }
}
