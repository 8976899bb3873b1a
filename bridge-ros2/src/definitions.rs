//! Message definitions: those built in, and those of the ROS installation the program was started in.

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::Arc;

use crate::type_description::TypeSource;
use bridge_node::{Environment, TypePaths};
use messages::{
    ActionCalls, ActionMessages, ActionTypeHashes, DefinitionError, DescribedType, Dialect,
    MessageType, Registry, ServiceType, ServiceTypeHashes, TextKind, TypeHash, TypeName,
};
use uadp::BuiltinType;

/// Finds message types by name; a type once found stays.
///
/// A name may have several definitions: the one known here, and those that nodes told. Their hashes keep them apart.
#[derive(Debug)]
pub(crate) struct Definitions {
    known: bridge_node::Definitions,
    /// Those of `known` that were asked for.
    found: BTreeMap<TypeName, Definition>,
    told: BTreeMap<(TypeName, TypeHash), Told>,
}

/// One definition of a type.
#[derive(Debug, Clone)]
pub(crate) struct Definition {
    pub(crate) message_type: Arc<MessageType>,
    /// `None` where it has none, as with a type that ROS 2 cannot express.
    pub(crate) hash: Option<TypeHash>,
    /// Where it is from, for people.
    pub(crate) from: Arc<str>,
}

impl Definition {
    pub(crate) fn name(&self) -> &TypeName {
        self.message_type.name()
    }

    /// Whether both are one definition: by their hashes, or, where there are none, by what they are made of.
    pub(crate) fn is_same(&self, other: &Self) -> bool {
        match (self.hash, other.hash) {
            (None, None) => {
                self.name() == other.name() && self.message_type.is_same(&other.message_type)
            }
            (ours, theirs) => ours == theirs,
        }
    }
}

impl Definitions {
    /// With the built-in definitions, those of the mapping's `type_paths`, and the prefixes of ROS 2 installations, as
    /// `AMENT_PREFIX_PATH` lists them.
    pub(crate) fn new(types: Arc<TypePaths>, prefixes: Vec<PathBuf>) -> Self {
        let environment = Environment {
            ros1: Vec::new(),
            ros2: prefixes,
        };
        Self {
            known: bridge_node::Definitions::new(Dialect::Ros2, types, environment),
            found: BTreeMap::new(),
            told: BTreeMap::new(),
        }
    }

    /// Takes what the mapping's `type_paths` have by now. What nodes told stays.
    pub(crate) fn replace(&mut self, types: &Arc<TypePaths>) {
        self.known.replace(types);
        self.found.clear();
    }

    /// Whether it is still what endpoints mean that announce this hash. A file that cannot be read for the moment changes
    /// nothing.
    pub(crate) fn is_current(
        &mut self,
        definition: &Definition,
        announced: Option<TypeHash>,
    ) -> bool {
        let now = self.announced(definition.name(), announced);
        !now.is_ok_and(|now| !now.is_same(definition))
    }

