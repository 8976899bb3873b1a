use std::collections::BTreeMap;
use std::sync::Arc;

use uadp::BuiltinType;

use crate::bundle;
use crate::definition::MessageDefinition;
use crate::idl;
use crate::resolve::{self, TypeResolver};
use crate::service::{self, ServiceDefinition};
use crate::{
    ActionCalls, ActionMessages, ActionType, DefinitionError, Dialect, MessageType, ServiceType,
    TextKind, TypeName,
};

/// Message definitions of a dialect by name.
///
/// Definitions may be added in any order: the types that a type needs are resolved on request.
#[derive(Clone, Debug)]
pub struct TypeRegistry {
    dialect: Dialect,
    pub(crate) definitions: BTreeMap<TypeName, Arc<MessageDefinition>>,
    services: BTreeMap<TypeName, Arc<ServiceDefinition>>,
}

impl TypeRegistry {
    /// Creates a registry without definitions.
    pub fn empty(dialect: Dialect) -> Self {
        Self {
            dialect,
            definitions: BTreeMap::new(),
            services: BTreeMap::new(),
        }
    }

    /// Creates a registry with the built-in common interfaces:
    ///
    /// - std_msgs, geometry_msgs, sensor_msgs, nav_msgs, trajectory_msgs, diagnostic_msgs,
    ///   actionlib_msgs, tf2_msgs, rosgraph_msgs, shape_msgs, visualization_msgs and stereo_msgs
    /// - the services of std_srvs and ua_msgs (the skills of OPC UA, `ros/ua_msgs`)
    /// - the actions of actionlib, the MoveBase of move_base_msgs, and the Fibonacci of the
    ///   tutorials of ROS 1 and ROS 2
    /// - for ROS 1 also roscpp, and the services of these packages
    /// - for ROS 2 also builtin_interfaces, action_msgs, unique_identifier_msgs, lifecycle_msgs and
    ///   rcl_interfaces with the services of action_msgs and rcl_interfaces
    pub fn bundle(dialect: Dialect) -> Self {
        let mut registry = Self::empty(dialect);
        for (kind, name, text) in bundle::texts(dialect) {
            let added = match kind {
                bundle::BundledKind::Message => registry.add(&name, &text),
                bundle::BundledKind::Service => registry.add_service(&name, &text),
                bundle::BundledKind::Action => registry.add_action(&name, &text),
            };
            // A test checks each of them.
            debug_assert!(added.is_ok(), "every text of the bundle parses");
        }
        registry
    }

    /// Returns the dialect of the definitions.
    pub const fn dialect(&self) -> Dialect {
        self.dialect
    }

    /// Returns the names of the definitions, in order.
    pub fn names(&self) -> impl Iterator<Item = &TypeName> {
        self.definitions.keys()
    }

    /// Replaces the message of that name by the definition of `other`.
    pub(crate) fn restore(&mut self, name: &TypeName, other: &Self) {
        match other.definitions.get(name) {
            Some(definition) => self
                .definitions
                .insert(name.clone(), Arc::clone(definition)),
            None => self.definitions.remove(name),
        };
    }

    /// Replaces the service of that name by the definition of `other`.
    pub(crate) fn restore_service(&mut self, name: &TypeName, other: &Self) {
        match other.services.get(name) {
            Some(definition) => self.services.insert(name.clone(), Arc::clone(definition)),
            None => self.services.remove(name),
        };
    }

    /// Adds the text of a `.msg` file; it replaces a definition of the same name.
    ///
    /// # Errors
    /// [`DefinitionError::Syntax`]. Needed types may be added later, so a missing type is an error
    /// of [`TypeRegistry::get`] only.
    pub fn add(&mut self, name: &TypeName, text: &str) -> Result<(), DefinitionError> {
        let definition = MessageDefinition::parse(self.dialect, name, text)?;
        self.definitions.insert(name.clone(), Arc::new(definition));
        Ok(())
    }

    /// Adds the type of a ROS 1 publisher from the `message_definition` of its connection header:
    /// the text of the type, followed by each type it needs. Each needed type follows a line of `=`
    /// and a line `MSG: package/Name`.
    ///
    /// The returned type is created from this text alone, except for missing types, which are taken
    /// from the registry. The registry stores the definitions of new names, and never lets a peer
    /// replace an existing definition.
    pub fn add_ros1_definition(
        &mut self,
        name: &TypeName,
        text: &str,
    ) -> Result<Arc<MessageType>, DefinitionError> {
        let (found, definitions) = self.read_ros1_definition(name, text)?;
        self.keep(&definitions);
        Ok(found)
    }

