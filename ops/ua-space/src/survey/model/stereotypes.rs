//! The stereotypes of a model, and their meaning.

use std::collections::{BTreeMap, HashMap};

use mappings::{CallKind, NamespaceText, SpaceId, nearest};
use messages::{ArrayRank, Dialect, TypeName, TypeRegistry};
use uadp::BuiltinType;

use super::{
    Applied, Element, ElementKind, Finding, ModelCall, ModelTopic, ModelValue, NodeModel, Tag,
    shown,
};

/// A stereotype with its elements and values.
struct Stereotype {
    name: &'static str,
    applies_to: AppliesTo,
    tags: &'static [&'static str],
}

#[derive(Clone, Copy, PartialEq, Eq)]
enum AppliesTo {
    Property,
    Operation,
    Package,
}

impl AppliesTo {
    const fn words(self) -> &'static str {
        match self {
            Self::Property => "a property",
            Self::Operation => "an operation",
            Self::Package => "a package",
        }
    }

    const fn fits(self, kind: ElementKind) -> bool {
        match self {
            Self::Property => matches!(kind, ElementKind::Property),
            Self::Operation => matches!(kind, ElementKind::Operation),
            Self::Package => matches!(kind, ElementKind::Other),
        }
    }
}

const STEREOTYPES: [Stereotype; 8] = [
    Stereotype {
        name: "Ros1Topic",
        applies_to: AppliesTo::Property,
        tags: &["topic", "type", "field", "publishes"],
    },
    Stereotype {
        name: "Ros2Topic",
        applies_to: AppliesTo::Property,
        tags: &["topic", "type", "field", "publishes", "space", "domain"],
    },
    Stereotype {
        name: "UaNode",
        applies_to: AppliesTo::Property,
        tags: &["node", "name", "dataType"],
    },
    Stereotype {
        name: "Ros1Service",
        applies_to: AppliesTo::Operation,
        tags: &["service", "type"],
    },
    Stereotype {
        name: "Ros2Service",
        applies_to: AppliesTo::Operation,
        tags: &["service", "type", "space", "domain"],
    },
    Stereotype {
        name: "Ros1Action",
        applies_to: AppliesTo::Operation,
        tags: &["server", "type"],
    },
    Stereotype {
        name: "Ros2Action",
        applies_to: AppliesTo::Operation,
        tags: &["server", "type", "space", "domain"],
    },
    Stereotype {
        name: "UaNamespace",
        applies_to: AppliesTo::Package,
        tags: &["index", "uri"],
    },
];

/// Returns the values and calls of the elements, and the findings.
pub(super) fn interpret(elements: &[Element]) -> (NodeModel, Vec<Finding>) {
    let mut reader = Reader {
        model: NodeModel::default(),
        findings: Vec::new(),
        domains: BTreeMap::new(),
        names: HashMap::new(),
        registries: [
            TypeRegistry::bundle(Dialect::Ros1),
            TypeRegistry::bundle(Dialect::Ros2),
        ],
    };
    for element in elements {
        reader.namespaces(element);
    }
    for element in elements {
        reader.element(element);
    }
    (reader.model, reader.findings)
}

struct Reader {
    model: NodeModel,
    findings: Vec<Finding>,
    /// The domain of each ROS 2 space, and the line that gives it.
    domains: BTreeMap<SpaceId, (u16, usize)>,
    /// The lines of the used ROS names: the space, the kind and the name.
    names: HashMap<(SpaceId, &'static str, String), usize>,
    /// The built-in definitions of ROS 1 and of ROS 2.
    registries: [TypeRegistry; 2],
}

/// The type of the values of a topic: `None` if it is unknown here or is a whole message.
type Leaf = Option<(BuiltinType, bool)>;

impl Reader {
    fn report(&mut self, line: usize, message: impl Into<String>) {
        self.findings.push(Finding::new(line, message));
    }

    fn namespaces(&mut self, element: &Element) {
        for applied in of(element, "UaNamespace") {
            let index = self.number(applied, "index", 2..=u16::MAX);
            let uri = self.required(applied, "uri");
            if let (Some(index), Some(uri)) = (index, uri) {
                let before = self.model.namespaces.insert(index, uri.clone());
                if before.is_some_and(|before| before != uri) {
                    self.report(
                        applied.line,
                        format!("index {index} has another URI already"),
                    );
                }
            } else if tag(applied, "index").is_none() {
                self.report(applied.line, "UaNamespace needs `index`, such as 2");
            }
        }
    }

    fn element(&mut self, element: &Element) {
        let mut is_known = false;
        for applied in &element.applied {
            is_known |= self.known(element, applied);
        }
        if !is_known {
            return;
        }
        match element.kind {
            ElementKind::Property => self.value(element),
            ElementKind::Operation => self.calls(element),
            ElementKind::Other => {}
        }
    }

