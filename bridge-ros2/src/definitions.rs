//! Message definitions: those built in, and those of the ROS installation the program was started in.

use std::path::PathBuf;
use std::sync::Arc;

use bridge_node::Wanted;
use messages::{
    DefinitionError, Dialect, MessageType, ServiceType, ServiceTypeHashes, TypeHash, TypeName,
};
use uadp::BuiltinType;

/// Finds message types by name; a type once found stays.
#[derive(Debug)]
pub(crate) struct Definitions {
    known: bridge_node::Definitions,
    /// Folders that hold `share/<package>/msg/<Name>.msg`, first match wins.
    prefixes: Vec<PathBuf>,
}

impl Definitions {
    /// With the built-in definitions and the prefixes of a ROS 2 installation, as `AMENT_PREFIX_PATH` lists them.
    pub(crate) fn new(prefixes: Vec<PathBuf>) -> Self {
        Self {
            known: bridge_node::Definitions::new(Dialect::Ros2),
            prefixes,
        }
    }

    /// The type of that name with all it needs. One that is not built in is read from the prefixes.
    ///
    /// # Errors
    /// [`DefinitionError`].
    pub(crate) fn get(&mut self, name: &TypeName) -> Result<Arc<MessageType>, DefinitionError> {
        let prefixes = &self.prefixes;
        self.known.find(name, |wanted| locate(prefixes, wanted))
    }

    /// The service of that name, found likewise.
    ///
    /// # Errors
    /// [`DefinitionError`].
    pub(crate) fn service(&mut self, name: &TypeName) -> Result<Arc<ServiceType>, DefinitionError> {
        let prefixes = &self.prefixes;
        self.known
            .find_service(name, |wanted| locate(prefixes, wanted))
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

fn locate(prefixes: &[PathBuf], Wanted { name, kind }: Wanted<'_>) -> Option<PathBuf> {
    // Neither part of a type name can hold a separator or a dot.
    let file = PathBuf::from("share")
        .join(name.package())
        .join(kind)
        .join(format!("{}.{kind}", name.name()));
    prefixes
        .iter()
        .map(|prefix| prefix.join(&file))
        .find(|file| file.is_file())
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

        let found = Definitions::new(vec![prefix.clone()]).get(&"robot_msgs/Arm".parse().unwrap());
        std::fs::remove_dir_all(&prefix).unwrap();
        assert_eq!(found.unwrap().leaves()[0].path, "joints");
    }

    #[test]
    fn a_type_nobody_defines_is_named_in_the_error() {
        let error = Definitions::new(vec![])
            .get(&"robot_msgs/Arm".parse().unwrap())
            .unwrap_err();
        assert!(error.to_string().contains("robot_msgs/Arm"), "{error}");
    }
}
