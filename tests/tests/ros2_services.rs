//! Services of ROS 2 between this workspace and the middleware of each vendor, in both roles.

mod bindings;
mod peer;
mod secured;

use std::time::Duration;

use bytes::Bytes;
use futures_util::future::join_all;
use nix::sys::signal::Signal;
use ros2_node::service::{
    CallPhase, ServiceClient, ServiceClientOptions, ServiceError, ServiceName, ServiceOptions,
    ServiceServer,
};
use serde_json::json;
use system_tests::{Cell, Peer};
use tokio::time::Instant;

use peer::{
    DONE, SET_BOOL, SOON, ServiceParticipant, Vendor, cyclone_calls, cyclone_serves, until,
};

const GRIP: &str = "/arm/grip";

fn grip() -> ServiceName {
    ServiceName::new(GRIP, &SET_BOOL.parse().unwrap())
}

fn within(timeout: Duration) -> ServiceClientOptions {
    ServiceClientOptions {
        timeout: Some(timeout),
        ..ServiceClientOptions::default()
    }
}

/// Encodes a request of `std_srvs/SetBool`.
fn set(on: bool) -> Bytes {
    Bytes::from(vec![0, 1, 0, 0, u8::from(on)])
}

fn client(ours: &ServiceParticipant, options: ServiceClientOptions) -> ServiceClient {
    ServiceClient::open(&ours.domain, &ours.peers, &grip(), options).unwrap()
}

