//! Message definitions: those built in, and those of the ROS installation the program was started in.

use std::path::PathBuf;
use std::sync::Arc;

use bridge_node::Environment;
use messages::{
    DefinitionError, Dialect, MessageType, ServiceType, ServiceTypeHashes, TypeHash, TypeName,
};
use uadp::BuiltinType;

/// Finds message types by name; a type once found stays.
#[derive(Debug)]
pub(crate) struct Definitions {
    known: bridge_node::Definitions,
}

impl Definitions {
    /// With the built-in definitions, those of the mapping's `type_paths`, and the prefixes of ROS 2 installations, as
    /// `AMENT_PREFIX_PATH` lists them.
    pub(crate) fn new(type_paths: &[PathBuf], prefixes: Vec<PathBuf>) -> Self {
        let environment = Environment {
            ros1: Vec::new(),
            ros2: prefixes,
        };
        Self {
            known: bridge_node::Definitions::new(Dialect::Ros2, type_paths, environment),
        }
    }

    /// The type of that name with all it needs. One that is not built in is read from the prefixes.
    ///
    /// # Errors
    /// [`DefinitionError`].
    pub(crate) fn get(&mut self, name: &TypeName) -> Result<Arc<MessageType>, DefinitionError> {
        self.known.find(name)
    }

    /// The service of that name, found likewise.
    ///
    /// # Errors
    /// [`DefinitionError`].
    pub(crate) fn service(&mut self, name: &TypeName) -> Result<Arc<ServiceType>, DefinitionError> {
        self.known.find_service(name)
    }

    /// Where the definition of a type is from, for people.
    pub(crate) fn source(&self, name: &TypeName) -> &str {
        self.known.source(name)
    }

    /// The type hash of a type that was found.
    pub(crate) fn type_hash(&self, name: &TypeName) -> Option<TypeHash> {
        self.known.registry().type_hash(name).ok()
    }

    /// The type hashes of a service that was found.
    pub(crate) fn service_type_hashes(&self, name: &TypeName) -> Option<ServiceTypeHashes> {
        self.known.registry().service_type_hashes(name).ok()
    }

    /// The ROS type that carries one value of that type, and nothing else.
    pub(crate) fn standard_type(&self, builtin: BuiltinType, array: bool) -> Option<TypeName> {
        self.known.registry().standard_type(builtin, array)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_type_that_is_not_built_in_is_read_from_the_ros_installation() {
        let prefix = std::env::temp_dir().join(format!("definitions-{}", std::process::id()));
        let folder = prefix.join("share/robot_msgs/msg");
        std::fs::create_dir_all(&folder).unwrap();
        std::fs::write(folder.join("Arm.msg"), "robot_msgs/Joint[] joints\n").unwrap();
        std::fs::write(folder.join("Joint.msg"), "string name\nfloat64 angle\n").unwrap();

        let found =
            Definitions::new(&[], vec![prefix.clone()]).get(&"robot_msgs/Arm".parse().unwrap());
        std::fs::remove_dir_all(&prefix).unwrap();
        assert_eq!(found.unwrap().leaves()[0].path, "joints");
    }

    #[test]
    fn a_type_nobody_defines_is_named_in_the_error() {
        let error = Definitions::new(&[], vec![])
            .get(&"robot_msgs/Arm".parse().unwrap())
            .unwrap_err();
        assert!(error.to_string().contains("robot_msgs/Arm"), "{error}");
    }
}
