//! Results of other implementations: md5 sums, field lists, and messages. See `data/make.py`.
use crate::support;

use std::collections::HashMap;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::Arc;

use md5::{Digest, Md5};
use messages::{
    ActionType, DefinitionError, Dialect, MessagePlan, MessageType, Selection, TypeName,
    TypeRegistry, Wire,
};
use serde_json::Value as Json;
use support::{EventPlayer, Recorder};

const MD5S: &str = include_str!("data/ros1_md5.txt");
const SERVICES: &str = include_str!("data/ros1_services.txt");
const ACTIONS: &str = include_str!("data/ros1_actions.txt");
const FIELDS: &str = include_str!("data/ros2_fields.txt");
const ROSBAGS: &str = include_str!("data/rosbags.json");
const CYCLONE: &str = include_str!("data/cyclone.json");
const GENPY: &str = include_str!("data/genpy.json");

fn name(text: &str) -> TypeName {
    text.parse().unwrap()
}

fn bytes(hex: &Json) -> Vec<u8> {
    let hex = hex.as_str().unwrap();
    (0..hex.len())
        .step_by(2)
        .map(|at| u8::from_str_radix(&hex[at..at + 2], 16).unwrap())
        .collect()
}

fn samples(text: &str) -> Vec<Json> {
    serde_json::from_str(text).unwrap()
}

fn text(json: &Json) -> &str {
    json.as_str().unwrap()
}

fn strings(json: &Json) -> Vec<String> {
    json.as_array()
        .unwrap()
        .iter()
        .map(|each| text(each).to_owned())
        .collect()
}

#[test]
fn the_md5_of_every_ros_1_type_of_the_bundle_is_the_one_others_compute() {
    let registry = TypeRegistry::bundle(Dialect::Ros1);
    let mut table: HashMap<String, String> = MD5S
        .lines()
        .map(|line| line.split_once(' ').unwrap())
        .map(|(name, md5)| (name.to_owned(), md5.to_owned()))
        .collect();
    let logger = SERVICES
        .lines()
        .filter(|line| line.starts_with("roscpp/Logger "));
    for line in logger.chain(ACTIONS.lines()) {
        let (name, md5) = line.split_once(' ').unwrap();
        table.insert(name.to_owned(), md5.to_owned());
    }
    for sample in samples(GENPY) {
        table.insert(
            text(&sample["type"]).to_owned(),
            text(&sample["md5"]).to_owned(),
        );
    }
    for known in registry.names() {
        let wanted = table
            .remove(&known.to_string())
            .unwrap_or_else(|| panic!("no table has {known}"));
        assert_eq!(registry.get(known).unwrap().md5(), wanted, "{known}");
    }
    assert!(table.is_empty(), "the bundle lacks {table:?}");
}

/// Parses a table with a type name and an md5 per line.
fn table(text: &str) -> HashMap<String, String> {
    text.lines()
        .filter_map(|line| line.split_once(' '))
        .map(|(name, md5)| (name.to_owned(), md5.to_owned()))
        .collect()
}

fn parts(action: &ActionType) -> [&Arc<MessageType>; 7] {
    [
        action.action(),
        action.action_goal(),
        action.action_result(),
        action.action_feedback(),
        action.goal(),
        action.result(),
        action.feedback(),
    ]
}

#[test]
fn the_md5_of_every_service_of_the_bundle_is_the_one_genpy_computed() {
    let registry = TypeRegistry::bundle(Dialect::Ros1);
    let table = table(SERVICES);
    for known in registry.services() {
        let service = registry.service(known).unwrap();
        assert_eq!(service.md5(), table[&known.to_string()], "{known}");
        assert_eq!(service.request().name(), &name(&format!("{known}Request")));
    }
    assert_eq!(registry.services().count(), 15);
}

#[test]
fn an_action_is_the_seven_messages_genaction_makes() {
    let table = table(SERVICES);
    let texts = [
        (
            "move_base_msgs/MoveBase",
            "geometry_msgs/PoseStamped target_pose\n---\n---\ngeometry_msgs/PoseStamped base_position\n",
        ),
        (
            "tf2_msgs/LookupTransform",
            "#Simple API\nstring target_frame\nstring source_frame\ntime source_time\nduration timeout\n\n#Advanced API\n\
             time target_time\nstring fixed_frame\n\n#Whether or not to use the advanced API\nbool advanced\n\n---\n\
             geometry_msgs/TransformStamped transform\ntf2_msgs/TF2Error error\n---\n",
        ),
    ];
    let mut registry = TypeRegistry::bundle(Dialect::Ros1);
    for (action, text) in texts {
        registry.add_action(&name(action), text).unwrap();
        let action = registry.action(&name(action)).unwrap();
        for part in parts(&action) {
            assert_eq!(
                part.md5(),
                table[&part.name().to_string()],
                "{}",
                part.name()
            );
        }
    }
}

