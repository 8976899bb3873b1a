//! Definitions that are flattened, incomplete, hostile, or from a peer.
use std::collections::BTreeMap;
use std::sync::Arc;

use messages::{
    ArrayRank, DefinitionError, Dialect, Leaf, MessagePlan, MessageType, NoFields, PlanError,
    Selection, TypeName, TypeRegistry, Wire, standard_type,
};
use uadp::BuiltinType;

fn name(text: &str) -> TypeName {
    text.parse().unwrap()
}

fn registry(dialect: Dialect, definitions: &[(&str, &str)]) -> TypeRegistry {
    let mut registry = TypeRegistry::bundle(dialect);
    for (name_text, text) in definitions {
        registry.add(&name(name_text), text).unwrap();
    }
    registry
}

fn message(dialect: Dialect, text: &str) -> Arc<MessageType> {
    registry(dialect, &[("t/T", text)])
        .get(&name("t/T"))
        .unwrap()
}

#[test]
fn a_pose_stamped_is_flattened_by_path_without_the_sequence_number() {
    let leaf = |path: &str, builtin| Leaf {
        path: path.to_owned(),
        builtin,
        rank: ArrayRank::Scalar,
    };
    let mut wanted = vec![
        leaf("header.stamp", BuiltinType::DateTime),
        leaf("header.frame_id", BuiltinType::String),
    ];
    for part in [
        "position.x",
        "position.y",
        "position.z",
        "orientation.x",
        "orientation.y",
        "orientation.z",
        "orientation.w",
    ] {
        wanted.push(leaf(&format!("pose.{part}"), BuiltinType::Double));
    }
    for dialect in [Dialect::Ros1, Dialect::Ros2] {
        let found = TypeRegistry::bundle(dialect)
            .get(&name("geometry_msgs/PoseStamped"))
            .unwrap();
        assert_eq!(found.leaves(), wanted, "{dialect:?}");
        assert_eq!(found.leaf("pose.position.y"), wanted.get(3));
        assert_eq!(found.leaf("pose"), None);
    }
}

#[test]
fn bytes_are_byte_strings_fixed_arrays_keep_their_length_and_messages_become_structures() {
    let text = "byte[] signed\nuint8[4] four\nchar c\nfloat32[3] axes\ngeometry_msgs/Point[2] points\nduration[] waits";
    let shapes: Vec<_> = message(Dialect::Ros1, text)
        .leaves()
        .iter()
        .map(|leaf| (leaf.builtin, leaf.rank))
        .collect();
    assert_eq!(
        shapes,
        [
            (BuiltinType::SByte, ArrayRank::Array { fixed: None }),
            (BuiltinType::ByteString, ArrayRank::Scalar),
            (BuiltinType::Byte, ArrayRank::Scalar),
            (BuiltinType::Float, ArrayRank::Array { fixed: Some(3) }),
            (
                BuiltinType::ExtensionObject,
                ArrayRank::Array { fixed: Some(2) }
            ),
            (BuiltinType::Double, ArrayRank::Array { fixed: None }),
        ]
    );
    let ros2 = message(Dialect::Ros2, "byte[] bytes\nbyte one\nwstring wide");
    let builtins: Vec<_> = ros2.leaves().iter().map(|leaf| leaf.builtin).collect();
    assert_eq!(
        builtins,
        [
            BuiltinType::ByteString,
            BuiltinType::Byte,
            BuiltinType::String
        ]
    );
}

#[test]
fn a_missing_type_is_named_with_who_needs_it_and_what_may_be_meant() {
    let registry = registry(
        Dialect::Ros1,
        &[
            ("t/T", "geometry_msgs/Pont p"),
            ("t/U", "nowhere/Unheard x"),
        ],
    );
    let error = registry.get(&name("t/T")).unwrap_err();
    assert_eq!(
        error.to_string(),
        "no definition of `geometry_msgs/Pont`, which `t/T` uses"
    );
    assert_eq!(
        registry.suggest(&name("geometry_msgs/Pont")),
        Some(name("geometry_msgs/Point"))
    );
    assert_eq!(
        registry.get(&name("t/U")).unwrap_err(),
        DefinitionError::Unknown {
            name: name("nowhere/Unheard"),
            needed_by: Some(name("t/U")),
        }
    );
    assert_eq!(
        registry.suggest(&name("sensor_msgs/Twist")),
        Some(name("geometry_msgs/Twist"))
    );
    assert_eq!(
        registry.suggest(&name("sensor_msgs/JointStates")),
        Some(name("sensor_msgs/JointState"))
    );
}