/// Creates a server that answers `done` to true and nothing to false.
fn server(ours: &ServiceParticipant, options: ServiceOptions) -> ServiceServer {
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

async fn a_server_of_theirs_answers(vendor: Vendor) {
    let Some(cell) = Cell::with(vendor.needs()) else {
        return;
    };
    let ours = ServiceParticipant::join();
    let client = client(&ours, within(SOON));
    // Called before a server exists: the client waits for the server.
    let early = tokio::spawn({
        let client = client.clone();
        async move { client.call(set(true)).await }
    });
    let server = vendor.serves(&cell, GRIP);
    assert_eq!(early.await.unwrap().unwrap()[4], 1);
    let reply = client.call(set(false)).await.unwrap();
    assert!(reply.starts_with(&DONE[..17]), "{reply:?}");
    until("the server has said so", || {
        vendor.asked(&server) == [true, false]
    })
    .await;
    assert_eq!((client.servers(), client.ignored()), (1, 0));
    until("it says that it knows us", || client.acquainted() == 1).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn a_server_of_cyclone_answers_our_client() {
    a_server_of_theirs_answers(Vendor::Cyclone).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn a_server_of_fast_dds_answers_our_client() {
    a_server_of_theirs_answers(Vendor::FastDds).await;
}

async fn a_hundred_calls_at_once(vendor: Vendor) {
    let Some(cell) = Cell::with(vendor.needs()) else {
        return;
    };
    let ours = ServiceParticipant::join();
    let theirs = vendor.serves(&cell, GRIP);
    let client = client(&ours, within(SOON));
    let calls = (0..100).map(|_| client.call(set(true)));
    for reply in join_all(calls).await {
        assert_eq!(reply.unwrap()[4], 1);
    }
    until("each was asked once", || vendor.asked(&theirs).len() == 100).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn a_hundred_calls_at_once_are_answered_by_cyclone() {
    a_hundred_calls_at_once(Vendor::Cyclone).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn a_hundred_calls_at_once_are_answered_by_fast_dds() {
    a_hundred_calls_at_once(Vendor::FastDds).await;
}

async fn a_client_of_theirs_is_answered(vendor: Vendor) {
    let Some(cell) = Cell::with(vendor.needs()) else {
        return;
    };
    let ours = ServiceParticipant::join();
    let server = server(&ours, ServiceOptions::default());
    let client = vendor.calls(&cell, GRIP, 100);
    until("the client is done", || vendor.answers(&client).is_some()).await;
    assert_eq!(vendor.answers(&client), Some((100, 0)));
    let counters = server.counters();
    assert_eq!((counters.calls, counters.undelivered), (100, 0));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn a_hundred_calls_of_cyclone_are_answered_by_our_server() {
    a_client_of_theirs_is_answered(Vendor::Cyclone).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn a_hundred_calls_of_fast_dds_are_answered_by_our_server() {
    a_client_of_theirs_is_answered(Vendor::FastDds).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn a_client_finds_a_killed_server_again_even_as_one_of_another_vendor() {
    let Some(cell) = Cell::with(&[Peer::Python, Peer::FastDds]) else {
        return;
    };
    let ours = ServiceParticipant::join();
    let client = client(&ours, within(Duration::from_secs(1)));
    for vendor in [Vendor::Cyclone, Vendor::FastDds, Vendor::Cyclone] {
        let server = vendor.serves(&cell, GRIP);
        // Until the lease of a killed server ends, a call may go to it alone.
        let deadline = Instant::now() + SOON;
        while let Err(error) = client.call(set(true)).await {
            assert!(error.may_have_run(), "{error}");
            assert!(Instant::now() < deadline, "{error}");
        }
        server.signal(Signal::SIGKILL);
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn a_call_whose_server_is_killed_ends_in_time_and_may_have_run() {
    let Some(cell) = Cell::with(Vendor::Cyclone.needs()) else {
        return;
    };
    let ours = ServiceParticipant::join();
    let server = cyclone_serves(&cell, GRIP, &["--silent"]);
    let limit = Duration::from_secs(2);
    let client = client(&ours, within(limit));
    let call = tokio::spawn({
        let client = client.clone();
        async move { client.call(set(true)).await }
    });
    until("the server is asked", || {
        Vendor::Cyclone.asked(&server).len() == 1
    })
    .await;
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
    let ours = ServiceParticipant::join();
    let mut server = cyclone_serves(&cell, GRIP, &["--silent", "--leave"]);
    let no_limit = ServiceClientOptions {
        timeout: None,
        ..ServiceClientOptions::default()
    };
    let client = client(&ours, no_limit);
    let call = tokio::spawn(async move { client.call(set(true)).await });
    until("the server is asked", || {
        Vendor::Cyclone.asked(&server).len() == 1
    })
    .await;
    server.tell("leave");
    let error = tokio::time::timeout(SOON, call).await.unwrap().unwrap();
    assert!(matches!(error, Err(ServiceError::Lost { .. })), "{error:?}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn a_call_without_a_server_says_so_and_has_not_run() {
    let Some(_cell) = Cell::with(&[]) else {
        return;
    };
    let ours = ServiceParticipant::join();
    // Our own server does not count: it is the server that we offer to others.
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
    let ours = ServiceParticipant::join();
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
    let ours = ServiceParticipant::join();
    let server = server(&ours, ServiceOptions::default());
    let values = [
        "--value",
        r#"{"data":false}"#,
        "--at-once",
        "1",
        "--wait",
        "1",
    ];
    let failing = cyclone_calls(&cell, GRIP, &values);
    until("the call is given up", || {
        failing
            .json_lines()
            .iter()
            .any(|line| line["unanswered"] == json!(1))
    })
    .await;
    assert_eq!(server.counters().failures, 1);
    let next = Vendor::Cyclone.calls(&cell, GRIP, 1);
    until("the next is answered", || {
        Vendor::Cyclone.answers(&next) == Some((1, 0))
    })
    .await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn garbage_is_counted_and_does_no_harm() {
    let Some(cell) = Cell::with(Vendor::Cyclone.needs()) else {
        return;
    };
    let ours = ServiceParticipant::join();
    let server = server(&ours, ServiceOptions::default());
    for form in ["short", "bare"] {
        let more = ["garbage", GRIP, SET_BOOL, "--domain", "2", "--form", form];
        let _garbage = cell
            .cyclone_started("ros2_service.py", &more)
            .told()
            .start()
            .ready(SOON);
        // A request too short for its header, and a header without a body, which the handler
        // refuses.
        match form {
            "short" => until("ten are malformed", || server.counters().malformed == 10).await,
            _ => until("ten fail", || server.counters().failures == 10).await,
        }
    }
    let next = Vendor::Cyclone.calls(&cell, GRIP, 1);
    until("a call is answered", || {
        Vendor::Cyclone.answers(&next) == Some((1, 0))
    })
    .await;
    assert_eq!(server.counters().malformed, 10);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn clients_of_both_vendors_are_answered_by_one_server_of_ours() {
    let Some(cell) = Cell::with(&[Peer::Python, Peer::FastDds]) else {
        return;
    };
    let ours = ServiceParticipant::join();
    let server = server(&ours, ServiceOptions::default());
    let both = [
        Vendor::Cyclone,
        Vendor::FastDds,
        Vendor::Cyclone,
        Vendor::FastDds,
    ];
    let clients = both.map(|vendor| (vendor, vendor.calls(&cell, GRIP, 50)));
    for (vendor, client) in &clients {
        until("the client is done", || vendor.answers(client).is_some()).await;
        // Replies to other clients of the vendor also arrive, and are ignored.
        assert_eq!(vendor.answers(client).unwrap().0, 50);
    }
    let counters = server.counters();
    assert_eq!(
        (counters.calls, counters.malformed, counters.undelivered),
        (200, 0, 0)
    );
}

/// Requests of Cyclone DDS do not name the reader of their participant that waits for the reply.
#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn each_more_client_of_one_cyclone_participant_is_answered() {
    const CLIENTS: usize = 20;
    let Some(cell) = Cell::with(Vendor::Cyclone.needs()) else {
        return;
    };
    let ours = ServiceParticipant::join();
    let server = server(&ours, ServiceOptions::default());
    let how = ["--anew", "--settle", "0"];
    let requests = [["--value", r#"{"data":true}"#]; CLIENTS].concat();
    let clients = cyclone_calls(&cell, GRIP, &[&how[..], &requests].concat());
    until("they are done", || {
        Vendor::Cyclone.answers(&clients).is_some()
    })
    .await;
    assert_eq!(Vendor::Cyclone.answers(&clients).unwrap().0, CLIENTS);
    assert_eq!(server.counters().undelivered, 0);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn servers_of_both_vendors_are_each_asked_in_their_way() {
    let Some(cell) = Cell::with(&[Peer::Python, Peer::FastDds]) else {
        return;
    };
    let ours = ServiceParticipant::join();
    let servers =
        [Vendor::Cyclone, Vendor::FastDds].map(|vendor| (vendor, vendor.serves(&cell, GRIP)));
    let client = client(&ours, within(SOON));
    until("both are found", || client.servers() == 2).await;
    for turn in 0..20 {
        assert_eq!(client.call(set(turn % 2 == 0)).await.unwrap()[4], 1);
    }
    let wanted: Vec<bool> = (0..20).map(|turn| turn % 2 == 0).collect();
    for (vendor, server) in &servers {
        until("it was asked all", || vendor.asked(server) == wanted).await;
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn of_more_requests_than_may_wait_the_oldest_go() {
    let Some(_cell) = Cell::with(&[]) else {
        return;
    };
    let ours = ServiceParticipant::join();
    let others = ServiceParticipant::join();
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
    let ours = ServiceParticipant::join();
    let options = ServiceClientOptions {
        timeout: Some(Duration::from_millis(500)),
        max_calls: 3,
    };
    let client = client(&ours, options);
    let calls = join_all((0..5).map(|_| client.call(set(true)))).await;
    let busy = |call: &&Result<Bytes, ServiceError>| matches!(call, Err(ServiceError::Busy { .. }));
    assert_eq!(calls.iter().filter(busy).count(), 2);
    // Calls that timed out make room.
    let next = client.call(set(true)).await;
    assert!(
        matches!(next, Err(ServiceError::Timeout { .. })),
        "{next:?}"
    );
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn a_server_of_ours_says_when_it_knows_a_client() {
    let Some(_cell) = Cell::with(&[]) else {
        return;
    };
    let (ours, others) = (ServiceParticipant::join(), ServiceParticipant::join());
    let client = client(&ours, within(SOON));
    let server = server(&others, ServiceOptions::default());
    until("it says that it knows us", || client.acquainted() == 1).await;
    assert_eq!(client.servers(), 1);
    drop(server);
    until("it is gone", || client.servers() + client.acquainted() == 0).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn a_request_is_not_sent_to_a_server_that_comes_after_its_time() {
    let Some(_cell) = Cell::with(&[]) else {
        return;
    };
    let (ours, others) = (ServiceParticipant::join(), ServiceParticipant::join());
    let client = client(&ours, within(SOON));
    let start_by = Instant::now() + Duration::from_millis(100);
    let late = tokio::spawn({
        let client = client.clone();
        async move { client.call_by(set(true), Some(start_by)).await }
    });
    until("its time has passed", || Instant::now() > start_by).await;
    let server = server(&others, ServiceOptions::default());
    let error = late.await.unwrap().unwrap_err();
    assert!(matches!(error, ServiceError::TooLate { .. }), "{error}");
    assert!(!error.may_have_run());
    assert_eq!(client.call(set(true)).await.unwrap(), DONE);
    assert_eq!(server.counters().calls, 1);
}
