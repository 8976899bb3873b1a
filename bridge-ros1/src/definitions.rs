//! Message definitions: built-in definitions, definitions from connection headers of publishers,
//! and definitions from ROS packages.

use std::path::PathBuf;
use std::sync::Arc;

use bridge_node::{RosEnvironment, TypePaths};
use messages::{DefinitionError, Dialect, MessageType, PeerDefinitions, TypeName, TypeNameError};
use tcpros::ConnectionHeader;

use crate::brought::{Brought, MAX_BYTES, TypeRoom};

/// Finds message types by name. A found type is kept, except types of publishers that have
/// disconnected.
#[derive(Debug)]
pub(crate) struct Ros1Definitions {
    /// The types of all sources.
    pub(crate) known: bridge_node::Definitions,
    brought: Brought,
}

impl Ros1Definitions {
    /// Creates the definitions with the `type_paths` of the mapping, and the package folders in
    /// `ROS_PACKAGE_PATH`.
    pub(crate) fn new(types: Arc<TypePaths>, packages: Vec<PathBuf>) -> Self {
        let environment = RosEnvironment {
            ros1: packages,
            ros2: Vec::new(),
        };
        Self {
            known: bridge_node::Definitions::new(Dialect::Ros1, types, environment),
            brought: Brought::default(),
        }
    }

    /// Replaces the definitions of the `type_paths` of the mapping.
    pub(crate) fn replace(&mut self, types: &Arc<TypePaths>) {
        self.known.replace(types);
    }

    /// Returns the type of a publisher: from the definition in its connection header, otherwise the
    /// known type with this name and MD5 sum. The definition is stored if there is room; for a
    /// `mapped` topic there always is.
    pub(crate) fn of_publisher(
        &mut self,
        header: &ConnectionHeader,
        mapped: bool,
    ) -> Result<Arc<MessageType>, UnusableMessages> {
        let name: TypeName = header.type_name().unwrap_or_default().parse()?;
        let md5sum = header.md5sum().unwrap_or("*");
        let fits = |found: &MessageType| md5sum == "*" || found.md5() == md5sum;
        let text = header.message_definition().unwrap_or_default();
        if !text.trim().is_empty() || md5sum == EMPTY {
            // A definition known before is not used to read this publisher, but remains the
            // definition for publishing.
            let before = self.known.find(&name).is_ok();
            match self.known.registry().read_ros1_definition(&name, text) {
                Ok((found, definitions)) if fits(&found) => {
                    let found = self.keep(found, definitions, mapped)?;
                    if !before {
                        self.known
                            .learned(&name, || "a connection header".to_owned());
                    }
                    return Ok(found);
                }
                // Some tools that write bags or bridge topics send a definition that does not match
                // their MD5 sum.
                Ok(_) | Err(_)
                    if self
                        .known
                        .registry()
                        .get(&name)
                        .is_ok_and(|known| fits(&known)) => {}
                Ok((found, _)) => {
                    return Err(UnusableMessages::Checksum {
                        name,
                        theirs: md5sum.to_owned(),
                        ours: found.md5().to_owned(),
                    });
                }
                Err(error) => return Err(error.into()),
            }
        }
        let known = self.get(&name)?;
        if fits(&known) {
            Ok(known)
        } else {
            let ours = known.md5().to_owned();
            Err(UnusableMessages::Checksum {
                name,
                theirs: md5sum.to_owned(),
                ours,
            })
        }
    }

    /// Stores the definitions of a publisher, and removes definitions that no publisher uses.
    fn keep(
        &mut self,
        found: Arc<MessageType>,
        definitions: PeerDefinitions,
        mapped: bool,
    ) -> Result<Arc<MessageType>, UnusableMessages> {
        let gone = match self.brought.room_for(&found, definitions.len(), mapped) {
            TypeRoom::Known(known) => return Ok(known),
            TypeRoom::After(gone) => gone,
            TypeRoom::None => return Err(UnusableMessages::Full),
        };
        for entry in &gone {
            self.known.registry_mut().forget(&entry.definitions);
            self.known.forgotten(&entry.name);
        }
        if !gone.is_empty() {
            // A removed type may have brought definitions that a stored type uses and brought too.
            for kept in self.brought.definitions() {
                self.known.registry_mut().keep(kept);
            }
        }
        self.known.registry_mut().keep(&definitions);
        self.brought.take(&found, definitions);
        Ok(found)
    }

    /// Returns the type with this name and its dependencies. Unknown types are searched in the
    /// packages.
    pub(crate) fn get(&mut self, name: &TypeName) -> Result<Arc<MessageType>, DefinitionError> {
        self.known.find(name)
    }
}

/// The reason why messages of a publisher cannot be read.
#[derive(Debug, thiserror::Error)]
pub(crate) enum UnusableMessages {
    #[error(transparent)]
    Name(#[from] TypeNameError),
    #[error(transparent)]
    Definition(#[from] DefinitionError),
    #[error(
        "the limit of {} MiB for definitions of unmapped publishers is reached; add the topic to the \
         mapping to exempt it from the limit",
        MAX_BYTES >> 20
    )]
    Full,
    #[error(
        "the publisher announces the MD5 sum {theirs} for {name}, but the definition that it sends has {ours}"
    )]
    Checksum {
        name: TypeName,
        theirs: String,
        ours: String,
    },
}

/// The MD5 sum of a definition without fields, such as std_msgs/Empty.
const EMPTY: &str = "d41d8cd98f00b204e9800998ecf8427e";

