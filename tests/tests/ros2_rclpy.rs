//! bridge-ros2 with nodes of ROS 2 itself, rclpy over Fast DDS, of each distribution that is
//! available as a peer.

use std::{collections::BTreeSet, time::Duration};

use serde_json::{Value, json};
use system_tests::{Cell, Child, Distribution, Judge, Peer, UaSide};
use uadp::Scalar;

const NODE: &str = "/ua_bridge_ros2";
const SOON: Duration = Duration::from_secs(20);

const CELL: &str = "
spaces:
  - {id: 2}
namespaces:
  2: urn:test
variables:
  - {node: ns=2;i=1, name: Said, type: String, origin: 2, ros: {topic: /said, type: std_msgs/String, field: data}}
  - {node: ns=2;i=2, name: Lamp, type: Boolean, origin: 0, ros: {space: 2, topic: /lamp, type: std_msgs/Bool, field: data}}
  - {node: ns=2;i=3, name: Light, type: Boolean, origin: 0, ros: {space: 2, call: /light, type: std_srvs/SetBool, field: data}}
  - {node: ns=2;i=5, name: Odd, type: String, origin: 2, ros: {topic: /odd, type: std_msgs/String, field: data}}
  - {node: ns=2;i=4, name: Answer, origin: 2, ros: {answer: ns=2;i=3, field: message}}
";

/// Runs a test for each distribution, in a separate cell.
fn each(test: impl Fn(&Cell, Distribution)) {
    for distribution in Distribution::ALL {
        let Some(cell) = Cell::with(&[Peer::Ros2]) else {
            return;
        };
        test(&cell, distribution);
    }
}

/// Returns the names in a list of names and types.
fn names(of: &Value) -> BTreeSet<&str> {
    let pairs = of.as_array().unwrap().iter();
    pairs.map(|pair| pair[0].as_str().unwrap()).collect()
}

/// Waits for the bridge's only endpoint of that kind on a topic and the endpoint of the judge, and
/// returns both.
fn endpoints(judge: &mut Judge, topic: &str, kind: &str) -> (Value, Value) {
    judge.until(&json!({"topic": topic}), |endpoints| {
        let all = || endpoints.as_array().into_iter().flatten();
        let own = all().find(|one| one["node"] == "/judge/judge")?;
        let bridge: Vec<_> = all()
            .filter(|one| one["node"] == NODE && one["kind"] == kind)
            .collect();
        let [bridge] = bridge[..] else {
            return None;
        };
        Some((bridge.clone(), own.clone()))
    })
}

#[test]
fn a_node_of_ros_2_sees_nothing_odd_in_the_bridge() {
    each(|cell, distribution| {
        let file = cell.file("cell.yaml", CELL);
        let _bridge = cell.bridge_ros2(&[file.to_str().unwrap()]);
        let mut judge = cell.judge(distribution, &["judge"]);
        judge.until(&json!({"nodes": 1}), |nodes| {
            (*nodes == json!(["/judge/judge", NODE])).then_some(())
        });

        // The node as in `ros2 node info`.
        let info = judge.until(&json!({"info": NODE}), |info| {
            let there = names(&info["publishers"]).contains("/lamp")
                && names(&info["subscribers"]).contains("/said")
                && names(&info["services"]).len() == 7;
            there.then(|| info.clone())
        });
        assert_eq!(
            info["publishers"],
            json!([
                ["/lamp", ["std_msgs/msg/Bool"]],
                ["/parameter_events", ["rcl_interfaces/msg/ParameterEvent"]],
                ["/rosout", ["rcl_interfaces/msg/Log"]],
            ]),
            "{distribution:?}"
        );
        assert_eq!(
            info["subscribers"],
            json!([
                ["/odd", ["std_msgs/msg/String"]],
                ["/said", ["std_msgs/msg/String"]],
            ])
        );
        // An rclpy node has the same services.
        let own = judge.ask(json!({"info": "/judge/judge"}));
        let tails = |info: &Value, node: &str| -> BTreeSet<String> {
            let all = names(&info["services"]).into_iter();
            all.map(|name| name.strip_prefix(node).unwrap_or(name).to_owned())
                .collect()
        };
        assert_eq!(tails(&info, NODE), tails(&own, "/judge/judge"));
        assert_eq!(
            info["clients"],
            json!([["/light", ["std_srvs/srv/SetBool"]]])
        );
        assert_eq!(
            (&info["action servers"], &info["action clients"]),
            (&json!([]), &json!([]))
        );

        // The endpoints as in `ros2 topic info -v`, compared with an rclpy endpoint on the same
        // topic.
        for (topic, kind, of_type) in [
            ("/said", "SUBSCRIPTION", "std_msgs/msg/String"),
            ("/lamp", "PUBLISHER", "std_msgs/msg/Bool"),
        ] {
            judge.ask(json!({"publish": topic, "type": of_type}));
            let (bridge, own) = endpoints(&mut judge, topic, kind);
            for field in ["type", "hash", "liveliness", "deadline", "lifespan"] {
                assert_eq!(
                    bridge[field], own[field],
                    "{distribution:?} {topic} {field}"
                );
            }
        }
        // The topics that every node publishes are equal in every respect.
        for topic in ["/rosout", "/parameter_events"] {
            let (mut bridge, own) = endpoints(&mut judge, topic, "PUBLISHER");
            bridge["node"] = own["node"].clone();
            assert_eq!(bridge, own, "{distribution:?} {topic}");
        }
        let topics = judge.ask(json!({"topics": 1}));
        assert_eq!(
            topics,
            json!({
                "/odd": ["std_msgs/msg/String"],
                "/said": ["std_msgs/msg/String"],
                "/lamp": ["std_msgs/msg/Bool"],
                "/rosout": ["rcl_interfaces/msg/Log"],
                "/parameter_events": ["rcl_interfaces/msg/ParameterEvent"],
            })
        );
    });
}