    /// Reads a definition like [`add_ros1_definition`](Self::add_ros1_definition), but stores
    /// nothing. The returned definitions of the text that the type needs can be passed to
    /// [`keep`](Self::keep).
    ///
    /// # Errors
    /// [`DefinitionError`].
    pub fn read_ros1_definition(
        &self,
        name: &TypeName,
        text: &str,
    ) -> Result<(Arc<MessageType>, PeerDefinitions), DefinitionError> {
        let mut peers = BTreeMap::new();
        for (name, text) in sections(name, text)? {
            let definition = Arc::new(MessageDefinition::parse(self.dialect, &name, text)?);
            peers.entry(name).or_insert(definition);
        }
        let found = TypeResolver::new(self.dialect, &[&peers, &self.definitions])
            .message_type(name, Some(text))?;
        let mut needed = Vec::new();
        let mut wanted = vec![name.clone()];
        while let Some(name) = wanted.pop() {
            if let Some(definition) = peers.remove(&name) {
                wanted.extend(definition.needs().cloned());
                needed.push((name, definition));
            }
        }
        Ok((Arc::new(found), PeerDefinitions { needed }))
    }

    /// Adds the definitions of a peer, except for existing names.
    pub fn keep(&mut self, definitions: &PeerDefinitions) {
        for (name, definition) in &definitions.needed {
            if !self.definitions.contains_key(name) {
                self.definitions
                    .insert(name.clone(), Arc::clone(definition));
            }
        }
    }

    /// Removes the definitions of a peer, except for definitions that were not kept or have been
    /// replaced.
    pub fn forget(&mut self, definitions: &PeerDefinitions) {
        for (name, definition) in &definitions.needed {
            let known = self.definitions.get(name);
            if known.is_some_and(|known| Arc::ptr_eq(known, definition)) {
                self.definitions.remove(name);
            }
        }
    }

    /// Returns the type of that name with all types it needs.
    pub fn get(&self, name: &TypeName) -> Result<Arc<MessageType>, DefinitionError> {
        TypeResolver::new(self.dialect, &[&self.definitions])
            .message_type(name, None)
            .map(Arc::new)
    }

    pub(crate) fn definition(&self, name: &TypeName) -> Option<&Arc<MessageDefinition>> {
        self.definitions.get(name)
    }

    /// Returns the text of a message definition, as in its file.
    pub fn text(&self, name: &TypeName) -> Option<&str> {
        Some(&self.definitions.get(name)?.text)
    }

    /// Returns request and response of a service.
    pub(crate) fn service_definitions(
        &self,
        name: &TypeName,
    ) -> Option<[&Arc<MessageDefinition>; 2]> {
        self.services.get(name).map(|service| service.parts())
    }

    /// Returns the names of the services, in order.
    pub fn services(&self) -> impl Iterator<Item = &TypeName> {
        self.services.keys()
    }

    /// Adds the text of a `.srv` file, request and response separated by a line `---`. It replaces
    /// a service of the same name. A message may have the same name.
    ///
    /// # Errors
    /// [`DefinitionError::Syntax`]. Needed types may be added later, so a missing type is an error
    /// of [`TypeRegistry::service`] only.
    pub fn add_service(&mut self, name: &TypeName, text: &str) -> Result<(), DefinitionError> {
        let definition = ServiceDefinition::parse(self.dialect, name, text)?;
        self.services.insert(name.clone(), Arc::new(definition));
        Ok(())
    }

    /// Returns the service of that name with all types it needs.
    ///
    /// # Errors
    /// As [`TypeRegistry::get`]. [`DefinitionError::Unknown`] refers to the service itself if
    /// `needed_by` is `None`, otherwise to a message.
    pub fn service(&self, name: &TypeName) -> Result<Arc<ServiceType>, DefinitionError> {
        let Some(definition) = self.services.get(name) else {
            return Err(DefinitionError::Unknown {
                name: name.clone(),
                needed_by: None,
            });
        };
        let own = definition.messages();
        let sets = [&own, &self.definitions];
        let mut resolver = TypeResolver::new(self.dialect, &sets);
        definition.resolve(name, &mut resolver).map(Arc::new)
    }

    /// Adds the text of an `.action` file: goal, result and feedback, separated by two lines `---`.
    /// It replaces messages of the same names: for ROS 1 the seven messages of genaction, for ROS 2
    /// the messages of [`ActionMessages`].
    ///
    /// # Errors
    /// [`DefinitionError::Syntax`]; then nothing is added.
    pub fn add_action(&mut self, name: &TypeName, text: &str) -> Result<(), DefinitionError> {
        let definitions = service::action(self.dialect, name, text)?;
        self.definitions.extend(definitions);
        Ok(())
    }

