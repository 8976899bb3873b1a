//! Services of ROS 2 between us and the middleware of each vendor, in both roles.

#[path = "ros2_services/peer.rs"]
mod peer;

use std::time::Duration;

use bridge_ros2::service::{
    CallPhase, Service, ServiceClient, ServiceClientOptions, ServiceError, ServiceOptions,
    ServiceServer,
};
use bytes::Bytes;
use futures_util::future::join_all;
use nix::sys::signal::Signal;
use serde_json::json;
use system_tests::{Cell, Child, Peer};

use peer::{DONE, Ours, SOON, Vendor, until};

const GRIP: &str = "/arm/grip";
const SET_BOOL: &str = "std_srvs/SetBool";

fn grip() -> Service {
    Service::new(GRIP, &SET_BOOL.parse().unwrap())
}

fn within(timeout: Duration) -> ServiceClientOptions {
    ServiceClientOptions {
        timeout: Some(timeout),
        ..ServiceClientOptions::default()
    }
}

/// A request of `std_srvs/SetBool`.
fn set(on: bool) -> Bytes {
    Bytes::from(vec![0, 1, 0, 0, u8::from(on)])
}

fn client(ours: &Ours, options: ServiceClientOptions) -> ServiceClient {
    ServiceClient::open(&ours.domain, &ours.peers, &grip(), options).unwrap()
}

/// Answers `done` to true and nothing to false.
fn server(ours: &Ours, options: ServiceOptions) -> ServiceServer {
    let handler = async |on: Option<u8>| match on {
        Some(1) => Ok(Bytes::from_static(DONE)),
        Some(_) => Err("the valve is stuck".to_owned()),
        None => Err("a request without a body".to_owned()),
    };
    ServiceServer::open(
        &ours.domain,
        &ours.peers,
        &grip(),
        options,
        move |request| handler(request.bytes.get(4).copied()),
    )
    .unwrap()
}

/// What a server of the other vendor was asked.
fn asked(server: &Child) -> usize {
    server.values().len()
}