#[test]
fn a_node_of_ros_2_lists_describes_and_gets_the_parameters_and_may_not_set_them() {
    each(|cell, distribution| {
        let _bridge = cell.bridge_ros2(&[]);
        let mut judge = cell.judge(distribution, &["judge"]);
        let parameters = judge.ask(json!({"parameters": NODE}));
        let parameters = parameters.as_object().unwrap();
        let known: Vec<_> = parameters.keys().map(String::as_str).collect();
        assert_eq!(known, ["domain", "space", "use_sim_time"]);
        let space = &parameters["space"];
        assert_eq!((&space["value"], &space["type"]), (&json!(2), &json!(2)));
        assert_eq!(parameters["use_sim_time"]["value"], false);
        for (name, parameter) in parameters {
            assert_eq!(parameter["described"], name.as_str(), "{distribution:?}");
            assert_eq!(parameter["described type"], parameter["type"]);
            assert_ne!(parameter["description"], "");
            assert_eq!(parameter["read only"], true);
        }
        let refused = judge.ask(json!({"set": NODE, "name": "space", "value": 3}));
        assert_eq!(refused["successful"], false);
        assert_ne!(refused["reason"], "");
        let unknown = judge.ask(json!({"set": NODE, "name": "nothing", "value": 3}));
        assert_eq!(unknown["successful"], false);
    });
}

#[test]
fn values_and_calls_cross_to_and_from_a_node_of_ros_2() {
    each(|cell, distribution| {
        let file = cell.file("cell.yaml", CELL);
        let mut ua = UaSide::join();
        let _bridge = cell.bridge_ros2(&[file.to_str().unwrap()]);
        let mut judge = cell.judge(distribution, &["judge"]);
        judge.ask(json!({"subscribe": "/lamp", "type": "std_msgs/msg/Bool"}));
        judge.ask(
            json!({"subscribe": "/rosout", "type": "rcl_interfaces/msg/Log",
                         "qos": {"durability": "TRANSIENT_LOCAL", "depth": 1000}}),
        );
        let say = |data: &str| json!({"publish": "/said", "type": "std_msgs/msg/String", "value": {"data": data}});
        judge.until(
            &json!({"publish": "/said", "type": "std_msgs/msg/String"}),
            |subscribers| (*subscribers == 1).then_some(()),
        );
        judge.ask(say("grüße"));
        ua.hear_scalar((2, 2, 1), Scalar::String(Some("grüße")));
        ua.write((0, 2, 2), Scalar::Boolean(true));
        let lit = judge.hears("/lamp", |value| Some(value["data"].clone()));
        assert_eq!(lit, true, "{distribution:?}");

        // A state is retried until its service is available.
        ua.write((0, 2, 3), Scalar::Boolean(true));
        judge.ask(json!({"serve": "/light", "type": "std_srvs/srv/SetBool",
                         "value": {"success": true, "message": "lit"}}));
        ua.hear_scalar((2, 2, 4), Scalar::String(Some("lit")));
        let asked = judge
            .child()
            .wait_for_json("a call", SOON, |line| Some(line.get("asked")?.clone()));
        assert_eq!(asked, "/light");

        // The bridge's warnings, here about a publisher of another type, are shown in rqt_console.
        judge.ask(json!({"publish": "/odd", "type": "std_msgs/msg/Bool"}));
        judge.ask(
            json!({"subscribe": "/rosout", "type": "rcl_interfaces/msg/Log",
                         "qos": {"durability": "TRANSIENT_LOCAL", "depth": 1000}}),
        );
        let logged = judge.hears("/rosout", |log| {
            (log["name"] == "ua_bridge_ros2").then(|| log.clone())
        });
        assert_eq!(logged["level"], 30, "{logged}");
        assert!(logged["msg"].as_str().unwrap().contains("odd"), "{logged}");
        assert!(logged["stamp"]["sec"].as_i64().unwrap() > 1_700_000_000);
    });
}

