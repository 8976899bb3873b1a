//! The connections of a program with its broker.

use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::{Duration, Instant};

use mappings::{Broker, MqttVersion};
use tokio::sync::mpsc;

use crate::connection::{BrokerLink, ConnectionShared, instant, run};
use crate::packets::ReceivedPublish;
use crate::settings::BrokerSettings;

/// The connections of a program with its broker: one that receives and sends, and with QoS 1 one
/// that only sends the values that the broker confirms.
///
/// A cluster without a leader confirms nothing, and may end the connection of the sender. The
/// session of a connection ends with it, so a program with a single connection would miss the
/// messages of others until it is connected again.
#[derive(Debug)]
pub(crate) struct BrokerLinks {
    main: Arc<ConnectionShared>,
    confirmed: Option<Arc<ConnectionShared>>,
    /// The time until which the main connection waits for the end of the other, while that closes.
    main_closes: Option<Instant>,
}

impl BrokerLinks {
    /// Starts to connect. Called in a runtime of tokio. The tasks end when the connections are
    /// closed, or when the receiver of `out` is dropped.
    pub(crate) fn open(
        settings: &Arc<BrokerSettings>,
        confirmed: Option<BrokerSettings>,
        out: mpsc::Sender<(ReceivedPublish, SocketAddr)>,
    ) -> Self {
        let start = |settings, out| {
            let shared = Arc::new(ConnectionShared::default());
            drop(tokio::spawn(run(settings, Arc::clone(&shared), out)));
            shared
        };
        let confirmed = confirmed.map(|of| start(Arc::new(of), out.clone()));
        let main = start(Arc::clone(settings), out);
        Self {
            main,
            confirmed,
            main_closes: None,
        }
    }

    /// Returns the connection for messages that the broker confirms, or for all others.
    pub(crate) const fn of(&self, confirmed: bool) -> &Arc<ConnectionShared> {
        match &self.confirmed {
            Some(second) if confirmed => second,
            Some(_) | None => &self.main,
        }
    }

    /// Returns the connection that receives, and that publishes the retained messages.
    pub(crate) const fn main(&self) -> &Arc<ConnectionShared> {
        &self.main
    }

    fn all(&self) -> impl Iterator<Item = &Arc<ConnectionShared>> {
        [&self.main].into_iter().chain(&self.confirmed)
    }

    /// Returns whether the broker may return an own message: with MQTT 3.1.1 it always does, and
    /// with MQTT 5 a message of another connection than the main one.
    pub(crate) fn is_returned(&self, version: MqttVersion, confirmed: bool) -> bool {
        version == MqttVersion::V3_1_1 || !Arc::ptr_eq(self.of(confirmed), &self.main)
    }

    /// Returns whether a retained message of this topic is published with each connection, and
    /// accepted by `is_it`.
    pub(crate) fn keeps(&self, topic: &str, is_it: impl Fn(&[u8]) -> bool) -> bool {
        let state = self.main.state();
        let kept = state.kept.get(topic);
        kept.is_some_and(|own| is_it(&own.payload))
    }

    /// Returns the topics of the retained messages that are published with each connection.
    pub(crate) fn kept_topics(&self) -> Vec<String> {
        self.main.state().kept.keys().cloned().collect()
    }

    /// Returns the reason why messages are not received, or not sent.
    pub(crate) fn lost(&self, broker: &Broker) -> Option<String> {
        let address = &broker.address;
        if let BrokerLink::Waiting(why) = &self.main.state().link {
            return Some(format!("waiting for broker {address}: {why}"));
        }
        match &self.confirmed.as_ref()?.state().link {
            BrokerLink::Connected { .. } => None,
            BrokerLink::Waiting(why) => Some(format!(
                "waiting for broker {address} to confirm values: {why}"
            )),
        }
    }

    /// Returns the largest packet that the broker takes, if it is known.
    pub(crate) fn max_packet(&self) -> Option<u32> {
        match self.main.state().link {
            BrokerLink::Connected { max_packet, .. } => max_packet,
            BrokerLink::Waiting(_) => None,
        }
    }

    /// Returns the numbers of messages that were not passed on, by reason.
    pub(crate) fn dropped(&self) -> Vec<(&'static str, u64)> {
        let mut dropped = BTreeMap::new();
        for shared in self.all() {
            let state = shared.state();
            let counted = [
                ("queue_expired", state.queue.expired),
                ("queue_replaced", state.queue.replaced),
                ("connection_lost", state.queue.discarded),
                ("not_confirmed", state.queue.unconfirmed),
                ("packet_refused", state.queue.refused),
                ("received_overflow", state.overflow),
            ];
            for (reason, count) in counted {
                *dropped.entry(reason).or_default() += count;
            }
        }
        dropped.into_iter().collect()
    }

    /// Closes the connection of the values that the broker confirms, after the queued values. The
    /// main connection waits for that, so that no value follows the end of the program.
    pub(crate) fn close_confirmed(&mut self) {
        self.main_closes = Some(instant() + CONFIRMED_CLOSES);
        if let Some(second) = &self.confirmed {
            second.close();
        }
    }

