//! The slave API: the calls of the master, other nodes and `rosnode` to this node.
//!
//! Every call is answered at once; its effects continue in tasks of their own.

use std::sync::atomic::Ordering;

use crate::events;
use crate::header::clipped;
use crate::master::strings;
use crate::node::Inner;
use crate::outbox::lock;
use crate::xmlrpc::{MethodCall, MethodResponse, XmlRpcFault, XmlRpcValue};

/// Answers a call.
pub(crate) fn answer(node: &Inner, call: MethodCall) -> MethodResponse {
    let params = call.params.as_slice();
    match call.method.as_str() {
        "getPid" => Ok(done(i32::try_from(std::process::id()).unwrap_or(0))),
        "getMasterUri" => Ok(done(node.master.uri())),
        "getPublications" => Ok(done(publications(node))),
        "getSubscriptions" => Ok(done(subscriptions(node))),
        "getBusStats" => Ok(done(bus_stats(node))),
        "getBusInfo" => Ok(done(bus_info(node))),
        "publisherUpdate" => Ok(publisher_update(node, params)),
        "requestTopic" => Ok(request_topic(node, params)),
        "paramUpdate" => Ok(param_update(node, params)),
        "shutdown" => Ok(shutdown(node, params)),
        other => Err(XmlRpcFault {
            code: -1,
            message: format!("no such method: {other}"),
        }),
    }
}

fn publisher_update(node: &Inner, params: &[XmlRpcValue]) -> XmlRpcValue {
    let [_, XmlRpcValue::String(topic), publishers] = params else {
        return refused("publisherUpdate takes (caller_id, topic, publishers)");
    };
    let Some(publishers) = strings(publishers) else {
        return refused("publishers must be a list of strings");
    };
    node.publishers_changed(topic, &publishers);
    done(0)
}

fn param_update(node: &Inner, params: &[XmlRpcValue]) -> XmlRpcValue {
    let [_, XmlRpcValue::String(key), _] = params else {
        return refused("paramUpdate takes (caller_id, key, value)");
    };
    // The key of a namespace ends in a slash, and the key of the root is only a slash.
    let name = key.trim_end_matches('/');
    node.parameter_changed(if name.is_empty() { "/" } else { name });
    done(0)
}

fn request_topic(node: &Inner, params: &[XmlRpcValue]) -> XmlRpcValue {
    let [
        caller,
        XmlRpcValue::String(topic),
        XmlRpcValue::Array(protocols),
    ] = params
    else {
        return refused("requestTopic takes (caller_id, topic, protocols)");
    };
    let Some(hub) = node.publication(topic) else {
        return triple(-1, &format!("not a publisher of [{topic}]"), Vec::new());
    };
    let tcpros = |protocol: &XmlRpcValue| {
        protocol
            .as_array()
            .and_then(<[XmlRpcValue]>::first)
            .and_then(XmlRpcValue::as_str)
            == Some("TCPROS")
    };
    if !protocols.iter().any(tcpros) {
        hub.refuse_protocols(clipped(caller.as_str().unwrap_or_default()));
        return triple(0, "only TCPROS is spoken here", Vec::new());
    }
    let port = i32::from(node.topics_port);
    let chosen = vec!["TCPROS".into(), node.hostname.as_str().into(), port.into()];
    triple(1, &format!("ready on {}:{port}", node.hostname), chosen)
}

fn shutdown(node: &Inner, params: &[XmlRpcValue]) -> XmlRpcValue {
    let reason = clipped(params.get(1).and_then(XmlRpcValue::as_str).unwrap_or(""));
    if reason.contains(NAME_TAKEN) {
        node.name_is_contested();
    } else {
        events::shutdown_asked(reason);
        node.ask_to_shut_down(reason);
    }
    done(0)
}

fn publications(node: &Inner) -> XmlRpcValue {
    let pair = |hub: &std::sync::Arc<crate::publisher::PublishedTopic>| {
        XmlRpcValue::Array(vec![
            hub.topic.as_str().into(),
            hub.topic_type.name.as_str().into(),
        ])
    };
    XmlRpcValue::Array(node.publications().iter().map(pair).collect())
}

