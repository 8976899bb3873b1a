//! The NodeSet in parts, one for each domain, for engineering tools that need some of the types.
//!
//! All parts are of one namespace. The part of devices defines the model and is loaded first; the
//! others have no model of their own.

use super::super::table::SkillType;
use super::super::types::TYPES;
use super::{HEAD, NAMESPACE, Nodes};

/// A part of the NodeSet.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct DomainNodeSet {
    /// The name of its file.
    pub file: &'static str,
    /// The NodeSet2 document.
    pub text: String,
}

/// A file, and the types whose subtypes it contains with the types themselves.
const DOMAINS: [(&str, &[&str]); 6] = [
    ("UaBridge.Device.NodeSet2.xml", &["SkillType"]),
    (
        "UaBridge.Robotics.NodeSet2.xml",
        &["MotionSkillType", "NavigateToSkillType"],
    ),
    ("UaBridge.Gripper.NodeSet2.xml", &["GripperSkillType"]),
    ("UaBridge.ToolChanger.NodeSet2.xml", &["ToolSkillType"]),
    (
        "UaBridge.Composite.NodeSet2.xml",
        &["PickAndPlaceSkillType"],
    ),
    (
        "UaBridge.Process.NodeSet2.xml",
        &[
            "ExecuteProcessSkillType",
            "LocateObjectSkillType",
            "RunConveyorSkillType",
        ],
    ),
];

/// Returns the NodeSet of [`NAMESPACE`] in parts, in the order in which they are loaded.
#[must_use]
pub fn domain_nodesets() -> Vec<DomainNodeSet> {
    let parts = DOMAINS.iter().enumerate();
    parts
        .map(|(at, (file, _))| DomainNodeSet {
            file,
            text: part(at),
        })
        .collect()
}

fn part(at: usize) -> String {
    let head = HEAD.replace("{NAMESPACE}", NAMESPACE);
    let is_first = at == 0;
    let mut nodes = Nodes(match is_first {
        true => head,
        false => without_model(&head),
    });
    for of in TYPES.iter().filter(|of| domain(of) == at) {
        nodes.skill_type(of);
    }
    if is_first {
        nodes.event_type();
        nodes.controller_type();
        nodes.used_skills();
        nodes.dictionary();
    }
    let mut text = nodes.0;
    text.push_str("</UANodeSet>\n");
    text
}

/// Returns the index of the domain of a type: that of the nearest type of its chain which is
/// listed.
fn domain(of: &'static SkillType) -> usize {
    let listed = |name: &str| DOMAINS.iter().position(|(_, types)| types.contains(&name));
    of.chain()
        .find_map(|above| listed(above.name))
        .unwrap_or_default()
}

fn without_model(head: &str) -> String {
    match (
        head.split_once("  <Models>"),
        head.split_once("</Models>\n"),
    ) {
        (Some((before, _)), Some((_, after))) => format!("{before}{after}"),
        _ => head.to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;
    use std::path::Path;

    use super::*;
    use crate::model::nodeset;

    fn nodes(text: &str) -> BTreeSet<&str> {
        let ids = text.split(" NodeId=\"").skip(1);
        ids.filter_map(|rest| rest.split('"').next()).collect()
    }

    #[test]
    fn the_parts_have_each_node_once_and_the_first_defines_the_model() {
        let parts = domain_nodesets();
        let whole = nodeset();
        let mut all = BTreeSet::new();
        for part in &parts {
            for node in nodes(&part.text) {
                assert!(all.insert(node), "{}: {node}", part.file);
            }
            let is_first = part.file == "UaBridge.Device.NodeSet2.xml";
            assert_eq!(part.text.contains("<Models>"), is_first, "{}", part.file);
            let supertypes_are_known = part
                .text
                .split("ParentNodeId=\"")
                .skip(1)
                .filter_map(|rest| rest.split('"').next())
                .all(|parent| all.contains(parent));
            assert!(supertypes_are_known, "{}", part.file);
        }
        assert_eq!(all, nodes(&whole));
        let grippers = &parts[2].text;
        assert!(grippers.contains("1:GraspSkillType") && !grippers.contains("1:PtpMoveSkillType"));
    }

    /// With `UPDATE_NODESETS=1` the test writes the files.
    #[test]
    fn the_files_of_the_packages_are_current() {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../examples/plant/nodesets");
        for DomainNodeSet { file, text } in domain_nodesets() {
            let path = folder.join(file);
            if std::env::var_os("UPDATE_NODESETS").is_some() {
                std::fs::create_dir_all(&folder).unwrap();
                std::fs::write(&path, &text).unwrap();
            }
            let written = std::fs::read_to_string(&path).unwrap_or_default();
            assert!(
                written == text,
                "{} is outdated: run `UPDATE_NODESETS=1 cargo test -p skills`",
                path.display()
            );
        }
    }
}
