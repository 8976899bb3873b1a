//! The shipped ROS definitions of the skill types: the actions of `ros/ua_msgs`, and the same
//! actions built in.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

use messages::{Dialect, TypeName, TypeRegistry};
use skills::model::TYPES;
use ua_component::definition::{PACKAGE, action_name, action_type, definition, field_name};

const REFRESH: &str = "refresh it: UA_REFRESH=1 cargo test -p ua-component --test definitions";

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../..")
}

fn definitions() -> BTreeMap<&'static str, String> {
    let all = TYPES.iter().map(|of| (action_name(of), definition(of)));
    all.collect()
}

/// Returns the content of a file, which is updated before if UA_REFRESH is set.
fn shipped(path: &Path, wanted: &str) -> String {
    if std::env::var_os("UA_REFRESH").is_some() {
        // A failed write leaves other content, which the caller reports.
        drop(fs::write(path, wanted));
    }
    fs::read_to_string(path).unwrap_or_default()
}

#[test]
fn the_actions_of_the_package_are_those_of_the_table_of_skill_types() {
    let folder = root().join("ros").join(PACKAGE);
    let all = definitions();
    assert_eq!(all.len(), TYPES.len(), "each has a name of its own");
    for (name, text) in &all {
        let path = folder.join("action").join(format!("{name}.action"));
        assert_eq!(shipped(&path, text), *text, "{name}: {REFRESH}");
    }
    let files = fs::read_dir(folder.join("action")).unwrap();
    assert_eq!(files.count(), all.len(), "no others are shipped");
    let path = folder.join("CMakeLists.txt");
    let names: Vec<String> = all.keys().map(|name| format!("{name}.action")).collect();
    let now = fs::read_to_string(&path).unwrap();
    let wanted: String = now
        .lines()
        .map(|line| match line.starts_with("set(actions") {
            true => format!("set(actions {})\n", names.join(" ")),
            false => format!("{line}\n"),
        })
        .collect();
    assert_eq!(shipped(&path, &wanted), wanted, "{REFRESH}");
}

#[test]
fn the_actions_that_are_built_in_are_those_of_the_package() {
    let path = root().join("ros/messages/bundle/ua_msgs.txt");
    let now = fs::read_to_string(&path).unwrap();
    let mut wanted: String = now
        .lines()
        .take_while(|line| !line.starts_with("action "))
        .map(|line| format!("{line}\n"))
        .collect();
    for (name, text) in definitions() {
        let lines = text
            .lines()
            .filter(|line| !line.is_empty() && !line.starts_with('#'));
        let lines = lines.map(|line| format!("{line}\n"));
        wanted.push_str(&format!("action {name}\n{}", lines.collect::<String>()));
    }
    // The services of the package, which are not of skills, follow the actions.
    let services = now
        .lines()
        .skip_while(|line| !line.starts_with("service "))
        .map(|line| format!("{line}\n"));
    wanted.extend(services);
    assert_eq!(shipped(&path, &wanted), wanted, "{REFRESH}");
}

#[test]
fn either_ros_takes_the_definitions_as_they_are_shipped() {
    for dialect in [Dialect::Ros1, Dialect::Ros2] {
        let mut registry = TypeRegistry::bundle(dialect);
        for (name, text) in definitions() {
            let name: TypeName = format!("test_{PACKAGE}/{name}").parse().unwrap();
            registry.add_action(&name, &text).unwrap();
            registry.action_calls(&name).unwrap();
        }
    }
}

#[test]
fn a_skill_is_of_the_action_of_its_nearest_type_that_is_ours() {
    let own = |name: &str| name.parse().unwrap();
    let vendor = own("nsu=urn:vendor;VacuumGraspSkillType");
    let types = [vendor, own("GraspSkillType"), own("GripperSkillType")];
    assert_eq!(action_type(&types).as_deref(), Some("ua_msgs/Grasp"));
    assert_eq!(action_type(&types[2..]).as_deref(), Some("ua_msgs/Gripper"));
    let all = [own("SkillType")];
    assert_eq!(action_type(&all).as_deref(), Some("ua_msgs/RunSkill"));
    assert_eq!(action_type(&types[..1]), None);
}

#[test]
fn names_are_spelled_as_ros_takes_them() {
    for (name, wanted) in [
        ("TargetPosition", "target_position"),
        ("Force", "force"),
        ("ToolAppUri", "tool_app_uri"),
        ("Axis1Bounds", "axis1_bounds"),
        ("Max - Force", "max_force"),
    ] {
        assert_eq!(field_name(name), wanted);
    }
}
