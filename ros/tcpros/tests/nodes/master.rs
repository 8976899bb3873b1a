//! The node and its master: started late, restarted, and up to date with all topics and services.

use std::time::Duration;

use bytes::Bytes;
use tcpros::{
    Core, Inbox, InboxEvent, MasterState, Node, NodeError, Publisher, PublisherOptions,
    ServiceOptions, ServiceRequest, ServiceTypeSum, TopicType,
};

use crate::support::*;

#[tokio::test]
async fn a_node_that_starts_before_its_master_registers_when_it_comes() {
    let placeholder = core();
    let address = placeholder.address();
    drop(placeholder);
    let early = Node::start(options("early", &format!("http://{address}"))).unwrap();
    let _publisher = advertise(&early, "/t", PublisherOptions::default());
    assert_eq!(*early.master_state().borrow(), MasterState::Awaited);
    let core = within("the port", async {
        loop {
            match Core::start(address) {
                Ok(core) => return core,
                Err(_) => tokio::task::yield_now().await,
            }
        }
    })
    .await;
    registered(&early).await;
    let graph = early.graph().await.unwrap();
    assert_eq!(graph.publishers["/t"], ["/early"]);
    assert_eq!(graph.types["/t"], "std_msgs/String");
    drop(core);
}

#[tokio::test]
async fn after_a_restart_of_the_master_all_is_registered_again_and_links_have_stayed() {
    let core = core();
    let address = core.address();
    let (talker, listener) = (node("talker", &core), node("listener", &core));
    let mut inbox = Inbox::new();
    let subscription = subscribe(&listener, "/t", &inbox);
    let publisher = advertise(&talker, "/t", PublisherOptions::default());
    eventually("the link", || publisher.subscribers() == 1).await;
    registered(&listener).await;
    drop(core);
    let mut state = talker.master_state();
    within("the loss", state.wait_for(|s| *s == MasterState::Awaited))
        .await
        .unwrap();
    assert_eq!(publisher.publish(Bytes::from_static(b"without")).sent_to, 1);
    assert_eq!(message(&mut inbox).await.bytes, b"without".as_slice());

    let _core = Core::start(address).unwrap();
    within("the new registrations", async {
        loop {
            let graph = talker.graph().await.unwrap_or_default();
            let known =
                |of: &std::collections::BTreeMap<String, Vec<String>>| of.contains_key("/t");
            if known(&graph.publishers) && known(&graph.subscribers) {
                return;
            }
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
    })
    .await;
    assert_eq!((publisher.subscribers(), subscription.publishers()), (1, 1));
    assert_eq!(publisher.publish(Bytes::from_static(b"again")).sent_to, 1);
    assert_eq!(message(&mut inbox).await.bytes, b"again".as_slice());
}

/// Requirement: registrations that `rosnode cleanup` removes from the master while the master still
/// knows the node are registered again.
#[tokio::test]
async fn what_the_master_no_longer_lists_is_registered_again() {
    let core = core();
    let node = node("node", &core);
    let inbox = Inbox::new();
    let _subscription = subscribe(&node, "/heard", &inbox);
    let _publisher = advertise(&node, "/said", PublisherOptions::default());
    let _kept = advertise(&node, "/kept", PublisherOptions::default());
    let service_type = ServiceTypeSum {
        name: "std_srvs/Trigger".to_owned(),
        md5sum: MD5.to_owned(),
        request_type: "std_srvs/TriggerRequest".to_owned(),
        response_type: "std_srvs/TriggerResponse".to_owned(),
    };
    let echo = |request: ServiceRequest| async move { Ok(request.bytes) };
    let _service = node
        .advertise_service("/done", service_type, ServiceOptions::default(), echo)
        .unwrap();
    let listed = async || {
        let graph = node.graph().await.unwrap();
        let own = ["/node".to_owned()];
        let has = |of: Option<&Vec<String>>| of.is_some_and(|nodes| *nodes == own);
        [
            has(graph.publishers.get("/said")),
            has(graph.subscribers.get("/heard")),
            has(graph.services.get("/done")),
            has(graph.publishers.get("/kept")),
        ]
    };
    let all_listed = async || while listed().await != [true; 4] {};
    within("the registrations", all_listed()).await;
    let uri = node.uri();
    call(core.uri(), "unregisterPublisher", &["/node", "/said", uri]).await;
    call(
        core.uri(),
        "unregisterSubscriber",
        &["/node", "/heard", uri],
    )
    .await;
    let state = call(core.uri(), "lookupService", &["/node", "/done"]).await;
    let at = state.find("rosrpc://").unwrap();
    let service_uri = state[at..].split('<').next().unwrap();
    call(
        core.uri(),
        "unregisterService",
        &["/node", "/done", service_uri],
    )
    .await;
    assert_eq!(listed().await, [false, false, false, true]);
    within("the new registrations", async {
        while listed().await != [true; 4] {
            tokio::time::sleep(Duration::from_millis(50)).await;
        }
    })
    .await;
}

/// Requirement: if two nodes with the same name start in the same instant, one ends, and the other
/// keeps all its registrations.
#[tokio::test]
async fn of_two_nodes_of_one_name_that_start_at_once_exactly_one_stays() {
    let core = core();
    for round in 0..10 {
        let nodes = [node("twin", &core), node("twin", &core)];
        let topics = |of: usize| (0..100).map(move |n| format!("/r{round}/n{of}/t{n}"));
        let publishers = [0, 1].map(|of| {
            let advertise = |topic: String| advertise(&nodes[of], &topic, Default::default());
            topics(of).map(advertise).collect::<Vec<_>>()
        });
        let [a, b] = [nodes[0].shutdown_requested(), nodes[1].shutdown_requested()];
        let first = within("the end of one", async {
            tokio::select! { reason = a => (0, reason), reason = b => (1, reason) }
        });
        let (lost, reason) = first.await;
        let stays = 1 - lost;
        let [first, second] = nodes;
        let (loser, winner) = if lost == 0 {
            (first, second)
        } else {
            (second, first)
        };
        within("the end", loser.shutdown()).await;
        let all_listed = async {
            loop {
                let graph = winner.graph().await.unwrap();
                if topics(stays).all(|topic| graph.publishers.contains_key(&topic)) {
                    return;
                }
                tokio::time::sleep(Duration::from_millis(20)).await;
            }
        };
        tokio::select! {
            reason = winner.shutdown_requested() => panic!("the other ends as well: {reason}"),
            () = within("all that it registers", all_listed) => {}
        }
        assert!(
            reason.contains(&format!("/twin runs at {}", winner.uri())),
            "{reason}"
        );
        winner.shutdown().await;
        drop(publishers);
    }
}

#[tokio::test]
async fn shutdown_leaves_nothing_in_the_master_and_delivers_what_was_queued() {
    let core = core();
    let (talker, listener) = (node("talker", &core), node("listener", &core));
    let mut inbox = Inbox::new();
    let mut held: Vec<Publisher> = (0..40)
        .map(|n| advertise(&talker, &format!("/t{n}"), Default::default()))
        .collect();
    let own = subscribe(&talker, "/own", &inbox);
    let _subscription = subscribe(&listener, "/t0", &inbox);
    eventually("the link", || held[0].subscribers() == 1).await;
    registered(&talker).await;
    assert_eq!(held[0].publish(Bytes::from_static(b"farewell")).sent_to, 1);
    drop(held.pop());
    within("the shutdown", talker.shutdown()).await;
    let graph = listener.graph().await.unwrap();
    assert_eq!(graph.publishers.len(), 0);
    assert_eq!(graph.subscribers.keys().collect::<Vec<_>>(), ["/t0"]);
    assert_eq!(message(&mut inbox).await.bytes, b"farewell".as_slice());
    assert_eq!(held[0].publish(Bytes::new()).sent_to, 0);
    drop(own);
}

#[tokio::test]
async fn a_dropped_publisher_leaves_the_graph_and_its_subscribers_learn_it() {
    let core = core();
    let (talker, listener) = (node("talker", &core), node("listener", &core));
    let mut inbox = Inbox::new();
    let subscription = subscribe(&listener, "/t", &inbox);
    let publisher = advertise(&talker, "/t", PublisherOptions::default());
    within("the link", async {
        while !matches!(
            inbox.recv().await.1,
            InboxEvent::Peer {
                connected: true,
                publishers: 1,
                ..
            }
        ) {}
    })
    .await;
    drop(publisher);
    within("the end", async {
        while !matches!(
            inbox.recv().await.1,
            InboxEvent::Peer {
                connected: false,
                publishers: 0,
                ..
            }
        ) {}
    })
    .await;
    assert_eq!(subscription.publishers(), 0);
    // The topic may be advertised again at once, with another type.
    let other = TopicType {
        name: "std_msgs/Other".to_owned(),
        ..string()
    };
    let again = talker
        .advertise("/t", other, PublisherOptions::default())
        .unwrap();
    eventually("the link", || again.subscribers() == 1).await;
    assert_eq!(talker.graph().await.unwrap().types["/t"], "std_msgs/Other");
}

#[tokio::test]
async fn a_topic_is_published_once_and_with_a_whole_type() {
    let core = core();
    let talker = node("talker", &core);
    let _publisher = advertise(&talker, "/t", PublisherOptions::default());
    let twice = talker.advertise("t", string(), PublisherOptions::default());
    assert!(matches!(twice, Err(NodeError::AlreadyPublished(topic)) if topic == "/t"));
    let any = TopicType {
        md5sum: "*".to_owned(),
        ..string()
    };
    assert!(matches!(
        talker.advertise("/u", any, Default::default()),
        Err(NodeError::Type { .. })
    ));
    let named = talker.advertise("/a b", string(), Default::default());
    assert!(matches!(named, Err(NodeError::Name(_))));
}

#[tokio::test]
async fn two_hundred_topics_leave_no_file_descriptor_behind() {
    // Descriptors are counted in a process without the other tests, which open and close files.
    if std::env::var_os(ALONE).is_none() {
        let name = "master::two_hundred_topics_leave_no_file_descriptor_behind";
        let alone = std::process::Command::new(std::env::current_exe().unwrap())
            .args(["--exact", name])
            .env(ALONE, "1")
            .output()
            .unwrap();
        let told = String::from_utf8_lossy(&alone.stdout);
        assert!(
            alone.status.success() && told.contains("1 passed"),
            "{told}"
        );
        return;
    }
    let open = || std::fs::read_dir("/proc/self/fd").unwrap().count();
    let core = core();
    let (talker, listener) = (node("talker", &core), node("listener", &core));
    registered(&talker).await;
    registered(&listener).await;
    let alive = || {
        tokio::runtime::Handle::current()
            .metrics()
            .num_alive_tasks()
    };
    eventually("quiet", || alive() <= 9).await;
    let (files, tasks) = (open(), alive());
    let inbox = Inbox::new();
    let topics: Vec<String> = (0..200).map(|n| format!("/t{n}")).collect();
    let publishers: Vec<_> = topics
        .iter()
        .map(|t| advertise(&talker, t, PublisherOptions::default()))
        .collect();
    let subscriptions: Vec<_> = topics
        .iter()
        .map(|t| subscribe(&listener, t, &inbox))
        .collect();
    eventually("all links", || {
        publishers.iter().all(|p| p.subscribers() == 1)
    })
    .await;
    assert!(open() >= files + 400);
    drop((publishers, subscriptions));
    // Except for the few connections of the watchdogs, which open and close.
    eventually("the end of all links", || {
        open() <= files + 4 && alive() <= tasks + 4
    })
    .await;
}

/// Environment variable that marks the only test of its process.
const ALONE: &str = "UA_TEST_ALONE";
