//! Shipped files beside the code: the documents, and their schema for editors.
use std::path::{Path, PathBuf};

use mappings::{Code, Mapping, Overflow, SpaceId, TopicId};
use messages::Selection;
use uadp::BuiltinType;

fn folder() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

fn load(path: &Path) -> Mapping {
    let text = std::fs::read_to_string(path).unwrap();
    let checked = Mapping::from_yaml(&text, &path.display().to_string());
    // A vendor's robot brings its own types, by its publishers and by files beside the program; so
    // do Nav2 and MoveIt.
    let expected = |code| {
        path.ends_with("niryo-ned.yaml")
            && matches!(
                code,
                Code::UnknownMessageType | Code::UnknownServiceType | Code::UnknownActionType
            )
            || ["navigation.yaml", "moveit.yaml"]
                .iter()
                .any(|name| path.ends_with(name))
                && code == Code::UnknownActionType
    };
    assert!(
        checked
            .findings
            .iter()
            .all(|finding| expected(finding.code)),
        "{}",
        checked.render(&text)
    );
    checked
        .mapping
        .unwrap_or_else(|| panic!("{} has no finding and no mapping", path.display()))
}

#[test]
fn every_shipped_document_is_without_findings() {
    let entries = std::fs::read_dir(folder())
        .unwrap()
        .map(|entry| entry.unwrap().path());
    let yaml: Vec<PathBuf> = entries
        .filter(|path| path.extension().is_some_and(|e| e == "yaml"))
        .collect();
    assert!(yaml.len() >= 2, "{yaml:?}");
    for path in yaml {
        load(&path);
    }
}

#[test]
fn the_readme_shows_the_minimal_document_as_it_is() {
    let minimal = std::fs::read_to_string(folder().join("minimal.yaml")).unwrap();
    let readme = std::fs::read_to_string(folder().join("../README.md")).unwrap();
    assert!(
        readme.contains(&minimal),
        "the README's first mapping is not minimal.yaml"
    );
}

#[test]
fn the_assembly_line_names_each_value_on_both_sides() {
    let mapping = load(&folder().join("assembly-line.yaml"));
    assert_eq!(mapping.pubsub().interface.as_deref(), Some("lo"));
    assert_eq!(
        mapping.namespaces().get(&2).map(String::as_str),
        Some("urn:ua-bridge:assembly-line")
    );
    let two = SpaceId::new(2).unwrap();
    assert_eq!(mapping.domain_of(two), Some(2));
    assert_eq!(mapping.space_of_domain(2), Some(two));
    let expected = [
        (
            "ua_1_2_10",
            "ConveyorRunning",
            BuiltinType::Boolean,
            "/conveyor/running",
        ),
        (
            "ua_1_2_11",
            "CoversInStorage",
            BuiltinType::UInt32,
            "/storage/covers",
        ),
        (
            "ua_1_2_12",
            "CoversOnConveyor",
            BuiltinType::UInt32,
            "/conveyor/covers",
        ),
        (
            "ua_1_2_13",
            "CoversOnTurtleBot3",
            BuiltinType::UInt32,
            "/turtlebot3/covers",
        ),
        ("ua_2_2_20", "ParkBusy", BuiltinType::Boolean, "/park/busy"),
        (
            "ua_2_2_21",
            "BucketBusy",
            BuiltinType::Boolean,
            "/bucket/busy",
        ),
    ];
    assert_eq!(mapping.variables().len(), expected.len());
    for (topic, name, builtin, ros_topic) in expected {
        let topic: TopicId = topic.parse().unwrap();
        let variable = mapping.variable(topic).unwrap();
        assert_eq!(variable.name, name);
        assert_eq!(
            variable.node.to_string(),
            format!("ns=2;i={}", topic.identifier)
        );
        assert_eq!(variable.value_type, Some((builtin, false)));
        assert_eq!(variable.fields.len(), 1);
        assert_eq!(variable.overflow, Overflow::KeepLatest);
        for space in [SpaceId::ROS1, two] {
            let binding = variable.binding(space).unwrap();
            assert_eq!(binding.ros_topic, ros_topic);
            assert_eq!(binding.selection, Selection::Field("data".to_owned()));
        }
    }
    assert_eq!(mapping.bindings(SpaceId::ROS1).count(), 6);
}

#[test]
fn the_first_mapping_of_the_readme_has_eleven_lines() {
    let path = folder().join("minimal.yaml");
    assert_eq!(std::fs::read_to_string(&path).unwrap().lines().count(), 11);
    let mapping = load(&path);
    let variable = mapping.variable("ua_1_2_10".parse().unwrap()).unwrap();
    assert_eq!(
        variable.value_type,
        Some((BuiltinType::Boolean, false)),
        "the ROS type says it"
    );
    assert_eq!(
        variable.bindings.first().map(|binding| binding.space),
        Some(SpaceId::ROS1)
    );
}

#[test]
fn the_schema_is_that_of_the_code() {
    let path = folder().join("schema.json");
    let schema = mappings::schema();
    if std::env::var_os("UA_REFRESH").is_some() {
        std::fs::write(&path, &schema).unwrap();
    }
    let shipped = std::fs::read_to_string(&path).unwrap_or_default();
    assert!(
        shipped == schema,
        "mappings/schema.json is not what the code says; refresh it: UA_REFRESH=1 cargo test -p mappings"
    );
}
