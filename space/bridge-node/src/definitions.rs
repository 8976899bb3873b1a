//! Type definitions for a port: built-in definitions, definitions from files, and definitions from
//! peers.

use std::collections::BTreeMap;
use std::sync::Arc;

use messages::{
    ActionCalls, ActionMessages, ActionType, DefinitionError, Dialect, Library, MessageType, Noted,
    ServiceType, TextKind, TypeName, TypeRegistry,
};
use tracing::{info, warn};
use type_files::{RosEnvironment, TypeFiles, TypePaths};

/// Finds types by name. A definition stays cached until all definitions are read again.
#[derive(Debug)]
pub struct Definitions {
    library: Library,
    files: TypeFiles,
    /// The sources of the definitions from peers.
    peers: BTreeMap<TypeName, String>,
    /// How many further unknown names are compared with the known names.
    suggestions: u32,
}

impl Definitions {
    /// Creates the definitions of one ROS from the built-in definitions, the `type_paths` of the
    /// mapping, and the installed ROS distributions.
    #[must_use]
    pub fn new(dialect: Dialect, types: Arc<TypePaths>, environment: RosEnvironment) -> Self {
        Self {
            library: Library::new(TypeRegistry::bundle(dialect)),
            files: TypeFiles::new(types, environment),
            peers: BTreeMap::new(),
            suggestions: MOST_SUGGESTIONS,
        }
    }

    /// Replaces the definitions of the `type_paths`. Definitions from peers stay.
    pub fn replace(&mut self, types: &Arc<TypePaths>) {
        self.suggestions = MOST_SUGGESTIONS;
        if self.files.paths().is_none() && types.is_none() {
            return;
        }
        self.library.forget_texts();
        self.files.replace(Arc::clone(types));
    }

    /// Returns the registry of the known definitions.
    #[must_use]
    pub const fn registry(&self) -> &TypeRegistry {
        self.library.registry()
    }

    /// Returns the registry for definitions that do not come from files.
    pub const fn registry_mut(&mut self) -> &mut TypeRegistry {
        self.library.registry_mut()
    }

    /// Returns the type of a name with all its nested types. Files are read once.
    ///
    /// # Errors
    /// [`DefinitionError`]. A file that does not parse is logged and ignored.
    pub fn find(&mut self, name: &TypeName) -> Result<Arc<MessageType>, DefinitionError> {
        let found = self.library.message(name, &mut self.files);
        self.tell();
        found
    }

    /// Returns the service type of a name, as [`find`](Self::find) does.
    ///
    /// # Errors
    /// As [`find`](Self::find).
    pub fn find_service(&mut self, name: &TypeName) -> Result<Arc<ServiceType>, DefinitionError> {
        let found = self.library.service(name, &mut self.files);
        self.tell();
        found
    }

    /// Returns the ROS 1 action type of a name, as [`find`](Self::find) does.
    ///
    /// # Errors
    /// As [`find`](Self::find), for one of the messages of the action.
    pub fn find_action(&mut self, name: &TypeName) -> Result<Arc<ActionType>, DefinitionError> {
        let found = self.library.action(name, &mut self.files);
        self.tell();
        found
    }

    /// Returns the messages of the ROS 2 action of a name, as [`find`](Self::find) does.
    ///
    /// # Errors
    /// As [`find`](Self::find), for one of the messages of the action.
    pub fn find_action_messages(
        &mut self,
        name: &TypeName,
    ) -> Result<ActionMessages, DefinitionError> {
        let found = self.library.action_messages(name, &mut self.files);
        self.tell();
        found
    }

    /// Returns the ROS 1 or ROS 2 action of a name as calls and values of the space, as
    /// [`find`](Self::find) does.
    ///
    /// # Errors
    /// As [`find`](Self::find), for one of the messages of the action.
    pub fn find_action_calls(
        &mut self,
        name: &TypeName,
    ) -> Result<Arc<ActionCalls>, DefinitionError> {
        let found = self.library.action_calls(name, &mut self.files);
        self.tell();
        found.map(Arc::new)
    }

    /// Explains an error of [`find`](Self::find), or of [`find_service`](Self::find_service) for
    /// the kind of services, as text for the user. Suggests the known name that may be meant. Call
    /// it only for errors that are shown, because it compares all names. Only the first unknown
    /// names are compared, because peers can invent names.
    pub fn explain(&mut self, kind: TextKind, error: &DefinitionError) -> String {
        let DefinitionError::Unknown { name, needed_by } = error else {
            return error.to_string();
        };
        let Some(left) = self.suggestions.checked_sub(1) else {
            return error.to_string();
        };
        self.suggestions = left;
        let registry = self.library.registry();
        let near = match kind {
            TextKind::Service if needed_by.is_none() => registry.suggest_service(name),
            TextKind::Service | TextKind::Message | TextKind::Action => registry.suggest(name),
        };
        match near {
            Some(near) => format!("{error}; did you mean `{near}`?"),
            None => error.to_string(),
        }
    }

