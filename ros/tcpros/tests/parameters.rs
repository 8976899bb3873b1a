//! Parameters, simulated time, names and the environment, around a master in this process.

#![expect(clippy::unwrap_used, clippy::panic, reason = "test code")]

use std::future::Future;
use std::net::{Ipv4Addr, Ipv6Addr, SocketAddr};
use std::time::Duration;

use bytes::Bytes;
use tcpros::{
    Core, Inbox, InboxEvent, MasterState, Node, NodeOptions, ParamError, ParamSubscription,
    ParamValue, Publisher, PublisherOptions, RequestedType, Ros1Time, SubscriberOptions, TopicType,
};
use tokio::time::timeout;

const DEADLINE: Duration = Duration::from_secs(20);

fn core() -> Core {
    Core::start(SocketAddr::from((Ipv4Addr::LOCALHOST, 0))).unwrap()
}

fn options(name: &str, master: &str) -> NodeOptions {
    let mut options = NodeOptions::from_env(name);
    master.clone_into(&mut options.master_uri);
    "/line".clone_into(&mut options.namespace);
    options.advertise_as("127.0.0.1");
    options
}

fn with_arguments(name: &str, core: &Core, arguments: &[&str]) -> Node {
    let mut options = options(name, core.uri());
    assert_eq!(options.apply_arguments(arguments).unwrap().len(), 0);
    Node::start(options).unwrap()
}