#[cfg(test)]
mod tests {
    use super::*;

    fn header(name: &str, md5sum: &str, text: &str) -> ConnectionHeader {
        ConnectionHeader::default()
            .with("type", name)
            .with("md5sum", md5sum)
            .with("message_definition", text)
    }

    #[test]
    fn a_type_nobody_has_heard_of_is_learned_from_its_publisher() {
        let mut definitions = Ros1Definitions::new(Arc::default(), vec![]);
        let text = "robot_msgs/Joint[] joints\n\
            ================================================================================\n\
            MSG: robot_msgs/Joint\nstring name\nfloat64 angle\n";
        let found = definitions
            .of_publisher(&header("robot_msgs/Arm", "*", text), false)
            .unwrap();
        assert_eq!(found.leaves()[0].path, "joints");
        let joint = definitions
            .get(&"robot_msgs/Joint".parse().unwrap())
            .unwrap();
        assert_eq!(joint.leaves()[1].path, "angle");
    }

    #[test]
    fn a_publisher_without_a_text_is_known_by_its_checksum() {
        let mut definitions = Ros1Definitions::new(Arc::default(), vec![]);
        let string = "992ce8a1687cec8c8bd883ec73ca41d1";
        let found = definitions
            .of_publisher(&header("std_msgs/String", string, ""), false)
            .unwrap();
        assert_eq!(found.md5(), string);
        let other =
            definitions.of_publisher(&header("std_msgs/String", &"0".repeat(32), ""), false);
        assert!(matches!(other, Err(UnusableMessages::Checksum { .. })));
    }

    #[test]
    fn a_text_that_is_not_that_of_the_checksum_is_not_believed() {
        let mut definitions = Ros1Definitions::new(Arc::default(), vec![]);
        let lie = header("robot_msgs/Arm", &"0".repeat(32), "int32 a\n");
        assert!(matches!(
            definitions.of_publisher(&lie, false),
            Err(UnusableMessages::Checksum { .. })
        ));
        let bool = definitions.get(&"std_msgs/Bool".parse().unwrap()).unwrap();
        let wrong_text = header("std_msgs/Bool", bool.md5(), "int32 a\n");
        assert_eq!(
            definitions
                .of_publisher(&wrong_text, false)
                .unwrap()
                .definition(),
            bool.definition()
        );
    }

    #[test]
    fn a_message_without_fields_has_a_type() {
        let found = Ros1Definitions::new(Arc::default(), vec![])
            .of_publisher(&header("std_msgs/Empty", EMPTY, ""), false);
        assert_eq!(found.unwrap().leaves().len(), 0);
    }

    /// Returns a connection header of a type with this number, with as many nested types as fit
    /// into half a MiB.
    fn bulky(number: usize) -> ConnectionHeader {
        let rule = "=".repeat(80);
        let mut text = String::new();
        for part in 0..2000 {
            text += &format!("bulk_msgs/N{number}P{part} p{part}\n");
        }
        for part in 0..2000 {
            text += &format!(
                "{rule}\nMSG: bulk_msgs/N{number}P{part}\nint8 a # {:100}\n",
                ""
            );
        }
        header(&format!("bulk_msgs/N{number}"), "*", &text)
    }

    #[test]
    fn publishers_that_come_and_go_with_ever_new_types_leave_no_more_than_has_room() {
        let mut definitions = Ros1Definitions::new(Arc::default(), vec![]);
        let built_in = definitions.known.registry().names().count();
        for number in 0..20 {
            drop(definitions.of_publisher(&bulky(number), false).unwrap());
        }
        let kept = definitions.known.registry().names().count() - built_in;
        assert!(kept <= 4096, "{kept} names");
        assert!(definitions.brought.len() <= 2);
        let last = definitions.get(&"bulk_msgs/N19".parse().unwrap());
        assert!(last.is_ok(), "the newest is known");
    }

    #[test]
    fn types_in_use_stay_and_only_the_mapping_has_room_beside_them() {
        let mut definitions = Ros1Definitions::new(Arc::default(), vec![]);
        let first = definitions.of_publisher(&bulky(0), false).unwrap();
        let _second = definitions.of_publisher(&bulky(1), false).unwrap();
        let refused = definitions.of_publisher(&bulky(2), false);
        assert!(matches!(refused, Err(UnusableMessages::Full)));
        assert!(definitions.of_publisher(&bulky(2), true).is_ok());
        // A publisher of the same type reconnects, or another publisher of the type connects.
        let again = definitions.of_publisher(&bulky(0), false).unwrap();
        assert!(Arc::ptr_eq(&first, &again));
        drop((first, again));
        assert!(definitions.of_publisher(&bulky(3), false).is_ok());
        assert!(definitions.get(&"bulk_msgs/N0".parse().unwrap()).is_err());
    }

    #[test]
    fn a_type_is_found_in_a_package_deep_in_a_workspace() {
        let root = std::env::temp_dir().join(format!("packages-{}", std::process::id()));
        let folder = root.join("src/repository/robot_msgs/msg");
        std::fs::create_dir_all(&folder).unwrap();
        std::fs::write(folder.join("Leg.msg"), "float64 knee\n").unwrap();
        let found = Ros1Definitions::new(Arc::default(), vec![root.clone()])
            .get(&"robot_msgs/Leg".parse().unwrap());
        std::fs::remove_dir_all(&root).unwrap();
        assert_eq!(found.unwrap().leaves()[0].path, "knee");
    }
}
