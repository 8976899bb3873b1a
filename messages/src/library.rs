//! Definitions of one ROS from several places, the nearest of which wins: files before what is built in.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt;
use std::sync::Arc;

use crate::definition::Definition;
use crate::{
    ActionCalls, ActionMessages, ActionType, DefinitionError, Dialect, MessageType, Registry,
    ServiceType, TypeName,
};

/// What a text defines.
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
    /// Each of them.
    pub const ALL: [Self; 3] = [Self::Message, Self::Service, Self::Action];

    /// `msg`, `srv` or `action`: the folder in a package, and the ending of a file's name.
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
    /// That of `.msg`, `.srv` and `.action` files.
    Ros,
    /// OMG IDL as rosidl writes it, in `.idl` files of ROS 2.
    Idl,
}

/// A text and where it is from.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct DefinitionText {
    /// The whole text.
    pub text: String,
    /// Its language.
    pub language: Language,
    /// The file, as people are told of it.
    pub file: Arc<str>,
}

/// Where definition texts are that are not built in.
pub trait DefinitionTexts {
    /// The text of that name and kind for one ROS, of the nearest place that has one. It is asked for once.
    fn find(&mut self, dialect: Dialect, kind: TextKind, name: &TypeName)
    -> Option<DefinitionText>;

    /// Names that can be found, for advice when one cannot.
    fn names(&mut self, dialect: Dialect, kind: TextKind) -> Vec<TypeName>;

    /// Where is looked, for people: folders, files, variables of the environment. Empty when nowhere.
    fn places(&self, dialect: Dialect) -> Vec<String>;
}

/// Nothing beside what is built in.
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

/// What is worth telling of a text that was asked for.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Noted {
    /// It counts.
    Read {
        /// What it defines.
        name: TypeName,
        /// The file.
        file: Arc<str>,
    },
    /// It does not parse, and counts as not there.
    Refused {
        /// What it is a text of.
        name: TypeName,
        /// The file.
        file: Arc<str>,
        /// Why.
        error: DefinitionError,
    },
    /// It counts, and differs from what is built in under its name.
    Differs {
        /// What it defines.
        name: TypeName,
        /// The file.
        file: Arc<str>,
        /// Fields, and in ROS 1 constants, that only the file has; in their order, a part of a service or action before its name.
        only_file: Vec<String>,
        /// Those that only the built-in definition has.
        only_built_in: Vec<String>,
    },
}

/// Definitions of one ROS, those built in and those of texts, which are read as they are asked for.
///
/// A text wins over a built-in definition of its name. What peers define is for the owner to add to the
/// [`registry`](Self::registry_mut): a text found later replaces it.
#[derive(Clone, Debug)]
pub struct Library {
    registry: Registry,
    asked: BTreeSet<(TextKind, TypeName)>,
    files: BTreeMap<(TextKind, TypeName), Arc<str>>,
    noted: Vec<Noted>,
}

impl Library {
    /// With the definitions of a registry as those built in.
    #[must_use]
    pub const fn new(registry: Registry) -> Self {
        Self {
            registry,
            asked: BTreeSet::new(),
            files: BTreeMap::new(),
            noted: Vec::new(),
        }
    }

    /// What is known by now.
    #[must_use]
    pub const fn registry(&self) -> &Registry {
        &self.registry
    }

    /// For definitions that come another way than by texts.
    pub const fn registry_mut(&mut self) -> &mut Registry {
        &mut self.registry
    }

