use std::time::Duration;

use bridge_node::RosEnvironment;

use super::*;
use crate::live::channels::TopicChannels;
use crate::live::described::{AnnouncedDescription, DescribedKind};
use crate::live::robot::RobotModelMessage;

fn published(hub: &ViewerHub, byte: u8, size: usize) {
    hub.publish(&Publication {
        channel: 7,
        time: u64::from(byte),
        data: &vec![byte; size],
    });
}

/// Returns a hub that offers channel 7.
fn hub() -> ViewerHub {
    let hub = ViewerHub::new("239.192.0.40:4840", Assets::default());
    let topic = "ua_1_2_10".parse().unwrap();
    let offered = Offered {
        channel: 7,
        shown: json!({"id": 7}),
    };
    hub.state().offered.insert(Some(topic), vec![offered]);
    hub
}

fn text(client: &ConnectedViewer) -> Value {
    let Next::Text(text) = client.next() else {
        panic!("no message of the protocol");
    };
    serde_json::from_str(&text).unwrap()
}

#[test]
fn a_viewer_gets_the_values_of_its_subscriptions() {
    let hub = hub();
    let (_, client) = hub.connect().unwrap();
    assert_eq!(text(&client)["op"], "serverInfo");
    assert_eq!(text(&client)["channels"][0]["id"], 7);
    published(&hub, 1, 3);
    assert_eq!(client.next(), Next::Nothing, "not subscribed");
    let subscribe = r#"{"op":"subscribe","subscriptions":[{"id":5,"channelId":7}]}"#;
    hub.handle(&client, subscribe);
    assert!(hub.is_wanted(7) && !hub.is_wanted(8));
    published(&hub, 2, 3);
    let wanted = [&[1, 5, 0, 0, 0, 2, 0, 0, 0, 0, 0, 0, 0][..], &[2; 3]].concat();
    assert_eq!(client.next(), Next::Binary(wanted));
    hub.handle(&client, r#"{"op":"unsubscribe","subscriptionIds":[5]}"#);
    assert!(!hub.is_wanted(7));
}

#[test]
fn a_viewer_that_does_not_read_loses_its_oldest_values() {
    let hub = hub();
    let (_, client) = hub.connect().unwrap();
    let subscribe = r#"{"op":"subscribe","subscriptions":[{"id":5,"channelId":7}]}"#;
    hub.handle(&client, subscribe);
    for byte in 0..100 {
        published(&hub, byte, 1 << 20);
    }
    assert!(client.queue().weight <= MOST_WEIGHT);
    while text(&client)["op"] != "status" {}
    let Next::Binary(oldest) = client.next() else {
        panic!("no value");
    };
    assert!(oldest.last() > Some(&90), "the newest values are kept");
    let mut last = oldest;
    while let Next::Binary(value) = client.next() {
        last = value;
    }
    assert_eq!(last.last(), Some(&99));
    assert_eq!(client.queue().weight, 0);
}

#[test]
fn a_viewer_subscribes_to_a_channel_once() {
    let hub = hub();
    let (_, client) = hub.connect().unwrap();
    let subscribe =
        r#"{"op":"subscribe","subscriptions":[{"id":5,"channelId":7},{"id":6,"channelId":7}]}"#;
    hub.handle(&client, subscribe);
    let [.., refused] = [text(&client), text(&client), text(&client)];
    assert_eq!(refused["message"], "channel 7 is subscribed already");
    published(&hub, 1, 3);
    assert!(matches!(client.next(), Next::Binary(_)));
    assert_eq!(client.next(), Next::Nothing);
    hub.handle(&client, r#"{"op":"unsubscribe","subscriptionIds":[5]}"#);
    hub.handle(&client, subscribe);
    assert!(hub.is_wanted(7));
}

#[test]
fn writers_whose_descriptions_alternate_leave_all_subscriptions_in_place() {
    let hub = ViewerHub::new("239.192.0.40:4840", Assets::default());
    let topic: TopicId = "ua_1_2_10".parse().unwrap();
    let (_, client) = hub.connect().unwrap();
    text(&client);
    let mut channels = TopicChannels::new();
    let mut made = |description: &str| {
        let described = Arc::new(AnnouncedDescription {
            name: "Left.Speed".to_owned(),
            description: description.to_owned(),
            ros_topics: Vec::new(),
            command: false,
            what: DescribedKind::Value(Vec::new()),
        });
        let channel = channels.channel(topic, Some(&described), Duration::ZERO);
        channel.unwrap()
    };
    let both = ["; first", "; second"].map(&mut made);
    for channel in &both {
        hub.offer(Some(topic), channel);
        let advertised = text(&client);
        assert_eq!(advertised["op"], "advertise");
        assert_eq!(advertised["channels"][0]["id"], channel.id);
        // The number of a subscription differs from that of its channel.
        client
            .subscribe(u32::from(channel.id) + 40, channel.id)
            .unwrap();
    }
    for _ in 0..3 {
        for channel in &both {
            hub.offer(Some(topic), channel);
            assert!(hub.is_wanted(channel.id));
            hub.publish(&Publication {
                channel: channel.id,
                time: 0,
                data: &[],
            });
            let Next::Binary(value) = client.next() else {
                panic!("a value and nothing else");
            };
            assert_eq!(value[1..5], (u32::from(channel.id) + 40).to_le_bytes());
        }
    }
    let (_, late) = hub.connect().unwrap();
    text(&late);
    let advertised = text(&late);
    let names = [0, 1].map(|at| advertised["channels"][at]["topic"].clone());
    assert_eq!(names, ["/Left/Speed", "/Left/Speed/2"]);
}

#[test]
fn a_viewer_that_writes_and_does_not_read_is_given_up() {
    let hub = hub();
    let (_, client) = hub.connect().unwrap();
    let long = "x".repeat(1 << 20);
    for _ in 0..=MOST_CONTROL >> 20 {
        client.queue_text(long.clone());
    }
    assert!(client.queue().closed);
    client.queue_text(long);
    let queue = client.queue();
    assert!(queue.control.is_empty() && queue.control_weight == 0);
    drop(queue);
    assert_eq!(client.next(), Next::Closed);
    // The notice is kept until the connection looks for it.
    let mut given_up = std::pin::pin!(client.given_up.notified());
    assert!(given_up.as_mut().enable());
}

#[test]
fn a_viewer_cannot_publish_and_the_number_of_viewers_is_limited() {
    let hub = hub();
    let (id, client) = hub.connect().unwrap();
    hub.handle(&client, r#"{"op":"advertise","channels":[]}"#);
    hub.handle(
        &client,
        r#"{"op":"subscribe","subscriptions":[{"id":1,"channelId":9}]}"#,
    );
    let all = [text(&client), text(&client), text(&client), text(&client)];
    let [.., published, subscribed] = &all;
    assert_eq!(
        (&published["op"], &published["level"]),
        (&json!("status"), &json!(2))
    );
    assert!(
        subscribed["message"]
            .as_str()
            .unwrap()
            .contains("not offered")
    );
    for _ in 1..MOST_CLIENTS {
        hub.connect().unwrap();
    }
    assert!(hub.connect().is_none());
    hub.disconnect(id);
    assert!(hub.connect().is_some());
}

#[test]
fn each_subscriber_gets_the_model_of_a_robot_once() {
    let hub = ViewerHub::new("239.192.0.40:4840", Assets::default());
    let model = RobotModelMessage {
        topic: "/robot_description".to_owned(),
        data: vec![1, 2, 3],
    };
    let channel = TopicChannels::new().of_model(&model).unwrap();
    hub.keep(&channel, (9, model.data));
    let subscribe = json!({
        "op": "subscribe",
        "subscriptions": [{"id": 5, "channelId": channel.id}],
    });
    for _ in 0..2 {
        let (_, client) = hub.connect().unwrap();
        text(&client);
        let advertised = &text(&client)["channels"][0];
        assert_eq!(advertised["topic"], "/robot_description");
        assert_eq!(advertised["schemaName"], "std_msgs/msg/String");
        assert_eq!(client.next(), Next::Nothing, "not subscribed");
        hub.handle(&client, &subscribe.to_string());
        let value = [1, 5, 0, 0, 0, 9, 0, 0, 0, 0, 0, 0, 0, 1, 2, 3].to_vec();
        assert_eq!(client.next(), Next::Binary(value));
        assert_eq!(client.next(), Next::Nothing);
    }
}

#[test]
fn files_are_requested_only_from_a_server_that_has_packages() {
    let fetch = r#"{"op":"fetchAsset","uri":"package://arm/a.stl","requestId":7}"#;
    let without = hub();
    let (_, client) = without.connect().unwrap();
    assert_eq!(text(&client)["capabilities"], json!([]));
    text(&client);
    assert_eq!(without.handle(&client, fetch), None);
    assert_eq!(text(&client)["op"], "status");

    let packages = RosEnvironment {
        ros1: vec!["/opt/ros/noetic/share".into()],
        ros2: Vec::new(),
    };
    let with = ViewerHub::new("239.192.0.40:4840", Assets::new(packages));
    let (_, client) = with.connect().unwrap();
    assert_eq!(text(&client)["capabilities"], json!(["assets"]));
    let uri = "package://arm/a.stl".to_owned();
    let request = with.handle(&client, fetch);
    assert_eq!(request, Some(AssetRequest { id: 7, uri }));
    assert_eq!(with.handle(&client, r#"{"op":"fetchAsset"}"#), None);
    assert_eq!(text(&client)["op"], "status");
    client.push_asset(vec![4]);
    assert_eq!(client.next(), Next::Binary(vec![4]));
    assert_eq!(client.next(), Next::Nothing);
}