    /// Returns whether the main connection waits for the end of the other.
    pub(crate) const fn main_waits(&self) -> bool {
        self.main_closes.is_some()
    }

    /// Returns true once when the main connection is to be closed: the other is closed, or its time
    /// is over, and the values that still wait are discarded.
    pub(crate) fn main_is_due(&mut self) -> bool {
        let Some(until) = self.main_closes else {
            return false;
        };
        if let Some(second) = self.confirmed.as_ref().filter(|of| !of.is_closed()) {
            if instant() < until {
                return false;
            }
            second.state().queue.discard();
            second.wake();
        }
        self.main_closes = None;
        true
    }

    /// Closes the connections after the queued messages.
    pub(crate) fn close(&self) {
        for shared in self.all() {
            shared.close();
        }
    }

    pub(crate) fn are_closed(&self) -> bool {
        self.all().all(|shared| shared.is_closed())
    }
}

/// The time for the end of the connection of values that the broker confirms. A program waits twice
/// as long for the end of its carrier.
const CONFIRMED_CLOSES: Duration = Duration::from_secs(1);

#[cfg(test)]
mod tests {
    use mappings::BrokerAddress;

    use crate::json::PromotedTexts;
    use crate::queue::QueuedPublish;

    use super::*;

    fn links(confirmed: bool) -> BrokerLinks {
        BrokerLinks {
            main: Arc::default(),
            confirmed: confirmed.then(Arc::default),
            main_closes: None,
        }
    }

    fn connected(shared: &ConnectionShared) {
        shared.state().link = BrokerLink::Connected {
            at: SocketAddr::from(([127, 0, 0, 1], 1883)),
            version: MqttVersion::V5,
            max_packet: None,
        };
    }

    fn announcement(confirmed: bool) -> QueuedPublish {
        QueuedPublish {
            topic: "metadata".to_owned(),
            payload: vec![1],
            retained: true,
            confirmed,
            replaceable: true,
            outlasts: false,
            within: Some(Duration::from_secs(1)),
            message_type: "ua-metadata",
            content_type: "application/opcua+uadp",
            promoted: PromotedTexts::default(),
        }
    }

    #[test]
    fn only_messages_that_the_broker_confirms_have_a_connection_of_their_own() {
        for has_second in [false, true] {
            let links = links(has_second);
            let confirmed = links.of(true);
            assert_eq!(Arc::ptr_eq(confirmed, links.of(false)), !has_second);
            assert!(Arc::ptr_eq(links.of(false), &links.main));
            assert_eq!(links.all().count(), 1 + usize::from(has_second));
            // The main connection suppresses its own messages with MQTT 5.
            for (confirmed, of_another) in [(false, false), (true, has_second)] {
                let returned = [MqttVersion::V3_1_1, MqttVersion::V5]
                    .map(|version| links.is_returned(version, confirmed));
                assert_eq!(returned, [true, of_another]);
            }

            let announcement = announcement(false);
            let mut state = links.main().state();
            state.kept.insert("metadata".to_owned(), announcement);
            drop(state);
            assert!(links.keeps("metadata", |of| of == [1]));
            assert!(!links.keeps("metadata", |of| of == [2]) && !links.keeps("a", |_| true));
            assert_eq!(links.kept_topics(), ["metadata"]);
        }
    }

    #[test]
    fn both_connections_are_needed_counted_and_closed() {
        let links = links(true);
        let broker = Broker::new(BrokerAddress::parse("mqtt://localhost").unwrap());
        connected(&links.main);
        let lost = links.lost(&broker).unwrap();
        assert!(lost.contains("to confirm values"), "{lost}");
        connected(links.of(true));
        assert_eq!(links.lost(&broker), None);
        links.main.state().link = BrokerLink::default();
        let lost = links.lost(&broker).unwrap();
        assert!(lost.contains("not connected yet"), "{lost}");

        for confirmed in [false, true] {
            let mut state = links.of(confirmed).state();
            for _ in 0..2 {
                let pushed = state.queue.push(announcement(confirmed), instant());
                pushed.unwrap();
            }
        }
        let replaced = links
            .dropped()
            .into_iter()
            .find(|of| of.0 == "queue_replaced");
        assert_eq!(replaced, Some(("queue_replaced", 2)));
        links.close();
        assert!(!links.are_closed(), "the tasks close them");
    }

    #[test]
    fn the_main_connection_waits_for_the_end_of_the_other() {
        let mut single = links(false);
        assert!(!single.main_is_due());
        single.close_confirmed();
        assert!(single.main_is_due() && !single.main_is_due());

        let mut both = links(true);
        both.close_confirmed();
        assert!(!both.main_is_due() && both.main_waits());
        both.of(true).closed();
        assert!(both.main_is_due() && !both.main_waits());

        // A broker that confirms nothing is not waited for.
        let mut late = links(true);
        let pushed = late
            .of(true)
            .state()
            .queue
            .push(announcement(true), instant());
        pushed.unwrap();
        late.close_confirmed();
        assert!(!late.main_is_due() && !late.of(true).state().queue.is_empty());
        late.main_closes = Some(instant());
        assert!(late.main_is_due() && late.of(true).state().queue.is_empty());
    }
}