#[test]
#[expect(
    clippy::disallowed_methods,
    reason = "what takes how long is the matter"
)]
fn a_name_nobody_knows_costs_no_more_than_one_that_is_known() {
    let registry = TypeRegistry::bundle(Dialect::Ros2);
    let time = |text: &str| {
        let name = name(text);
        let start = std::time::Instant::now();
        for _ in 0..2000 {
            let _found_or_not = registry.get(&name);
        }
        start.elapsed()
    };
    let (known, unknown) = (
        time("geometry_msgs/TwistStamped"),
        time("robot_msgs/TwistsStamp"),
    );
    assert!(
        unknown < 4 * known,
        "{unknown:?} for an unknown name, {known:?} for a known one"
    );
}

#[test]
fn types_that_contain_themselves_or_nest_without_end_are_refused() {
    let registry = registry(
        Dialect::Ros1,
        &[("t/Self", "Self[] more"), ("t/A", "B b"), ("t/B", "A[] a")],
    );
    assert_eq!(
        registry.get(&name("t/Self")).unwrap_err(),
        DefinitionError::Cyclic {
            name: name("t/Self")
        }
    );
    assert_eq!(
        registry.get(&name("t/B")).unwrap_err(),
        DefinitionError::Cyclic { name: name("t/B") }
    );

    let mut deep = TypeRegistry::empty(Dialect::Ros2);
    deep.add(&name("t/L1"), "int8 x").unwrap();
    for level in 2..=33 {
        deep.add(
            &name(&format!("t/L{level}")),
            &format!("L{} below", level - 1),
        )
        .unwrap();
    }
    assert_eq!(deep.get(&name("t/L32")).unwrap().leaves().len(), 1);
    assert_eq!(
        deep.get(&name("t/L33")).unwrap_err(),
        DefinitionError::TooDeep { name: name("t/L1") }
    );
}

#[test]
fn a_time_defined_by_itself_is_still_a_time() {
    let registry = registry(
        Dialect::Ros2,
        &[
            ("builtin_interfaces/Time", "Time again"),
            ("t/T", "builtin_interfaces/Time at"),
        ],
    );
    for type_name in ["t/T", "builtin_interfaces/Time"] {
        let found = registry.get(&name(type_name)).unwrap();
        assert_eq!(
            found.leaves().first().unwrap().builtin,
            BuiltinType::DateTime
        );
    }
}

#[test]
fn a_text_of_very_many_fields_is_refused_where_the_limit_is_passed() {
    let text: String = (0..5000).map(|field| format!("int8 f{field}\n")).collect();
    let error = TypeRegistry::empty(Dialect::Ros1)
        .add(&name("t/T"), &text)
        .unwrap_err();
    assert_eq!(
        error.to_string(),
        "`t/T` line 4097: more than 4096 fields: `int8 f4096`"
    );
}

#[test]
fn types_that_multiply_are_refused_before_they_are_built() {
    let mut registry = TypeRegistry::empty(Dialect::Ros2);
    registry.add(&name("t/L1"), "int8 x").unwrap();
    for level in 2..=20 {
        let text: String = (0..8)
            .map(|field| format!("L{} f{field}\n", level - 1))
            .collect();
        registry.add(&name(&format!("t/L{level}")), &text).unwrap();
    }
    let too_many = DefinitionError::TooBig {
        name: name("t/L5"),
        what: "more than 4096 fields",
    };
    assert_eq!(registry.get(&name("t/L20")).unwrap_err(), too_many);
    registry
        .add(&name("t/Big"), "float64[4294967295] x")
        .unwrap();
    let too_big = DefinitionError::TooBig {
        name: name("t/Big"),
        what: "fixed arrays of more than 64 MiB",
    };
    assert_eq!(registry.get(&name("t/Big")).unwrap_err(), too_big);
}

const PEER: &str = "Header header\nmine/Thing[] things\n\n\
    ================================================================================\nMSG: std_msgs/Header\n\
    uint32 seq\ntime stamp\nstring frame_id\n\n\
    ================================================================================\nMSG: mine/Thing\nint32 MAX=7\nuint16 id\n";

