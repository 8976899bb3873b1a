//! Definitions of a ROS version from several locations. The nearest location takes precedence:
//! files before built-in definitions.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt;
use std::sync::Arc;

use crate::definition::MessageDefinition;
use crate::{
    ActionCalls, ActionMessages, ActionType, DefinitionError, Dialect, MessageType, ServiceType,
    TypeName, TypeRegistry,
};

/// The kind of a definition text.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum TextKind {
    /// `.msg`
    Message,
    /// `.srv`
    Service,
    /// `.action`
    Action,
}

impl TextKind {
    /// All kinds.
    pub const ALL: [Self; 3] = [Self::Message, Self::Service, Self::Action];

    /// Returns `msg`, `srv` or `action`: the folder in a package, and the extension of a file's
    /// name.
    #[must_use]
    pub const fn word(self) -> &'static str {
        match self {
            Self::Message => "msg",
            Self::Service => "srv",
            Self::Action => "action",
        }
    }
}

impl fmt::Display for TextKind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.word())
    }
}

/// The language of a definition text.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Language {
    /// The language of `.msg`, `.srv` and `.action` files.
    Ros,
    /// OMG IDL as written by rosidl, in `.idl` files of ROS 2.
    Idl,
}

/// A text and its location.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct DefinitionText {
    /// The whole text.
    pub text: String,
    /// Its language.
    pub language: Language,
    /// The file, for messages to users.
    pub file: Arc<str>,
}

/// A provider of definition texts beside the built-in definitions.
pub trait DefinitionTexts {
    /// Returns the text of that name and kind for a ROS version, from the nearest location that
    /// has it. Called once per name.
    fn find(&mut self, dialect: Dialect, kind: TextKind, name: &TypeName)
    -> Option<DefinitionText>;

    /// Returns the available names, for suggestions when a name is missing.
    fn names(&mut self, dialect: Dialect, kind: TextKind) -> Vec<TypeName>;

    /// Returns the searched locations for users: folders, files, environment variables. Empty if
    /// there are no locations.
    fn places(&self, dialect: Dialect) -> Vec<String>;
}

/// A provider without texts, for built-in definitions only.
#[derive(Clone, Copy, Debug, Default)]
pub struct NoTexts;

impl DefinitionTexts for NoTexts {
    fn find(&mut self, _: Dialect, _: TextKind, _: &TypeName) -> Option<DefinitionText> {
        None
    }

    fn names(&mut self, _: Dialect, _: TextKind) -> Vec<TypeName> {
        Vec::new()
    }

    fn places(&self, _: Dialect) -> Vec<String> {
        Vec::new()
    }
}

/// Event of a requested text, for the log.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Noted {
    /// The text is used.
    Read {
        /// The defined type.
        name: TypeName,
        /// The file.
        file: Arc<str>,
    },
    /// The text does not parse and is ignored.
    Refused {
        /// The type that the text should define.
        name: TypeName,
        /// The file.
        file: Arc<str>,
        /// The error.
        error: DefinitionError,
    },
    /// The text is used, and differs from the built-in definition of the same name.
    Differs {
        /// The defined type.
        name: TypeName,
        /// The file.
        file: Arc<str>,
        /// Fields, and in ROS 1 constants, that only the file has, in order. The part of a service
        /// or action precedes the name.
        only_file: Vec<String>,
        /// Fields and constants that only the built-in definition has.
        only_built_in: Vec<String>,
    },
}

/// Definitions of a ROS version, built in or from texts, which are read on request.
///
/// A text takes precedence over a built-in definition of the same name. The owner adds the
/// definitions of peers to the [`registry`](Self::registry_mut): a text found later replaces them.
#[derive(Clone, Debug)]
pub struct Library {
    registry: TypeRegistry,
    asked: BTreeSet<(TextKind, TypeName)>,
    files: BTreeMap<(TextKind, TypeName), Arc<str>>,
    noted: Vec<Noted>,
}

impl Library {
    /// Creates a library with the definitions of a registry as its built-in definitions.
    #[must_use]
    pub const fn new(registry: TypeRegistry) -> Self {
        Self {
            registry,
            asked: BTreeSet::new(),
            files: BTreeMap::new(),
            noted: Vec::new(),
        }
    }

    /// Returns the current definitions.
    #[must_use]
    pub const fn registry(&self) -> &TypeRegistry {
        &self.registry
    }

    /// Returns the registry, for definitions from other sources than texts.
    pub const fn registry_mut(&mut self) -> &mut TypeRegistry {
        &mut self.registry
    }

    /// Discards the definitions of texts, so that the texts are requested again. Definitions from
    /// other sources stay.
    pub fn forget_texts(&mut self) {
        self.asked.clear();
        let files = std::mem::take(&mut self.files);
        if files.is_empty() {
            return;
        }
        let built_in = TypeRegistry::bundle(self.dialect());
        for (kind, name) in files.into_keys() {
            match kind {
                TextKind::Message => self.registry.restore(&name, &built_in),
                TextKind::Service => self.registry.restore_service(&name, &built_in),
                TextKind::Action => {
                    for made in self.needed(kind, &name) {
                        self.registry.restore(&made, &built_in);
                    }
                }
            }
        }
    }

