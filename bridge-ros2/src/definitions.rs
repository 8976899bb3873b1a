//! Message definitions: those built in, and those of the ROS installation the program was started in.

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::Arc;

use bridge_node::Environment;
use messages::{
    DefinitionError, DescribedType, Dialect, MessageType, ServiceType, ServiceTypeHashes, TypeHash,
    TypeName,
};
use uadp::BuiltinType;

/// Finds message types by name; a type once found stays.
#[derive(Debug)]
pub(crate) struct Definitions {
    known: bridge_node::Definitions,
    /// What nodes told of their types, with the hash they announce.
    described: BTreeMap<TypeName, Described>,
    hashes: BTreeMap<TypeName, TypeHash>,
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
            described: BTreeMap::new(),
            hashes: BTreeMap::new(),
        }
    }

    /// The type of that name with all it needs. One that is not built in is read from the prefixes.
    ///
    /// # Errors
    /// [`DefinitionError`].
    pub(crate) fn get(&mut self, name: &TypeName) -> Result<Arc<MessageType>, DefinitionError> {
        if let Some(described) = self.described.get(name) {
            return Ok(Arc::clone(&described.message_type));
        }
        let found = self.known.find(name)?;
        if !self.hashes.contains_key(name)
            && let Ok(hash) = self.known.registry().type_hash(name)
        {
            self.hashes.insert(name.clone(), hash);
        }
        Ok(found)
    }

    /// Takes what a node told of a type in place of what is known under its name, if it is the type of that hash.
    ///
    /// # Errors
    /// [`DefinitionError`].
    pub(crate) fn add_described(
        &mut self,
        name: &TypeName,
        types: &[DescribedType],
        hash: TypeHash,
        from: impl FnOnce() -> String,
    ) -> Result<(), DefinitionError> {
        let registry = self.known.registry_mut();
        let message_type = registry.add_described(name, types, hash)?;
        let described = Described {
            hash,
            message_type,
            types: DescribedType::needed(name, types)
                .into_iter()
                .cloned()
                .collect(),
        };
        self.described.insert(name.clone(), described);
        self.known.learned(name, from);
        Ok(())
    }

    /// The hash of a type that was asked for, or that a node told.
    pub(crate) fn hash_of(&self, name: &TypeName) -> Option<TypeHash> {
        let described = self.described.get(name).map(|described| described.hash);
        described.or_else(|| self.hashes.get(name).copied())
    }

    /// The description of a type and what it needs.
    ///
    /// # Errors
    /// [`DefinitionError`].
    pub(crate) fn described(&self, name: &TypeName) -> Result<Vec<DescribedType>, DefinitionError> {
        match self.described.get(name) {
            Some(described) => Ok(described.types.clone()),
            None => self.known.registry().describe(name),
        }
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

    /// The type hashes of a service that was found.
    pub(crate) fn service_type_hashes(&self, name: &TypeName) -> Option<ServiceTypeHashes> {
        self.known.registry().service_type_hashes(name).ok()
    }

    /// The ROS type that carries one value of that type, and nothing else.
    pub(crate) fn standard_type(&self, builtin: BuiltinType, array: bool) -> Option<TypeName> {
        self.known.registry().standard_type(builtin, array)
    }
}

/// What a node told of a type.
#[derive(Debug)]
struct Described {
    hash: TypeHash,
    message_type: Arc<MessageType>,
    types: Vec<DescribedType>,
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
