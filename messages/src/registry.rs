use std::collections::BTreeMap;
use std::sync::Arc;

use uadp::BuiltinType;

use crate::bundle;
use crate::definition::Definition;
use crate::resolve::Resolver;
use crate::{DefinitionError, Dialect, MessageType, TypeName};

/// Message definitions of one dialect by name.
///
/// Definitions may be added in any order: what a type needs is looked for when it is asked for.
#[derive(Clone, Debug)]
pub struct Registry {
    dialect: Dialect,
    definitions: BTreeMap<TypeName, Arc<Definition>>,
}

impl Registry {
    /// Without any definition.
    pub fn empty(dialect: Dialect) -> Self {
        Self {
            dialect,
            definitions: BTreeMap::new(),
        }
    }

    /// With the common interfaces built in: std_msgs, geometry_msgs, sensor_msgs, nav_msgs, trajectory_msgs,
    /// diagnostic_msgs, actionlib_msgs, tf2_msgs, rosgraph_msgs, shape_msgs, visualization_msgs, stereo_msgs, and for
    /// ROS 2 builtin_interfaces, action_msgs, unique_identifier_msgs, lifecycle_msgs and rcl_interfaces.
    pub fn bundle(dialect: Dialect) -> Self {
        let mut registry = Self::empty(dialect);
        for (name, text) in bundle::texts(dialect) {
            // Every text of the bundle parses: a test asks for each of them.
            if let Ok(definition) = Definition::parse(dialect, &name, &text) {
                registry.definitions.insert(name, Arc::new(definition));
            }
        }
        registry
    }

    /// The dialect of the definitions.
    pub fn dialect(&self) -> Dialect {
        self.dialect
    }

    /// The names there are, in order.
    pub fn names(&self) -> impl Iterator<Item = &TypeName> {
        self.definitions.keys()
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
        let mut peers = BTreeMap::new();
        for (name, text) in sections(name, text)? {
            let definition = Arc::new(Definition::parse(self.dialect, &name, text)?);
            peers.entry(name).or_insert(definition);
        }
        let found = Resolver::new(self.dialect, &[&peers, &self.definitions])
            .message_type(name, Some(text))?;
        for (name, definition) in peers {
            self.definitions.entry(name).or_insert(definition);
        }
        Ok(Arc::new(found))
    }

    /// The type of that name with all it needs.
    pub fn get(&self, name: &TypeName) -> Result<Arc<MessageType>, DefinitionError> {
        Resolver::new(self.dialect, &[&self.definitions])
            .message_type(name, None)
            .map(Arc::new)
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
        Resolver::new(self.dialect, &[&self.definitions]).suggest(name)
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