    /// Returns the type of that name with all types it needs.
    ///
    /// # Errors
    /// [`DefinitionError`]. A text that does not parse is noted, and is ignored.
    pub fn message(
        &mut self,
        name: &TypeName,
        texts: &mut dyn DefinitionTexts,
    ) -> Result<Arc<MessageType>, DefinitionError> {
        self.gather(vec![(TextKind::Message, name.clone())], texts);
        self.registry.get(name)
    }

    /// Returns the service of that name with all types it needs.
    ///
    /// # Errors
    /// As [`message`](Self::message).
    pub fn service(
        &mut self,
        name: &TypeName,
        texts: &mut dyn DefinitionTexts,
    ) -> Result<Arc<ServiceType>, DefinitionError> {
        self.gather(vec![(TextKind::Service, name.clone())], texts);
        self.registry.service(name)
    }

    /// Returns the ROS 1 action of that name, from its `.action` text or from the texts of its
    /// seven messages.
    ///
    /// # Errors
    /// As [`message`](Self::message), for its messages.
    pub fn action(
        &mut self,
        name: &TypeName,
        texts: &mut dyn DefinitionTexts,
    ) -> Result<Arc<ActionType>, DefinitionError> {
        self.gather(vec![(TextKind::Action, name.clone())], texts);
        self.registry.action(name)
    }

    /// Returns the messages of the ROS 2 action of that name.
    ///
    /// # Errors
    /// As [`message`](Self::message), for its messages.
    pub fn action_messages(
        &mut self,
        name: &TypeName,
        texts: &mut dyn DefinitionTexts,
    ) -> Result<ActionMessages, DefinitionError> {
        self.gather(vec![(TextKind::Action, name.clone())], texts);
        self.registry.action_messages(name)
    }

    /// Returns the action of that name, of ROS 1 or ROS 2, as calls and values of the space.
    ///
    /// # Errors
    /// As [`message`](Self::message), for its messages.
    pub fn action_calls(
        &mut self,
        name: &TypeName,
        texts: &mut dyn DefinitionTexts,
    ) -> Result<ActionCalls, DefinitionError> {
        self.gather(vec![(TextKind::Action, name.clone())], texts);
        self.registry.action_calls(name)
    }

    /// Returns the file of a definition, or `None` if the definition is built in, came from a peer,
    /// or is unknown.
    #[must_use]
    pub fn file(&self, kind: TextKind, name: &TypeName) -> Option<&Arc<str>> {
        self.files.get(&(kind, name.clone()))
    }

    /// Returns the events after the previous call.
    pub fn take_noted(&mut self) -> Vec<Noted> {
        std::mem::take(&mut self.noted)
    }

    /// Returns the known name, built in or in a text, that is most similar to an unknown name.
    pub fn suggest(
        &self,
        kind: TextKind,
        name: &TypeName,
        texts: &mut dyn DefinitionTexts,
    ) -> Option<TypeName> {
        let named = texts.names(self.registry.dialect(), kind);
        match kind {
            TextKind::Service => {
                crate::resolve::suggest(name, self.registry.services().chain(&named))
            }
            TextKind::Message | TextKind::Action => {
                crate::resolve::suggest(name, self.registry.names().chain(&named))
            }
        }
    }

    /// Reads the requested texts that were not read yet, and recursively the texts that they need.
    fn gather(&mut self, mut wanted: Vec<(TextKind, TypeName)>, texts: &mut dyn DefinitionTexts) {
        let mut budget = MOST_TEXTS;
        let mut met = BTreeSet::new();
        while let Some((kind, name)) = wanted.pop() {
            if !met.insert((kind, name.clone())) {
                continue;
            }
            if !self.asked.contains(&(kind, name.clone())) {
                let Some(left) = budget.checked_sub(1) else {
                    return;
                };
                budget = left;
                if self.asked.len() >= MOST_ASKED {
                    // Peers can invent any number of names; names without a text are requested
                    // again.
                    let files = &self.files;
                    self.asked.retain(|asked| files.contains_key(asked));
                }
                self.asked.insert((kind, name.clone()));
                if let Some(text) = texts.find(self.registry.dialect(), kind, &name) {
                    self.take(kind, &name, text);
                }
            }
            let needed = self.needed(kind, &name);
            wanted.extend(needed.into_iter().map(|name| (TextKind::Message, name)));
        }
    }

    fn needed(&self, kind: TextKind, name: &TypeName) -> Vec<TypeName> {
        let of =
            |definition: &Arc<MessageDefinition>| definition.needs().cloned().collect::<Vec<_>>();
        match kind {
            TextKind::Message => self.registry.definition(name).map(of).unwrap_or_default(),
            TextKind::Service => {
                let parts = self.registry.service_definitions(name);
                parts.into_iter().flatten().flat_map(of).collect()
            }
            // The existing messages; for an action without a text its messages are searched.
            TextKind::Action => {
                let suffixes: &[&str] = match self.registry.dialect() {
                    Dialect::Ros1 => &ACTION_MESSAGES,
                    Dialect::Ros2 => &["Goal", "Result", "Feedback"],
                };
                suffixes
                    .iter()
                    .filter_map(|suffix| crate::service::derived(name, suffix).ok())
                    .collect()
            }
        }
    }