    /// The type of that name with all it needs, as endpoints mean it that announce no hash: built in, or read from files;
    /// else what a node told, if nodes told the same.
    ///
    /// # Errors
    /// [`DefinitionError`].
    pub(crate) fn get(&mut self, name: &TypeName) -> Result<Definition, DefinitionError> {
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

    /// The type as endpoints mean it that announce this hash, or none. Of a hash that is not known it is what is known
    /// here under the name.
    ///
    /// # Errors
    /// [`DefinitionError`].
    pub(crate) fn announced(
        &mut self,
        name: &TypeName,
        hash: Option<TypeHash>,
    ) -> Result<Definition, DefinitionError> {
        match hash {
            Some(hash) => match self.of_hash(name, hash) {
                Some(found) => Ok(found),
                None => self.here(name),
            },
            None => self.get(name),
        }
    }

    /// The definition of that hash.
    pub(crate) fn of_hash(&mut self, name: &TypeName, hash: TypeHash) -> Option<Definition> {
        let here = self.here(name).ok();
        here.filter(|found| found.hash == Some(hash)).or_else(|| {
            let told = self.told.get(&(name.clone(), hash));
            told.map(|told| told.definition.clone())
        })
    }

    /// What is known here, whatever nodes tell.
    ///
    /// # Errors
    /// [`DefinitionError`].
    pub(crate) fn here(&mut self, name: &TypeName) -> Result<Definition, DefinitionError> {
        if let Some(found) = self.found.get(name) {
            return Ok(found.clone());
        }
        let found = Definition {
            message_type: self.known.find(name)?,
            hash: self.known.registry().type_hash(name).ok(),
            from: self.known.source(name).into(),
        };
        self.found.insert(name.clone(), found.clone());
        Ok(found)
    }

    /// Takes what a node told of a type, if it is the type of that hash.
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
        // Of its own: the types in it may be others than those of that name here.
        let message_type = Registry::empty(Dialect::Ros2).add_described(name, types, hash)?;
        let told = Told {
            definition: Definition {
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

    /// The description of a type and what it needs.
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

    /// The source of each of these types: the text of a message whose file is known here. A part of a service or action has no
    /// file of its own, and neither has a type that a node described.
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

    /// The description of a service that was found, and what it needs.
    ///
    /// # Errors
    /// [`DefinitionError`].
    pub(crate) fn described_service(
        &self,
        name: &TypeName,
    ) -> Result<Vec<DescribedType>, DefinitionError> {
        self.known.registry().describe_service(name)
    }

    /// What people are to be told of such an error, or of one of [`service`](Self::service).
    pub(crate) fn explain(&mut self, kind: TextKind, error: &DefinitionError) -> String {
        self.known.explain(kind, error)
    }

    /// Explains an error of a type whose definition only files bring.
    pub(crate) fn explain_missing(
        &mut self,
        of: (TextKind, &TypeName),
        error: &DefinitionError,
        wanted: &str,
    ) -> String {
        self.known.explain_missing(of, error, wanted)
    }

    /// The service of that name, found likewise.
    ///
    /// # Errors
    /// [`DefinitionError`].
    pub(crate) fn service(&mut self, name: &TypeName) -> Result<Arc<ServiceType>, DefinitionError> {
        self.known.find_service(name)
    }

    /// The type hashes of a service that was found.
    pub(crate) fn service_type_hashes(&self, name: &TypeName) -> Option<ServiceTypeHashes> {
        self.known.registry().service_type_hashes(name).ok()
    }

    /// The calls and values that the action of that name is, found likewise.
    ///
    /// # Errors
    /// [`DefinitionError`].
    pub(crate) fn action_calls(
        &mut self,
        name: &TypeName,
    ) -> Result<Arc<ActionCalls>, DefinitionError> {
        self.known.find_action_calls(name)
    }

    /// The messages of the action of that name, found likewise.
    ///
    /// # Errors
    /// [`DefinitionError`].
    pub(crate) fn action_messages(
        &mut self,
        name: &TypeName,
    ) -> Result<ActionMessages, DefinitionError> {
        self.known.find_action_messages(name)
    }

    /// The type hashes of an action that was found.
    pub(crate) fn action_type_hashes(&self, name: &TypeName) -> Option<ActionTypeHashes> {
        self.known.registry().added_action_type_hashes(name).ok()
    }

    /// The description of an action that was found, and what it needs.
    ///
    /// # Errors
    /// [`DefinitionError`].
    pub(crate) fn described_action(
        &self,
        name: &TypeName,
    ) -> Result<Vec<DescribedType>, DefinitionError> {
        self.known.registry().describe_action(name)
    }

    /// The ROS type that carries one value of that type, and nothing else.
    pub(crate) fn standard_type(&self, builtin: BuiltinType, array: bool) -> Option<TypeName> {
        self.known.registry().standard_type(builtin, array)
    }
}

/// What a node told of a type.
#[derive(Debug)]
struct Told {
    definition: Definition,
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

        let found = Definitions::new(Arc::default(), vec![prefix.clone()])
            .get(&"robot_msgs/Arm".parse().unwrap());
        std::fs::remove_dir_all(&prefix).unwrap();
        assert_eq!(found.unwrap().message_type.leaves()[0].path, "joints");
    }

    #[test]
    fn a_type_nobody_defines_is_named_in_the_error() {
        let error = Definitions::new(Arc::default(), vec![])
            .get(&"robot_msgs/Arm".parse().unwrap())
            .unwrap_err();
        assert!(error.to_string().contains("robot_msgs/Arm"), "{error}");
    }

    #[test]
    fn a_definition_without_a_hash_is_another_when_it_is_made_of_other_fields() {
        let name: TypeName = "robot_msgs/Arm".parse().unwrap();
        let without = |text| {
            let mut registry = Registry::empty(Dialect::Ros2);
            registry.add(&name, text).unwrap();
            Definition {
                message_type: registry.get(&name).unwrap(),
                hash: None,
                from: "a file".into(),
            }
        };
        let (old, new) = (without("float64 angle\n"), without("float32 angle\n"));
        assert!(old.is_same(&without("float64 angle # in rad\n")));
        assert!(!old.is_same(&new));
        let mut definitions = Definitions::new(Arc::default(), vec![]);
        definitions.found.insert(name.clone(), new.clone());
        assert!(definitions.is_current(&new, None));
        assert!(!definitions.is_current(&old, None));
    }

    /// Description and hash of a type, as a node would tell it.
    fn told(name: &TypeName, text: &str) -> (Vec<DescribedType>, TypeHash) {
        let mut registry = Registry::empty(Dialect::Ros2);
        registry.add(name, text).unwrap();
        let hash = registry.type_hash(name).unwrap();
        (registry.describe(name).unwrap(), hash)
    }

    #[test]
    fn definitions_of_one_name_are_kept_apart_by_their_hashes() {
        let name: TypeName = "robot_msgs/Arm".parse().unwrap();
        let mut definitions = Definitions::new(Arc::default(), vec![]);
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
        // Nobody says which.
        definitions.get(&name).unwrap_err();
        definitions.announced(&name, None).unwrap_err();
    }

    #[test]
    fn what_is_told_leaves_what_is_known_here_as_it_was() {
        let name: TypeName = "std_msgs/Bool".parse().unwrap();
        let mut definitions = Definitions::new(Arc::default(), vec![]);
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