#[test]
fn services_and_actions_have_the_md5s_genmsg_computes() {
    if let Some(judged) = judged(&test_data::own("ros1")) {
        // Two services, and the seven messages of an action.
        assert_eq!(judged, 9);
    }
}

#[test]
fn the_services_and_actions_of_a_real_robot_have_the_md5s_genmsg_computes() {
    let Some(robot) = test_data::foreign("ros1-niryo") else {
        return;
    };
    if let Some(judged) = judged(&robot) {
        assert!(judged > 90, "{judged}");
    }
}

/// Compares the md5s of all services and actions of a folder with the md5s of genmsg, and returns
/// their number.
fn judged(robot: &Path) -> Option<usize> {
    let here = Path::new(env!("CARGO_MANIFEST_DIR"));
    let genmsg = Command::new("/usr/bin/python3")
        .arg(here.join("tests/data/genmsg_md5.py"))
        .arg(robot)
        .output();
    let Some(told) = genmsg.ok().filter(|done| done.status.success()) else {
        test_data::skip("the peer genmsg (Debian's python3-genmsg) is not on this machine");
        return None;
    };
    let told = String::from_utf8(told.stdout).unwrap();
    let table = table(&told);
    let mut registry = TypeRegistry::bundle(Dialect::Ros1);
    let (mut services, mut actions) = (Vec::new(), Vec::new());
    for path in files_below(robot) {
        let folder = path.parent().unwrap();
        let package = folder
            .parent()
            .unwrap()
            .file_name()
            .unwrap()
            .to_str()
            .unwrap();
        let stem = path.file_stem().unwrap().to_str().unwrap();
        let text = std::fs::read_to_string(&path);
        match folder.file_name().unwrap().to_str().unwrap() {
            "msg" => registry
                .add(&name(&format!("{package}/{stem}")), &text.unwrap())
                .unwrap(),
            "srv" => {
                let service = name(&format!("{package}/{stem}"));
                registry.add_service(&service, &text.unwrap()).unwrap();
                services.push(service);
            }
            "action" => {
                let action = name(&format!("{package}/{stem}"));
                registry.add_action(&action, &text.unwrap()).unwrap();
                actions.push(action);
            }
            _ => {}
        }
    }
    let mut judged = 0;
    let mut compare = |name: &TypeName, md5: Result<String, DefinitionError>| {
        let Some(wanted) = table.get(&name.to_string()) else {
            return;
        };
        if told.contains(&format!("? {name}: ")) {
            assert!(md5.is_err(), "{name}");
            return;
        }
        assert_eq!(&md5.unwrap(), wanted, "{name}");
        judged += 1;
    };
    for name in &services {
        compare(
            name,
            registry.service(name).map(|found| found.md5().to_owned()),
        );
    }
    for name in &actions {
        for part in parts(&registry.action(name).unwrap()) {
            compare(part.name(), Ok(part.md5().to_owned()));
        }
    }
    Some(judged)
}

fn files_below(folder: &Path) -> Vec<PathBuf> {
    let mut found = Vec::new();
    for entry in std::fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            found.extend(files_below(&path));
        } else if path
            .extension()
            .is_some_and(|kind| ["msg", "srv", "action"].iter().any(|known| kind == *known))
        {
            found.push(path);
        }
    }
    found
}

#[test]
fn the_md5s_well_known_to_ros_1_users_are_right() {
    let registry = TypeRegistry::bundle(Dialect::Ros1);
    for (type_name, md5) in [
        ("std_msgs/String", "992ce8a1687cec8c8bd883ec73ca41d1"),
        ("geometry_msgs/Twist", "9f195f881246fdfa2798d1d3eebca84a"),
        ("nav_msgs/Odometry", "cd5e73d190d741a2f92e81eda573aca7"),
        ("sensor_msgs/JointState", "3066dcd76a6cfaef579bd0f34173e9fd"),
        ("tf2_msgs/TFMessage", "94810edda583a504dfda3829e70d7eec"),
    ] {
        assert_eq!(
            registry.get(&name(type_name)).unwrap().md5(),
            md5,
            "{type_name}"
        );
    }
}