    /// Returns true if the stereotype is in the table and fits the element. Reports a misspelt
    /// name, and values that the stereotype does not have.
    fn known(&mut self, element: &Element, applied: &Applied) -> bool {
        let names = STEREOTYPES.iter().map(|known| known.name);
        let name = applied.stereotype.as_str();
        let Some(known) = STEREOTYPES.iter().find(|known| known.name == name) else {
            // Other profiles have stereotypes of their own.
            if let Some(near) = nearest(name, names) {
                let name = shown(name);
                self.report(
                    applied.line,
                    format!("unknown stereotype `{name}`; did you mean `{near}`?"),
                );
            }
            return false;
        };
        let fits = known.applies_to.fits(element.kind);
        if !fits {
            let (element, wanted) = (shown(&element.name), known.applies_to.words());
            self.report(
                applied.line,
                format!("{name} applies to {wanted}; `{element}` is not one"),
            );
        }
        for tag in &applied.tags {
            if !known.tags.contains(&tag.name.as_str()) {
                let near = nearest(&tag.name, known.tags.iter().copied());
                let near = near.map_or_else(
                    || format!("it has {}", known.tags.join(", ")),
                    |near| format!("did you mean `{near}`?"),
                );
                let wrong = shown(&tag.name);
                self.report(tag.line, format!("{name} has no `{wrong}`; {near}"));
            }
        }
        fits
    }

    fn value(&mut self, element: &Element) {
        let (mut topics, mut publishers) = (Vec::new(), Vec::new());
        let mut leaf = None;
        for applied in &element.applied {
            let space = match applied.stereotype.as_str() {
                "Ros1Topic" => Some(SpaceId::ROS1),
                "Ros2Topic" => self.space(applied),
                _ => continue,
            };
            let found = space.and_then(|space| self.topic(element, applied, space));
            let Some((topic, value)) = found else {
                continue;
            };
            if self.is_published(applied) {
                publishers.push(topic.space);
            }
            leaf = leaf.or(value);
            topics.push(topic);
        }
        if publishers.len() > 1 {
            let name = shown(&element.name);
            self.report(
                element.line,
                format!(
                    "`{name}` is published by several spaces; set `publishes` at one of its topics"
                ),
            );
        }
        topics.sort_by_key(|topic| topic.space);
        let within = element.owners.join(".");
        let mut value = ModelValue {
            name: joined(&within, &element.name),
            within,
            node: None,
            value: leaf,
            origin: publishers.first().copied().unwrap_or(SpaceId::UA),
            topics,
        };
        for applied in of(element, "UaNode") {
            self.node(applied, &mut value);
        }
        let is_marked = element.applied.iter().any(|applied| {
            ["Ros1Topic", "Ros2Topic", "UaNode"].contains(&applied.stereotype.as_str())
        });
        if value.topics.is_empty() && value.value.is_none() {
            value.value = builtin(element);
            let has_topic = of(element, "Ros1Topic").chain(of(element, "Ros2Topic"));
            if value.value.is_none() && is_marked && has_topic.count() == 0 {
                let name = shown(&element.name);
                self.report(
                    element.line,
                    format!("`{name}` has no topic and no known type; set `dataType` of UaNode, such as Double"),
                );
            }
        }
        if is_marked {
            self.model.values.push(value);
        }
    }

    fn node(&mut self, applied: &Applied, value: &mut ModelValue) {
        if let Some(name) = tag(applied, "name") {
            value.name.clone_from(&name.value);
        }
        if let Some(tag) = tag(applied, "dataType") {
            let (name, array) = match tag.value.strip_suffix("[]") {
                Some(name) => (name, true),
                None => (tag.value.as_str(), false),
            };
            match BuiltinType::from_name(name) {
                Some(builtin) => value.value = Some((builtin, array)),
                None => {
                    let names = BuiltinType::ALL.iter().map(|builtin| builtin.name());
                    let near = nearest(name, names).unwrap_or("Double");
                    let name = shown(name);
                    self.report(
                        tag.line,
                        format!("unknown data type `{name}`; did you mean `{near}`?"),
                    );
                }
            }
        }
        let Some(tag) = tag(applied, "node") else {
            return;
        };
        match tag.value.parse::<mappings::ExpandedNodeIdText>() {
            Ok(node) => {
                let key = (SpaceId::UA, "node", tag.value.clone());
                if let Some(first) = self.names.insert(key, tag.line) {
                    let text = shown(&tag.value);
                    let what = format!("node `{text}` is used in line {first} already");
                    self.report(tag.line, what);
                }
                if let NamespaceText::Index(index) = node.namespace
                    && index > 0
                    && !self.model.namespaces.contains_key(&index)
                {
                    self.report(
                        tag.line,
                        format!(
                            "namespace {index} has no URI; write `nsu=URI;..`, or apply \
                             UaNamespace with index {index} to a package"
                        ),
                    );
                }
                value.node = Some(node);
            }
            Err(error) => {
                let text = shown(&tag.value);
                self.report(
                    tag.line,
                    format!("`{text}` is no node id: {error}; it is like `nsu=urn:line;i=10`"),
                );
            }
        }
    }

