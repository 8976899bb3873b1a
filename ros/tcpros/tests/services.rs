//! Services of this crate with each other and with misbehaving peers, around a master in this
//! process.

#![expect(clippy::unwrap_used, clippy::panic, reason = "test code")]

use std::collections::VecDeque;
use std::future::{Future, poll_fn};
use std::io::ErrorKind;
use std::net::SocketAddr;
use std::pin::pin;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::task::Poll;
use std::time::Duration;

use bytes::Bytes;
use socket2::SockRef;
use tcpros::{
    CallPhase, ConnectionHeader, Core, MasterGraph, MasterState, Node, NodeError, NodeOptions,
    ServiceClient, ServiceClientOptions, ServiceError, ServiceOptions, ServiceRequest,
    ServiceServer, ServiceTypeSum,
};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpListener, TcpStream};
use tokio::task::JoinSet;
use tokio::time::{Instant, timeout};

const MD5: &str = "09fb03525b03e7ea1fd3992bafd87e16";
const DEADLINE: Duration = Duration::from_secs(20);

fn core() -> Core {
    Core::start(SocketAddr::from(([127, 0, 0, 1], 0))).unwrap()
}

fn node(name: &str, core: &Core) -> Node {
    let mut options = NodeOptions::from_env(name);
    core.uri().clone_into(&mut options.master_uri);
    "/".clone_into(&mut options.namespace);
    options.advertise_as("127.0.0.1");
    Node::start(options).unwrap()
}

fn set_bool() -> ServiceTypeSum {
    ServiceTypeSum {
        name: "std_srvs/SetBool".to_owned(),
        md5sum: MD5.to_owned(),
        request_type: "std_srvs/SetBoolRequest".to_owned(),
        response_type: "std_srvs/SetBoolResponse".to_owned(),
    }
}

/// Responds with the request, except for a few commands.
async fn echo(request: ServiceRequest) -> Result<Bytes, String> {
    match request.bytes.as_ref() {
        b"fail" => Err("the gripper is stuck".to_owned()),
        b"panic" => panic!("on purpose"),
        b"hang" => std::future::pending().await,
        b"who" => Ok(Bytes::from(request.client.caller_id.clone())),
        _ => Ok(request.bytes),
    }
}

fn offer(node: &Node, service: &str) -> ServiceServer {
    offer_with(node, service, ServiceOptions::default())
}

fn offer_with(node: &Node, service: &str, options: ServiceOptions) -> ServiceServer {
    node.advertise_service(service, set_bool(), options, echo)
        .unwrap()
}

fn client(node: &Node, service: &str) -> ServiceClient {
    node.service_client(service, ServiceClientOptions::default())
        .unwrap()
}

fn persistent(node: &Node, service: &str) -> ServiceClient {
    let options = ServiceClientOptions {
        persistent: true,
        ..Default::default()
    };
    node.service_client(service, options).unwrap()
}

async fn within<T>(what: &str, future: impl Future<Output = T>) -> T {
    match timeout(DEADLINE, future).await {
        Ok(value) => value,
        Err(_) => panic!("waited {DEADLINE:?} for {what}"),
    }
}