#[test]
fn the_text_of_every_ros_1_type_means_the_same_to_the_crate_ros_message() {
    let registry = TypeRegistry::bundle(Dialect::Ros1);
    let path =
        |name: &TypeName| ros_message::MessagePath::new(name.package(), name.name()).unwrap();
    let types: Vec<Arc<MessageType>> = registry
        .names()
        .map(|name| registry.get(name).unwrap())
        .collect();
    let md5s: HashMap<_, _> = types
        .iter()
        .map(|each| (path(each.name()), each.md5().to_owned()))
        .collect();
    for each in &types {
        let own_text = each.definition().split("\n====").next().unwrap();
        let parsed = ros_message::Msg::new(path(each.name()), own_text).unwrap();
        let hashed = Md5::digest(parsed.get_md5_representation(&md5s).unwrap().trim());
        let hashed: String = hashed.iter().map(|byte| format!("{byte:02x}")).collect();
        assert_eq!(hashed, each.md5(), "{}", each.name());
    }
    assert!(types.len() > 120);
}

#[test]
fn the_fields_of_every_ros_2_type_of_the_bundle_are_those_of_rosbags() {
    let mut others = TypeRegistry::empty(Dialect::Ros2);
    for line in FIELDS.lines() {
        let mut words = line.split(' ');
        let type_name = name(words.next().unwrap());
        let fields: Vec<String> = words
            .map(|field| field.split_once(':').unwrap())
            .map(|(field, kind)| format!("{} {field}", kind.replace("octet", "byte")))
            .collect();
        others.add(&type_name, &fields.join("\n")).unwrap();
    }
    let bundle = TypeRegistry::bundle(Dialect::Ros2);
    // rosbags has no actions.
    let of_actions = |name: &&TypeName| {
        ACTION_PACKAGES.contains(&name.package())
            && (name.package() != "ua_msgs" || others.get(name).is_err())
    };
    let messages = || bundle.names().filter(|name| !of_actions(name));
    assert!(messages().eq(others.names()));
    for each in messages() {
        let (ours, theirs) = (bundle.get(each).unwrap(), others.get(each).unwrap());
        assert_eq!(ours.leaves(), theirs.leaves(), "{each}");
        let without_constants: Vec<&str> = ours
            .definition()
            .split("\n====")
            .next()
            .unwrap()
            .lines()
            .filter(|line| !line.contains('=') || line.contains("<="))
            .collect();
        let full = |line: &str| {
            let (kind, field) = line.split_once(' ').unwrap();
            let base = kind.split(['[', '<']).next().unwrap();
            let local = !base.contains('/') && base.starts_with(|c: char| c.is_ascii_uppercase());
            format!(
                "{}{kind} {field}",
                if local {
                    format!("{}/", each.package())
                } else {
                    String::new()
                }
            )
        };
        let ours: Vec<String> = without_constants.iter().map(|line| full(line)).collect();
        assert_eq!(
            ours.join("\n"),
            theirs.definition().split("\n====").next().unwrap(),
            "{each}"
        );
    }
}

/// rosbags has no actions.
const ACTION_PACKAGES: [&str; 7] = [
    "action_tutorials_interfaces",
    "actionlib",
    "actionlib_tutorials",
    "example_interfaces",
    "move_base_msgs",
    "test_msgs",
    "ua_msgs",
];

#[test]
fn every_action_of_the_bundle_is_the_same_calls_and_values_in_both_ros() {
    let registries = [Dialect::Ros1, Dialect::Ros2].map(TypeRegistry::bundle);
    let leaves = |message: &MessageType| {
        let leaves = message.leaves().iter();
        leaves
            .map(|leaf| (leaf.path.clone(), leaf.builtin))
            .collect::<Vec<_>>()
    };
    let goals = registries[0].names().filter_map(|goal| {
        let action = goal.name().strip_suffix("ActionGoal")?;
        Some(name(&format!("{}/{action}", goal.package())))
    });
    let mut judged = 0;
    // nav_msgs/GetMap exists only in ROS 1.
    for action in goals.filter(|action| ACTION_PACKAGES.contains(&action.package())) {
        let [one, two] = registries.each_ref().map(|registry| {
            let calls = registry.action_calls(&action).unwrap();
            let (goal, result) = (calls.goal().request(), calls.result().response());
            [goal, result, calls.feedback()].map(|message| leaves(message))
        });
        assert_eq!(one, two, "{action}");
        judged += 1;
    }
    assert_eq!(judged, 31);
}

