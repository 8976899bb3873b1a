//! Type hashes compared with the hashes of rosbags (`data/make.py hashes`), and with published
//! hashes of services and actions.
use std::collections::BTreeSet;

use messages::{Dialect, TextKind, TypeName, TypeRegistry};
use uadp::BuiltinType;

const HASHES: &str = include_str!("data/ros2_type_hashes.txt");

const WITH_CHAR: [&str; 5] = [
    "rmw_dds_common/Gid",
    "rmw_dds_common/NodeEntitiesInfo",
    "rmw_dds_common/ParticipantEntitiesInfo",
    "service_msgs/ServiceEventInfo",
    "std_msgs/Char",
];

/// Packages of the bundle with nothing but actions.
const OF_ACTIONS: [&str; 6] = [
    "action_tutorials_interfaces",
    "actionlib",
    "actionlib_tutorials",
    "example_interfaces",
    "move_base_msgs",
    "test_msgs",
];

fn name(text: &str) -> TypeName {
    text.parse().unwrap()
}

/// rosbags treats `char` as a type of its own. rosidl treats it as `uint8`: the observed hashes of
/// services follow from `uint8[16]` in place of the `char[16]` in `service_msgs/ServiceEventInfo`.
fn has_char(store: &[&str], type_name: &str) -> bool {
    store
        .iter()
        .map(|line| line.split(' ').skip(1))
        .filter(|words| words.clone().next() == Some(type_name))
        .flat_map(|words| words.skip(1).filter_map(|field| field.split_once(':')))
        .any(|(_, kind)| {
            let kind = kind.split('[').next().unwrap();
            kind == "char" || has_char(store, kind)
        })
}

#[test]
fn every_message_of_humble_to_lyrical_has_the_hash_rosbags_computes() {
    let mut registry = TypeRegistry::empty(Dialect::Ros2);
    let mut judged = 0;
    let mut with_char = BTreeSet::new();
    let mut all: Vec<&str> = Vec::new();
    for store in HASHES.split("# ").skip(1) {
        let lines: Vec<&str> = store.lines().skip(1).collect();
        for line in &lines {
            let mut words = line.split(' ').skip(1);
            let type_name = name(words.next().unwrap());
            let fields: Vec<String> = words
                .map(|field| field.split_once(':').unwrap())
                .map(|(field, kind)| format!("{kind} {field}"))
                .collect();
            registry.add(&type_name, &fields.join("\n")).unwrap();
        }
        all.extend(&lines);
        for line in &lines {
            let mut words = line.split(' ');
            let (hash, type_name) = (words.next().unwrap(), words.next().unwrap());
            if has_char(&all, type_name) {
                with_char.insert(type_name);
                continue;
            }
            let ours = registry.type_hash(&name(type_name)).unwrap();
            assert_eq!(ours.to_string(), hash, "{type_name}");
            judged += 1;
        }
    }
    assert!(judged > 170, "{judged}");
    assert_eq!(with_char.into_iter().collect::<Vec<_>>(), WITH_CHAR);
}

#[test]
fn the_messages_of_the_bundle_have_the_hashes_of_jazzy() {
    let jazzy = HASHES.split("# Kilted").next().unwrap();
    let registry = TypeRegistry::bundle(Dialect::Ros2);
    let is_judged = |known: &&TypeName| {
        !WITH_CHAR.contains(&known.to_string().as_str())
            // rosbags has no actions.
            && !OF_ACTIONS.contains(&known.package())
            && (known.package() != "ua_msgs" || jazzy.contains(&format!(" {known} ")))
    };
    for known in registry.names().filter(is_judged) {
        let wanted = jazzy
            .lines()
            .filter(|line| line.split(' ').nth(1) == Some(&known.to_string()))
            .filter_map(|line| line.split(' ').next())
            .next_back()
            .unwrap();
        assert_eq!(
            registry.type_hash(known).unwrap().to_string(),
            wanted,
            "{known}"
        );
    }
}