/// Starts a bridge between the domains 2 and 3, and a node in each domain.
fn two_domains(cell: &Cell, distribution: Distribution) -> (Child, Judge, Judge) {
    let file = cell.file(
        "cell.yaml",
        "spaces:\n  - {id: 2}\n  - {id: 3}\nnamespaces:\n  5: urn:test\nvariables: []\n",
    );
    let bridge = cell.bridge_ros2_alone(&[file.to_str().unwrap(), "--space", "2,3"]);
    let to = cell.rclpy_started(distribution, "ros2_node.py", &["to"]);
    let to = to.env("ROS_DOMAIN_ID", "3").told();
    (
        bridge.start(),
        cell.judge(distribution, &["from"]),
        Judge::of(to.start()),
    )
}

/// Types without local definition files: the publishing nodes describe them.
const UNKNOWN: [&str; 13] = [
    "Arrays",
    "BasicTypes",
    "BoundedPlainSequences",
    "BoundedSequences",
    "Builtins",
    "Constants",
    "Defaults",
    "Empty",
    "MultiNested",
    "Nested",
    "Strings",
    "UnboundedSequences",
    "WStrings",
];

#[test]
fn messages_of_types_that_only_nodes_of_ros_2_know_cross_between_their_domains_whole() {
    each(|cell, distribution| {
        let (_bridge, mut from, mut to) = two_domains(cell, distribution);
        for (id, name) in (1..).zip(UNKNOWN) {
            let (topic, kind) = (format!("/ua_2_5_{id}"), format!("test_msgs/msg/{name}"));
            to.ask(json!({"subscribe": topic, "type": kind}));
            from.until(&json!({"publish": topic, "type": kind}), |subscribers| {
                (*subscribers == 1).then_some(())
            });
            let sent = from.ask(json!({"publish": topic, "type": kind, "seed": id}));
            let heard = to.hears(&topic, |value| Some(value.clone()));
            assert_eq!(heard, sent, "{distribution:?} {kind}");
        }
    });
}

#[test]
fn large_samples_reach_nodes_of_ros_2_with_the_socket_buffers_they_have() {
    each(|cell, distribution| {
        let (_bridge, mut from, mut to) = two_domains(cell, distribution);
        let (topic, kind) = ("/ua_2_5_1", "std_msgs/msg/UInt8MultiArray");
        to.ask(json!({"subscribe": topic, "type": kind, "checksum": 1}));
        from.until(&json!({"publish": topic, "type": kind}), |subscribers| {
            (*subscribers == 1).then_some(())
        });
        // The first value creates the writer in the other domain, and DDS matches it meanwhile.
        let first = json!({"publish": topic, "type": kind, "bytes": 8, "seed": 9});
        from.until(&first, |sent| {
            to.child().values().contains(sent).then_some(())
        });
        // Not multiples of four, so the last fragment has an odd size.
        for (seed, bytes) in (1..).zip([999_999, 1_000_001, 2_000_003, 4_999_997, 1_000_002]) {
            let sent =
                from.ask(json!({"publish": topic, "type": kind, "bytes": bytes, "seed": seed}));
            to.hears(topic, |checksum| (*checksum == sent).then_some(()));
        }
    });
}