    fn take(&mut self, kind: TextKind, name: &TypeName, text: DefinitionText) {
        let before = self.lines(kind, name);
        let added = match (text.language, kind) {
            (Language::Idl, _) => self.registry.add_idl(kind, name, &text.text),
            (Language::Ros, TextKind::Message) => self.registry.add(name, &text.text),
            (Language::Ros, TextKind::Service) => self.registry.add_service(name, &text.text),
            (Language::Ros, TextKind::Action) => self.registry.add_action(name, &text.text),
        };
        let (name, file) = (name.clone(), text.file);
        if let Err(error) = added {
            self.noted.push(Noted::Refused { name, file, error });
            return;
        }
        if kind == TextKind::Action {
            // The messages of the action come from this text, even if there are files of their
            // names.
            for made in self.needed(kind, &name) {
                self.asked.insert((TextKind::Message, made));
            }
        }
        self.files.insert((kind, name.clone()), Arc::clone(&file));
        if let (Some(before), Some(after)) = (before, self.lines(kind, &name))
            && before != after
        {
            let only = |these: &[String], those: &[String]| {
                let mut only = these.to_vec();
                only.retain(|line| !those.contains(line));
                only
            };
            self.noted.push(Noted::Differs {
                name: name.clone(),
                file: Arc::clone(&file),
                only_file: only(&after, &before),
                only_built_in: only(&before, &after),
            });
        }
        self.noted.push(Noted::Read { name, file });
    }

    /// Returns the lines of a definition that its peers must agree on.
    fn lines(&self, kind: TextKind, name: &TypeName) -> Option<Vec<String>> {
        match kind {
            TextKind::Message => Some(self.registry.definition(name)?.lines(self.dialect(), "")),
            TextKind::Service => {
                let [request, response] = self.registry.service_definitions(name)?;
                let mut lines = request.lines(self.dialect(), "request ");
                lines.extend(response.lines(self.dialect(), "response "));
                Some(lines)
            }
            TextKind::Action => {
                let mut lines = Vec::new();
                for (part, prefix) in [
                    ("Goal", "goal "),
                    ("Result", "result "),
                    ("Feedback", "feedback "),
                ] {
                    let name = crate::service::derived(name, part).ok()?;
                    let definition = self.registry.definition(&name)?;
                    lines.extend(definition.lines(self.dialect(), prefix));
                }
                Some(lines)
            }
        }
    }

    const fn dialect(&self) -> Dialect {
        self.registry.dialect()
    }
}

impl MessageDefinition {
    /// Returns the messages among its fields.
    pub(crate) fn needs(&self) -> impl Iterator<Item = &TypeName> {
        self.fields.iter().filter_map(|field| match &field.kind {
            crate::definition::FieldType::Message(name) => Some(name),
            crate::definition::FieldType::Primitive(_) => None,
        })
    }

    /// Returns its fields as `prefix type name`, with the types in a uniform notation, and for ROS
    /// 1 its constants, which the md5 includes.
    pub(crate) fn lines(&self, dialect: Dialect, prefix: &str) -> Vec<String> {
        let constants = self.constants.iter().filter(|_| dialect == Dialect::Ros1);
        let constants = constants.map(|constant| format!("{prefix}{}", constant.line));
        let fields = self
            .fields
            .iter()
            .map(|field| format!("{prefix}{} {}", field.spelling(), field.name));
        constants.chain(fields).collect()
    }
}

/// Checks a text by itself, without the types it needs.
///
/// # Errors
/// [`DefinitionError::Syntax`].
pub fn check_text(
    dialect: Dialect,
    kind: TextKind,
    name: &TypeName,
    text: &DefinitionText,
) -> Result<(), DefinitionError> {
    let mut registry = TypeRegistry::empty(dialect);
    match (text.language, kind) {
        (Language::Idl, _) => registry.add_idl(kind, name, &text.text),
        (Language::Ros, TextKind::Message) => registry.add(name, &text.text),
        (Language::Ros, TextKind::Service) => registry.add_service(name, &text.text),
        (Language::Ros, TextKind::Action) => registry.add_action(name, &text.text),
    }
}

/// Suffixes that genaction appends to the name of an action.
const ACTION_MESSAGES: [&str; 7] = [
    "Action",
    "ActionGoal",
    "ActionResult",
    "ActionFeedback",
    "Goal",
    "Result",
    "Feedback",
];
/// Limit of remembered names without a text.
const MOST_ASKED: usize = 16_384;
/// Limit of texts read for a request, which exceeds the need of any message.
const MOST_TEXTS: usize = 512;