/// Returns a registry with the services of published hashes.
fn services() -> TypeRegistry {
    let mut registry = TypeRegistry::bundle(Dialect::Ros2);
    let texts = [
        ("std_srvs/Empty", "---\n"),
        (
            "std_srvs/SetBool",
            "bool data\n---\nbool success\nstring message\n",
        ),
        ("std_srvs/Trigger", "---\nbool success\nstring message\n"),
        (
            "example_interfaces/SetBool",
            "bool data\n---\nbool success\nstring message\n",
        ),
        (
            "example_interfaces/AddTwoInts",
            "int64 a\nint64 b\n---\nint64 sum\n",
        ),
        (
            "rcl_interfaces/ListParameters",
            "uint64 DEPTH_RECURSIVE=0\nstring[] prefixes\nuint64 depth\n---\nListParametersResult result\n",
        ),
        (
            "rcl_interfaces/GetParameters",
            "string[] names\n---\nParameterValue[] values\n",
        ),
        (
            "rcl_interfaces/GetParameterTypes",
            "string[] names\n---\nuint8[] types\n",
        ),
        (
            "rcl_interfaces/SetParameters",
            "Parameter[] parameters\n---\nSetParametersResult[] results\n",
        ),
        (
            "rcl_interfaces/SetParametersAtomically",
            "Parameter[] parameters\n---\nSetParametersResult result\n",
        ),
        (
            "rcl_interfaces/DescribeParameters",
            "string[] names\n---\nParameterDescriptor[] descriptors\n",
        ),
        (
            "action_msgs/CancelGoal",
            "GoalInfo goal_info\n---\nint8 return_code\nGoalInfo[] goals_canceling\n",
        ),
    ];
    for (service, text) in texts {
        registry.add_service(&name(service), text).unwrap();
    }
    registry
}

#[test]
fn services_have_the_hashes_that_nodes_of_ros_2_were_seen_to_announce() {
    // rmw_zenoh puts the hash of a service into its keys. AddTwoInts is from its design document,
    // the other hashes are recorded as observed (Jazzy) in projects that communicate with it
    // without ROS.
    let registry = services();
    for (service, hash) in [
        (
            "example_interfaces/AddTwoInts",
            "e118de6bf5eeb66a2491b5bda11202e7b68f198d6f67922cf30364858239c81a",
        ),
        (
            "example_interfaces/SetBool",
            "a69782e5631b12e15c8e218410de1685bbf13e382718295adad14037a24afbe8",
        ),
        (
            "std_srvs/Trigger",
            "eeff2cd6fa5ad9d27cdf4dec64818317839b62f212a91e6b5304b634b2062c5f",
        ),
        (
            "std_srvs/SetBool",
            "abe9e4bb6b41b40e6789712c00ec8871923e089af3f667a79992a428cff2da0a",
        ),
        (
            "std_srvs/Empty",
            "5888399dedec5ccc85ea6451949fd2c9f97bfdf963f9a588821639fcd31b5d19",
        ),
        (
            "rcl_interfaces/ListParameters",
            "3e6062bfbb27bfb8730d4cef2558221f51a11646d78e7bb30a1e83afac3aad9d",
        ),
        (
            "rcl_interfaces/GetParameters",
            "bf9803d5c74cf989a5de3e0c2e99444599a627c7ff75f97b8c05b01003675cbc",
        ),
        (
            "rcl_interfaces/GetParameterTypes",
            "da199c878688b3e530bdfe3ca8f74cb9fa0c303101e980a9e8f260e25e1c80ca",
        ),
        (
            "rcl_interfaces/SetParameters",
            "56eed9a67e169f9cb6c1f987bc88f868c14a8fc9f743a263bc734c154015d7e0",
        ),
        (
            "rcl_interfaces/SetParametersAtomically",
            "0e192ef259c07fc3c07a13191d27002222e65e00ccec653ca05e856f79285fcd",
        ),
        (
            "rcl_interfaces/DescribeParameters",
            "845b484d71eb0673dae682f2e3ba3c4851a65a3dcfb97bddd82c5b57e91e4cff",
        ),
    ] {
        let ours = registry.service_type_hashes(&name(service)).unwrap();
        assert_eq!(
            ours.service.to_string(),
            format!("RIHS01_{hash}"),
            "{service}"
        );
    }
    let cancel = registry
        .service_type_hashes(&name("action_msgs/CancelGoal"))
        .unwrap();
    assert_eq!(
        cancel.request.to_string(),
        "RIHS01_3d3c84653c1f96918086887e1dcb236faec88b81a5b14fd4cf4840065bcdf8af"
    );
}