async fn eventually(what: &str, mut condition: impl FnMut() -> bool) {
    within(what, async {
        while !condition() {
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
    })
    .await;
}

/// Waits until the master's graph is as wanted.
async fn graph(node: &Node, what: &str, mut as_wanted: impl FnMut(&MasterGraph) -> bool) {
    within(what, async {
        while !node.graph().await.is_ok_and(|graph| as_wanted(&graph)) {
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
    })
    .await;
}

async fn offered(node: &Node, service: &str) {
    graph(node, "the registration", |g| {
        g.services.contains_key(service)
    })
    .await;
}

async fn ask(client: &ServiceClient, request: &'static str) -> Result<Bytes, ServiceError> {
    within(
        "a call",
        client.call(Bytes::from_static(request.as_bytes())),
    )
    .await
}

async fn post(address: &str, body: &str) -> String {
    let mut stream = TcpStream::connect(address).await.unwrap();
    let head = "POST / HTTP/1.1\r\nHost: x\r\nConnection: close\r\nContent-Length:";
    stream
        .write_all(format!("{head} {}\r\n\r\n{body}", body.len()).as_bytes())
        .await
        .unwrap();
    let mut answer = String::new();
    within("an XML-RPC answer", stream.read_to_string(&mut answer))
        .await
        .unwrap();
    answer
}

async fn call_api(address: &str, method: &str, arguments: &[&str]) -> String {
    let params: String = arguments
        .iter()
        .map(|a| format!("<param><value>{a}</value></param>"))
        .collect();
    let call = format!(
        "<methodCall><methodName>{method}</methodName><params>{params}</params></methodCall>"
    );
    post(address, &call).await
}

/// Registers an address for a service, as a hand-made server does.
async fn register(core: &Core, service: &str, address: SocketAddr) {
    let (master, uri) = (core.address().to_string(), format!("rosrpc://{address}"));
    let arguments = ["/by_hand", service, &uri, "http://127.0.0.1:1/"];
    call_api(&master, "registerService", &arguments).await;
}

async fn server_by_hand(core: &Core, service: &str) -> TcpListener {
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    register(core, service, listener.local_addr().unwrap()).await;
    listener
}

async fn read_header(stream: &mut TcpStream) -> ConnectionHeader {
    let len = within("a header", stream.read_u32_le()).await.unwrap();
    let mut header = vec![0; usize::try_from(len).unwrap()];
    stream.read_exact(&mut header).await.unwrap();
    ConnectionHeader::parse(&header).unwrap()
}

/// Accepts a client as a hand-made server, up to its first request.
async fn accept(listener: &TcpListener) -> (TcpStream, ConnectionHeader) {
    let (stream, _) = within("a client", listener.accept()).await.unwrap();
    greet(stream).await
}

async fn greet(mut stream: TcpStream) -> (TcpStream, ConnectionHeader) {
    let header = read_header(&mut stream).await;
    let reply = ConnectionHeader::default()
        .with("callerid", "/by_hand")
        .with("md5sum", MD5);
    stream.write_all(&reply.encode().unwrap()).await.unwrap();
    (stream, header)
}

async fn take_request(stream: &mut TcpStream) -> Vec<u8> {
    let len = within("a request", stream.read_u32_le()).await.unwrap();
    let mut request = vec![0; usize::try_from(len).unwrap()];
    stream.read_exact(&mut request).await.unwrap();
    request
}

/// Connects to the server of a service as a hand-made client, and returns the server's header.
async fn client_by_hand(
    core: &Core,
    service: &str,
    fields: &[(&str, &str)],
) -> (TcpStream, ConnectionHeader) {
    let master = core.address().to_string();
    let found = call_api(&master, "lookupService", &["/by_hand", service]).await;
    let (_, rest) = found.split_once("rosrpc://").unwrap();
    let address = rest.split(['<', '/']).next().unwrap();
    let mut stream = TcpStream::connect(address).await.unwrap();
    let header = fields
        .iter()
        .fold(ConnectionHeader::default(), |h, (name, value)| {
            h.with(name, *value)
        })
        .with("service", service)
        .with("callerid", "/by_hand");
    stream.write_all(&header.encode().unwrap()).await.unwrap();
    let reply = read_header(&mut stream).await;
    (stream, reply)
}

#[tokio::test]
async fn a_request_is_answered_and_the_handler_knows_who_asks() {
    let core = core();
    let (arm, cell) = (node("arm", &core), node("cell", &core));
    let server = offer(&arm, "/grip");
    offered(&cell, "/grip").await;
    let client = client(&cell, "/grip");
    assert_eq!(ask(&client, "close").await.unwrap(), "close");
    assert_eq!(ask(&client, "").await.unwrap(), "");
    assert_eq!(ask(&client, "who").await.unwrap(), "/cell");
    assert_eq!((server.calls(), server.failures()), (3, 0));
    assert_eq!((server.bytes_received(), server.bytes_sent()), (8, 10));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn requests_and_answers_of_every_size_arrive_whole() {
    let core = core();
    let (arm, cell) = (node("arm", &core), node("cell", &core));
    let _server = offer(&arm, "/grip");
    offered(&cell, "/grip").await;
    for client in [client(&cell, "/grip"), persistent(&cell, "/grip")] {
        for size in [0, 1, 4096, 100_000, 1 << 20, 10 << 20] {
            let content: Vec<u8> = (0..=255).cycle().take(size).collect();
            let answer = within("a call", client.call(Bytes::from(content.clone()))).await;
            assert!(answer.unwrap() == content, "{size} bytes differ");
        }
    }
}

#[tokio::test]
async fn a_request_that_fails_panics_or_hangs_costs_only_itself_and_says_why() {
    let core = core();
    let (arm, cell) = (node("arm", &core), node("cell", &core));
    let limits = ServiceOptions {
        handler_timeout: Duration::from_millis(100),
        ..Default::default()
    };
    let server = offer_with(&arm, "/grip", limits);
    offered(&cell, "/grip").await;
    for client in [client(&cell, "/grip"), persistent(&cell, "/grip")] {
        for (request, words) in [
            ("fail", "the gripper is stuck"),
            ("panic", "panicked"),
            ("hang", "did not respond within 100ms"),
        ] {
            let error = ask(&client, request).await.unwrap_err();
            assert!(!error.may_have_run());
            assert!(
                matches!(&error, ServiceError::Failed { message, .. } if message.contains(words)),
                "{error}"
            );
            assert_eq!(ask(&client, "on").await.unwrap(), "on");
        }
    }
    assert_eq!((server.calls(), server.failures()), (12, 6));
}

#[tokio::test]
async fn a_client_of_another_checksum_is_refused_and_one_of_any_is_not() {
    let core = core();
    let (arm, cell) = (node("arm", &core), node("cell", &core));
    let server = offer(&arm, "/grip");
    offered(&cell, "/grip").await;
    let of = |md5sum: &str| {
        let options = ServiceClientOptions {
            md5sum: Some(md5sum.to_owned()),
            ..Default::default()
        };
        cell.service_client("/grip", options).unwrap()
    };
    assert_eq!(ask(&of("*"), "on").await.unwrap(), "on");
    assert_eq!(ask(&of(MD5), "on").await.unwrap(), "on");
    let other = "0".repeat(32);
    let error = ask(&of(&other), "on").await.unwrap_err();
    assert!(
        matches!(&error, ServiceError::Refused { message, .. }
            if message.contains(&other) && message.contains(MD5)),
        "{error}"
    );
    assert_eq!((server.calls(), server.refused()), (2, 1));
}

#[tokio::test]
async fn a_server_of_another_checksum_is_not_asked() {
    let core = core();
    let cell = node("cell", &core);
    let listener = server_by_hand(&core, "/grip").await;
    let options = ServiceClientOptions {
        md5sum: Some("0".repeat(32)),
        ..Default::default()
    };
    let client = cell.service_client("/grip", options).unwrap();
    let (error, (mut stream, _)) = tokio::join!(ask(&client, "on"), accept(&listener));
    assert!(matches!(error, Err(ServiceError::OtherType { theirs, .. }) if theirs.contains(MD5)));
    let mut rest = Vec::new();
    within("the end", stream.read_to_end(&mut rest))
        .await
        .unwrap();
    assert_eq!(rest, b"");
}

#[tokio::test]
async fn a_probe_tells_the_type_without_calling() {
    let core = core();
    let (arm, cell) = (node("arm", &core), node("cell", &core));
    let server = offer(&arm, "/grip");
    offered(&cell, "/grip").await;
    let header = within("the probe", client(&cell, "/grip").probe())
        .await
        .unwrap();
    assert_eq!(header.type_name(), Some("std_srvs/SetBool"));
    assert_eq!((header.md5sum(), header.caller_id()), (Some(MD5), "/arm"));
    assert_eq!(header.get("request_type"), Some("std_srvs/SetBoolRequest"));
    assert_eq!(
        header.get("response_type"),
        Some("std_srvs/SetBoolResponse")
    );
    let (mut stream, _) = client_by_hand(&core, "/grip", &[("md5sum", "*"), ("probe", "1")]).await;
    within("the end", stream.read_to_end(&mut Vec::new()))
        .await
        .unwrap();
    assert_eq!((server.calls(), server.refused()), (0, 0));
}

#[tokio::test]
async fn a_persistent_client_keeps_one_connection_for_calls_from_many_tasks() {
    let core = core();
    let (arm, cell) = (node("arm", &core), node("cell", &core));
    let running = Arc::new(AtomicUsize::new(0));
    let most = Arc::new(AtomicUsize::new(0));
    let (now, peak) = (Arc::clone(&running), Arc::clone(&most));
    let handler = move |request: ServiceRequest| {
        let (now, peak) = (Arc::clone(&now), Arc::clone(&peak));
        async move {
            peak.fetch_max(now.fetch_add(1, Ordering::SeqCst) + 1, Ordering::SeqCst);
            tokio::task::yield_now().await;
            now.fetch_sub(1, Ordering::SeqCst);
            Ok(request.bytes)
        }
    };
    let server = arm
        .advertise_service("/grip", set_bool(), ServiceOptions::default(), handler)
        .unwrap();
    offered(&cell, "/grip").await;
    let client = persistent(&cell, "/grip");
    let calls: Vec<_> = (0..50u8)
        .map(|n| {
            let client = client.clone();
            tokio::spawn(async move { client.call(Bytes::from(vec![n])).await.unwrap() == vec![n] })
        })
        .collect();
    for call in calls {
        assert!(within("the calls", call).await.unwrap());
    }
    assert_eq!((server.clients(), server.calls()), (1, 50));
    assert_eq!(most.load(Ordering::SeqCst), 1);
    drop(client);
    eventually("its leaving", || server.clients() == 0).await;
}

#[tokio::test]
async fn a_persistent_client_finds_a_server_that_came_back_elsewhere() {
    let core = core();
    let cell = node("cell", &core);
    let client = persistent(&cell, "/grip");
    for _ in 0..3 {
        // Another node each time, so another port.
        let arm = node("arm", &core);
        let _server = offer(&arm, "/grip");
        offered(&cell, "/grip").await;
        assert_eq!(ask(&client, "on").await.unwrap(), "on");
        assert_eq!(ask(&client, "off").await.unwrap(), "off");
        within("the shutdown", arm.shutdown()).await;
    }
    let error = ask(&client, "on").await.unwrap_err();
    assert!(
        matches!(error, ServiceError::NotAdvertised { .. }),
        "{error}"
    );
}

#[tokio::test]
async fn a_server_that_does_not_grant_persistence_is_connected_to_for_every_call() {
    let core = core();
    let cell = node("cell", &core);
    let listener = server_by_hand(&core, "/grip").await;
    let client = persistent(&cell, "/grip");
    let mut answered = None;
    for n in 0..20u8 {
        let mut call = pin!(client.call(Bytes::from(vec![n])));
        // The next call begins before the server closes the connection of the previous call.
        let begun = poll_fn(|cx| Poll::Ready(call.as_mut().poll(cx))).await;
        assert!(begun.is_pending(), "{begun:?}");
        drop(answered.take());
        let serve = async {
            let (mut stream, header) = accept(&listener).await;
            assert_eq!(header.get("persistent"), Some("1"));
            let request = take_request(&mut stream).await;
            stream
                .write_all(&[1, 1, 0, 0, 0, request[0]])
                .await
                .unwrap();
            stream
        };
        let both = async { tokio::join!(serve, call) };
        let (stream, answer) = within("the call", both).await;
        assert_eq!(answer.unwrap(), vec![n]);
        answered = Some(stream);
    }
}

/// The kernel holds five connections that a rospy server has not accepted yet, and drops the
/// packets of others.
#[tokio::test]
async fn calls_at_once_connect_a_few_at_a_time_and_all_are_answered() {
    const CALLS: usize = 20;
    const QUIET: Duration = Duration::from_millis(300);
    let core = core();
    let cell = node("cell", &core);
    let listener = server_by_hand(&core, "/grip").await;
    let client = client(&cell, "/grip");
    let mut calls = JoinSet::new();
    for _ in 0..CALLS {
        let client = client.clone();
        calls.spawn(async move { client.call(Bytes::from_static(b"on")).await });
    }
    let mut opening = VecDeque::new();
    while let Ok(accepted) = timeout(QUIET, listener.accept()).await {
        opening.push_back(accepted.unwrap().0);
    }
    assert!((1..=4).contains(&opening.len()), "{}", opening.len());
    let mut open = Vec::new();
    while let Some(mut stream) = opening.pop_front() {
        read_header(&mut stream).await;
        let reply = ConnectionHeader::default().with("md5sum", MD5);
        stream.write_all(&reply.encode().unwrap()).await.unwrap();
        open.push(stream);
        if open.len() + opening.len() < CALLS {
            let accepted = within("the next connection", listener.accept()).await;
            opening.push_back(accepted.unwrap().0);
        }
    }
    // A call that is executed holds up no other.
    for stream in &mut open {
        assert_eq!(take_request(stream).await, b"on");
    }
    for stream in &mut open {
        stream.write_all(b"\x01\x02\0\0\0on").await.unwrap();
    }
    while let Some(answer) = calls.join_next().await {
        assert_eq!(answer.unwrap().unwrap(), "on");
    }
}

#[tokio::test]
async fn a_silent_server_costs_the_time_limit_and_no_more() {
    let core = core();
    let cell = node("cell", &core);
    let listener = server_by_hand(&core, "/grip").await;
    let options = ServiceClientOptions {
        timeout: Duration::from_millis(300),
        ..Default::default()
    };
    let client = cell.service_client("/grip", options).unwrap();
    let start = Instant::now();
    let error = ask(&client, "on").await.unwrap_err();
    assert!(start.elapsed() < Duration::from_secs(3));
    assert!(
        matches!(
            error,
            ServiceError::Timeout {
                phase: CallPhase::Handshake,
                ..
            }
        ),
        "{error}"
    );
    assert!(!error.may_have_run());
    let (_before, _) = listener.accept().await.unwrap();
    let (error, _accepted) = tokio::join!(ask(&client, "on"), accept(&listener));
    let error = error.unwrap_err();
    assert!(
        matches!(
            error,
            ServiceError::Timeout {
                phase: CallPhase::Answer,
                ..
            }
        ),
        "{error}"
    );
    assert!(error.may_have_run());
}

#[tokio::test]
async fn a_registration_left_behind_is_named_with_its_remedy() {
    let core = core();
    let cell = node("cell", &core);
    let listener = server_by_hand(&core, "/grip").await;
    let port = listener.local_addr().unwrap().port();
    drop(listener);
    let error = ask(&client(&cell, "/grip"), "on").await.unwrap_err();
    let text = error.to_string();
    assert!(text.contains("rosnode cleanup"), "{text}");
    assert!(text.contains(&format!("127.0.0.1:{port}")), "{text}");
    assert!(!error.may_have_run());
}

#[tokio::test]
async fn a_service_nobody_offers_and_a_master_that_is_away_are_told_apart() {
    let core = core();
    let cell = node("cell", &core);
    let client = client(&cell, "grip");
    let error = ask(&client, "on").await.unwrap_err();
    assert!(matches!(&error, ServiceError::NotAdvertised { service } if service == "/grip"));
    assert!(error.to_string().contains("rosservice list"), "{error}");
    drop(core);
    let error = ask(&client, "on").await.unwrap_err();
    assert!(matches!(error, ServiceError::Master { .. }), "{error}");
}

#[tokio::test]
async fn what_a_broken_server_answers_is_an_error_of_its_own_kind() {
    let core = core();
    let cell = node("cell", &core);
    let listener = server_by_hand(&core, "/grip").await;
    let options = ServiceClientOptions {
        max_response: 1000,
        ..Default::default()
    };
    let client = cell.service_client("/grip", options).unwrap();
    let answered = async |answer: &[u8]| {
        let serve = async {
            let (mut stream, _) = accept(&listener).await;
            take_request(&mut stream).await;
            stream.write_all(answer).await.unwrap();
        };
        let (called, ()) = tokio::join!(ask(&client, "on"), serve);
        called.unwrap_err()
    };
    let error = answered(&[7]).await;
    assert!(matches!(error, ServiceError::Malformed { .. }) && error.may_have_run());
    let error = answered(&[1, 0, 0, 0, 0x80]).await;
    assert!(matches!(error, ServiceError::AnswerTooLong { .. }) && error.may_have_run());
    let error = answered(&[1, 4, 0, 0, 0, b'x']).await;
    assert!(matches!(error, ServiceError::Lost { .. }) && error.may_have_run());
    let error = answered(&[]).await;
    assert!(matches!(error, ServiceError::Lost { .. }) && error.may_have_run());
    let error = answered(&[0, 2, 0, 0, 0, b'n', b'o']).await;
    assert!(matches!(&error, ServiceError::Failed { message, .. } if message == "no"));
}

#[tokio::test]
async fn a_server_that_greets_with_garbage_is_an_error() {
    let core = core();
    let cell = node("cell", &core);
    let listener = server_by_hand(&core, "/grip").await;
    let client = client(&cell, "/grip");
    for (garbage, lost) in [
        (b"\xff\xff\xff\x7f".as_slice(), false),
        (b"HTTP/1.1 400 Bad Request\r\n\r\n", false),
        (b"\x05\0\0\0\x01\0\0\0a", false),
        (b"\x10", true),
        (b"", true),
    ] {
        let serve = async {
            let (mut stream, _) = listener.accept().await.unwrap();
            read_header(&mut stream).await;
            stream.write_all(garbage).await.unwrap();
        };
        let (called, ()) = tokio::join!(ask(&client, "on"), serve);
        let error = called.unwrap_err();
        assert_eq!(matches!(error, ServiceError::Lost { .. }), lost, "{error}");
        assert_eq!(
            matches!(error, ServiceError::Malformed { .. }),
            !lost,
            "{error}"
        );
        assert!(!error.may_have_run());
    }
}

#[tokio::test]
async fn a_call_given_up_halfway_leaves_nothing_to_the_next() {
    let core = core();
    let (arm, cell) = (node("arm", &core), node("cell", &core));
    let server = offer(&arm, "/grip");
    offered(&cell, "/grip").await;
    let client = persistent(&cell, "/grip");
    assert_eq!(ask(&client, "on").await.unwrap(), "on");
    let hanging = client.call(Bytes::from_static(b"hang"));
    assert!(timeout(Duration::from_millis(200), hanging).await.is_err());
    assert_eq!(ask(&client, "off").await.unwrap(), "off");
    assert_eq!(server.bytes_received(), 2 + 4 + 3);
}

#[tokio::test]
async fn a_request_is_not_sent_after_the_time_until_which_it_may_start() {
    let core = core();
    let cell = node("cell", &core);
    let listener = server_by_hand(&core, "/grip").await;
    for client in [client(&cell, "/grip"), persistent(&cell, "/grip")] {
        let soon = Instant::now() + Duration::from_millis(100);
        let calling = client.call_by(Bytes::from_static(b"on"), Some(soon));
        let serving = async {
            let (stream, _) = within("a client", listener.accept()).await.unwrap();
            // The server accepts the connection header only when the time has passed.
            tokio::time::sleep_until(soon + Duration::from_millis(1)).await;
            let mut stream = greet(stream).await.0;
            let mut rest = Vec::new();
            // The client discards what may wait in its socket.
            let reset = within("the end", stream.read_to_end(&mut rest)).await;
            let kind = reset.map_err(|error| error.kind());
            assert_eq!(kind, Err(ErrorKind::ConnectionReset));
            rest
        };
        let (called, received) = tokio::join!(calling, serving);
        let error = called.unwrap_err();
        assert!(matches!(error, ServiceError::TooLate { .. }), "{error}");
        assert!(!error.may_have_run());
        assert_eq!(received, b"");
        let later = Instant::now() + DEADLINE;
        let calling = client.call_by(Bytes::from_static(b"off"), Some(later));
        let serving = async {
            let (mut stream, _) = accept(&listener).await;
            let request = take_request(&mut stream).await;
            stream.write_all(b"\x01\x02\0\0\0ok").await.unwrap();
            request
        };
        let (called, received) = tokio::join!(calling, serving);
        assert_eq!(called.unwrap(), "ok");
        assert_eq!(received, b"off");
    }
}

#[tokio::test]
async fn clients_that_break_the_protocol_stop_nobody_and_are_counted() {
    let core = core();
    let (arm, cell) = (node("arm", &core), node("cell", &core));
    let server = offer(&arm, "/grip");
    offered(&cell, "/grip").await;
    let keeps = persistent(&cell, "/grip");
    assert_eq!(ask(&keeps, "on").await.unwrap(), "on");
    let any = [("md5sum", "*")];

    let (mut silent, _) = client_by_hand(&core, "/grip", &any).await;
    let (mut huge, _) = client_by_hand(&core, "/grip", &any).await;
    huge.write_all(&[0, 0, 0, 0x80, 1, 2, 3]).await.unwrap();
    let mut told = Vec::new();
    within("an error text", huge.read_to_end(&mut told))
        .await
        .ok();
    assert_eq!(told.first(), Some(&0));
    assert!(
        String::from_utf8_lossy(&told).contains("2147483648"),
        "{told:?}"
    );

    let (mut half, _) = client_by_hand(&core, "/grip", &any).await;
    half.write_all(&[9, 0, 0, 0, 1, 2]).await.unwrap();
    half.shutdown().await.unwrap();
    within("the end", half.read_to_end(&mut Vec::new()))
        .await
        .ok();

    let (mut resets, _) = client_by_hand(&core, "/grip", &any).await;
    resets.write_all(b"\x04\0\0\0hang").await.unwrap();
    eventually("the request", || server.bytes_received() == 6).await;
    SockRef::from(&resets)
        .set_linger(Some(Duration::ZERO))
        .unwrap();
    drop(resets);

    let (_, no_md5) = client_by_hand(&core, "/grip", &[]).await;
    assert!(no_md5.get("error").unwrap().contains("md5sum"));

    assert_eq!(ask(&keeps, "off").await.unwrap(), "off");
    assert_eq!(ask(&client(&cell, "/grip"), "off").await.unwrap(), "off");
    assert_eq!(server.refused(), 3);
    silent.write_all(b"\x02\0\0\0on").await.unwrap();
    let mut answer = [0; 7];
    within("a late request", silent.read_exact(&mut answer))
        .await
        .unwrap();
    assert_eq!(&answer, b"\x01\x02\0\0\0on");
}

#[tokio::test]
async fn a_service_that_is_full_says_so() {
    let core = core();
    let (arm, cell) = (node("arm", &core), node("cell", &core));
    let limits = ServiceOptions {
        max_clients: 2,
        ..Default::default()
    };
    let server = offer_with(&arm, "/grip", limits);
    offered(&cell, "/grip").await;
    let kept = [persistent(&cell, "/grip"), persistent(&cell, "/grip")];
    for client in &kept {
        assert_eq!(ask(client, "on").await.unwrap(), "on");
    }
    let third = client(&cell, "/grip");
    let error = ask(&third, "on").await.unwrap_err();
    assert!(
        matches!(&error, ServiceError::Refused { message, .. } if message.contains("2 clients")),
        "{error}"
    );
    // A probe is still possible.
    assert!(within("the probe", third.probe()).await.is_ok());
    drop(kept);
    eventually("free places", || server.clients() == 0).await;
    assert_eq!(ask(&third, "on").await.unwrap(), "on");
}

#[tokio::test]
async fn requests_sent_ahead_are_answered_in_their_order() {
    let core = core();
    let (arm, cell) = (node("arm", &core), node("cell", &core));
    let _server = offer(&arm, "/grip");
    offered(&cell, "/grip").await;
    let fields = [("md5sum", "*"), ("persistent", "1")];
    let (mut stream, _) = client_by_hand(&core, "/grip", &fields).await;
    stream.write_all(b"\x01\0\0\0a\x01\0\0\0b").await.unwrap();
    let mut answers = [0; 12];
    within("both", stream.read_exact(&mut answers))
        .await
        .unwrap();
    assert_eq!(&answers, b"\x01\x01\0\0\0a\x01\x01\0\0\0b");
}

#[tokio::test]
async fn a_withdrawn_service_leaves_the_master_and_answers_what_it_has_begun() {
    let core = core();
    let (arm, cell) = (node("arm", &core), node("cell", &core));
    let (go, gone) = (
        Arc::new(tokio::sync::Notify::new()),
        Arc::new(AtomicUsize::new(0)),
    );
    let (wait, begun) = (Arc::clone(&go), Arc::clone(&gone));
    let handler = move |request: ServiceRequest| {
        let (wait, begun) = (Arc::clone(&wait), Arc::clone(&begun));
        async move {
            begun.fetch_add(1, Ordering::SeqCst);
            wait.notified().await;
            Ok(request.bytes)
        }
    };
    let server = arm
        .advertise_service("/grip", set_bool(), ServiceOptions::default(), handler)
        .unwrap();
    offered(&cell, "/grip").await;
    let calling = persistent(&cell, "/grip");
    let call = tokio::spawn(async move { calling.call(Bytes::from_static(b"on")).await });
    eventually("the request", || gone.load(Ordering::SeqCst) == 1).await;
    drop(server);
    graph(&cell, "the withdrawal", |g| g.services.is_empty()).await;
    go.notify_one();
    assert_eq!(within("the answer", call).await.unwrap().unwrap(), "on");
    // Under the same name at once, as another service.
    let again = offer(&arm, "/grip");
    offered(&cell, "/grip").await;
    assert_eq!(ask(&client(&cell, "/grip"), "on").await.unwrap(), "on");
    assert_eq!(again.calls(), 1);
}

#[tokio::test]
async fn requests_sent_ahead_do_not_keep_a_withdrawn_service_up() {
    let core = core();
    let (arm, cell) = (node("arm", &core), node("cell", &core));
    let (go, begun) = (
        Arc::new(tokio::sync::Notify::new()),
        Arc::new(AtomicUsize::new(0)),
    );
    let (wait, count) = (Arc::clone(&go), Arc::clone(&begun));
    let handler = move |request: ServiceRequest| {
        let (wait, count) = (Arc::clone(&wait), Arc::clone(&count));
        async move {
            count.fetch_add(1, Ordering::SeqCst);
            wait.notified().await;
            Ok(request.bytes)
        }
    };
    let server = arm
        .advertise_service("/grip", set_bool(), ServiceOptions::default(), handler)
        .unwrap();
    offered(&cell, "/grip").await;
    let fields = [("md5sum", "*"), ("persistent", "1")];
    let (mut stream, _) = client_by_hand(&core, "/grip", &fields).await;
    stream.write_all(b"\x01\0\0\0a\x01\0\0\0b").await.unwrap();
    eventually("the first request", || begun.load(Ordering::SeqCst) == 1).await;
    drop(server);
    go.notify_one();
    // A connection that is closed with an unread request may end in a reset.
    let mut answers = Vec::new();
    let mut byte = [0];
    while let Ok(1) = within("the end", stream.read(&mut byte)).await {
        answers.extend_from_slice(&byte);
    }
    assert_eq!(answers, b"\x01\x01\0\0\0a");
    assert_eq!(begun.load(Ordering::SeqCst), 1);
}

#[tokio::test]
async fn a_service_for_any_number_of_clients_counts_them() {
    let core = core();
    let (arm, cell) = (node("arm", &core), node("cell", &core));
    let limits = ServiceOptions {
        max_clients: usize::MAX,
        ..Default::default()
    };
    let server = offer_with(&arm, "/grip", limits);
    assert_eq!(server.clients(), 0);
    offered(&cell, "/grip").await;
    let kept = persistent(&cell, "/grip");
    assert_eq!(ask(&kept, "on").await.unwrap(), "on");
    assert_eq!(server.clients(), 1);
}

#[tokio::test]
async fn what_a_peer_says_at_length_is_quoted_in_part() {
    let core = core();
    let (arm, cell) = (node("arm", &core), node("cell", &core));
    let _server = offer(&arm, "/grip");
    offered(&cell, "/grip").await;
    let long = "5".repeat(100_000);
    let (_, reply) = client_by_hand(&core, "/grip", &[("md5sum", &long)]).await;
    let error = reply.get("error").unwrap();
    assert!(
        error.contains("md5sum 5555") && error.len() < 500,
        "{error}"
    );

    let listener = server_by_hand(&core, "/long").await;
    let calling = client(&cell, "/long");
    let call = tokio::spawn(async move { ask(&calling, "on").await });
    let (mut stream, _) = within("a client", listener.accept()).await.unwrap();
    read_header(&mut stream).await;
    let refusal = ConnectionHeader::default().with("error", &*long);
    stream.write_all(&refusal.encode().unwrap()).await.unwrap();
    let error = within("the call", call).await.unwrap().unwrap_err();
    assert!(matches!(error, ServiceError::Refused { .. }), "{error}");
    assert!(error.to_string().len() < 500, "{error}");
}

#[tokio::test]
async fn shutdown_ends_in_time_with_a_handler_that_does_not() {
    let core = core();
    let (arm, cell) = (node("arm", &core), node("cell", &core));
    let server = offer(&arm, "/grip");
    let idle = persistent(&cell, "/grip");
    offered(&cell, "/grip").await;
    assert_eq!(ask(&idle, "on").await.unwrap(), "on");
    let client = client(&cell, "/grip");
    let call = tokio::spawn(async move { client.call(Bytes::from_static(b"hang")).await });
    eventually("the request", || server.bytes_received() == 6).await;
    let start = Instant::now();
    within("the shutdown", arm.shutdown()).await;
    assert!(start.elapsed() < Duration::from_secs(4));
    let error = within("the call", call).await.unwrap().unwrap_err();
    assert!(error.to_string().contains("withdrawn"), "{error}");
    assert_eq!(cell.graph().await.unwrap().services.len(), 0);
    assert!(ask(&idle, "on").await.is_err());
}

#[tokio::test]
async fn services_are_registered_again_after_a_restart_of_the_master() {
    let core = core();
    let address = core.address();
    let (arm, cell) = (node("arm", &core), node("cell", &core));
    let _server = offer(&arm, "/grip");
    offered(&cell, "/grip").await;
    let keeps = persistent(&cell, "/grip");
    assert_eq!(ask(&keeps, "on").await.unwrap(), "on");
    drop(core);
    let mut state = arm.master_state();
    within("the loss", state.wait_for(|s| *s == MasterState::Awaited))
        .await
        .unwrap();
    assert_eq!(ask(&keeps, "without").await.unwrap(), "without");
    let _core = Core::start(address).unwrap();
    offered(&cell, "/grip").await;
    assert_eq!(
        ask(&client(&cell, "/grip"), "again").await.unwrap(),
        "again"
    );
}

#[tokio::test]
async fn of_two_nodes_with_one_service_the_last_serves_and_the_first_may_leave() {
    let core = core();
    let (first, second) = (node("first", &core), node("second", &core));
    let early = offer(&first, "/grip");
    offered(&second, "/grip").await;
    let late = offer(&second, "/grip");
    let by = |node: &'static str| {
        move |g: &MasterGraph| g.services.get("/grip").is_some_and(|n| n == &[node])
    };
    graph(&first, "the takeover", by("/second")).await;
    let client = client(&first, "/grip");
    assert_eq!(ask(&client, "on").await.unwrap(), "on");
    assert_eq!((early.calls(), late.calls()), (0, 1));
    drop(early);
    within("the shutdown", first.shutdown()).await;
    assert!(by("/second")(&second.graph().await.unwrap()));
    assert_eq!(ask(&client, "on").await.unwrap(), "on");
}

#[tokio::test]
async fn a_service_is_offered_once_and_with_a_whole_type() {
    let core = core();
    let arm = node("arm", &core);
    let _server = offer(&arm, "/grip");
    let advertise = |name: &str, service_type| {
        arm.advertise_service(name, service_type, ServiceOptions::default(), echo)
    };
    assert!(
        matches!(advertise("grip", set_bool()), Err(NodeError::AlreadyOffered(s)) if s == "/grip")
    );
    let any = ServiceTypeSum {
        md5sum: "*".to_owned(),
        ..set_bool()
    };
    assert!(matches!(
        advertise("/other", any),
        Err(NodeError::ServiceType { .. })
    ));
    assert!(matches!(
        advertise("/a b", set_bool()),
        Err(NodeError::Name(_))
    ));
    let named = arm.service_client("/a b", ServiceClientOptions::default());
    assert!(matches!(named, Err(NodeError::Name(_))));
}

#[tokio::test]
async fn the_statistics_of_a_node_count_its_services() {
    let core = core();
    let (arm, cell) = (node("arm", &core), node("cell", &core));
    let _servers = (offer(&arm, "/grip"), offer(&arm, "/turn"));
    offered(&cell, "/grip").await;
    offered(&cell, "/turn").await;
    assert!(ask(&client(&cell, "/grip"), "four").await.is_ok());
    assert!(ask(&client(&cell, "/turn"), "fail").await.is_err());
    let api = arm
        .uri()
        .trim_start_matches("http://")
        .trim_end_matches('/');
    let stats = call_api(api, "getBusStats", &["/rosnode"]).await;
    // 2 requests with 8 bytes, and 4 + 20 bytes of responses.
    let numbers: Vec<_> = stats.split("<i4>").skip(1).collect();
    let numbers: Vec<_> = numbers
        .iter()
        .map(|n| n.split('<').next().unwrap())
        .collect();
    assert_eq!(numbers, ["1", "2", "8", "24"], "{stats}");
}

#[tokio::test]
async fn a_thousand_calls_and_two_hundred_services_leave_nothing_open() {
    // The few connections of the watchdogs, which open and close.
    const WATCHED: usize = 4;
    let open = || std::fs::read_dir("/proc/self/fd").unwrap().count();
    let alive = || {
        tokio::runtime::Handle::current()
            .metrics()
            .num_alive_tasks()
    };
    let core = core();
    let (arm, cell) = (node("arm", &core), node("cell", &core));
    {
        let _first = offer(&arm, "/first");
        offered(&cell, "/first").await;
    }
    graph(&cell, "quiet", |g| g.services.is_empty()).await;
    let (files, tasks) = (open(), alive());
    let services: Vec<String> = (0..200).map(|n| format!("/s{n}")).collect();
    let servers: Vec<_> = services.iter().map(|s| offer(&arm, s)).collect();
    graph(&cell, "all services", |g| g.services.len() == 200).await;
    let clients: Vec<_> = services.iter().map(|s| persistent(&cell, s)).collect();
    for client in &clients {
        assert_eq!(ask(client, "on").await.unwrap(), "on");
    }
    assert!(open() + WATCHED >= files + 400);
    drop(clients);
    for n in 0..1000 {
        let client = client(&cell, &services[n % 200]);
        assert_eq!(ask(&client, "on").await.unwrap(), "on");
    }
    assert_eq!(servers.iter().map(ServiceServer::calls).sum::<u64>(), 1200);
    drop(servers);
    graph(&cell, "no services", |g| g.services.is_empty()).await;
    eventually("the end of all connections", || {
        open() <= files + WATCHED && alive() <= tasks + WATCHED
    })
    .await;
}
