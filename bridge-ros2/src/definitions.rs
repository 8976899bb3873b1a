//! Message definitions: built in, or from the ROS installation that was sourced when the process
//! was started.

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::Arc;

use bridge_node::{RosEnvironment, TypePaths};
use messages::{
    ActionTypeHashes, DefinitionError, DescribedType, Dialect, MessageType, ServiceTypeHashes,
    TypeHash, TypeName, TypeRegistry,
};
use ros2_node::type_description::TypeSource;

/// Finds message types by name and caches them.
///
/// A name may have several definitions: the local definition, and definitions that nodes described.
/// Their hashes distinguish them.
#[derive(Debug)]
pub(crate) struct Ros2Definitions {
    /// The types of this host.
    pub(crate) known: bridge_node::Definitions,
    /// The requested definitions of `known`.
    found: BTreeMap<TypeName, TypeDefinition>,
    told: BTreeMap<(TypeName, TypeHash), DescribedDefinition>,
}

/// A definition of a type.
#[derive(Debug, Clone)]
pub(crate) struct TypeDefinition {
    pub(crate) message_type: Arc<MessageType>,
    /// `None` for a type that ROS 2 cannot express and that has no hash.
    pub(crate) hash: Option<TypeHash>,
    /// The origin of the definition, for log messages.
    pub(crate) from: Arc<str>,
}

impl TypeDefinition {
    pub(crate) fn name(&self) -> &TypeName {
        self.message_type.name()
    }

    /// Returns whether both are the same definition: by their hashes or, without hashes, by their
    /// fields.
    pub(crate) fn is_same(&self, other: &Self) -> bool {
        match (self.hash, other.hash) {
            (None, None) => {
                self.name() == other.name() && self.message_type.is_same(&other.message_type)
            }
            (ours, theirs) => ours == theirs,
        }
    }
}

impl Ros2Definitions {
    /// Creates the definitions from the built-in types, the mapping's `type_paths`, and the
    /// prefixes of ROS 2 installations in the order of `AMENT_PREFIX_PATH`.
    pub(crate) fn new(types: Arc<TypePaths>, prefixes: Vec<PathBuf>) -> Self {
        let environment = RosEnvironment {
            ros1: Vec::new(),
            ros2: prefixes,
        };
        Self {
            known: bridge_node::Definitions::new(Dialect::Ros2, types, environment),
            found: BTreeMap::new(),
            told: BTreeMap::new(),
        }
    }

    /// Replaces the definitions from the mapping's `type_paths`. Definitions described by nodes
    /// stay.
    pub(crate) fn replace(&mut self, types: &Arc<TypePaths>) {
        self.known.replace(types);
        self.found.clear();
    }

    /// Returns whether the definition still applies to endpoints that announce the hash. A file
    /// that is temporarily unreadable changes nothing.
    pub(crate) fn is_current(
        &mut self,
        definition: &TypeDefinition,
        announced: Option<TypeHash>,
    ) -> bool {
        let now = self.announced(definition.name(), announced);
        !now.is_ok_and(|now| !now.is_same(definition))
    }

    /// Returns the type with its referenced types for endpoints that announce no hash: the built-in
    /// type or the type from files, else the definition that nodes described, if it is unique.
    ///
    /// # Errors
    /// [`DefinitionError`].
    pub(crate) fn get(&mut self, name: &TypeName) -> Result<TypeDefinition, DefinitionError> {
        let error = match self.here(name) {
            Ok(found) => return Ok(found),
            Err(error) => error,
        };
        let mut told = self.told.iter().filter(|((of, _), _)| of == name);
        match (told.next(), told.next()) {
            (Some((_, only)), None) => Ok(only.definition.clone()),
            (None, _) | (Some(_), Some(_)) => Err(error),
        }
    }

    /// Returns the type for endpoints that announce the hash, or none. For an unknown hash, returns
    /// the local definition of the name.
    ///
    /// # Errors
    /// [`DefinitionError`].
    pub(crate) fn announced(
        &mut self,
        name: &TypeName,
        hash: Option<TypeHash>,
    ) -> Result<TypeDefinition, DefinitionError> {
        match hash {
            Some(hash) => match self.of_hash(name, hash) {
                Some(found) => Ok(found),
                None => self.here(name),
            },
            None => self.get(name),
        }
    }