#[test]
fn a_full_definition_names_what_it_needs_in_the_order_of_genpy() {
    let registry = TypeRegistry::bundle(Dialect::Ros1);
    for sample in samples(GENPY) {
        let found = registry.get(&name(text(&sample["type"]))).unwrap();
        let needs: Vec<String> = found
            .definition()
            .lines()
            .filter_map(|line| line.strip_prefix("MSG: "))
            .map(str::to_owned)
            .collect();
        assert_eq!(needs, strings(&sample["needs"]), "{}", found.name());
        let mut empty = TypeRegistry::empty(Dialect::Ros1);
        let again = empty
            .add_ros1_definition(found.name(), found.definition())
            .unwrap();
        assert_eq!(again.md5(), found.md5());
        assert_eq!(again.leaves(), found.leaves());
    }
}

/// Reads `payload`, compares the fields, writes them and compares the bytes with `written`.
fn judge(plan: &MessagePlan, sample: &Json, payload: &[u8], written: &[u8]) {
    let what = text(&sample["type"]);
    let mut recorder = Recorder::default();
    plan.read(payload, &mut recorder)
        .unwrap_or_else(|error| panic!("{what}: {error}"));
    let events: Vec<String> = recorder.events.iter().map(ToString::to_string).collect();
    assert_eq!(events, strings(&sample["fields"]), "{what}");
    let mut out = vec![0xEE];
    plan.write(&mut EventPlayer::new(&recorder.events), &mut out)
        .unwrap_or_else(|error| panic!("{what}: {error}"));
    let mut wanted = vec![0xEE];
    wanted.extend_from_slice(written);
    assert_eq!(out, wanted, "{what}");
}

fn padded(mut cdr: Vec<u8>) -> Vec<u8> {
    cdr.resize(cdr.len().next_multiple_of(4), 0);
    cdr
}

#[test]
fn ros_1_messages_written_by_genpy_and_rosbags_are_read_and_written_alike() {
    let registry = TypeRegistry::bundle(Dialect::Ros1);
    let mut count = 0;
    for sample in samples(GENPY)
        .iter()
        .chain(&samples(ROSBAGS))
        .filter(|sample| sample["dialect"] == 1)
    {
        let plan = MessagePlan::compile(
            &registry.get(&name(text(&sample["type"]))).unwrap(),
            &Selection::Whole,
            Wire::Ros1,
        )
        .unwrap();
        let payload = bytes(&sample["ros1"]);
        judge(&plan, sample, &payload, &payload);
        count += 1;
    }
    assert!(count > 200, "{count}");
}

#[test]
fn cdr_of_both_byte_orders_written_by_rosbags_is_read_alike_and_written_little_endian() {
    let registry = TypeRegistry::bundle(Dialect::Ros2);
    let mut count = 0;
    for sample in samples(ROSBAGS)
        .iter()
        .filter(|sample| sample["dialect"] == 2)
    {
        let plan = MessagePlan::compile(
            &registry.get(&name(text(&sample["type"]))).unwrap(),
            &Selection::Whole,
            Wire::Cdr,
        )
        .unwrap();
        let little = bytes(&sample["little"]);
        let padded = padded(little.clone());
        judge(&plan, sample, &little, &padded);
        judge(&plan, sample, &bytes(&sample["big"]), &padded);
        judge(&plan, sample, &padded, &padded);
        count += 1;
    }
    assert!(count > 140, "{count}");
}

#[test]
fn cdr_written_by_cyclone_dds_is_read_and_written_alike() {
    let registry = TypeRegistry::bundle(Dialect::Ros2);
    let samples = samples(CYCLONE);
    for sample in &samples {
        let found = registry.get(&name(text(&sample["type"]))).unwrap();
        let plan = MessagePlan::compile(&found, &Selection::Whole, Wire::Cdr).unwrap();
        let payload = bytes(&sample["little"]);
        judge(&plan, sample, &payload, &padded(payload.clone()));
    }
    assert!(samples.len() > 140, "{}", samples.len());
}