#[test]
fn a_connection_header_brings_its_own_definition() {
    let mut registry = TypeRegistry::bundle(Dialect::Ros1);
    let found = registry
        .add_ros1_definition(&name("mine/Things"), PEER)
        .unwrap();
    let paths: Vec<_> = found
        .leaves()
        .iter()
        .map(|leaf| leaf.path.as_str())
        .collect();
    assert_eq!(paths, ["header.stamp", "header.frame_id", "things"]);
    assert_eq!(found.definition(), PEER);
    let known = registry.get(&name("mine/Things")).unwrap();
    assert_eq!(known.md5(), found.md5());
    assert_eq!(registry.get(&name("mine/Thing")).unwrap().leaves().len(), 1);
}

#[test]
fn of_a_connection_header_only_what_its_type_needs_is_kept_and_can_be_forgotten() {
    let mut registry = TypeRegistry::bundle(Dialect::Ros1);
    let before = registry.names().count();
    let rule = "=".repeat(80);
    let padded = format!("{PEER}{rule}\nMSG: mine/Unneeded\nint8 x\n");
    let things = name("mine/Things");
    let (_, first) = registry.read_ros1_definition(&things, &padded).unwrap();
    assert_eq!((registry.names().count(), first.len()), (before, 3));
    registry.keep(&first);
    // Header is built in.
    assert_eq!(registry.names().count(), before + 2);
    let (_, second) = registry.read_ros1_definition(&things, PEER).unwrap();
    registry.keep(&second);
    registry.forget(&second);
    assert!(registry.get(&things).is_ok(), "it is the first one's");
    registry.forget(&first);
    assert_eq!(registry.names().count(), before);
}

#[test]
fn a_peer_cannot_replace_a_definition() {
    let mut registry = TypeRegistry::bundle(Dialect::Ros1);
    let before = registry.get(&name("geometry_msgs/Point")).unwrap();
    let found = registry
        .add_ros1_definition(&name("geometry_msgs/Point"), "float32 x\n")
        .unwrap();
    assert_eq!(found.leaves().len(), 1);
    assert_eq!(
        registry.get(&name("geometry_msgs/Point")).unwrap().md5(),
        before.md5()
    );
    registry
        .add(&name("geometry_msgs/Point"), "float32 x\n")
        .unwrap();
    assert_eq!(
        registry.get(&name("geometry_msgs/Point")).unwrap().md5(),
        found.md5()
    );
}

#[test]
fn a_broken_connection_header_is_refused_and_leaves_nothing_behind() {
    let mut registry = TypeRegistry::empty(Dialect::Ros1);
    let rule = "=".repeat(80);
    for text in [
        format!("int8 x\n{rule}\nno heading\nint8 y\n"),
        format!("int8 x\n{rule}\nMSG: not a name\nint8 y\n"),
        format!("mine/Missing x\n{rule}\nMSG: mine/Other\nint8 y\n"),
        format!("int8 x\n{rule}\nMSG: mine/Other\nint8[99999999999999999999] y\n"),
    ] {
        assert!(
            registry
                .add_ros1_definition(&name("mine/T"), &text)
                .is_err(),
            "{text}"
        );
        assert_eq!(registry.names().count(), 0, "{text}");
    }
    assert!(
        registry
            .add_ros1_definition(&name("mine/T"), &format!("int8 x\n{rule}"))
            .is_ok()
    );
}

#[test]
fn a_wrong_path_lists_the_paths_there_are() {
    let found = TypeRegistry::bundle(Dialect::Ros1)
        .get(&name("geometry_msgs/Vector3"))
        .unwrap();
    let error =
        MessagePlan::compile(&found, &Selection::Field("X".to_owned()), Wire::Ros1).unwrap_err();
    assert_eq!(
        error.to_string(),
        "`geometry_msgs/Vector3` has no field `X`; it has x, y, z"
    );
    let error = MessagePlan::compile(&found, &Selection::Whole, Wire::Cdr).unwrap_err();
    assert_eq!(
        error,
        PlanError::Wire {
            name: found.name().clone()
        }
    );
}

#[test]
fn every_standard_type_holds_its_builtin_type_alone() {
    for dialect in [Dialect::Ros1, Dialect::Ros2] {
        let registry = TypeRegistry::bundle(dialect);
        let mut found = 0;
        for builtin in (1..=25).filter_map(BuiltinType::from_id) {
            assert_eq!(standard_type(builtin, true), None);
            let Some(standard) = registry.standard_type(builtin, false) else {
                continue;
            };
            let leaves = registry.get(&standard).unwrap().leaves().to_vec();
            assert_eq!(
                leaves,
                [Leaf {
                    path: "data".to_owned(),
                    builtin,
                    rank: ArrayRank::Scalar
                }],
                "{standard}"
            );
            found += 1;
        }
        assert_eq!(found, 13);
    }
    assert_eq!(
        standard_type(BuiltinType::DateTime, false),
        Some(name("std_msgs/Time"))
    );
}