    fn topic(
        &mut self,
        element: &Element,
        applied: &Applied,
        space: SpaceId,
    ) -> Option<(ModelTopic, Leaf)> {
        let topic = self.ros_name(applied, "topic", space);
        let kind = self.required(applied, "type");
        let line = tag(applied, "type").map_or(applied.line, |tag| tag.line);
        let kind = kind.and_then(|text| match text.parse::<TypeName>() {
            Ok(kind) => Some(kind),
            Err(_) => {
                let text = shown(&text);
                self.report(
                    line,
                    format!("`{text}` is no message type; it is like `std_msgs/Bool`"),
                );
                None
            }
        });
        let (topic, kind) = (topic?, kind?);
        let field = tag(applied, "field").filter(|tag| !tag.value.is_empty());
        let leaf = self.leaf(&kind, field, space);
        if let (Some(wanted), Some((builtin, _))) = (element.type_name.as_deref(), leaf)
            && Class::of_model(wanted).is_some_and(|class| class != Class::of(builtin))
        {
            let (name, wanted) = (shown(&element.name), shown(wanted));
            self.report(
                line,
                format!(
                    "`{name}` is a {wanted} in the model, and a {} in {kind}",
                    builtin.name()
                ),
            );
        }
        let field = field.map(|tag| tag.value.clone());
        let topic = ModelTopic {
            space,
            topic,
            kind,
            field,
        };
        Some((topic, leaf))
    }

    /// Returns the type of the field, or of the only field of the message. Reports a field that a
    /// built-in message does not have.
    fn leaf(&mut self, kind: &TypeName, field: Option<&Tag>, space: SpaceId) -> Leaf {
        let [ros1, ros2] = &self.registries;
        let registry = if space.is_ros2() { ros2 } else { ros1 };
        let known = registry.get(kind).ok()?;
        let leaves = known.leaves();
        let Some(field) = field else {
            return match leaves {
                [one] => Some((one.builtin, matches!(one.rank, ArrayRank::Array { .. }))),
                _ => None,
            };
        };
        let path = field.value.as_str();
        let same = leaves.iter().find(|leaf| leaf.path == path);
        if let Some(leaf) = same {
            return Some((leaf.builtin, matches!(leaf.rank, ArrayRank::Array { .. })));
        }
        // Parts of arrays, and messages in messages, are checked with the mapping.
        let begins = |leaf: &str| {
            leaf.strip_prefix(path)
                .is_some_and(|rest| rest.starts_with('.'))
        };
        if !path.contains('[') && !leaves.iter().any(|leaf| begins(&leaf.path)) {
            let near = nearest(path, leaves.iter().map(|leaf| leaf.path.as_str()));
            let near = near.map_or_else(String::new, |near| format!("; did you mean `{near}`?"));
            let (path, line) = (shown(path), field.line);
            self.report(line, format!("{kind} has no field `{path}`{near}"));
        }
        None
    }

    fn calls(&mut self, element: &Element) {
        for applied in &element.applied {
            let (kind, key, is_ros2) = match applied.stereotype.as_str() {
                "Ros1Service" => (CallKind::Service, "service", false),
                "Ros2Service" => (CallKind::Service, "service", true),
                "Ros1Action" => (CallKind::Action, "server", false),
                "Ros2Action" => (CallKind::Action, "server", true),
                _ => continue,
            };
            let space = if is_ros2 {
                self.space(applied)
            } else {
                Some(SpaceId::ROS1)
            };
            let type_name = self.required(applied, "type");
            let Some(space) = space else {
                continue;
            };
            let server = self.ros_name(applied, key, space);
            if let (Some(server), Some(type_name)) = (server, type_name) {
                self.model.calls.push(ModelCall {
                    name: joined(&element.owners.join("."), &element.name),
                    origin: space,
                    kind,
                    server,
                    type_name,
                });
            }
        }
    }

    /// Returns the ROS 2 space of a stereotype: 2 if it gives none.
    fn space(&mut self, applied: &Applied) -> Option<SpaceId> {
        let number = match tag(applied, "space") {
            Some(_) => self.number(applied, "space", 2..=232)?,
            None => 2,
        };
        let space = SpaceId::new(number)?;
        let domain = match tag(applied, "domain") {
            Some(_) => Some(self.number(applied, "domain", 0..=232)?),
            None => None,
        };
        let entry = self.model.spaces.entry(space).or_insert(Some(number));
        if let Some(domain) = domain {
            let (first, line) = *self.domains.entry(space).or_insert((domain, applied.line));
            *entry = Some(first);
            if first != domain {
                self.report(
                    applied.line,
                    format!("space {space} has domain {first} in line {line}; it cannot have domain {domain} too"),
                );
            }
        }
        Some(space)
    }