#[test]
fn the_messages_of_an_action_have_the_hashes_rosidl_generates() {
    // example_interfaces/action/Fibonacci from SwiftROS2, where it was checked against rosidl's
    // generated files.
    let text = "int32 order\n---\nint32[] sequence\n---\nint32[] sequence\n";
    let fibonacci = name("example_interfaces/Fibonacci");
    let mut registry = TypeRegistry::bundle(Dialect::Ros2);
    let ours = registry.action_type_hashes(&fibonacci, text).unwrap();
    registry.add_action(&fibonacci, text).unwrap();
    assert_eq!(
        registry.added_action_type_hashes(&fibonacci),
        Ok(ours.clone())
    );
    let described = registry.describe_action(&fibonacci).unwrap();
    assert_eq!(described[0].name, "example_interfaces/action/Fibonacci");
    for (ours, hash) in [
        (
            ours.goal,
            "226cb437e4355dcd3e914f930382a3b0cc1da81545bd319ed554e95a03255f51",
        ),
        (
            ours.result,
            "fea81394f25aa4502217953f1a021fb750e79c10bbd43f13dd94632da6569649",
        ),
        (
            ours.feedback,
            "2b12e37361da6f408d4c85bc24a18de64333f29082f2ca34b5ee33dc4c8b42a9",
        ),
        (
            ours.send_goal.request,
            "3d088942b413247db536576f0286768c6be8fcd5d0c9a5d544f359fba090a238",
        ),
        (
            ours.send_goal.response,
            "d8c07bb3d5b766fe4b43159c9a5222af5214e2fcc29229b991d826166c512be1",
        ),
        (
            ours.get_result.request,
            "c8a4f5e7d13b81286ee1043e2ecd084281cecf1ff06aaa799464f5f15479f003",
        ),
        (
            ours.get_result.response,
            "6021dc98ab9b4bbe395e48aa4de81ee5f68eb570f88358affcc648146668b24f",
        ),
        (
            ours.feedback_message,
            "c1de71afd52e49a89c53d8262366884185bc0a02f78ce051c4e46b0a7fe59bb2",
        ),
    ] {
        assert_eq!(ours.to_string(), format!("RIHS01_{hash}"));
    }
}

#[test]
fn what_is_missing_or_contains_itself_is_an_error_as_elsewhere() {
    let mut registry = TypeRegistry::empty(Dialect::Ros2);
    registry.add(&name("a/Ring"), "Ring[] rings").unwrap();
    assert!(registry.type_hash(&name("a/Ring")).is_err());
    assert!(registry.type_hash(&name("a/Unknown")).is_err());
    assert!(registry.service_type_hashes(&name("a/Unknown")).is_err());
    let action = "Ring ring\n---\n---\n";
    assert!(registry.action_type_hashes(&name("a/Act"), action).is_err());
    let unknown = registry
        .added_action_type_hashes(&name("a/Act"))
        .unwrap_err();
    assert!(unknown.to_string().contains("a/ActGoal"), "{unknown}");
}