#[test]
fn constants_are_told_with_their_values() {
    let mut registry = TypeRegistry::empty(Dialect::Ros1);
    let text = "uint8 ADD=1 # one\nstring WORD= it's # all\nuint8 cmd";
    registry.add(&name("t/T"), text).unwrap();
    let found = registry.get(&name("t/T")).unwrap();
    let add = found.constant("ADD").unwrap();
    assert_eq!((add.builtin, add.value.as_str()), (BuiltinType::Byte, "1"));
    assert_eq!(found.constant("WORD").unwrap().value, "it's # all");
    assert_eq!(found.constants().len(), 2);
    assert!(found.constant("cmd").is_none());
    let mut registry = TypeRegistry::empty(Dialect::Ros2);
    let text = "string A='x'\nstring B=\"y\"\nstring C=z";
    registry.add(&name("t/T"), text).unwrap();
    let found = registry.get(&name("t/T")).unwrap();
    let values: Vec<&str> = found
        .constants()
        .iter()
        .map(|constant| constant.value.as_str())
        .collect();
    assert_eq!(values, ["x", "y", "z"]);
}

#[test]
fn a_service_is_the_same_while_no_message_in_it_is_another() {
    for dialect in [Dialect::Ros1, Dialect::Ros2] {
        let service = |inner: &str| {
            let mut registry = TypeRegistry::empty(dialect);
            registry.add(&name("t/Inner"), inner).unwrap();
            registry
                .add_service(&name("t/S"), "t/Inner[] all\n---\nbool ok\n")
                .unwrap();
            registry.service(&name("t/S")).unwrap()
        };
        let was = service("int32 a\n");
        assert!(was.is_same(&service("# as before\nint32 a\n")));
        assert!(!was.is_same(&service("int64 a\n")), "{dialect:?}");
        assert!(!was.is_same(&service("int32 b\n")), "{dialect:?}");
    }
}

#[test]
fn a_service_is_two_messages_found_only_through_it() {
    let mut registry = TypeRegistry::bundle(Dialect::Ros1);
    let text = "uint8 ADD = 1\nuint8 cmd\n--- # the answer\nItem[] items\n";
    registry.add_service(&name("t/List"), text).unwrap();
    let error = registry.service(&name("t/List")).unwrap_err();
    assert_eq!(
        error.to_string(),
        "no definition of `t/Item`, which `t/ListResponse` uses"
    );
    registry.add(&name("t/Item"), "string id").unwrap();
    let found = registry.service(&name("t/List")).unwrap();
    assert_eq!(found.request().leaves().len(), 1);
    assert_eq!(found.request().constant("ADD").unwrap().value, "1");
    assert_eq!(found.response().leaves()[0].path, "items");
    assert!(registry.get(&name("t/ListRequest")).is_err());
    let unknown = name("std_srvs/Triger");
    registry.service(&unknown).unwrap_err();
    assert_eq!(
        registry.suggest_service(&unknown),
        Some(name("std_srvs/Trigger"))
    );
}

#[test]
fn a_service_or_action_text_in_the_wrong_number_of_parts_is_refused() {
    let mut registry = TypeRegistry::empty(Dialect::Ros1);
    for text in ["", "bool a\n", "---\n---\n"] {
        let error = registry.add_service(&name("t/S"), text).unwrap_err();
        assert!(error.to_string().contains("one line `---`"), "{error}");
    }
    for text in ["", "---\n", "---\n---\n---\n"] {
        let error = registry.add_action(&name("t/A"), text).unwrap_err();
        assert!(error.to_string().contains("two lines `---`"), "{error}");
    }
    let error = registry
        .add_service(&name("t/S"), "bool a\n---\nbool b\nbool 9\n")
        .unwrap_err();
    assert!(
        error.to_string().starts_with("`t/SResponse` line 4"),
        "{error}"
    );
    let long = format!("t/{}", "S".repeat(250));
    assert!(registry.add_service(&name(&long), "---").is_err());
    assert_eq!(registry.names().count() + registry.services().count(), 0);
}

