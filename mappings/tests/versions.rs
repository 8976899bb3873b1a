//! The ROS 1 and the ROS 2 version of each type in both bundles, bound to one variable.
use std::collections::BTreeSet;
use std::fmt::Write as _;

use mappings::{Code, Mapping};
use messages::{Dialect, TypeName, TypeRegistry};

/// Types of both bundles that do not cross unchanged, and the reason, as `ua-space check` reports
/// it. All other types have the same fields in the same order: `Header.seq` is left out, times and
/// durations are one field each, and ROS 2 has lower-case letters.
const TOLD: [(&str, &str); 6] = [
    (
        "diagnostic_msgs/DiagnosticStatus",
        "with different types: `level (SByte, Byte)`",
    ),
    ("sensor_msgs/Range", "only in space 2: `variance`"),
    (
        "shape_msgs/SolidPrimitive",
        "only in space 2: `polygon.points`",
    ),
    ("std_msgs/Byte", ""),
    (
        "std_msgs/ByteMultiArray",
        "with different types: `data (SByte[], ByteString)`",
    ),
    (
        "visualization_msgs/Marker",
        "only in space 2: `texture_resource`, `texture.header.stamp`, `texture.header.frame_id`, `texture.format`, \
         `texture.data`, `uv_coordinates`, `mesh_file.filename`, `mesh_file.data`",
    ),
];

fn common() -> Vec<TypeName> {
    let ros2 = TypeRegistry::bundle(Dialect::Ros2);
    let ros1 = TypeRegistry::bundle(Dialect::Ros1);
    let both = ros1
        .names()
        .filter(|name| ros2.names().any(|other| other == *name));
    // A type without fields has no value.
    both.filter(|name| !ros1.get(name).unwrap().leaves().is_empty())
        .cloned()
        .collect()
}

#[test]
fn every_type_of_both_bundles_crosses_or_is_told_with_the_fields_of_both_sides() {
    let names = common();
    assert!(names.len() > 110, "{}", names.len());
    let mut yaml = "spaces: [{id: 1}, {id: 2}]\nnamespaces: {2: urn:x}\nvariables:\n".to_owned();
    for (number, name) in names.iter().enumerate() {
        let id = number + 1;
        writeln!(
            yaml,
            "  - {{node: ns=2;i={id}, name: V{id}, origin: 1, ros: [{{topic: /t{id}, type: {name}}}, {{space: 2, topic: /t{id}, type: {name}}}]}}"
        )
        .unwrap();
    }
    let checked = Mapping::from_yaml(&yaml, "versions.yaml");
    let told: BTreeSet<(String, String)> = checked
        .findings
        .iter()
        .filter(|found| found.code != Code::EndlessMotion)
        .map(|found| {
            let name = names.get(found.at.line - 4).unwrap();
            let help = found.help.clone().unwrap_or_default();
            assert_eq!(found.code, Code::BindingsDiffer, "{name}");
            let help = help
                .strip_suffix("bind fields of one type on both sides")
                .unwrap();
            (name.to_string(), help.trim_end_matches("; ").to_owned())
        })
        .collect();
    let expected = TOLD.map(|(name, help)| (name.to_owned(), help.to_owned()));
    assert_eq!(told, BTreeSet::from(expected), "{}", checked.render(&yaml));
}