fn subscriptions(node: &Inner) -> XmlRpcValue {
    let pair = |feed: &std::sync::Arc<crate::subscription::TopicFeed>| {
        let wanted = feed.wanted.type_name.as_deref().unwrap_or("*");
        XmlRpcValue::Array(vec![feed.topic.as_str().into(), wanted.into()])
    };
    XmlRpcValue::Array(node.feeds().iter().map(pair).collect())
}

/// Returns `[publishStats, subscribeStats, serviceStats]`.
fn bus_stats(node: &Inner) -> XmlRpcValue {
    let mut published = Vec::new();
    for hub in node.publications() {
        let (mut total, mut connections) = (0u64, Vec::new());
        for subscriber in hub.connected() {
            let bytes = subscriber.bytes.load(Ordering::Relaxed);
            let messages = subscriber.messages.load(Ordering::Relaxed);
            total = total.saturating_add(bytes);
            connections.push(XmlRpcValue::Array(vec![
                subscriber.id.into(),
                count(bytes),
                count(messages),
                XmlRpcValue::Bool(true),
            ]));
        }
        published.push(vec![hub.topic.as_str().into(), count(total), connections.into()].into());
    }
    let mut subscribed = Vec::new();
    for feed in node.feeds() {
        let connection = |(_, link): (String, std::sync::Arc<crate::subscription::TopicLink>)| {
            let bytes = count(link.bytes.load(Ordering::Relaxed));
            XmlRpcValue::Array(vec![
                link.id.into(),
                bytes,
                count(feed.dropped()),
                XmlRpcValue::Bool(true),
            ])
        };
        let connections: Vec<XmlRpcValue> =
            feed.connections().into_iter().map(connection).collect();
        subscribed.push(vec![feed.topic.as_str().into(), connections.into()].into());
    }
    // Requests, bytes received and bytes sent over all services: the slave API has no finer
    // statistics.
    let (mut calls, mut received, mut sent) = (0u64, 0u64, 0u64);
    for served in node.services() {
        let counters = &served.counters;
        calls = calls.saturating_add(counters.calls.load(Ordering::Relaxed));
        received = received.saturating_add(counters.received.load(Ordering::Relaxed));
        sent = sent.saturating_add(counters.sent.load(Ordering::Relaxed));
    }
    let services = vec![count(calls), count(received), count(sent)];
    XmlRpcValue::Array(vec![
        XmlRpcValue::Array(published),
        XmlRpcValue::Array(subscribed),
        XmlRpcValue::Array(services),
    ])
}

/// Returns `[connectionId, destinationId, direction, transport, topic, connected, connectionInfo]`
/// per connection. The destination is the name of a subscriber or the URI of a publisher, as in
/// rospy and roscpp.
fn bus_info(node: &Inner) -> XmlRpcValue {
    let mut entries = Vec::new();
    for hub in node.publications() {
        for subscriber in hub.connected() {
            entries.push(XmlRpcValue::Array(vec![
                subscriber.id.into(),
                subscriber.caller_id.as_str().into(),
                "o".into(),
                "TCPROS".into(),
                hub.topic.as_str().into(),
                XmlRpcValue::Bool(true),
                subscriber.transport.as_str().into(),
            ]));
        }
    }
    for feed in node.feeds() {
        for (uri, link) in feed.connections() {
            entries.push(XmlRpcValue::Array(vec![
                link.id.into(),
                uri.into(),
                "i".into(),
                "TCPROS".into(),
                feed.topic.as_str().into(),
                XmlRpcValue::Bool(true),
                lock(&link.transport).as_str().into(),
            ]));
        }
    }
    XmlRpcValue::Array(entries)
}

/// Returns a count as an XML-RPC integer of 32 bits; larger counts are limited.
fn count(number: u64) -> XmlRpcValue {
    XmlRpcValue::Int(i32::try_from(number).unwrap_or(i32::MAX))
}

fn done(result: impl Into<XmlRpcValue>) -> XmlRpcValue {
    triple(1, "", result)
}

fn refused(message: &str) -> XmlRpcValue {
    triple(-1, message, 0)
}

fn triple(code: i32, message: &str, result: impl Into<XmlRpcValue>) -> XmlRpcValue {
    XmlRpcValue::Array(vec![code.into(), message.into(), result.into()])
}

/// Text with which the master displaces the previous owner of a name
/// (`rosmaster/registrations.py`).
const NAME_TAKEN: &str = "new node registered with same name";