#[test]
fn an_action_of_ros_2_has_its_status_before_its_result() {
    let mut registry = TypeRegistry::bundle(Dialect::Ros2);
    let fibonacci = name("demo_msgs/Fibonacci");
    let text = "int32 order\n---\nint32[] sequence\n---\nint32[] partial\n";
    registry.add_action(&fibonacci, text).unwrap();
    let action = registry.action_messages(&fibonacci).unwrap();
    let paths = |message: &MessageType| -> Vec<String> {
        let leaves = message.leaves().iter();
        leaves.map(|leaf| leaf.path.clone()).collect()
    };
    assert_eq!(paths(action.goal()), ["order"]);
    assert_eq!(paths(action.feedback()), ["partial"]);
    let result = action.result_response();
    assert_eq!(paths(result), ["status", "result.sequence"]);
    let field = Selection::Field("result".to_owned());
    let plan = MessagePlan::compile(result, &field, Wire::Cdr).unwrap();
    assert_eq!(plan.leaves().len(), 1);
    let nothing = Selection::Template {
        fields: Vec::new(),
        rest: BTreeMap::new(),
    };
    let plan = MessagePlan::compile(result, &nothing, Wire::Cdr).unwrap();
    let mut empty = Vec::new();
    plan.write(&mut NoFields, &mut empty).unwrap();
    // The count of the sequence is aligned after the status.
    assert_eq!(empty, [0, 1, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0]);
    let error = registry
        .action_messages(&name("demo_msgs/Fibonaci"))
        .unwrap_err();
    assert!(
        error.to_string().contains("demo_msgs/FibonaciGoal"),
        "{error}"
    );
}

/// `ros/ua_msgs` is the package of these types for nodes of users.
#[test]
fn the_package_people_build_has_the_skill_messages_that_are_built_in() {
    let folder = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../../ros/ua_msgs");
    let cmake = std::fs::read_to_string(folder.join("CMakeLists.txt")).unwrap();
    for dialect in [Dialect::Ros1, Dialect::Ros2] {
        let built_in = TypeRegistry::bundle(dialect);
        let mut files = TypeRegistry::empty(dialect);
        for entry in std::fs::read_dir(folder.join("msg")).unwrap() {
            let path = entry.unwrap().path();
            let stem = path.file_stem().unwrap().to_str().unwrap().to_owned();
            let text = std::fs::read_to_string(&path).unwrap();
            files.add(&name(&format!("ua_msgs/{stem}")), &text).unwrap();
            assert!(cmake.contains(&format!(" {stem}.msg")), "{stem}");
        }
        for entry in std::fs::read_dir(folder.join("action")).unwrap() {
            let path = entry.unwrap().path();
            let stem = path.file_stem().unwrap().to_str().unwrap().to_owned();
            let text = std::fs::read_to_string(&path).unwrap();
            let action = name(&format!("ua_msgs/{stem}"));
            files.add_action(&action, &text).unwrap();
            assert!(cmake.contains(&format!(" {stem}.action")), "{stem}");
        }
        for entry in std::fs::read_dir(folder.join("srv")).unwrap() {
            let path = entry.unwrap().path();
            let stem = path.file_stem().unwrap().to_str().unwrap().to_owned();
            let text = std::fs::read_to_string(&path).unwrap();
            let service = name(&format!("ua_msgs/{stem}"));
            files.add_service(&service, &text).unwrap();
            assert!(cmake.contains(&format!("{stem}.srv")), "{stem}");
            let [ours, file] = [&built_in, &files].map(|all| all.service(&service).unwrap());
            assert_eq!(ours.md5(), file.md5(), "{service}");
        }
        let of_ours: Vec<&TypeName> = built_in
            .names()
            .filter(|known| known.package() == "ua_msgs")
            .collect();
        assert_eq!(files.names().collect::<Vec<_>>(), of_ours);
        // The wrappers of actionlib around the parts of an action belong to other packages.
        let parts = of_ours
            .iter()
            .filter(|name| !name.name().contains("Action"));
        for each in parts.copied() {
            let (ours, file) = (built_in.get(each).unwrap(), files.get(each).unwrap());
            assert_eq!(ours.leaves(), file.leaves(), "{each}");
            assert_eq!(ours.constants(), file.constants(), "{each}");
            if dialect == Dialect::Ros1 {
                assert_eq!(ours.md5(), file.md5(), "{each}");
            }
        }
    }
}
