//! The state of each carrier.

use std::collections::BTreeMap;

use serde::Serialize;
use transport::{CarrierState, Senders, Traffic};

/// The state of a carrier.
#[derive(Debug, Clone, Serialize)]
pub(crate) struct CarrierStatus {
    /// Name of the network interface or broker.
    network: String,
    /// How far senders are told apart: `addresses`, `hidden`, or `authorized` by access rules.
    senders: &'static str,
    /// The reason why nothing is received and sent.
    #[serde(skip_serializing_if = "Option::is_none")]
    lost: Option<String>,
    /// Numbers of messages, of a program with several carriers.
    #[serde(flatten, skip_serializing_if = "Option::is_none")]
    traffic: Option<TrafficStatus>,
    /// Messages that were not sent, forwarded or passed on, by reason.
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    dropped: BTreeMap<&'static str, u64>,
}

#[derive(Debug, Clone, Copy, Serialize)]
struct TrafficStatus {
    received: u64,
    sent: u64,
    forwarded: u64,
}

impl From<CarrierState> for CarrierStatus {
    fn from(state: CarrierState) -> Self {
        let traffic = |Traffic {
                           received,
                           sent,
                           forwarded,
                       }| TrafficStatus {
            received,
            sent,
            forwarded,
        };
        let mut dropped = BTreeMap::new();
        for (reason, count) in state.dropped {
            *dropped.entry(reason).or_default() += count;
        }
        Self {
            network: state.network,
            senders: match state.senders {
                Senders::Addresses => "addresses",
                Senders::Authorized => "authorized",
                Senders::Hidden => "hidden",
            },
            lost: state.lost,
            traffic: state.traffic.map(traffic),
            dropped,
        }
    }
}

impl CarrierStatus {
    /// Adds the figures of a carrier for Prometheus, if the program has several.
    pub(super) fn figures(
        &self,
        own: &str,
        line: &mut dyn FnMut(&str, &str, &dyn std::fmt::Display),
    ) {
        let Some(TrafficStatus {
            received,
            sent,
            forwarded,
        }) = self.traffic
        else {
            return;
        };
        let labels = format!("{own},carrier=\"{}\"", super::escaped(&self.network));
        line("carrier_up", &labels, &u8::from(self.lost.is_none()));
        line("carrier_received_total", &labels, &received);
        line("carrier_sent_total", &labels, &sent);
        line("carrier_forwarded_total", &labels, &forwarded);
        for (reason, count) in &self.dropped {
            let labels = format!("{labels},reason=\"{reason}\"");
            line("carrier_dropped_total", &labels, count);
        }
    }
}