    /// Adds the definitions of a ROS 2 `.idl` text under that name: a struct in the modules of its
    /// package and kind. A service has two structs (`_Request`, `_Response`), an action three
    /// (`_Goal`, `_Result`, `_Feedback`). Other structs are ignored.
    ///
    /// # Errors
    /// [`DefinitionError::Syntax`]; then nothing is added. ROS 1 has no such texts.
    pub fn add_idl(
        &mut self,
        kind: TextKind,
        name: &TypeName,
        text: &str,
    ) -> Result<(), DefinitionError> {
        if self.dialect == Dialect::Ros1 {
            return Err(DefinitionError::Syntax {
                name: name.clone(),
                line: 1,
                reason: "ROS 1 does not use IDL definitions",
                text: String::new(),
            });
        }
        match kind {
            TextKind::Message => {
                let parts = [("", name.clone())];
                for definition in idl::definitions(kind, name, text, parts)? {
                    self.definitions.insert(name.clone(), Arc::new(definition));
                }
            }
            TextKind::Service => {
                let definition = ServiceDefinition::of_idl(name, text)?;
                self.services.insert(name.clone(), Arc::new(definition));
            }
            TextKind::Action => {
                let definitions = service::idl_action(name, text)?;
                self.definitions.extend(definitions);
            }
        }
        Ok(())
    }

    /// Returns the ROS 1 action of that name. Its messages suffice, from any source: a built
    /// package has a `.msg` file for each message beside the `.action` file.
    ///
    /// # Errors
    /// As [`TypeRegistry::get`], for its messages.
    pub fn action(&self, name: &TypeName) -> Result<Arc<ActionType>, DefinitionError> {
        ActionType::of(name, |name| self.get(name)).map(Arc::new)
    }

    /// Returns the added ROS 2 action of that name.
    ///
    /// # Errors
    /// As [`TypeRegistry::get`], for its messages.
    pub fn action_messages(&self, name: &TypeName) -> Result<ActionMessages, DefinitionError> {
        ActionMessages::of(name, |name| self.get(name))
    }

    /// Returns the action of that name, of ROS 1 or ROS 2, as calls and values of the space.
    ///
    /// # Errors
    /// As [`TypeRegistry::get`], for its messages.
    pub fn action_calls(&self, name: &TypeName) -> Result<ActionCalls, DefinitionError> {
        ActionCalls::of((self.dialect, name), &self.definitions)
    }

    /// Returns a similar name as [`TypeRegistry::suggest`] does, among the services.
    pub fn suggest_service(&self, name: &TypeName) -> Option<TypeName> {
        resolve::suggest(name, self.services.keys())
    }

    /// Returns the type of [`standard_type`](crate::standard_type), with this dialect's type for a
    /// DateTime.
    pub fn standard_type(&self, builtin: BuiltinType, array: bool) -> Option<TypeName> {
        match (self.dialect, builtin, array) {
            (Dialect::Ros2, BuiltinType::DateTime, false) => {
                TypeName::new("builtin_interfaces", "Time").ok()
            }
            _ => crate::standard_type(builtin, array),
        }
    }

    /// Returns the known name that is most similar to `name`, if any is close: the same name in
    /// another package, or with at most a third of the letters different.
    pub fn suggest(&self, name: &TypeName) -> Option<TypeName> {
        resolve::suggest(name, self.definitions.keys())
    }
}

/// The type definitions of a peer by name, the type itself first.
#[derive(Clone, Debug)]
pub struct PeerDefinitions {
    needed: Vec<(TypeName, Arc<MessageDefinition>)>,
}

impl PeerDefinitions {
    /// Returns the number of definitions, at least one.
    #[expect(clippy::len_without_is_empty, reason = "the type itself is among them")]
    #[must_use]
    pub const fn len(&self) -> usize {
        self.needed.len()
    }
}

/// Returns the parts of a connection header's definition, the type itself first.
fn sections<'t>(
    name: &TypeName,
    text: &'t str,
) -> Result<Vec<(TypeName, &'t str)>, DefinitionError> {
    let mut found = Vec::new();
    let mut current = name.clone();
    let mut start = 0;
    let mut offset = 0;
    let mut after_rule = None;
    for (number, line) in text.split_inclusive('\n').enumerate() {
        let content = line.trim_end();
        let next = offset + line.len();
        match after_rule.take() {
            Some(rule) => {
                let heading = content.strip_prefix("MSG:").map(|name| name.trim().parse());
                let Some(Ok(next_name)) = heading else {
                    return Err(DefinitionError::Syntax {
                        name: name.clone(),
                        line: number + 1,
                        reason: "expected `MSG: package/Name` after a line of `=`",
                        text: content.chars().take(200).collect(),
                    });
                };
                found.push((
                    std::mem::replace(&mut current, next_name),
                    text.get(start..rule).unwrap_or_default(),
                ));
                start = next;
            }
            None if content.len() >= 40 && content.bytes().all(|b| b == b'=') => {
                after_rule = Some(offset)
            }
            None => {}
        }
        offset = next;
    }
    found.push((
        current,
        text.get(start..after_rule.unwrap_or(text.len()))
            .unwrap_or_default(),
    ));
    Ok(found)
}
