//! Metadata of topics of other spaces, from their writers.

use std::net::SocketAddr;
use std::time::{Duration, Instant};

use mappings::{Mapping, TopicId};
use uadp::discovery::DataSetMetaDataType;

use super::about::DropSite;
use super::values::TopicQueues;
use crate::counters::Reason;
use crate::description::{DescriptionFault, TopicMetaData};
use crate::layout::DataSetLayout;
use crate::learned::{AnnouncementEffect, TopicPrecedence};
use crate::output::Output;
use crate::reader::LocalTypeRequest;
use crate::settings::{Local, Now};
use crate::topic::{Topic, TopicSide};
use crate::topics::TopicTable;

impl TopicQueues {
    /// Handles the metadata of a topic of another space. `answered` is called if the metadata is
    /// accepted as an answer to a probe.
    pub(super) fn learn(
        &mut self,
        topic: TopicId,
        (meta_data, from): (&DataSetMetaDataType<'_>, SocketAddr),
        answered: impl FnOnce(),
        now: Now,
    ) {
        let about = DropSite {
            topic: Some(topic),
            from: Some(from),
        };
        if !self.may_say(topic, from, now) {
            return;
        }
        let shape = match self.topics.get(&topic).map(|entry| &entry.role) {
            Some(TopicSide::Theirs(reader)) => reader.shape.clone(),
            Some(TopicSide::Ours(_)) | None => None,
        };
        let fault = self.learn_layout(topic, meta_data, from, now).err();
        if !self.is_learned(topic) {
            answered();
            if let Some(why) = fault {
                self.count(about, Reason::MetaData, 1, || why.to_string());
            }
            return;
        }
        let described = match TopicMetaData::read(meta_data) {
            Ok(described) => described,
            Err(why) => {
                self.count(about, (Reason::MetaData, "useless"), 1, || why.to_string());
                return;
            }
        };
        answered();
        if let Some(described) = &described
            && shape.is_some()
            && !self.may_be_renamed(topic, described, now)
        {
            self.count(about, (Reason::MetaData, "too often"), 1, || {
                "its writer changes its description too often".to_owned()
            });
            return;
        }
        match self.take_note(topic, described, now) {
            AnnouncementEffect::Same => {}
            AnnouncementEffect::Full => self.count(about, (Reason::MetaData, "no room"), 1, || {
                "the limit of described topics is reached".to_owned()
            }),
            AnnouncementEffect::Other => {
                self.topics.counters(Some(topic)).described += 1;
                if !self.arrange(topic, now)
                    && shape.is_some()
                    && let Some(at) = self.topics.find(topic)
                {
                    self.tell_unbound(at);
                }
            }
        }
    }

    /// Returns whether a sender may be the writer of a topic. Topics without values may have any
    /// writer.
    pub(super) fn may_be_writer(&self, topic: TopicId, from: SocketAddr, now: Now) -> bool {
        let timeout = self.mapping.pubsub().receive_timeout;
        match self.topics.get(&topic).map(|of| &of.role) {
            Some(TopicSide::Theirs(reader)) => reader.may_be(from, now.monotonic, timeout),
            Some(TopicSide::Ours(_)) | None => true,
        }
    }

    /// Handles the announcement of a writer that it does not have a topic any more.
    pub(super) fn unlearn(&mut self, topic: TopicId, from: SocketAddr, now: Now) {
        let timeout = self.mapping.pubsub().receive_timeout;
        let Some(at) = self.topics.find(topic) else {
            return;
        };
        if let Some(reader) = self.topics.reader(at)
            && reader.may_be(from, now.monotonic, timeout)
        {
            let left = reader.leave();
            if self.settings.local != Local::Fields {
                reader.withdraw();
            }
            if left {
                self.tell_silence(at);
            }
            self.lose(at, now);
        }
    }

    /// Plans a probe for the metadata of a topic of another space.
    pub(super) fn ask_what(&mut self, topic: TopicId) {
        if self.is_learned(topic) {
            self.inquiries.probe(topic);
        }
    }

    /// Plans a probe for the fields of a topic if its messages cannot be read without them. The
    /// rate of these probes is limited.
    pub(super) fn ask_layout(&mut self, topic: TopicId, now: Now) {
        let Some(reader) = self.topics.reader_of(topic) else {
            return;
        };
        let before = reader.asked_layout;
        if before.is_none_or(|asked| now.monotonic >= asked + ASK_LAYOUT_AGAIN) {
            reader.asked_layout = Some(now.monotonic);
            self.inquiries.probe(topic);
        }
    }

    /// Returns whether the local type of a topic may come from its writer, because the mapping does
    /// not define it.
    fn is_learned(&self, topic: TopicId) -> bool {
        let own = self.settings.own;
        let bound = self.mapping.variable(topic).is_some_and(|variable| {
            let service = variable.service.as_ref();
            variable.binding(own).is_some() || service.is_some_and(|service| service.space == own)
        });
        self.settings.local != Local::Fields && !bound
    }

    /// Returns whether the sender may announce the topic as its writer.
    fn may_say(&mut self, topic: TopicId, from: SocketAddr, now: Now) -> bool {
        if self.may_be_writer(topic, from, now) {
            return true;
        }
        // If the mapping defines the type, a restart at another port is not worth a log entry.
        if self.is_learned(topic) {
            let about = DropSite {
                topic: Some(topic),
                from: Some(from),
            };
            self.count(about, (Reason::MetaData, "sender"), 1, || {
                "its description comes from a program that does not send its values".to_owned()
            });
        }
        false
    }

    /// Stores the announced fields of a topic.
    fn learn_layout(
        &mut self,
        topic: TopicId,
        meta_data: &DataSetMetaDataType<'_>,
        from: SocketAddr,
        now: Now,
    ) -> Result<(), DescriptionFault> {
        let layout = DataSetLayout::read(meta_data, from)?;
        let until = (now.monotonic, self.mapping.pubsub().metadata_period);
        let rank = rank(&self.topics, &self.mapping, now.monotonic);
        match self.layouts.learn(topic, layout, until, rank) {
            AnnouncementEffect::Full => Err(DescriptionFault::Full),
            AnnouncementEffect::Same | AnnouncementEffect::Other => Ok(()),
        }
    }

    /// Stores the description of a topic. An announcement without a ROS type removes the stored
    /// description.
    fn take_note(
        &mut self,
        topic: TopicId,
        described: Option<TopicMetaData>,
        now: Now,
    ) -> AnnouncementEffect {
        let until = (now.monotonic, self.mapping.pubsub().metadata_period);
        let Some(described) = described else {
            self.learned.forget(topic);
            return AnnouncementEffect::Same;
        };
        let rank = rank(&self.topics, &self.mapping, now.monotonic);
        self.learned.learn(topic, described, until, rank)
    }

    /// Returns whether a topic with values may change to the description. The known description is
    /// always accepted.
    fn may_be_renamed(&mut self, topic: TopicId, described: &TopicMetaData, now: Now) -> bool {
        let known = self.learned.last(topic);
        if known.is_some_and(|known| **known == *described) {
            return true;
        }
        let known = known.is_some();
        match self.topics.get_mut(&topic) {
            Some(Topic {
                role: TopicSide::Theirs(reader),
                ..
            }) => reader.may_be_renamed(known, now.monotonic),
            Some(_) | None => true,
        }
    }

    /// Returns the request to the port for the local type of a topic with values of the given
    /// shape, together with the known description. For a topic that already has a type, it requests
    /// a check of the description.
    pub(super) fn asked(
        &mut self,
        topic: TopicId,
        ask: LocalTypeRequest,
        shape: Vec<(uadp::BuiltinType, bool)>,
        now: Now,
    ) -> Option<Output> {
        if self.arrange(topic, now) {
            return None;
        }
        let described = self.learned.get(topic, now.monotonic).cloned();
        let fits = described
            .as_ref()
            .is_none_or(|described| described.fits(&shape));
        if ask == LocalTypeRequest::IfDescribed && (described.is_none() || !fits) {
            return None;
        }
        if described.is_none() {
            self.ask_what(topic);
        }
        if !fits {
            self.count(
                DropSite::topic(topic),
                (Reason::MetaData, "values"),
                1,
                || "its values do not match the description of its writer".to_owned(),
            );
        }
        Some(Output::Unbound {
            topic,
            shape,
            described: described.filter(|_| fits),
        })
    }
}

/// The minimum time between two probes of a writer for the fields of its messages.
const ASK_LAYOUT_AGAIN: Duration = Duration::from_secs(10);

/// Returns the precedence of topics when there is no room for all descriptions.
fn rank(
    topics: &TopicTable,
    mapping: &Mapping,
    now: Instant,
) -> impl Fn(TopicId) -> TopicPrecedence {
    let timeout = mapping.pubsub().receive_timeout;
    move |topic| match topics.get(&topic).map(|of| &of.role) {
        _ if mapping.variable(topic).is_some() => TopicPrecedence::Mapped,
        Some(TopicSide::Theirs(reader))
            if now.saturating_duration_since(reader.heard_at()) < timeout =>
        {
            TopicPrecedence::Heard
        }
        Some(_) | None => TopicPrecedence::Stray,
    }
}
