use std::collections::BTreeMap;
use std::sync::Arc;

use uadp::BuiltinType;

use crate::bundle;
use crate::definition::Definition;
use crate::idl;
use crate::resolve::{self, Resolver};
use crate::service::{self, ServiceDefinition};
use crate::{
    ActionCalls, ActionMessages, ActionType, DefinitionError, Dialect, MessageType, ServiceType,
    TextKind, TypeName,
};

/// Message definitions of one dialect by name.
///
/// Definitions may be added in any order: what a type needs is looked for when it is asked for.
#[derive(Clone, Debug)]
pub struct Registry {
    dialect: Dialect,
    pub(crate) definitions: BTreeMap<TypeName, Arc<Definition>>,
    services: BTreeMap<TypeName, Arc<ServiceDefinition>>,
}

impl Registry {
    /// Without any definition.
    pub fn empty(dialect: Dialect) -> Self {
        Self {
            dialect,
            definitions: BTreeMap::new(),
            services: BTreeMap::new(),
        }
    }

    /// With the common interfaces built in: std_msgs, geometry_msgs, sensor_msgs, nav_msgs, trajectory_msgs,
    /// diagnostic_msgs, actionlib_msgs, tf2_msgs, rosgraph_msgs, shape_msgs, visualization_msgs, stereo_msgs, the
    /// services of std_srvs and ua_msgs (the skills of OPC UA, `ros/ua_msgs`), the actions of actionlib, the MoveBase of
    /// move_base_msgs and the Fibonacci of the tutorials of both ROS, for ROS 1 also roscpp and their services,
    /// and for ROS 2 builtin_interfaces, action_msgs, unique_identifier_msgs, lifecycle_msgs and rcl_interfaces with the
    /// services of action_msgs and rcl_interfaces.
    pub fn bundle(dialect: Dialect) -> Self {
        let mut registry = Self::empty(dialect);
        for (kind, name, text) in bundle::texts(dialect) {
            let added = match kind {
                bundle::Kind::Message => registry.add(&name, &text),
                bundle::Kind::Service => registry.add_service(&name, &text),
                bundle::Kind::Action => registry.add_action(&name, &text),
            };
            // A test asks for each of them.
            debug_assert!(added.is_ok(), "every text of the bundle parses");
        }
        registry
    }

    /// The dialect of the definitions.
    pub const fn dialect(&self) -> Dialect {
        self.dialect
    }

    /// The names there are, in order.
    pub fn names(&self) -> impl Iterator<Item = &TypeName> {
        self.definitions.keys()
    }

    /// Puts the message of that name as `other` has it in the place of the one there is.
    pub(crate) fn restore(&mut self, name: &TypeName, other: &Self) {
        match other.definitions.get(name) {
            Some(definition) => self
                .definitions
                .insert(name.clone(), Arc::clone(definition)),
            None => self.definitions.remove(name),
        };
    }

    /// Likewise the service.
    pub(crate) fn restore_service(&mut self, name: &TypeName, other: &Self) {
        match other.services.get(name) {
            Some(definition) => self.services.insert(name.clone(), Arc::clone(definition)),
            None => self.services.remove(name),
        };
    }

    /// Adds the text of a `.msg` file; it replaces a definition of the same name.
    ///
    /// # Errors
    /// [`DefinitionError::Syntax`]. What the text needs may be added later, so only [`Registry::get`] finds it missing.
    pub fn add(&mut self, name: &TypeName, text: &str) -> Result<(), DefinitionError> {
        let definition = Definition::parse(self.dialect, name, text)?;
        self.definitions.insert(name.clone(), Arc::new(definition));
        Ok(())
    }

    /// The type a ROS 1 publisher means by the `message_definition` of its connection header: the text of the type,
    /// then each type it needs, headed by a line of `=` and a line `MSG: package/Name`.
    ///
    /// The type returned is made of this text alone, but for types it needs and does not hold, which are taken from the
    /// registry. The registry keeps the definitions of names new to it, and never lets a peer replace one it has.
    pub fn add_ros1_definition(
        &mut self,
        name: &TypeName,
        text: &str,
    ) -> Result<Arc<MessageType>, DefinitionError> {
        let (found, definitions) = self.read_ros1_definition(name, text)?;
        self.keep(&definitions);
        Ok(found)
    }

