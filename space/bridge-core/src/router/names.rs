//! The display names of topics and calls.

use std::time::Instant;

use mappings::TopicId;

use super::Router;

impl Router {
    /// Returns the display name of a topic or call: from the mapping, from the local side, or from
    /// the announcement of its writer or executor. Returns `None` without a name.
    #[must_use]
    pub fn name_of(&self, topic: TopicId) -> Option<&str> {
        let mapped = self.values.mapping.variable(topic);
        let mapped = mapped.map(|variable| variable.name.as_str());
        let said = || {
            let of = self.values.topics.get(&topic)?;
            of.said.as_ref().map(|said| said.name.as_str())
        };
        let announced = || self.values.layouts.last(topic).map(|of| of.name());
        let call = || self.calls.as_ref()?.name_of(topic);
        let mapped_call = || {
            let call = self.values.mapping.call(topic);
            call.map(|call| call.name.as_str())
        };
        let is_given = |name: &&str| !name.is_empty();
        let value = mapped.or_else(said).filter(is_given);
        let value = value.or_else(|| announced().filter(is_given));
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