    /// Returns the definition with the hash.
    pub(crate) fn of_hash(&mut self, name: &TypeName, hash: TypeHash) -> Option<TypeDefinition> {
        let here = self.here(name).ok();
        here.filter(|found| found.hash == Some(hash)).or_else(|| {
            let told = self.told.get(&(name.clone(), hash));
            told.map(|told| told.definition.clone())
        })
    }

    /// Returns the local definition, regardless of the descriptions of nodes.
    ///
    /// # Errors
    /// [`DefinitionError`].
    pub(crate) fn here(&mut self, name: &TypeName) -> Result<TypeDefinition, DefinitionError> {
        if let Some(found) = self.found.get(name) {
            return Ok(found.clone());
        }
        let found = TypeDefinition {
            message_type: self.known.find(name)?,
            hash: self.known.registry().type_hash(name).ok(),
            from: self.known.source(name).into(),
        };
        self.found.insert(name.clone(), found.clone());
        Ok(found)
    }

    /// Adds a node's description of a type if it matches the hash.
    ///
    /// # Errors
    /// [`DefinitionError`].
    pub(crate) fn add_described(
        &mut self,
        name: &TypeName,
        types: &[DescribedType],
        hash: TypeHash,
        from: &str,
    ) -> Result<(), DefinitionError> {
        // In a separate registry: the referenced types may differ from the local types of the same
        // name.
        let message_type = TypeRegistry::empty(Dialect::Ros2).add_described(name, types, hash)?;
        let told = DescribedDefinition {
            definition: TypeDefinition {
                message_type,
                hash: Some(hash),
                from: from.into(),
            },
            types: DescribedType::needed(name, types)
                .into_iter()
                .cloned()
                .collect(),
        };
        self.told.insert((name.clone(), hash), told);
        Ok(())
    }

    /// Returns the descriptions of a type and of its referenced types.
    ///
    /// # Errors
    /// [`DefinitionError`].
    pub(crate) fn described(
        &self,
        name: &TypeName,
        hash: TypeHash,
    ) -> Result<Vec<DescribedType>, DefinitionError> {
        match self.told.get(&(name.clone(), hash)) {
            Some(told) => Ok(told.types.clone()),
            None => self.known.registry().describe(name),
        }
    }

    /// Returns the source of each of these types: the text of a message if its file is known
    /// locally. A part of a service or action has no own file, nor has a type that a node
    /// described.
    pub(crate) fn sources(&self, types: &[DescribedType]) -> Vec<TypeSource> {
        let registry = self.known.registry();
        let source = |described: &DescribedType| {
            let name = described.name.parse::<TypeName>().ok();
            let name = name.filter(|name| name.ros2() == described.name);
            let text = name.and_then(|name| {
                let same = registry.describe(&name).ok()?.first() == Some(described);
                registry.text(&name).filter(|_| same)
            });
            match text {
                Some(text) => TypeSource {
                    name: described.name.clone(),
                    encoding: "msg",
                    text: text.to_owned(),
                },
                None => TypeSource {
                    name: described.name.clone(),
                    encoding: "implicit",
                    text: String::new(),
                },
            }
        };
        types.iter().map(source).collect()
    }

    /// Returns the descriptions of a known service and of its referenced types.
    ///
    /// # Errors
    /// [`DefinitionError`].
    pub(crate) fn described_service(
        &self,
        name: &TypeName,
    ) -> Result<Vec<DescribedType>, DefinitionError> {
        self.known.registry().describe_service(name)
    }

    /// Returns the type hashes of a known service.
    pub(crate) fn service_type_hashes(&self, name: &TypeName) -> Option<ServiceTypeHashes> {
        self.known.registry().service_type_hashes(name).ok()
    }

    /// Returns the type hashes of a known action.
    pub(crate) fn action_type_hashes(&self, name: &TypeName) -> Option<ActionTypeHashes> {
        self.known.registry().added_action_type_hashes(name).ok()
    }

