//! The calls of `rosnode` and the master to a node.

use std::time::Duration;

use bytes::Bytes;
use tcpros::{Inbox, PublisherOptions};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;
use tokio::time::Instant;

use crate::support::*;

#[tokio::test]
async fn rosnode_gets_an_answer_to_everything_it_asks() {
    let core = core();
    let (talker, listener) = (node("talker", &core), node("listener", &core));
    let inbox = Inbox::new();
    let _subscription = subscribe(&listener, "/t", &inbox);
    let publisher = advertise(&talker, "/t", PublisherOptions::default());
    eventually("the link", || publisher.subscribers() == 1).await;
    assert_eq!(publisher.publish(Bytes::from_static(b"abc")).sent_to, 1);
    let ask = async |method: &str| {
        let call = format!(
            "<methodCall><methodName>{method}</methodName><params><param><value>/rosnode</value></param></params></methodCall>"
        );
        slave_call(&talker, &call).await
    };
    assert!(
        ask("getPid")
            .await
            .contains(&format!("<i4>{}</i4>", std::process::id()))
    );
    assert!(ask("getMasterUri").await.contains(core.uri()));
    let publications = ask("getPublications").await;
    assert!(publications.contains("/t") && publications.contains("std_msgs/String"));
    assert!(!ask("getSubscriptions").await.contains("/t"));
    let info = ask("getBusInfo").await;
    assert!(
        info.contains("/listener")
            && info.contains("<string>o</string>")
            && info.contains("TCPROS connection on port "),
        "{info}"
    );
    within("the statistics", async {
        while !ask("getBusStats").await.contains("<i4>7</i4>") {}
    })
    .await;
    assert!(
        ask("paramUpdate")
            .await
            .contains("takes (caller_id, key, value)")
    );
    assert!(ask("nonsense").await.contains("no such method: nonsense"));
}

#[tokio::test]
async fn the_shutdown_call_reaches_the_program() {
    let core = core();
    let talker = node("talker", &core);
    let call = "<methodCall><methodName>shutdown</methodName><params><param><value>/master</value></param>\
                <param><value>user request</value></param></params></methodCall>";
    slave_call(&talker, call).await;
    let reason = within("the request", talker.shutdown_requested()).await;
    assert_eq!(reason, "user request");
}

/// Requirement: a report that another node has taken its name does not end a node that still owns
/// the name.
#[tokio::test]
async fn a_node_that_has_its_name_still_goes_on_when_told_that_it_is_taken() {
    let core = core();
    let talker = node("talker", &core);
    let _first = advertise(&talker, "/first", PublisherOptions::default());
    registered(&talker).await;
    let call = "<methodCall><methodName>shutdown</methodName><params><param><value>/master</value></param><param>\
                <value>[/talker] Reason: new node registered with same name</value></param></params></methodCall>";
    slave_call(&talker, call).await;
    let _second = advertise(&talker, "/second", PublisherOptions::default());
    let goes_on = async {
        while !talker
            .graph()
            .await
            .unwrap()
            .publishers
            .contains_key("/second")
        {}
    };
    tokio::select! {
        reason = talker.shutdown_requested() => panic!("it ends: {reason}"),
        () = within("what it registers from then on", goes_on) => {}
    }
}

/// Requirement: one HTTP connection serves several calls, as rospy and roscpp make them.
#[tokio::test]
async fn two_calls_on_one_connection_are_both_answered() {
    let core = core();
    let talker = node("talker", &core);
    let address = talker.uri().trim_start_matches("http://");
    let mut stream = TcpStream::connect(address.trim_end_matches('/'))
        .await
        .unwrap();
    for _ in 0..2 {
        let body = "<methodCall><methodName>getPid</methodName></methodCall>";
        let head = "POST /RPC2 HTTP/1.1\r\nHost: x\r\nContent-Type: text/xml\r\nContent-Length:";
        stream
            .write_all(format!("{head} {}\r\n\r\n{body}", body.len()).as_bytes())
            .await
            .unwrap();
        let mut answer = Vec::new();
        within("the answer", async {
            while !answer.ends_with(b"</methodResponse>\n") {
                assert!(stream.read_buf(&mut answer).await.unwrap() > 0);
            }
        })
        .await;
    }
}

/// Requirement: a caller that sends nothing, or half a call, delays no other caller.
#[tokio::test]
async fn silent_callers_keep_no_other_waiting() {
    let core = core();
    let talker = node("talker", &core);
    let address = talker.uri().trim_start_matches("http://");
    let address = address.trim_end_matches('/');
    let mut silent = Vec::new();
    for n in 0..100 {
        let mut stream = TcpStream::connect(address).await.unwrap();
        let half = "POST / HTTP/1.1\r\nContent-Length: 100\r\n\r\n<methodCall>";
        stream
            .write_all(&half.as_bytes()[..n % half.len()])
            .await
            .unwrap();
        silent.push(stream);
    }
    let started = Instant::now();
    let call = "<methodCall><methodName>getPid</methodName></methodCall>";
    assert!(slave_call(&talker, call).await.contains("<i4>1</i4>"));
    assert!(started.elapsed() < Duration::from_secs(5));
}