async fn a_server_of_theirs_answers(vendor: Vendor) {
    let Some(cell) = Cell::with(vendor.needs()) else {
        return;
    };
    let ours = Ours::join();
    let client = client(&ours, within(SOON));
    // Asked before there is a server: it is waited for.
    let early = tokio::spawn({
        let client = client.clone();
        async move { client.call(set(true)).await }
    });
    let server = vendor.serves(&cell, GRIP, &[]);
    assert_eq!(early.await.unwrap().unwrap()[4], 1);
    let reply = client.call(set(false)).await.unwrap();
    assert!(reply.starts_with(&DONE[..17]), "{reply:?}");
    assert_eq!(server.values()[0]["data"], json!(true));
    assert_eq!(server.values()[1]["data"], json!(false));
    assert_eq!((client.servers(), client.ignored()), (1, 0));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn a_server_of_cyclone_answers_our_client() {
    a_server_of_theirs_answers(Vendor::Cyclone).await;
}

async fn a_client_of_theirs_is_answered(vendor: Vendor) {
    let Some(cell) = Cell::with(vendor.needs()) else {
        return;
    };
    let ours = Ours::join();
    let server = server(&ours, ServiceOptions::default());
    let client = vendor.calls(&cell, GRIP, &["--value", r#"{"data":true}"#]);
    until("the client is answered", || vendor.answers(&client) == 1).await;
    assert_eq!(client.values()[0]["message"], json!("done"));
    assert_eq!(server.counters().calls, 1);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn a_client_of_cyclone_is_answered_by_our_server() {
    a_client_of_theirs_is_answered(Vendor::Cyclone).await;
}

async fn a_hundred_calls_at_once(vendor: Vendor) {
    let Some(cell) = Cell::with(vendor.needs()) else {
        return;
    };
    let ours = Ours::join();
    let theirs = vendor.serves(&cell, GRIP, &[]);
    let client = client(&ours, within(SOON));
    let calls = (0..100).map(|_| client.call(set(true)));
    for reply in join_all(calls).await {
        assert_eq!(reply.unwrap()[4], 1);
    }
    assert_eq!(asked(&theirs), 100);
    drop(theirs);

    let server = server(&ours, ServiceOptions::default());
    let more = ["--value", r#"{"data":true}"#, "--at-once", "100"];
    let caller = vendor.calls(&cell, GRIP, &more);
    until("all are answered", || vendor.answers(&caller) == 100).await;
    assert_eq!(server.counters().calls, 100);
    assert_eq!(server.counters().undelivered, 0);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn a_hundred_calls_at_once_are_answered_by_and_for_cyclone() {
    a_hundred_calls_at_once(Vendor::Cyclone).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn a_client_finds_a_restarted_server_again() {
    let Some(cell) = Cell::with(Vendor::Cyclone.needs()) else {
        return;
    };
    let ours = Ours::join();
    let client = client(&ours, within(SOON));
    for signal in [Signal::SIGKILL, Signal::SIGTERM] {
        let server = Vendor::Cyclone.serves(&cell, GRIP, &[]);
        assert_eq!(client.call(set(true)).await.unwrap()[4], 1);
        server.signal(signal);
    }
    let _server = Vendor::Cyclone.serves(&cell, GRIP, &[]);
    assert_eq!(client.call(set(true)).await.unwrap()[4], 1);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn a_call_whose_server_is_killed_ends_in_time_and_may_have_run() {
    let Some(cell) = Cell::with(Vendor::Cyclone.needs()) else {
        return;
    };
    let ours = Ours::join();
    let server = Vendor::Cyclone.serves(&cell, GRIP, &["--silent"]);
    let limit = Duration::from_secs(2);
    let client = client(&ours, within(limit));
    let call = tokio::spawn({
        let client = client.clone();
        async move { client.call(set(true)).await }
    });
    until("the server is asked", || asked(&server) == 1).await;
    server.signal(Signal::SIGKILL);
    let error = call.await.unwrap().unwrap_err();
    let timeout = ServiceError::Timeout {
        service: GRIP.to_owned(),
        phase: CallPhase::Answer,
        limit,
    };
    assert_eq!(error, timeout);
    assert!(error.may_have_run());
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn a_call_whose_server_leaves_ends_at_once() {
    let Some(cell) = Cell::with(Vendor::Cyclone.needs()) else {
        return;
    };
    let ours = Ours::join();
    let mut server = Vendor::Cyclone.serves(&cell, GRIP, &["--silent", "--leave"]);
    let no_limit = ServiceClientOptions {
        timeout: None,
        ..ServiceClientOptions::default()
    };
    let client = client(&ours, no_limit);
    let call = tokio::spawn(async move { client.call(set(true)).await });
    until("the server is asked", || asked(&server) == 1).await;
    server.tell("leave");
    let error = tokio::time::timeout(SOON, call).await.unwrap().unwrap();
    assert!(matches!(error, Err(ServiceError::Lost { .. })), "{error:?}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn a_call_without_a_server_says_so_and_has_not_run() {
    let Some(_cell) = Cell::with(&[]) else {
        return;
    };
    let ours = Ours::join();
    // One of our own does not count: it is what we tell others of.
    let _server = server(&ours, ServiceOptions::default());
    let client = client(&ours, within(Duration::from_secs(1)));
    let error = client.call(set(true)).await.unwrap_err();
    assert!(
        error.to_string().contains("a node that offers it"),
        "{error}"
    );
    assert!(!error.may_have_run());
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn a_server_of_another_type_is_named() {
    let Some(cell) = Cell::with(Vendor::Cyclone.needs()) else {
        return;
    };
    let ours = Ours::join();
    let _server = cell.cyclone(
        "ros2_service.py",
        &["serve", GRIP, "std_srvs/Trigger", "--domain", "2"],
    );
    let error = client(&ours, within(SOON)).call(set(true)).await;
    let error = error.unwrap_err().to_string();
    assert!(
        error.contains("std_srvs::srv::dds_::Trigger_Request_"),
        "{error}"
    );
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn a_failed_call_gets_no_answer_and_the_next_one_does() {
    let Some(cell) = Cell::with(Vendor::Cyclone.needs()) else {
        return;
    };
    let ours = Ours::join();
    let server = server(&ours, ServiceOptions::default());
    let values = [
        "--value",
        r#"{"data":false}"#,
        "--at-once",
        "1",
        "--wait",
        "1",
    ];
    let failing = Vendor::Cyclone.calls(&cell, GRIP, &values);
    until("the call is given up", || {
        failing
            .json_lines()
            .iter()
            .any(|line| line["unanswered"] == json!(1))
    })
    .await;
    assert_eq!(server.counters().failures, 1);
    let next = Vendor::Cyclone.calls(&cell, GRIP, &["--value", r#"{"data":true}"#]);
    until("the next is answered", || {
        Vendor::Cyclone.answers(&next) == 1
    })
    .await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn garbage_is_counted_and_does_no_harm() {
    let Some(cell) = Cell::with(Vendor::Cyclone.needs()) else {
        return;
    };
    let ours = Ours::join();
    let server = server(&ours, ServiceOptions::default());
    for form in ["short", "bare"] {
        let more = ["garbage", GRIP, SET_BOOL, "--domain", "2", "--form", form];
        let _garbage = cell
            .cyclone_started("ros2_service.py", &more)
            .told()
            .start()
            .ready(SOON);
        // Too short for its header, and a header without a body, which the handler refuses.
        match form {
            "short" => until("ten are malformed", || server.counters().malformed == 10).await,
            _ => until("ten fail", || server.counters().failures == 10).await,
        }
    }
    let next = Vendor::Cyclone.calls(&cell, GRIP, &["--value", r#"{"data":true}"#]);
    until("a call is answered", || Vendor::Cyclone.answers(&next) == 1).await;
    assert_eq!(server.counters().malformed, 10);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn clients_of_different_ways_are_answered_by_one_server_of_ours() {
    let Some(cell) = Cell::with(Vendor::Cyclone.needs()) else {
        return;
    };
    let ours = Ours::join();
    let server = server(&ours, ServiceOptions::default());
    // Of RustDDS, which is served as Fast DDS is.
    let others = Ours::join();
    let enhanced = client(&others, within(SOON));
    let more = ["--value", r#"{"data":true}"#, "--at-once", "50"];
    let cyclone = Vendor::Cyclone.calls(&cell, GRIP, &more);
    let calls = (0..50).map(|_| enhanced.call(set(true)));
    for reply in join_all(calls).await {
        assert_eq!(reply.unwrap()[4], 1);
    }
    until("Cyclone's calls are answered", || {
        Vendor::Cyclone.answers(&cyclone) == 50
    })
    .await;
    let last = cyclone
        .json_lines()
        .into_iter()
        .find(|line| line.get("strange").is_some());
    // No reply in the other way has reached it.
    assert_eq!(last.unwrap()["strange"], json!(0));
    assert_eq!(enhanced.ignored(), 0);
    assert_eq!(server.counters().calls, 100);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn servers_of_different_ways_are_each_asked_in_theirs() {
    let Some(cell) = Cell::with(Vendor::Cyclone.needs()) else {
        return;
    };
    let ours = Ours::join();
    let others = Ours::join();
    let theirs = server(&others, ServiceOptions::default());
    let cyclone = Vendor::Cyclone.serves(&cell, GRIP, &[]);
    let client = client(&ours, within(SOON));
    until("both are found", || client.servers() == 2).await;
    for _ in 0..20 {
        assert_eq!(client.call(set(true)).await.unwrap()[4], 1);
    }
    until("both were asked", || {
        asked(&cyclone) == 20 && theirs.counters().calls == 20
    })
    .await;
    assert_eq!(theirs.counters().malformed, 0);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn of_more_requests_than_may_wait_the_oldest_go() {
    let Some(_cell) = Cell::with(&[]) else {
        return;
    };
    let ours = Ours::join();
    let others = Ours::join();
    let options = ServiceOptions {
        max_handled: 1,
        max_waiting: 2,
        handler_timeout: Some(Duration::from_millis(400)),
    };
    let slow = ServiceServer::open(&others.domain, &others.peers, &grip(), options, |_| {
        std::future::pending()
    })
    .unwrap();
    let client = client(&ours, within(Duration::from_secs(2)));
    let calls = join_all((0..10).map(|_| client.call(set(true)))).await;
    assert!(
        calls
            .iter()
            .all(|call| call.as_ref().is_err_and(ServiceError::may_have_run))
    );
    let counters = slow.counters();
    assert_eq!(counters.calls + counters.overflowed, 10, "{counters:?}");
    assert!(counters.overflowed >= 5, "{counters:?}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn more_calls_than_allowed_are_refused_and_others_go_on() {
    let Some(_cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let ours = Ours::join();
    let options = ServiceClientOptions {
        timeout: Some(Duration::from_millis(500)),
        max_calls: 3,
    };
    let client = client(&ours, options);
    let calls = join_all((0..5).map(|_| client.call(set(true)))).await;
    let busy = |call: &&Result<Bytes, ServiceError>| matches!(call, Err(ServiceError::Busy { .. }));
    assert_eq!(calls.iter().filter(busy).count(), 2);
    // Those that were given up make room.
    let next = client.call(set(true)).await;
    assert!(
        matches!(next, Err(ServiceError::Timeout { .. })),
        "{next:?}"
    );
}
