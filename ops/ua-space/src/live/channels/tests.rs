use uadp::{DataSetHeader, NetworkHeader, NetworkMessage, NetworkMessageEncoder};

use super::*;

const NOW: Duration = Duration::from_secs(10);

fn topic(text: &str) -> TopicId {
    text.parse().unwrap()
}

fn described(description: &str, fields: &[(&str, BuiltinType)]) -> Arc<AnnouncedDescription> {
    let fields = fields.iter();
    let fields = fields.map(|(name, builtin)| AnnouncedField::plain(name, *builtin, None));
    Arc::new(AnnouncedDescription {
        name: "Robot.Place".to_owned(),
        description: description.to_owned(),
        ros_topics: vec![(2, "/place".to_owned())],
        command: false,
        what: DescribedKind::Value(fields.collect()),
    })
}

/// Returns the message of a value in its channel.
fn encoded(channel: &TopicChannel, values: &[Scalar<'_>]) -> Result<Vec<u8>, ChannelMismatch> {
    let mut datagram = Vec::new();
    let none = NetworkHeader::default();
    let mut writer = NetworkMessageEncoder::new(&mut datagram, &none, None).unwrap();
    let mut frame = writer.key_frame(&DataSetHeader::default()).unwrap();
    for value in values {
        frame.scalar(*value).unwrap();
    }
    frame.finish().unwrap();
    writer.finish().unwrap();
    let message = NetworkMessage::decode(&datagram).unwrap();
    let message = message.messages().next().unwrap().unwrap();
    let mut out = Vec::new();
    channel.encode(&message, &mut out).map(|()| out)
}

const XYZ: [(&str, BuiltinType); 3] = [
    ("x", BuiltinType::Double),
    ("y", BuiltinType::Double),
    ("z", BuiltinType::Double),
];

#[test]
fn fields_of_a_ros_message_are_that_message_again() {
    let mut channels = TopicChannels::new();
    let point = described("geometry_msgs/Point", &XYZ);
    let channel = channels.channel(topic("ua_2_5_10"), Some(&point), NOW);
    let channel = channel.unwrap();
    assert_eq!((channel.name.as_str(), channel.encoding), ("/place", "cdr"));
    assert_eq!(channel.schema_name, "geometry_msgs/msg/Point");
    assert_eq!(channel.schema_encoding, "ros2msg");
    assert!(channel.schema.contains("float64 x"), "{}", channel.schema);
    let bytes = encoded(&channel, &[1.0, 2.0, 3.0].map(Scalar::Double)).unwrap();
    let mut wanted = vec![0, 1, 0, 0];
    wanted.extend([1.0_f64, 2.0, 3.0].map(f64::to_le_bytes).concat());
    assert_eq!(bytes, wanted);
    let wrong = encoded(&channel, &[Scalar::Byte(1)]);
    assert_eq!(wrong, Err(ChannelMismatch::Mismatch));
}

#[test]
fn other_values_are_json_under_their_own_names() {
    let mut channels = TopicChannels::new();
    let x = described("", &XYZ[..1]);
    let mut all = Vec::new();
    for id in ["ua_2_5_10", "ua_2_5_11"] {
        all.push(channels.channel(topic(id), Some(&x), NOW).unwrap());
    }
    let names: Vec<&str> = all.iter().map(|channel| channel.name.as_str()).collect();
    assert_eq!(names, ["/Robot/Place", "/Robot/Place/ua_2_5_11"]);
    let bytes = encoded(&all[0], &[Scalar::Double(0.5)]).unwrap();
    assert_eq!(bytes, b"{\"x\":0.5}");
    let schema: Value = serde_json::from_str(&all[0].schema).unwrap();
    assert_eq!(schema["properties"]["x"]["type"], "number");
}

#[test]
fn a_type_without_definition_is_json_and_is_named() {
    let mut channels = TopicChannels::new();
    let made_up = described("no_msgs/Such", &XYZ);
    let channel = channels.channel(topic("ua_2_5_10"), Some(&made_up), NOW);
    assert_eq!(channel.unwrap().encoding, "json");
    assert!(channels.unknown().contains("no_msgs/Such"));
    // The type is known, but the writer has other fields.
    let other = described("geometry_msgs/Point", &[("w", BuiltinType::Double)]);
    let channel = channels.channel(topic("ua_2_5_11"), Some(&other), NOW);
    assert_eq!(channel.unwrap().encoding, "json");
}

#[test]
fn values_wait_for_their_description_and_a_new_description_makes_a_new_channel() {
    let mut channels = TopicChannels::new();
    let of = topic("ua_2_5_10");
    let early = channels.channel(of, None, NOW);
    assert_eq!(early.unwrap_err(), ChannelMismatch::Undescribed);
    let late = channels.channel(of, None, NOW + DESCRIBED_WITHIN).unwrap();
    assert_eq!((late.name.as_str(), late.encoding), ("/ua_2_5_10", "json"));
    let point = described("geometry_msgs/Point", &XYZ);
    let first = channels.channel(of, Some(&point), NOW).unwrap();
    let again = channels.channel(of, Some(&point.clone()), NOW).unwrap();
    assert!(first.id > late.id && first.id == again.id);
}

#[test]
fn each_description_of_a_topic_has_one_channel_and_their_number_is_limited() {
    let mut channels = TopicChannels::new();
    let of = topic("ua_2_5_10");
    let [first, second] = ["first", "second"].map(|text| described(text, &XYZ));
    let one = channels.channel(of, Some(&first), NOW).unwrap().id;
    let two = channels.channel(of, Some(&second), NOW).unwrap().id;
    assert_ne!(one, two);
    for _ in 0..3 {
        for (described, id) in [(&first, one), (&second, two)] {
            let again = channels.channel(of, Some(described), NOW).unwrap();
            assert_eq!(again.id, id);
            assert_eq!(channels.channel(of, None, NOW).unwrap().id, id);
        }
    }
    for number in 2..MOST_OF_TOPIC {
        let other = described(&number.to_string(), &XYZ);
        channels.channel(of, Some(&other), NOW).unwrap();
    }
    let other = described("other", &XYZ);
    let refused = channels.channel(of, Some(&other), NOW);
    assert_eq!(refused.unwrap_err(), ChannelMismatch::Channels);
    assert_eq!(channels.channel(of, Some(&first), NOW).unwrap().id, one);
}

#[test]
fn keep_alives_heartbeats_and_invalid_messages_are_no_values() {
    let valid = DataSetHeader::default();
    let invalid = DataSetHeader {
        valid: false,
        ..valid
    };
    let mut datagram = Vec::new();
    let none = NetworkHeader::default();
    let ids: [u16; 4] = [1, 2, 3, 4];
    let mut writer = NetworkMessageEncoder::new(&mut datagram, &none, Some(&ids)).unwrap();
    for header in [valid, invalid] {
        let mut frame = writer.key_frame(&header).unwrap();
        frame.scalar(Scalar::Byte(1)).unwrap();
        frame.finish().unwrap();
    }
    writer.heartbeat(&valid).unwrap();
    writer.keep_alive(&valid).unwrap();
    writer.finish().unwrap();
    let message = NetworkMessage::decode(&datagram).unwrap();
    let all = message.messages().map(|one| is_value(&one.unwrap()));
    let all: Vec<bool> = all.collect();
    assert_eq!(all, [true, false, false, false]);
}
