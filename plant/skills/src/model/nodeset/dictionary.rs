//! Entries of a dictionary (OPC 10000-19), so that tools recognise what the skills of a type do
//! without knowing the type.
//!
//! The entries are the classes of an ontology of VDI 2860, the German guideline on handling. The
//! guideline itself has no identifiers for its functions.

use super::super::table::SkillType;
use super::{Node, Nodes, own};

/// A class of the ontology, and the types whose skills have this function.
struct Entry {
    class: &'static str,
    types: &'static [&'static str],
    about: &'static str,
}

const ENTRIES: [Entry; 9] = [
    Entry {
        class: "Handling",
        types: &["PickAndPlaceSkillType"],
        about: "Handling of an object by several functions.",
    },
    Entry {
        class: "Securing",
        types: &["GripperSkillType"],
        about: "Creating, keeping or ending the hold of an object.",
    },
    Entry {
        class: "Tensioning",
        types: &["GraspSkillType"],
        about: "Clamping an object.",
    },
    Entry {
        class: "Slackening",
        types: &["ReleaseSkillType"],
        about: "Unclamping an object.",
    },
    Entry {
        class: "Moving",
        types: &["MotionSkillType"],
        about: "Changing the position or the orientation of an object.",
    },
    Entry {
        class: "Positioning",
        types: &["PtpMoveSkillType", "JointPtpMoveSkillType"],
        about: "Moving an object to a given position, on any path.",
    },
    Entry {
        class: "Guiding",
        types: &["LinearMoveSkillType", "JointLinearMoveSkillType"],
        about: "Moving an object along a given path.",
    },
    Entry {
        class: "Conveying",
        types: &["RunConveyorSkillType"],
        about: "Moving objects from one place to another.",
    },
    Entry {
        class: "MeasuringPosition",
        types: &["LocateObjectSkillType"],
        about: "Measuring the position of an object.",
    },
];

/// Adds the references of a type to its entries.
pub(super) fn refer<'a>(mut node: Node<'a>, of: &SkillType) -> Node<'a> {
    for (id, entry) in (FIRST_ENTRY..).zip(&ENTRIES) {
        if entry.types.contains(&of.name) {
            node = node.forward("HasDictionaryEntry", own(id));
        }
    }
    node
}

impl Nodes {
    /// Adds the folder of the dictionary and its entries.
    pub(super) fn dictionary(&mut self) {
        let folder = Node::new("UAObject", FOLDER, "1:VDI 2860")
            .about("Functions of handling, by the classes of an ontology of VDI 2860.")
            .forward("HasTypeDefinition", DICTIONARY_FOLDER_TYPE)
            .back("HasComponent", DICTIONARIES);
        self.add(folder);
        for (id, entry) in (FIRST_ENTRY..).zip(&ENTRIES) {
            let browse_name = format!("1:{ONTOLOGY}{}", entry.class);
            let node = Node::new("UAObject", id, &browse_name)
                .about(entry.about)
                .attribute("ParentNodeId", &own(FOLDER))
                .forward("HasTypeDefinition", URI_DICTIONARY_ENTRY_TYPE)
                .back("HasComponent", own(FOLDER));
            self.add(node);
        }
    }
}

const ONTOLOGY: &str = "http://www.hsu-ifa.de/ontologies/VDI2860#";
const FOLDER: u32 = 9100;
const FIRST_ENTRY: u32 = 9101;
const DICTIONARIES: &str = "i=17594";
const DICTIONARY_FOLDER_TYPE: &str = "i=17591";
const URI_DICTIONARY_ENTRY_TYPE: &str = "i=17600";

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::types::TYPES;

    #[test]
    fn each_type_of_an_entry_exists_and_refers_to_it() {
        let text = crate::model::nodeset();
        for (id, entry) in (FIRST_ENTRY..).zip(&ENTRIES) {
            let browse_name = format!("BrowseName=\"1:{ONTOLOGY}{}\"", entry.class);
            assert_eq!(text.matches(&browse_name).count(), 1, "{}", entry.class);
            assert!(
                TYPES
                    .iter()
                    .filter(|of| entry.types.contains(&of.name))
                    .count()
                    == entry.types.len()
            );
            let reference = format!("ReferenceType=\"HasDictionaryEntry\">ns=1;i={id}<");
            assert_eq!(text.matches(&reference).count(), entry.types.len());
        }
    }
}