/// The hash is the SHA-256 that Python computes of the description, in which such a field has
/// FIELD_TYPE_CHAR (13).
#[test]
fn a_char_of_idl_is_a_type_of_its_own_and_comes_back_from_its_description() {
    let idl = "module robot_msgs { module msg {
        typedef char char__4[4];
        struct Key { char letter; char__4 word; octet octet; }; }; };";
    let key = name("robot_msgs/Key");
    let mut registry = TypeRegistry::empty(Dialect::Ros2);
    registry.add_idl(TextKind::Message, &key, idl).unwrap();
    let hash = registry.type_hash(&key).unwrap();
    let expected = "0002d06732862500c8797638eea2b46640ccf5f690cd1aaaf3e25e97be1768a3";
    assert_eq!(hash.to_string(), format!("RIHS01_{expected}"));
    let told = registry.describe(&key).unwrap();
    let mut other = TypeRegistry::empty(Dialect::Ros2);
    other.add_described(&key, &told, hash).unwrap();
    assert_eq!(other.describe(&key).unwrap(), told);
    let values: Vec<_> = other
        .get(&key)
        .unwrap()
        .leaves()
        .iter()
        .map(|l| l.builtin)
        .collect();
    assert_eq!(
        values,
        [
            BuiltinType::Byte,
            BuiltinType::ByteString,
            BuiltinType::Byte
        ]
    );
}

#[test]
fn a_char_is_hashed_as_the_uint8_it_is_to_rosidl() {
    let mut registry = TypeRegistry::bundle(Dialect::Ros2);
    let texts = [
        ("rmw_dds_common/Gid", "char[16] data"),
        (
            "rmw_dds_common/NodeEntitiesInfo",
            "string<=256 node_namespace\nstring<=256 node_name\nGid[] reader_gid_seq\nGid[] writer_gid_seq",
        ),
        (
            "rmw_dds_common/ParticipantEntitiesInfo",
            "Gid gid\nNodeEntitiesInfo[] node_entities_info_seq",
        ),
    ];
    for (type_name, text) in texts {
        registry.add(&name(type_name), text).unwrap();
    }
    for (type_name, hash) in [
        (
            "std_msgs/Char",
            "3ad2d04dd29ba19d04b16659afa3ccaedd691914b02a64e82e252f2fa6a586a9",
        ),
        (
            "rmw_dds_common/ParticipantEntitiesInfo",
            "91a0593bacdcc50ea9bdcf849a938b128412cc1ea821245c663bcd26f83c295e",
        ),
    ] {
        let ours = registry.type_hash(&name(type_name)).unwrap();
        assert_eq!(ours.to_string(), format!("RIHS01_{hash}"), "{type_name}");
    }
}

#[test]
fn an_idl_text_makes_the_type_that_rosbags_reads_in_it() {
    let bundle = TypeRegistry::bundle(Dialect::Ros2);
    let samples: Vec<serde_json::Value> =
        serde_json::from_str(include_str!("data/rosbags_idl.json")).unwrap();
    assert_eq!(samples.len(), 16);
    for sample in samples {
        let of = |key: &str| sample[key].as_str().unwrap().to_owned();
        let type_name = name(&of("type"));
        let mut registry = bundle.clone();
        registry
            .add_idl(TextKind::Message, &type_name, &of("idl"))
            .unwrap();
        let hash = registry.type_hash(&type_name).unwrap();
        assert_eq!(hash.to_string(), of("hash"), "{type_name}");
        let (ours, built_in) = (
            registry.get(&type_name).unwrap(),
            bundle.get(&type_name).unwrap(),
        );
        assert_eq!(ours.leaves(), built_in.leaves(), "{type_name}");
        let constants = |found: &messages::MessageType| -> Vec<String> {
            found.constants().iter().map(|c| c.name.clone()).collect()
        };
        assert_eq!(constants(&ours), constants(&built_in), "{type_name}");
    }
}