fn node(name: &str, core: &Core) -> Node {
    with_arguments(name, core, &[])
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

async fn reaches(node: &Node, wanted: MasterState) {
    let mut state = node.master_state();
    within("the state", state.wait_for(|s| *s == wanted))
        .await
        .unwrap();
}

async fn registered(node: &Node) {
    reaches(node, MasterState::Registered).await;
}

async fn next(subscription: &mut ParamSubscription) -> Option<ParamValue> {
    within("a value", subscription.recv()).await.unwrap()
}

/// Starts a master at the address of the previous master.
async fn again(address: SocketAddr) -> Core {
    within("the port", async {
        loop {
            match Core::start(address) {
                Ok(core) => return core,
                Err(_) => tokio::task::yield_now().await,
            }
        }
    })
    .await
}

fn clock_publisher(node: &Node) -> Publisher {
    let clock = TopicType {
        name: "rosgraph_msgs/Clock".to_owned(),
        md5sum: "a9c97c1d230cfc112e270351a944ee47".to_owned(),
        definition: "time clock\n".to_owned(),
    };
    let options = PublisherOptions {
        latch: true,
        ..Default::default()
    };
    node.advertise("/clock", clock, options).unwrap()
}

fn tick(clock: &Publisher, secs: u32) {
    let time = [secs.to_le_bytes(), 5_u32.to_le_bytes()].concat();
    assert_eq!(clock.publish(Bytes::from(time)).dropped_oldest, 0);
}

fn string() -> TopicType {
    TopicType {
        name: "std_msgs/String".to_owned(),
        md5sum: "992ce8a1687cec8c8bd883ec73ca41d1".to_owned(),
        definition: "string data\n".to_owned(),
    }
}

#[tokio::test]
async fn every_kind_of_value_is_set_and_read_back() {
    let core = core();
    let node = node("n", &core);
    let parameters = node.parameters();
    let all: ParamValue = [
        ("flag", ParamValue::from(true)),
        ("count", i32::MIN.into()),
        ("ratio", 0.1.into()),
        ("text", "ä <&> \"x\"\n".into()),
        ("at", ParamValue::DateTime("20261121T23:59:59".to_owned())),
        ("bytes", ParamValue::Binary(vec![0, 255, 10])),
        ("list", vec![1, 2].into()),
        (
            "inner",
            [("deep", [("er", 3)])]
                .map(|(n, v)| (n, ParamValue::from(v)))
                .into(),
        ),
    ]
    .into();
    parameters.set("all", all.clone()).await.unwrap();
    assert_eq!(parameters.get("/line/all").await.unwrap(), Some(all));
    assert_eq!(
        parameters.get("all/inner/deep/er").await.unwrap(),
        Some(3.into())
    );
    assert_eq!(parameters.get("all/none").await.unwrap(), None);
    assert!(parameters.has("all/inner").await.unwrap());
    assert!(
        parameters
            .names()
            .await
            .unwrap()
            .contains(&"/line/all/inner/deep/er".to_owned())
    );
    let tree = parameters.get("/").await.unwrap().unwrap();
    assert!(
        tree.as_map().unwrap()["run_id"]
            .as_str()
            .is_some_and(|id| !id.is_empty())
    );
    assert!(parameters.delete("all").await.unwrap());
    assert!(!parameters.delete("all").await.unwrap());
    assert!(!parameters.has("all").await.unwrap());
}

#[tokio::test]
async fn names_of_parameters_are_names_of_the_graph() {
    let core = core();
    let node = with_arguments("n", &core, &["gains:=/shared/gains"]);
    let parameters = node.parameters();
    parameters.set("~rate", 5).await.unwrap();
    parameters.set("gains/p", 1.5).await.unwrap();
    assert_eq!(parameters.names().await.unwrap()[0], "/line/gains/p");
    assert_eq!(
        parameters.get("/line/n/rate").await.unwrap(),
        Some(5.into())
    );
    let found = async |name| parameters.search(name).await.unwrap();
    parameters.set("/limits/low", -1).await.unwrap();
    assert_eq!(found("limits/low").await.as_deref(), Some("/limits/low"));
    assert_eq!(found("rate").await.as_deref(), Some("/line/n/rate"));
    assert_eq!(found("none").await, None);
    for bad in ["", "a b", "1a"] {
        assert!(
            matches!(parameters.get(bad).await, Err(ParamError::Name(_))),
            "{bad}"
        );
        assert!(parameters.subscribe(bad).is_err(), "{bad}");
    }
}

#[tokio::test]
async fn parameters_outlive_the_borrow_of_their_node_and_fail_without_a_master() {
    let core = core();
    let node = node("n", &core);
    let parameters = node.parameters();
    let set = tokio::spawn(async move {
        parameters.set("/a", 1).await.unwrap();
        parameters
    });
    let parameters = set.await.unwrap();
    drop(core);
    assert!(matches!(
        parameters.get("/a").await,
        Err(ParamError::Master(_))
    ));
}

#[tokio::test]
async fn a_subscription_tells_the_value_now_and_each_change() {
    let core = core();
    let (ours, theirs) = (node("ours", &core), node("theirs", &core));
    let (ours, other) = (ours.parameters(), (theirs.parameters(), theirs));
    let other = &other.0;
    let mut rate = ours.subscribe("rate").unwrap();
    assert_eq!((rate.name(), rate.current()), ("/line/rate", None));
    assert_eq!(next(&mut rate).await, None);
    other.set("rate", 5).await.unwrap();
    assert_eq!(next(&mut rate).await, Some(5.into()));
    assert_eq!(rate.current(), Some(5.into()));
    // The master does not notify a node of its own changes.
    ours.set("rate", 6).await.unwrap();
    assert_eq!(next(&mut rate).await, Some(6.into()));
    // A later subscription starts with the known value.
    let mut second = ours.subscribe("rate").unwrap();
    assert_eq!(next(&mut second).await, Some(6.into()));
    drop(second);
    other.delete("/line").await.unwrap();
    assert_eq!(next(&mut rate).await, None);
}

#[tokio::test]
async fn a_subscribed_namespace_changes_with_what_it_holds() {
    let core = core();
    let (ours, theirs) = (node("ours", &core), node("theirs", &core));
    let other = theirs.parameters();
    other.set("/gains", [("p", 1), ("i", 2)]).await.unwrap();
    let mut gains = ours.parameters().subscribe("/gains").unwrap();
    let mut deep = ours.parameters().subscribe("/gains/d/max").unwrap();
    assert_eq!(next(&mut gains).await, Some([("p", 1), ("i", 2)].into()));
    assert_eq!(next(&mut deep).await, None);
    other.set("/gains/p", 3).await.unwrap();
    assert_eq!(next(&mut gains).await, Some([("p", 3), ("i", 2)].into()));
    other.delete("/gains/i").await.unwrap();
    assert_eq!(next(&mut gains).await, Some([("p", 3)].into()));
    other.set("/gains/d", [("max", 9)]).await.unwrap();
    assert_eq!(next(&mut deep).await, Some(9.into()));
    other
        .set("/gains", ParamValue::Map(Default::default()))
        .await
        .unwrap();
    assert_eq!(next(&mut deep).await, None);
    eventually("the emptied namespace", || {
        gains.current() == Some(ParamValue::Map(Default::default()))
    })
    .await;
    other.delete("/gains").await.unwrap();
    eventually("the deleted namespace", || gains.current().is_none()).await;
}

#[tokio::test]
async fn changes_that_come_faster_than_they_are_taken_become_the_newest() {
    let core = core();
    let (ours, theirs) = (node("ours", &core), node("theirs", &core));
    let mut n = ours.parameters().subscribe("/n").unwrap();
    assert_eq!(next(&mut n).await, None);
    for value in 0..50 {
        theirs.parameters().set("/n", value).await.unwrap();
    }
    eventually("the newest", || n.current() == Some(49.into())).await;
    assert_eq!(next(&mut n).await, Some(49.into()));
}

#[tokio::test]
async fn a_subscription_goes_through_a_restart_of_the_master() {
    let first = core();
    let address = first.address();
    let (ours, theirs) = (node("ours", &first), node("theirs", &first));
    let mut rate = ours.parameters().subscribe("/rate").unwrap();
    theirs.parameters().set("/rate", 5).await.unwrap();
    eventually("the value", || rate.current() == Some(5.into())).await;
    assert_eq!(next(&mut rate).await, Some(5.into()));
    drop(first);
    reaches(&ours, MasterState::Awaited).await;
    assert_eq!(rate.current(), Some(5.into()));
    let _second = again(address).await;
    assert_eq!(next(&mut rate).await, None);
    theirs.parameters().set("/rate", 7).await.unwrap();
    assert_eq!(next(&mut rate).await, Some(7.into()));
}

#[tokio::test]
async fn the_end_of_a_node_ends_its_subscriptions_and_leaves_no_name_behind() {
    let core = core();
    let (ours, theirs) = (node("ours", &core), node("theirs", &core));
    let mut rate = ours.parameters().subscribe("/rate").unwrap();
    let parameters = ours.parameters();
    assert_eq!(next(&mut rate).await, None);
    let uri = ours.uri().to_owned();
    assert!(known_as(&core, "/line/ours").await.contains(&uri));
    within("the shutdown", ours.shutdown()).await;
    assert!(matches!(rate.recv().await, Err(ParamError::NodeEnded)));
    assert!(!known_as(&core, "/line/ours").await.contains(&uri));
    let mut late = parameters.subscribe("/rate").unwrap();
    assert!(matches!(late.recv().await, Err(ParamError::NodeEnded)));
    theirs.parameters().set("/rate", 1).await.unwrap();
    assert_eq!(parameters.get("/rate").await.unwrap(), Some(1.into()));
}

/// Returns the reply of the master to `lookupNode`.
async fn known_as(core: &Core, name: &str) -> String {
    call(
        core.address(),
        &format!(
            "<methodCall><methodName>lookupNode</methodName><params><param><value>/test</value></param>\
             <param><value>{name}</value></param></params></methodCall>"
        ),
    )
    .await
}

async fn call(address: SocketAddr, body: &str) -> String {
    use tokio::io::{AsyncReadExt, AsyncWriteExt};
    let mut stream = tokio::net::TcpStream::connect(address).await.unwrap();
    let head = "POST / HTTP/1.1\r\nHost: x\r\nConnection: close\r\nContent-Length:";
    let request = format!("{head} {}\r\n\r\n{body}", body.len());
    stream.write_all(request.as_bytes()).await.unwrap();
    let mut answer = String::new();
    within("the answer", stream.read_to_string(&mut answer))
        .await
        .unwrap();
    answer
}

#[tokio::test]
async fn private_parameters_of_the_command_line_are_there_when_the_node_is_registered() {
    let first = core();
    let address = first.address();
    let arguments = [
        "_rate:=5",
        "_frame:=map",
        "_gains:={p: 0.5}",
        "~old:=~new",
        "_old:=1",
    ];
    let node = with_arguments("n", &first, &arguments);
    registered(&node).await;
    let parameters = node.parameters();
    let own = parameters.get("~").await.unwrap().unwrap();
    let own = own.as_map().unwrap();
    assert_eq!(own["rate"], 5.into());
    assert_eq!(own["frame"], "map".into());
    assert_eq!(own["gains"], [("p", 0.5)].into());
    assert_eq!((own.get("old"), &own["new"]), (None, &1.into()));
    // A restarted master gets the parameters again, except for parameters that were set in the
    // meantime.
    drop(first);
    reaches(&node, MasterState::Awaited).await;
    let second = again(address).await;
    parameters.set("~rate", 6).await.unwrap();
    registered(&node).await;
    let own = parameters.get("~").await.unwrap().unwrap();
    assert_eq!(own.as_map().unwrap()["rate"], 6.into());
    assert_eq!(own.as_map().unwrap()["frame"], "map".into());
    drop(second);
}

#[tokio::test]
async fn the_clock_follows_use_sim_time_and_the_topic_clock() {
    let core = core();
    let (ours, simulator) = (node("ours", &core), node("simulator", &core));
    let clock = ours.clock();
    registered(&ours).await;
    assert!(!clock.is_simulated() && ours.now().secs > 1_700_000_000);
    simulator
        .parameters()
        .set("/use_sim_time", true)
        .await
        .unwrap();
    eventually("simulated time", || clock.is_simulated()).await;
    assert_eq!(ours.now(), Ros1Time::default());
    let publisher = clock_publisher(&simulator);
    tick(&publisher, 100);
    eventually("the time", || {
        clock.now()
            == Ros1Time {
                secs: 100,
                nsecs: 5,
            }
    })
    .await;
    tick(&publisher, 7);
    eventually("the jump back", || ours.now().secs == 7).await;
    simulator
        .parameters()
        .set("/use_sim_time", false)
        .await
        .unwrap();
    eventually("the wall clock", || !clock.is_simulated()).await;
    assert!(clock.now().secs > 1_700_000_000);
    eventually("no subscriber", || publisher.subscribers() == 0).await;
    assert!(
        !ours
            .graph()
            .await
            .unwrap()
            .subscribers
            .contains_key("/clock")
    );
}

#[tokio::test]
async fn a_node_that_starts_in_a_simulation_is_simulated_when_it_is_registered() {
    let core = core();
    let simulator = node("simulator", &core);
    simulator
        .parameters()
        .set("/use_sim_time", true)
        .await
        .unwrap();
    let publisher = clock_publisher(&simulator);
    tick(&publisher, 3);
    let late = node("late", &core);
    registered(&late).await;
    assert!(late.clock().is_simulated());
    eventually("the latched time", || late.now().secs == 3).await;
}

#[tokio::test]
async fn watching_the_master_and_reconnecting_go_on_while_simulated_time_stands_still_or_jumps_back()
 {
    let first = core();
    let address = first.address();
    let (ours, simulator) = (node("ours", &first), node("simulator", &first));
    simulator
        .parameters()
        .set("/use_sim_time", true)
        .await
        .unwrap();
    let clock = clock_publisher(&simulator);
    tick(&clock, 1000);
    eventually("the time", || ours.now().secs == 1000).await;
    let inbox: Inbox<()> = Inbox::new();
    let options = SubscriberOptions::default();
    let heard = ours
        .subscribe("/t", RequestedType::default(), options, (), &inbox)
        .unwrap();
    let publisher = simulator
        .advertise("/t", string(), Default::default())
        .unwrap();
    eventually("the link", || heard.publishers() == 1).await;
    tick(&clock, 2);
    eventually("the jump back", || ours.now().secs == 2).await;
    // From here on the clock publishes nothing. The publisher and the master are stopped and
    // restarted.
    drop(publisher);
    eventually("the loss of the link", || heard.publishers() == 0).await;
    let publisher = simulator
        .advertise("/t", string(), Default::default())
        .unwrap();
    eventually("the new link", || heard.publishers() == 1).await;
    drop(first);
    reaches(&ours, MasterState::Awaited).await;
    let before = ours.now();
    let _second = again(address).await;
    registered(&ours).await;
    within("the registrations", async {
        loop {
            let graph = ours.graph().await.unwrap();
            if graph.subscribers.contains_key("/t") && graph.publishers.contains_key("/t") {
                return;
            }
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
    })
    .await;
    assert_eq!(before, Ros1Time { secs: 2, nsecs: 5 });
    // The new master has no simulated time.
    eventually("the wall clock", || !ours.clock().is_simulated()).await;
    drop(publisher);
}

#[tokio::test]
async fn the_first_of_two_nodes_of_one_name_leaves_and_takes_nothing_of_the_second_with_it() {
    let core = core();
    let first = node("twin", &core);
    let held = first.advertise("/a", string(), Default::default()).unwrap();
    registered(&first).await;
    let second = node("twin", &core);
    let _kept = second
        .advertise("/a", string(), Default::default())
        .unwrap();
    let reason = within("the request", first.shutdown_requested()).await;
    assert!(reason.contains("/line/twin"), "{reason}");
    registered(&second).await;
    // Later registrations of the first node must not displace the second node.
    let late = first
        .advertise("/late", string(), Default::default())
        .unwrap();
    let mut rate = first.parameters().subscribe("/rate").unwrap();
    let mut asked_second = Box::pin(second.shutdown_requested());
    let nothing = timeout(Duration::from_secs(2), async {
        tokio::select! {
            _ = &mut asked_second => {}
            _ = rate.recv() => {}
        }
    });
    assert!(nothing.await.is_err(), "the first has registered again");
    within("the shutdown", first.shutdown()).await;
    drop((held, late, rate));
    let graph = second.graph().await.unwrap();
    assert_eq!(graph.publishers.keys().collect::<Vec<_>>(), ["/a"]);
    assert!(known_as(&core, "/line/twin").await.contains(second.uri()));
    // The second node still receives parameter updates.
    let mut heard = second.parameters().subscribe("/heard").unwrap();
    second.parameters().set("/heard", 1).await.unwrap();
    eventually("the value", || heard.current() == Some(1.into())).await;
    assert_eq!(next(&mut heard).await, Some(1.into()));
}

#[tokio::test]
async fn nodes_that_are_known_by_an_ipv6_address_talk_over_it() {
    let core = Core::start(SocketAddr::from((Ipv6Addr::LOCALHOST, 0))).unwrap();
    let node = |name: &str| {
        let mut options = options(name, core.uri());
        options.ipv6 = true;
        options.advertise_as("::1");
        Node::start(options).unwrap()
    };
    let (talker, listener) = (node("talker"), node("listener"));
    assert!(
        talker.uri().starts_with("http://[::1]:"),
        "{}",
        talker.uri()
    );
    let publisher = talker
        .advertise("/t", string(), Default::default())
        .unwrap();
    let mut inbox: Inbox<()> = Inbox::new();
    let options = SubscriberOptions::default();
    let _heard = listener
        .subscribe("/t", RequestedType::default(), options, (), &inbox)
        .unwrap();
    eventually("the link", || publisher.subscribers() == 1).await;
    assert_eq!(publisher.publish(Bytes::from_static(b"six")).sent_to, 1);
    let bytes = within("the message", async {
        loop {
            if let ((), InboxEvent::Message(message)) = inbox.recv().await {
                return message.bytes;
            }
        }
    });
    assert_eq!(bytes.await, b"six".as_slice());
    listener.parameters().set("/a", 1).await.unwrap();
}