    /// Returns the descriptions of a known action and of its referenced types.
    ///
    /// # Errors
    /// [`DefinitionError`].
    pub(crate) fn described_action(
        &self,
        name: &TypeName,
    ) -> Result<Vec<DescribedType>, DefinitionError> {
        self.known.registry().describe_action(name)
    }
}

/// A node's description of a type.
#[derive(Debug)]
struct DescribedDefinition {
    definition: TypeDefinition,
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

        let found = Ros2Definitions::new(Arc::default(), vec![prefix.clone()])
            .get(&"robot_msgs/Arm".parse().unwrap());
        std::fs::remove_dir_all(&prefix).unwrap();
        assert_eq!(found.unwrap().message_type.leaves()[0].path, "joints");
    }

    #[test]
    fn a_type_nobody_defines_is_named_in_the_error() {
        let error = Ros2Definitions::new(Arc::default(), vec![])
            .get(&"robot_msgs/Arm".parse().unwrap())
            .unwrap_err();
        assert!(error.to_string().contains("robot_msgs/Arm"), "{error}");
    }

    #[test]
    fn a_definition_without_a_hash_is_another_when_it_is_made_of_other_fields() {
        let name: TypeName = "robot_msgs/Arm".parse().unwrap();
        let without = |text| {
            let mut registry = TypeRegistry::empty(Dialect::Ros2);
            registry.add(&name, text).unwrap();
            TypeDefinition {
                message_type: registry.get(&name).unwrap(),
                hash: None,
                from: "a file".into(),
            }
        };
        let (old, new) = (without("float64 angle\n"), without("float32 angle\n"));
        assert!(old.is_same(&without("float64 angle # in rad\n")));
        assert!(!old.is_same(&new));
        let mut definitions = Ros2Definitions::new(Arc::default(), vec![]);
        definitions.found.insert(name.clone(), new.clone());
        assert!(definitions.is_current(&new, None));
        assert!(!definitions.is_current(&old, None));
    }

    /// Returns the description and the hash of a type, as a node would send it.
    fn told(name: &TypeName, text: &str) -> (Vec<DescribedType>, TypeHash) {
        let mut registry = TypeRegistry::empty(Dialect::Ros2);
        registry.add(name, text).unwrap();
        let hash = registry.type_hash(name).unwrap();
        (registry.describe(name).unwrap(), hash)
    }

    #[test]
    fn definitions_of_one_name_are_kept_apart_by_their_hashes() {
        let name: TypeName = "robot_msgs/Arm".parse().unwrap();
        let mut definitions = Ros2Definitions::new(Arc::default(), vec![]);
        let (old, old_hash) = told(&name, "float64 angle\n");
        let (new, new_hash) = told(&name, "float32 speed\nfloat64 angle\n");
        definitions
            .add_described(&name, &old, old_hash, "/old")
            .unwrap();
        assert_eq!(definitions.get(&name).unwrap().hash, Some(old_hash));
        definitions
            .add_described(&name, &new, new_hash, "/new")
            .unwrap();
        for (hash, first, types) in [(old_hash, "angle", &old), (new_hash, "speed", &new)] {
            let found = definitions.announced(&name, Some(hash)).unwrap();
            assert_eq!(found.message_type.leaves()[0].path, first);
            assert_eq!(definitions.described(&name, hash).unwrap(), *types);
        }
        // Ambiguous without a hash.
        definitions.get(&name).unwrap_err();
        definitions.announced(&name, None).unwrap_err();
    }

    #[test]
    fn what_is_told_leaves_what_is_known_here_as_it_was() {
        let name: TypeName = "std_msgs/Bool".parse().unwrap();
        let mut definitions = Ros2Definitions::new(Arc::default(), vec![]);
        let here = definitions.get(&name).unwrap();
        let (other, hash) = told(&name, "string data\n");
        definitions
            .add_described(&name, &other, hash, "/other")
            .unwrap();
        assert_eq!(definitions.get(&name).unwrap().hash, here.hash);
        let of = |hash| definitions.announced(&name, hash).unwrap().hash;
        assert_eq!(
            [hash, here.hash.unwrap()].map(Some).map(of),
            [Some(hash), here.hash]
        );
    }
}
