//! Values of the component that other participants of the space publish.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use async_trait::async_trait;
use bridge_node::LocalDelivery;
use mappings::TopicId;
use skills::{Component, Measured, SkillValue, UnknownValue, ValueSensor, ValueSource};
use tokio::sync::watch;

use crate::fields;

/// The fields of the newest message of a topic, or the reason why they are unknown.
type Fields = Result<Arc<Vec<Option<SkillValue>>>, String>;

/// The topics that sensors of the component need.
#[derive(Debug, Default)]
pub(crate) struct Topics(BTreeMap<TopicId, watch::Sender<Fields>>);

impl Topics {
    /// Replaces the description of topics by sensors that receive them.
    pub(crate) fn add_sensors(&mut self, component: &mut Component) {
        for value in &mut component.values {
            if let ValueSource::Topic(source) = &value.source
                && let Ok(topic) = source.topic.parse::<TopicId>()
            {
                let none = || watch::Sender::new(Err(format!("{topic} has no publisher")));
                let fields = self.0.entry(topic).or_insert_with(none).subscribe();
                value.source = ValueSource::Sensor(Arc::new(TopicSensor {
                    topic,
                    field: source.field,
                    fields,
                }));
            }
        }
    }

    /// Returns the topics.
    pub(crate) fn all(&self) -> impl Iterator<Item = TopicId> {
        self.0.keys().copied()
    }

    /// Takes a message of another participant.
    pub(crate) fn received(&self, sample: &LocalDelivery) {
        let Some(fields) = self.0.get(&sample.topic) else {
            return;
        };
        let newest = match sample.status & BAD {
            0 => fields::values(&sample.payload)
                .map(Arc::new)
                .map_err(|error| error.to_string()),
            _ => Err(format!(
                "the publisher of {} reports a Bad status (0x{:04X}0000)",
                sample.topic, sample.status
            )),
        };
        drop(fields.send_replace(newest));
    }

    /// Notes that a topic has no values, or has values again.
    pub(crate) fn set_silent(&self, topic: TopicId, silent: bool) {
        if silent && let Some(fields) = self.0.get(&topic) {
            let silent = Err(format!("the publisher of {topic} is silent"));
            drop(fields.send_replace(silent));
        }
    }
}

#[derive(Debug)]
struct TopicSensor {
    topic: TopicId,
    field: usize,
    fields: watch::Receiver<Fields>,
}

#[async_trait]
impl ValueSensor for TopicSensor {
    async fn measure(&self, _period: Duration, out: &Measured) -> String {
        let mut fields = self.fields.clone();
        loop {
            let newest = fields.borrow_and_update().clone();
            let value = newest.and_then(|fields| self.value(&fields));
            out.put_single(value.map_err(UnknownValue::Reported));
            if fields.changed().await.is_err() {
                return "the program ends".to_owned();
            }
        }
    }

    fn source(&self) -> String {
        self.topic.to_string()
    }

    /// The space reports the silence of a topic.
    fn within(&self, _period: Duration) -> Duration {
        Duration::from_secs(24 * 3600)
    }
}

impl TopicSensor {
    fn value(&self, fields: &[Option<SkillValue>]) -> Result<SkillValue, String> {
        match fields.get(self.field) {
            Some(Some(value)) => Ok(value.clone()),
            Some(None) => Err(format!("field {} of {} is null", self.field, self.topic)),
            None => Err(format!(
                "{} has {} fields, and field {} is needed",
                self.topic,
                fields.len(),
                self.field
            )),
        }
    }
}

/// The severity bit of the upper half of a StatusCode.
const BAD: u16 = 0x8000;

#[cfg(test)]
mod tests {
    use std::path::Path;

    use bridge_node::ValueRelation;
    use bytes::Bytes;
    use skills::server::{ComponentServer, ServeSettings};

    use super::*;

    #[tokio::test]
    async fn a_field_of_a_topic_is_a_value_until_its_publisher_is_silent() {
        let text = "component: x\napplication_uri: urn:x\nnamespace: 1\nvalues:\n  - {name: Level, type: Double, topic: {name: ua_1_2_5, field: 1}}\n";
        let mut component = Component::from_yaml(text, Path::new("")).unwrap();
        let mut topics = Topics::default();
        topics.add_sensors(&mut component);
        let settings = ServeSettings::default();
        let served = ComponentServer::build(&component, &settings, |_, _| Vec::new()).unwrap();
        let mut readings = served.values()[0].watch();
        let topic: TopicId = "ua_1_2_5".parse().unwrap();
        let sample = |fields: &[SkillValue], status| LocalDelivery {
            topic,
            payload: Bytes::from(fields::block(fields)),
            source: None,
            status,
            instance: None,
            kept: ValueRelation::Alone,
            lasting: true,
        };
        let mut until = async |wanted: Result<f64, &str>| {
            let found = readings.wait_for(|reading| match (&reading.value, wanted) {
                (Ok(value), Ok(wanted)) => value.as_f64() == Some(wanted),
                (Err(why), Err(wanted)) => why.to_string().contains(wanted),
                _ => false,
            });
            let found = tokio::time::timeout(Duration::from_secs(30), found).await;
            assert!(found.is_ok(), "{wanted:?}");
        };
        until(Err("ua_1_2_5 has no publisher")).await;
        topics.received(&sample(&["a".into(), 2.5.into()], 0));
        until(Ok(2.5)).await;
        topics.received(&sample(&["a".into()], 0));
        until(Err("has 1 fields, and field 1 is needed")).await;
        topics.received(&sample(&["a".into(), 3.5.into()], 0));
        until(Ok(3.5)).await;
        topics.received(&sample(&["a".into(), 4.5.into()], 0x8031));
        until(Err("Bad status (0x80310000)")).await;
        topics.set_silent(topic, true);
        until(Err("is silent")).await;
        served.stop().await;
    }
}