    /// As [`add_ros1_definition`](Self::add_ros1_definition), but nothing is kept. The definitions are for
    /// [`keep`](Self::keep): those of the text that the type needs.
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
            let definition = Arc::new(Definition::parse(self.dialect, &name, text)?);
            peers.entry(name).or_insert(definition);
        }
        let found = Resolver::new(self.dialect, &[&peers, &self.definitions])
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

    /// Adds the definitions of a peer, but for names that there are already.
    pub fn keep(&mut self, definitions: &PeerDefinitions) {
        for (name, definition) in &definitions.needed {
            if !self.definitions.contains_key(name) {
                self.definitions
                    .insert(name.clone(), Arc::clone(definition));
            }
        }
    }

    /// Takes away the definitions of a peer, but for those that were not kept or have been replaced.
    pub fn forget(&mut self, definitions: &PeerDefinitions) {
        for (name, definition) in &definitions.needed {
            let known = self.definitions.get(name);
            if known.is_some_and(|known| Arc::ptr_eq(known, definition)) {
                self.definitions.remove(name);
            }
        }
    }

    /// The type of that name with all it needs.
    pub fn get(&self, name: &TypeName) -> Result<Arc<MessageType>, DefinitionError> {
        Resolver::new(self.dialect, &[&self.definitions])
            .message_type(name, None)
            .map(Arc::new)
    }

    pub(crate) fn definition(&self, name: &TypeName) -> Option<&Arc<Definition>> {
        self.definitions.get(name)
    }

    /// The text of a message definition, as its file has it.
    pub fn text(&self, name: &TypeName) -> Option<&str> {
        Some(&self.definitions.get(name)?.text)
    }

    /// Request and response of a service.
    pub(crate) fn service_definitions(&self, name: &TypeName) -> Option<[&Arc<Definition>; 2]> {
        self.services.get(name).map(|service| service.parts())
    }

    /// The names of the services there are, in order.
    pub fn services(&self) -> impl Iterator<Item = &TypeName> {
        self.services.keys()
    }

    /// Adds the text of a `.srv` file, request and response parted by a line `---`; it replaces a service of the same
    /// name. A message may have that name too.
    ///
    /// # Errors
    /// [`DefinitionError::Syntax`]. What the text needs may be added later, so only [`Registry::service`] finds it
    /// missing.
    pub fn add_service(&mut self, name: &TypeName, text: &str) -> Result<(), DefinitionError> {
        let definition = ServiceDefinition::parse(self.dialect, name, text)?;
        self.services.insert(name.clone(), Arc::new(definition));
        Ok(())
    }

    /// The service of that name with all it needs.
    ///
    /// # Errors
    /// As [`Registry::get`]. [`DefinitionError::Unknown`] is of the service itself where nothing needs it, and else of a
    /// message.
    pub fn service(&self, name: &TypeName) -> Result<Arc<ServiceType>, DefinitionError> {
        let Some(definition) = self.services.get(name) else {
            return Err(DefinitionError::Unknown {
                name: name.clone(),
                needed_by: None,
            });
        };
        let own = definition.messages();
        let sets = [&own, &self.definitions];
        let mut resolver = Resolver::new(self.dialect, &sets);
        definition.resolve(name, &mut resolver).map(Arc::new)
    }

    /// Adds the text of an `.action` file, goal, result and feedback parted by two lines `---`, in place of messages of the
    /// same names: for ROS 1 the seven messages genaction makes of it, for ROS 2 those of [`ActionMessages`].
    ///
    /// # Errors
    /// [`DefinitionError::Syntax`]; then nothing is added.
    pub fn add_action(&mut self, name: &TypeName, text: &str) -> Result<(), DefinitionError> {
        let definitions = service::action(self.dialect, name, text)?;
        self.definitions.extend(definitions);
        Ok(())
    }

    /// Adds what a `.idl` text of ROS 2 defines under that name: a struct in the modules of its package and kind, of a service
    /// two (`_Request`, `_Response`), of an action three (`_Goal`, `_Result`, `_Feedback`). Other structs are left alone.
    ///
    /// # Errors
    /// [`DefinitionError::Syntax`]; then nothing is added. In ROS 1 there are no such texts.
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
                reason: "ROS 1 has no definitions in IDL",
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

    /// The action of ROS 1 of that name. Its messages suffice, wherever they are from: a package that was built has a `.msg` file
    /// of each beside the `.action` file.
    ///
    /// # Errors
    /// As [`Registry::get`], of one of the messages.
    pub fn action(&self, name: &TypeName) -> Result<Arc<ActionType>, DefinitionError> {
        ActionType::of(name, |name| self.get(name)).map(Arc::new)
    }

    /// The action of ROS 2 of that name, which was added.
    ///
    /// # Errors
    /// As [`Registry::get`], of one of the messages.
    pub fn action_messages(&self, name: &TypeName) -> Result<ActionMessages, DefinitionError> {
        ActionMessages::of(name, |name| self.get(name))
    }

    /// The action of that name, of either ROS, as calls and values of the space.
    ///
    /// # Errors
    /// As [`Registry::get`], of one of its messages.
    pub fn action_calls(&self, name: &TypeName) -> Result<ActionCalls, DefinitionError> {
        ActionCalls::of((self.dialect, name), &self.definitions)
    }

    /// As [`Registry::suggest`], among the services.
    pub fn suggest_service(&self, name: &TypeName) -> Option<TypeName> {
        resolve::suggest(name, self.services.keys())
    }

    /// As [`standard_type`](crate::standard_type), but with the type this dialect has for a DateTime.
    pub fn standard_type(&self, builtin: BuiltinType, array: bool) -> Option<TypeName> {
        match (self.dialect, builtin, array) {
            (Dialect::Ros2, BuiltinType::DateTime, false) => {
                TypeName::new("builtin_interfaces", "Time").ok()
            }
            _ => crate::standard_type(builtin, array),
        }
    }

    /// The name there is that is most like `name`, if one is near: the same name in another package, or at most a third
    /// of its letters different.
    pub fn suggest(&self, name: &TypeName) -> Option<TypeName> {
        resolve::suggest(name, self.definitions.keys())
    }
}

/// What a peer says its type is: definitions by name, the type itself first.
#[derive(Clone, Debug)]
pub struct PeerDefinitions {
    needed: Vec<(TypeName, Arc<Definition>)>,
}

impl PeerDefinitions {
    /// How many there are, at least one.
    #[expect(clippy::len_without_is_empty, reason = "the type itself is among them")]
    #[must_use]
    pub const fn len(&self) -> usize {
        self.needed.len()
    }
}

/// The parts of a connection header's definition, the type itself first.
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
                        reason: "`MSG: package/Name` expected after a line of `=`",
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