    /// Explains an error of a type that only files define. `wanted` names the file that is needed.
    /// If a file of the other ROS exists, the text names it instead.
    pub fn explain_missing(
        &mut self,
        (kind, name): (TextKind, &TypeName),
        error: &DefinitionError,
        wanted: &str,
    ) -> String {
        let (other, tool, version) = match self.registry().dialect() {
            Dialect::Ros1 => (Dialect::Ros2, "ament_", 2),
            Dialect::Ros2 => (Dialect::Ros1, "catkin", 1),
        };
        if let Some(file) = self.files.paths().file(other, kind, name) {
            return format!(
                "{error}; {file} is for ROS {version} only, because the package.xml of its package names only {tool}"
            );
        }
        format!("{}; {wanted}", self.explain(kind, error))
    }

    /// Records the peer that provides the definition in use, such as `type description of /camera`.
    pub fn learned(&mut self, name: &TypeName, from: impl FnOnce() -> String) {
        if self.peers.len() < MOST_PEERS {
            self.peers.insert(name.clone(), from());
        }
    }

    /// Removes the record of a definition from a peer.
    pub fn forgotten(&mut self, name: &TypeName) {
        self.peers.remove(name);
    }

    /// Returns the source of the definition of a type, as text for the user.
    #[must_use]
    pub fn source(&self, name: &TypeName) -> &str {
        let file = || {
            self.library
                .file(TextKind::Message, name)
                .map(AsRef::as_ref)
        };
        let peer = self.peers.get(name).map(String::as_str);
        peer.or_else(file).unwrap_or("built in")
    }

    fn tell(&mut self) {
        for noted in self.library.take_noted() {
            tell(noted);
        }
    }
}

fn tell(noted: Noted) {
    match noted {
        Noted::Read { name, file } => info!(definition = %name, %file, "definition read"),
        Noted::Refused { name, file, error } => {
            warn!(definition = %name, %file, "ignored a definition file: {error}");
        }
        Noted::Differs {
            name,
            file,
            only_file,
            only_built_in,
        } => tell_differing(&name, &file, &only_file, &only_built_in),
    }
}

fn tell_differing(name: &TypeName, file: &str, only_file: &[String], only_built_in: &[String]) {
    warn!(
        definition = %name,
        file,
        ?only_file,
        ?only_built_in,
        "using the definition of the file, which differs from the built-in definition"
    );
}

/// How many unknown names are compared with the known names until the definitions change.
const MOST_SUGGESTIONS: u32 = 64;
/// The maximal number of types from peers with a recorded source.
const MOST_PEERS: usize = 4096;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_may_be_meant_is_told_of_the_first_unknown_names() {
        let types = Arc::default();
        let mut known = Definitions::new(Dialect::Ros2, types, RosEnvironment::default());
        let name: TypeName = "geometry_msgs/Twists".parse().unwrap();
        let error = known.find(&name).unwrap_err();
        let mut explained = || known.explain(TextKind::Message, &error);
        let first = explained();
        assert_eq!(
            first,
            "no definition of `geometry_msgs/Twists`; did you mean `geometry_msgs/Twist`?"
        );
        let told = (1..1000).filter(|_| explained() == first).count();
        assert_eq!(told + 1, 64);
    }
    #[test]
    fn a_definition_of_the_other_ros_is_named_as_such() {
        let folder = std::env::temp_dir().join(format!("of-other-ros-{}", std::process::id()));
        let action = folder.join("robot_msgs/action");
        std::fs::create_dir_all(&action).unwrap();
        let manifest =
            "<package><name>robot_msgs</name><buildtool_depend>catkin</buildtool_depend></package>";
        std::fs::write(folder.join("robot_msgs/package.xml"), manifest).unwrap();
        std::fs::write(action.join("Turn.action"), "float64 a\n---\n---\n").unwrap();
        let types = TypePaths::read(std::slice::from_ref(&folder), &mut |_| {});
        let mut known = Definitions::new(Dialect::Ros2, Arc::new(types), RosEnvironment::default());
        let mut told = |name: &str| {
            let name: TypeName = name.parse().unwrap();
            let error = known.find_action_calls(&name).unwrap_err();
            known.explain_missing((TextKind::Action, &name), &error, "provide it")
        };
        let there = told("robot_msgs/Turn");
        let expected = "robot_msgs/action/Turn.action is for ROS 1 only, because the package.xml of its package names only catkin";
        assert!(there.ends_with(expected), "{there}");
        let missing = told("robot_msgs/Move");
        assert!(missing.ends_with("; provide it"), "{missing}");
        std::fs::remove_dir_all(folder).unwrap();
    }
}