    /// Forgets what texts define, so that they are asked for again. What came another way stays.
    pub fn forget_texts(&mut self) {
        self.asked.clear();
        let files = std::mem::take(&mut self.files);
        if files.is_empty() {
            return;
        }
        let built_in = Registry::bundle(self.dialect());
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

    /// The type of that name with all it needs.
    ///
    /// # Errors
    /// [`DefinitionError`]. A text that does not parse is noted, and counts as not there.
    pub fn message(
        &mut self,
        name: &TypeName,
        texts: &mut dyn DefinitionTexts,
    ) -> Result<Arc<MessageType>, DefinitionError> {
        self.gather(vec![(TextKind::Message, name.clone())], texts);
        self.registry.get(name)
    }

    /// The service of that name with all it needs.
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

    /// The action of ROS 1 of that name, by its `.action` text or by the texts of its seven messages.
    ///
    /// # Errors
    /// As [`message`](Self::message), of one of the messages.
    pub fn action(
        &mut self,
        name: &TypeName,
        texts: &mut dyn DefinitionTexts,
    ) -> Result<Arc<ActionType>, DefinitionError> {
        self.gather(vec![(TextKind::Action, name.clone())], texts);
        self.registry.action(name)
    }

    /// The messages of the action of ROS 2 of that name.
    ///
    /// # Errors
    /// As [`message`](Self::message), of one of the messages.
    pub fn action_messages(
        &mut self,
        name: &TypeName,
        texts: &mut dyn DefinitionTexts,
    ) -> Result<ActionMessages, DefinitionError> {
        self.gather(vec![(TextKind::Action, name.clone())], texts);
        self.registry.action_messages(name)
    }

    /// The action of that name, of either ROS, as calls and values of the space.
    ///
    /// # Errors
    /// As [`message`](Self::message), of one of the messages.
    pub fn action_calls(
        &mut self,
        name: &TypeName,
        texts: &mut dyn DefinitionTexts,
    ) -> Result<ActionCalls, DefinitionError> {
        self.gather(vec![(TextKind::Action, name.clone())], texts);
        self.registry.action_calls(name)
    }

    /// The file a definition is from; `None` of one that is built in, came from a peer, or is not known.
    #[must_use]
    pub fn file(&self, kind: TextKind, name: &TypeName) -> Option<&Arc<str>> {
        self.files.get(&(kind, name.clone()))
    }

    /// What is to be told since this was asked last.
    pub fn take_noted(&mut self) -> Vec<Noted> {
        std::mem::take(&mut self.noted)
    }

    /// The known name that is most like one that is not, built in or in a text.
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

    /// Reads what is wanted and not read yet, and what that needs in turn.
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
                    // Peers can make up names without end; those there is no text of are asked for again.
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
        let of = |definition: &Arc<Definition>| definition.needs().cloned().collect::<Vec<_>>();
        match kind {
            TextKind::Message => self.registry.definition(name).map(of).unwrap_or_default(),
            TextKind::Service => {
                let parts = self.registry.service_definitions(name);
                parts.into_iter().flatten().flat_map(of).collect()
            }
            // Those of them there are; of an action that was not defined by a text the messages are looked for.
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
            // Its messages are those of this text, whatever files of their names there are.
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

    /// What of a definition its peers must agree on.
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

impl Definition {
    /// The messages among its fields.
    pub(crate) fn needs(&self) -> impl Iterator<Item = &TypeName> {
        self.fields.iter().filter_map(|field| match &field.kind {
            crate::definition::FieldType::Message(name) => Some(name),
            crate::definition::FieldType::Primitive(_) => None,
        })
    }

    /// Its fields as `prefix type name`, the types spelt in one way, and for ROS 1, whose md5 has them, its constants.
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

/// Checks a text by itself, without what it needs.
///
/// # Errors
/// [`DefinitionError::Syntax`].
pub fn check_text(
    dialect: Dialect,
    kind: TextKind,
    name: &TypeName,
    text: &DefinitionText,
) -> Result<(), DefinitionError> {
    let mut registry = Registry::empty(dialect);
    match (text.language, kind) {
        (Language::Idl, _) => registry.add_idl(kind, name, &text.text),
        (Language::Ros, TextKind::Message) => registry.add(name, &text.text),
        (Language::Ros, TextKind::Service) => registry.add_service(name, &text.text),
        (Language::Ros, TextKind::Action) => registry.add_action(name, &text.text),
    }
}

/// What genaction puts behind the name of an action.
const ACTION_MESSAGES: [&str; 7] = [
    "Action",
    "ActionGoal",
    "ActionResult",
    "ActionFeedback",
    "Goal",
    "Result",
    "Feedback",
];
/// Names that were asked for and are remembered, beside those there is a text of.
const MOST_ASKED: usize = 16_384;
/// Texts looked for in one go: more types than any message needs.
const MOST_TEXTS: usize = 512;