    /// Returns the name of a topic, service or action. A name is used once in a space.
    fn ros_name(&mut self, applied: &Applied, key: &'static str, space: SpaceId) -> Option<String> {
        let text = self.required(applied, key)?;
        let line = tag(applied, key).map_or(applied.line, |tag| tag.line);
        if space == SpaceId::ROS1 {
            self.model.spaces.entry(space).or_insert(None);
        }
        let is_word = |c: char| c.is_ascii_alphanumeric() || c == '_' || c == '/';
        let is_name = text.len() > 1 && text.starts_with('/') && text.chars().all(is_word);
        if !is_name || text.ends_with('/') {
            let text = shown(&text);
            self.report(
                line,
                format!("`{text}` is no name of ROS; it is like `/conveyor/running`"),
            );
            return None;
        }
        if let Some(first) = self.names.insert((space, key, text.clone()), line) {
            self.report(
                line,
                format!("`{text}` of space {space} is used in line {first} already"),
            );
            return None;
        }
        Some(text)
    }

    fn is_published(&mut self, applied: &Applied) -> bool {
        let Some(tag) = tag(applied, "publishes") else {
            return false;
        };
        match tag.value.as_str() {
            "true" => true,
            "false" | "" => false,
            other => {
                let other = shown(other);
                self.report(
                    tag.line,
                    format!("`publishes` is `{other}`; it is true or false"),
                );
                false
            }
        }
    }

    fn required(&mut self, applied: &Applied, key: &str) -> Option<String> {
        let found = tag(applied, key).filter(|tag| !tag.value.is_empty());
        if found.is_none() {
            let name = &applied.stereotype;
            self.report(applied.line, format!("{name} needs `{key}`"));
        }
        found.map(|tag| tag.value.clone())
    }

    fn number(
        &mut self,
        applied: &Applied,
        key: &str,
        range: std::ops::RangeInclusive<u16>,
    ) -> Option<u16> {
        let tag = tag(applied, key)?;
        let number = tag
            .value
            .parse()
            .ok()
            .filter(|number| range.contains(number));
        if number.is_none() {
            let (value, first, last) = (shown(&tag.value), range.start(), range.end());
            self.report(
                tag.line,
                format!("`{key}` is `{value}`; it is a number from {first} to {last}"),
            );
        }
        number
    }
}

/// Returns the applications of the stereotype to the element.
fn of<'e>(element: &'e Element, name: &'static str) -> impl Iterator<Item = &'e Applied> {
    let applied = element.applied.iter();
    applied.filter(move |applied| applied.stereotype == name)
}

fn tag<'a>(applied: &'a Applied, name: &str) -> Option<&'a Tag> {
    applied.tags.iter().find(|tag| tag.name == name)
}

fn joined(within: &str, name: &str) -> String {
    match within {
        "" => name.to_owned(),
        within => format!("{within}.{name}"),
    }
}

/// The kinds of values that a model distinguishes.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Class {
    Boolean,
    Number,
    Text,
    Other,
}

impl Class {
    fn of(builtin: BuiltinType) -> Self {
        if builtin.is_number() {
            Self::Number
        } else if builtin == BuiltinType::Boolean {
            Self::Boolean
        } else if builtin == BuiltinType::String {
            Self::Text
        } else {
            Self::Other
        }
    }

    /// Returns the kind of a type of the model; `None` for types that only the model knows.
    fn of_model(name: &str) -> Option<Self> {
        of_model(name).map(Self::of)
    }
}

/// Returns the builtin type of a property by its type in the model.
fn builtin(element: &Element) -> Leaf {
    let name = element.type_name.as_deref()?;
    Some((of_model(name)?, element.is_array))
}

/// Returns the builtin type of a primitive type of UML, SysML, Ecore or OPC UA.
fn of_model(name: &str) -> Option<BuiltinType> {
    let own = BuiltinType::from_name(name);
    own.or(match name {
        "EBoolean" | "boolean" | "bool" | "Bool" => Some(BuiltinType::Boolean),
        "Integer" | "EInt" | "int" => Some(BuiltinType::Int32),
        "Natural" | "Positive" | "UnlimitedNatural" => Some(BuiltinType::UInt32),
        "ELong" | "long" => Some(BuiltinType::Int64),
        "Real" | "EDouble" | "double" | "Rational" => Some(BuiltinType::Double),
        "EFloat" | "float" => Some(BuiltinType::Float),
        "EString" => Some(BuiltinType::String),
        _ => None,
    })
}
