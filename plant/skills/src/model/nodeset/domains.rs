//! The NodeSet in parts, one for each domain, for engineering tools that need some of the types.
//!
//! The nodes of all parts are of one namespace. The part of devices is its model. Each other part
//! is a model of its own that requires it: loaders order documents by their models, and some load
//! only one document of a model.

use super::super::table::SkillType;
use super::super::types::TYPES;
use super::head::head;
use super::{NAMESPACE, Nodes};

/// A part of the NodeSet.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct DomainNodeSet {
    /// The name of its file.
    pub file: &'static str,
    /// The NodeSet2 document.
    pub text: String,
}

struct NodeSetDomain {
    file: &'static str,
    /// The end of the URI of its model; `None` for the model of the namespace.
    model: Option<&'static str>,
    /// The types whose subtypes it contains with the types themselves.
    types: &'static [&'static str],
}

const DOMAINS: [NodeSetDomain; 6] = [
    NodeSetDomain {
        file: "UaBridge.Device.NodeSet2.xml",
        model: None,
        types: &["SkillType"],
    },
    NodeSetDomain {
        file: "UaBridge.Robotics.NodeSet2.xml",
        model: Some("robotics"),
        types: &["MotionSkillType", "NavigateToSkillType"],
    },
    NodeSetDomain {
        file: "UaBridge.Gripper.NodeSet2.xml",
        model: Some("gripper"),
        types: &["GripperSkillType"],
    },
    NodeSetDomain {
        file: "UaBridge.ToolChanger.NodeSet2.xml",
        model: Some("tool-changer"),
        types: &["ToolSkillType"],
    },
    NodeSetDomain {
        file: "UaBridge.Composite.NodeSet2.xml",
        model: Some("composite"),
        types: &["PickAndPlaceSkillType"],
    },
    NodeSetDomain {
        file: "UaBridge.Process.NodeSet2.xml",
        model: Some("process"),
        types: &[
            "ExecuteProcessSkillType",
            "LocateObjectSkillType",
            "RunConveyorSkillType",
        ],
    },
];

/// Returns the NodeSet of [`NAMESPACE`] in parts, in the order in which they are loaded.
#[must_use]
pub fn domain_nodesets() -> Vec<DomainNodeSet> {
    let parts = DOMAINS.iter().enumerate();
    parts
        .map(|(at, part)| DomainNodeSet {
            file: part.file,
            text: part_text(at, part.model),
        })
        .collect()
}

fn part_text(at: usize, model: Option<&str>) -> String {
    let model = model.map(|model| format!("{NAMESPACE}:{model}"));
    let mut nodes = Nodes(head(model.as_deref()));
    for of in TYPES.iter().filter(|of| domain(of) == at) {
        nodes.skill_type(of);
    }
    if model.is_none() {
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
    let listed = |name: &str| {
        let mut domains = DOMAINS.iter();
        domains.position(|domain| domain.types.contains(&name))
    };
    of.chain()
        .find_map(|above| listed(above.name))
        .unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;
    use std::path::Path;

    use super::*;
    use crate::model::nodeset;

    /// Returns the texts from a mark to the next quotation mark.
    fn after<'t>(text: &'t str, mark: &str) -> Vec<&'t str> {
        let rests = text.split(mark).skip(1);
        rests.filter_map(|rest| rest.split('"').next()).collect()
    }

    fn nodes(text: &str) -> BTreeSet<&str> {
        after(text, " NodeId=\"").into_iter().collect()
    }

    #[test]
    fn the_parts_have_each_node_once_and_a_model_each_that_requires_the_first() {
        let parts = domain_nodesets();
        let whole = nodeset();
        let mut all = BTreeSet::new();
        let mut models = BTreeSet::new();
        for part in &parts {
            for node in nodes(&part.text) {
                assert!(all.insert(node), "{}: {node}", part.file);
            }
            let [model] = after(&part.text, "<Model ModelUri=\"")[..] else {
                panic!("{}", part.file)
            };
            assert!(models.insert(model.to_owned()), "{model} is there twice");
            let uris = after(&part.text, "<Uri>").into_iter();
            let uris: Vec<&str> = uris.filter_map(|rest| rest.split('<').next()).collect();
            let required = after(&part.text, "<RequiredModel ModelUri=\"");
            let core = "http://opcfoundation.org/UA/";
            match part.file {
                "UaBridge.Device.NodeSet2.xml" => {
                    assert_eq!((uris, required), (vec![NAMESPACE], vec![core]));
                    assert_eq!(model, NAMESPACE);
                }
                _ => assert_eq!(
                    (uris, required),
                    (vec![NAMESPACE, model], vec![core, NAMESPACE])
                ),
            }
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
