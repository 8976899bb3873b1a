//! The table as a NodeSet2 document (OPC 10000-6, annex F).

mod dictionary;
mod domains;
mod head;
mod methods;

use std::fmt::Write as _;

use program::{ProgramMethod, Rest};

pub use self::domains::{DomainNodeSet, domain_nodesets};

use self::head::head;
use super::table::{SkillType, TableUnit, TableVariable};
use super::types::TYPES;
use super::{
    CONTROLLER_TYPE, CURRENT_TOOL, EVENT_TYPE, GRIP_POINT_OFFSET, GRIP_POINT_OPENING,
    GRIP_POINT_TYPE, MOVER_ENDPOINT, NAMESPACE, REACH, SKILL_TYPE, TOOL_PLATE_OFFSET,
    USED_SKILL_TYPE, USES_SKILL, ZONE_BOUNDS, ZONE_NAMES,
};
use crate::value::{Builtin, SkillValue};

/// Returns the NodeSet of [`NAMESPACE`]. The text is deterministic and requires namespace 0 only.
#[must_use]
pub fn nodeset() -> String {
    let mut nodes = Nodes(head(None));
    for skill_type in &TYPES {
        nodes.skill_type(skill_type);
    }
    nodes.event_type();
    nodes.controller_type();
    nodes.used_skills();
    nodes.dictionary();
    let mut text = nodes.0;
    text.push_str("</UANodeSet>\n");
    text
}

/// A node of the document.
struct Node<'a> {
    class: &'a str,
    id: u32,
    /// The BrowseName with the index of its namespace, as `1:Name`.
    browse_name: &'a str,
    /// Additional attributes, each with a leading space.
    attributes: String,
    about: &'a str,
    /// ReferenceType, whether it is inverse, and the target.
    references: Vec<(&'a str, bool, String)>,
    value: Option<String>,
}

impl<'a> Node<'a> {
    fn new(class: &'a str, id: u32, browse_name: &'a str) -> Self {
        Self {
            class,
            id,
            browse_name,
            attributes: String::new(),
            about: "",
            references: Vec::new(),
            value: None,
        }
    }

    fn about(mut self, about: &'a str) -> Self {
        self.about = about;
        self
    }

    fn attribute(mut self, name: &str, value: &str) -> Self {
        self.attributes.push_str(&format!(" {name}=\"{value}\""));
        self
    }

    fn forward(mut self, reference: &'a str, target: impl Into<String>) -> Self {
        self.references.push((reference, false, target.into()));
        self
    }

    fn back(mut self, reference: &'a str, target: impl Into<String>) -> Self {
        self.references.push((reference, true, target.into()));
        self
    }

    /// Adds a child of a type, with the modelling rule.
    fn child_of(self, parent: u32, reference: &'a str, rule: Rule) -> Self {
        self.attribute("ParentNodeId", &own(parent))
            .forward("HasModellingRule", rule.node())
            .back(reference, own(parent))
    }
}

#[derive(Clone, Copy)]
enum Rule {
    Mandatory,
    Optional,
}

impl Rule {
    fn node(self) -> &'static str {
        match self {
            Self::Mandatory => "i=78",
            Self::Optional => "i=80",
        }
    }
}

fn own(id: u32) -> String {
    format!("ns=1;i={id}")
}

struct Nodes(String);

impl Nodes {
    fn add(&mut self, node: Node<'_>) {
        let Node {
            class,
            id,
            browse_name,
            attributes,
            about,
            references,
            value,
        } = node;
        let display = browse_name.trim_start_matches("1:");
        let out = &mut self.0;
        // Writing to a String cannot fail.
        _ = writeln!(
            out,
            "  <{class} NodeId=\"{}\" BrowseName=\"{browse_name}\"{attributes}>",
            own(id)
        );
        _ = writeln!(out, "    <DisplayName>{display}</DisplayName>");
        if !about.is_empty() {
            _ = writeln!(out, "    <Description>{}</Description>", escaped(about));
        }
        out.push_str("    <References>\n");
        for (reference, is_back, target) in references {
            let direction = if is_back { " IsForward=\"false\"" } else { "" };
            _ = writeln!(
                out,
                "      <Reference ReferenceType=\"{reference}\"{direction}>{target}</Reference>"
            );
        }
        out.push_str("    </References>\n");
        if let Some(value) = value {
            _ = writeln!(out, "    <Value>{value}</Value>");
        }
        _ = writeln!(out, "  </{class}>");
    }

    fn skill_type(&mut self, of: &SkillType) {
        let supertype = match of.base.and_then(super::find) {
            Some(base) => own(base.id),
            None => PROGRAM_STATE_MACHINE_TYPE.to_owned(),
        };
        let browse_name = format!("1:{}", of.name);
        let mut node = Node::new("UAObjectType", of.id, &browse_name).about(of.about);
        if of.is_abstract {
            node = node.attribute("IsAbstract", "true");
        }
        node = dictionary::refer(node.back("HasSubtype", supertype), of);
        let is_root = of.name == SKILL_TYPE;
        if is_root {
            node = node.forward("GeneratesEvent", own(EVENT_TYPE_ID));
        }
        self.add(node);
        if is_root {
            self.root_members(of.id);
        }
        if is_root || !of.parameters.is_empty() {
            let rule = if is_root {
                Rule::Optional
            } else {
                Rule::Mandatory
            };
            let about = "What the next run is told. Written before Start; kept by it.";
            self.group(of.id, PARAMETER_SET, ("1:ParameterSet", about), rule);
        }
        if is_root || !of.results.is_empty() {
            let about = "What the newest run that ended has said, whoever asks and whenever.";
            self.group(
                of.id,
                FINAL_RESULT_DATA,
                ("FinalResultData", about),
                Rule::Mandatory,
            );
        }
        self.optional_properties(of);
        if of.rests_in == Rest::Halted {
            self.ready_after_success(of.id + 3, of.id, false);
        }
        for (place, parameter) in (0..).zip(of.parameters) {
            let ids = Ids {
                node: of.id + PARAMETERS + place,
                properties: of.id + PARAMETER_PROPERTIES + 2 * place,
            };
            self.variable(parameter, of.id + PARAMETER_SET, ids, "3");
        }
        for (place, result) in (0..).zip(of.results) {
            let ids = Ids {
                node: of.id + RESULTS + place,
                properties: of.id + RESULT_PROPERTIES + 2 * place,
            };
            self.variable(result, of.id + FINAL_RESULT_DATA, ids, "1");
        }
    }

    /// Adds the properties that only some instances of a type have.
    fn optional_properties(&mut self, of: &SkillType) {
        let own = OPTIONAL.iter().filter(|property| property.of == of.name);
        for property in own {
            let browse_name = format!("1:{}", property.name);
            let mut node = Node::new("UAVariable", of.id + property.offset, &browse_name)
                .about(property.about)
                .attribute("DataType", property.builtin.name());
            if let Some(length) = property.length {
                node = node
                    .attribute("ValueRank", "1")
                    .attribute("ArrayDimensions", &length.to_string());
            }
            let node = node.forward("HasTypeDefinition", PROPERTY_TYPE);
            self.add(node.child_of(of.id, "HasProperty", Rule::Optional));
        }
    }

    fn group(&mut self, parent: u32, offset: u32, (browse_name, about): (&str, &str), rule: Rule) {
        let node = Node::new("UAObject", parent + offset, browse_name).about(about);
        self.add(
            node.forward("HasTypeDefinition", "i=58")
                .child_of(parent, "HasComponent", rule),
        );
    }

    /// Adds the members of every skill beside the members of a Program.
    fn root_members(&mut self, parent: u32) {
        for (place, method) in (0..).zip(METHODS) {
            let node = Node::new("UAMethod", parent + FIRST_METHOD + place, method.name());
            self.add(node.child_of(parent, "HasComponent", Rule::Mandatory));
        }
        for (offset, browse_name, builtin, array, is_property, about) in MEMBERS {
            let reference = if is_property {
                "HasProperty"
            } else {
                "HasComponent"
            };
            let definition = if is_property {
                PROPERTY_TYPE
            } else {
                BASE_DATA_VARIABLE_TYPE
            };
            let mut node = Node::new("UAVariable", parent + offset, browse_name)
                .about(about)
                .attribute("DataType", builtin.name());
            if array {
                node = node.attribute("ValueRank", "1");
            }
            self.add(node.forward("HasTypeDefinition", definition).child_of(
                parent,
                reference,
                Rule::Mandatory,
            ));
        }
        self.ready_after_success(parent + 25, parent, true);
        self.outcome_members(parent);
        for method in &methods::OF_A_SKILL {
            self.method(method, parent);
        }
    }

    /// Overrides the value of the supertypes.
    fn ready_after_success(&mut self, id: u32, parent: u32, value: bool) {
        let mut rests = Node::new("UAVariable", id, "1:ReadyAfterSuccess")
            .about(
                "Whether a run that did its work leaves it Ready; otherwise a Reset comes first.",
            )
            .attribute("DataType", Builtin::Boolean.name())
            .forward("HasTypeDefinition", PROPERTY_TYPE)
            .child_of(parent, "HasProperty", Rule::Mandatory);
        rests.value = Some(xml_value(&SkillValue::Boolean(value)));
        self.add(rests);
    }

    /// Adds the members that hold the outcome of a run.
    fn outcome_members(&mut self, parent: u32) {
        let outcome = [
            (
                30,
                "1:Run",
                Builtin::UInt32,
                "Which run has ended so; 0 before the first one.",
            ),
            (
                31,
                "1:Succeeded",
                Builtin::Boolean,
                "Whether the run did its work.",
            ),
            (32, "1:Message", Builtin::String, "Why it did not."),
            (
                33,
                "1:Trace",
                Builtin::String,
                "Its steps and what was done in them, each with the seconds since its beginning.",
            ),
            (
                34,
                "1:Unknown",
                Builtin::Boolean,
                "Whether the end of its work is unknown: the machine may move, and the skill needs a Reset.",
            ),
        ];
        for (offset, browse_name, builtin, about) in outcome {
            let mut node = Node::new("UAVariable", parent + offset, browse_name)
                .about(about)
                .attribute("DataType", builtin.name());
            if browse_name == "1:Trace" {
                node = node.attribute("ValueRank", "1");
            }
            let node = node.forward("HasTypeDefinition", BASE_DATA_VARIABLE_TYPE);
            self.add(node.child_of(parent + FINAL_RESULT_DATA, "HasComponent", Rule::Mandatory));
        }
    }

    fn variable(&mut self, variable: &TableVariable, parent: u32, ids: Ids, access: &str) {
        let browse_name = format!("1:{}", variable.name);
        let mut node = Node::new("UAVariable", ids.node, &browse_name)
            .about(variable.about)
            .attribute("DataType", variable.shape.builtin.name());
        if variable.shape.array {
            node = node.attribute("ValueRank", "1");
        }
        if let Some(length) = variable.length {
            node = node.attribute("ArrayDimensions", &length.to_string());
        }
        node = node
            .attribute("AccessLevel", access)
            .attribute("UserAccessLevel", access);
        let definition = match (variable.unit, variable.range) {
            (None, None) => BASE_DATA_VARIABLE_TYPE,
            (Some(_), None) => ANALOG_UNIT_TYPE,
            (None, Some(_)) => ANALOG_ITEM_TYPE,
            (Some(_), Some(_)) => ANALOG_UNIT_RANGE_TYPE,
        };
        node = node.forward("HasTypeDefinition", definition).child_of(
            parent,
            "HasComponent",
            Rule::Mandatory,
        );
        node.value = variable.default_value().map(|value| xml_value(&value));
        self.add(node);
        if let Some(unit) = variable.unit {
            let mut property = Node::new("UAVariable", ids.properties, "EngineeringUnits")
                .attribute("DataType", "i=887");
            property = property
                .forward("HasTypeDefinition", PROPERTY_TYPE)
                .child_of(ids.node, "HasProperty", Rule::Mandatory);
            property.value = Some(engineering_unit(unit));
            self.add(property);
        }
        if let Some((low, high)) = variable.range {
            let mut property = Node::new("UAVariable", ids.properties + 1, "EURange")
                .attribute("DataType", "i=884");
            property = property
                .forward("HasTypeDefinition", PROPERTY_TYPE)
                .child_of(ids.node, "HasProperty", Rule::Mandatory);
            let body = format!("<Range><Low>{low}</Low><High>{high}</High></Range>");
            property.value = Some(structure("i=885", &body));
            self.add(property);
        }
    }

    fn event_type(&mut self) {
        let browse_name = format!("1:{EVENT_TYPE}");
        let node = Node::new("UAObjectType", EVENT_TYPE_ID, &browse_name)
            .about("A transition of a skill. IntermediateResult is the text of its step.")
            .back("HasSubtype", PROGRAM_TRANSITION_EVENT_TYPE);
        self.add(node);
        let run = Node::new("UAVariable", EVENT_TYPE_ID + 1, "1:RunId")
            .about("The number of the run that it begins, goes on with or ends; 0 for none.")
            .attribute("DataType", "UInt32");
        self.add(run.forward("HasTypeDefinition", PROPERTY_TYPE).child_of(
            EVENT_TYPE_ID,
            "HasProperty",
            Rule::Mandatory,
        ));
    }

    fn controller_type(&mut self) {
        let browse_name = format!("1:{CONTROLLER_TYPE}");
        let node = Node::new("UAObjectType", CONTROLLER_TYPE_ID, &browse_name)
            .about("What a component has that has skills.")
            .attribute("IsAbstract", "true")
            .back("HasSubtype", BASE_INTERFACE_TYPE);
        self.add(node);
        let skills = Node::new("UAObject", CONTROLLER_TYPE_ID + 1, "1:Skills")
            .about("Its skills, as components.")
            .forward("HasTypeDefinition", FOLDER_TYPE);
        self.add(skills.child_of(CONTROLLER_TYPE_ID, "HasComponent", Rule::Mandatory));
        let number = Node::new("UAVariable", CONTROLLER_TYPE_ID + 2, "1:NamespaceNumber")
            .about("Its number in the space of the cell, which is the WriterGroupId of its values.")
            .attribute("DataType", "UInt16");
        let number = number.forward("HasTypeDefinition", PROPERTY_TYPE);
        self.add(number.child_of(CONTROLLER_TYPE_ID, "HasProperty", Rule::Mandatory));
        let holder = Node::new("UAVariable", CONTROLLER_TYPE_ID + 3, "1:LeaseHolder")
            .about("Who alone may start its skills now; nothing where anybody may.")
            .attribute("DataType", "String");
        let holder = holder.forward("HasTypeDefinition", BASE_DATA_VARIABLE_TYPE);
        self.add(holder.child_of(CONTROLLER_TYPE_ID, "HasComponent", Rule::Mandatory));
    }
}

impl Nodes {
    /// Adds the reference type and the object type for composites.
    fn used_skills(&mut self) {
        let browse_name = format!("1:{USES_SKILL}");
        let node = Node::new("UAReferenceType", USES_SKILL_ID, &browse_name)
            .about("Leads from a skill to one of another component that its work is done with.")
            .back("HasSubtype", NON_HIERARCHICAL_REFERENCES);
        self.add(node);
        let browse_name = format!("1:{USED_SKILL_TYPE}");
        let node = Node::new("UAObjectType", USED_SKILL_TYPE_ID, &browse_name)
            .about("A skill of another component, which is where that is.")
            .back("HasSubtype", BASE_OBJECT_TYPE);
        self.add(node);
        let members = [
            (
                "1:Component",
                "The endpoint or ApplicationUri of the component it is of.",
            ),
            ("1:Type", "The type that it is of, or of a subtype of it."),
        ];
        for (id, (browse_name, about)) in (USED_SKILL_TYPE_ID + 1..).zip(members) {
            let member = Node::new("UAVariable", id, browse_name)
                .about(about)
                .attribute("DataType", "String")
                .forward("HasTypeDefinition", PROPERTY_TYPE);
            self.add(member.child_of(USED_SKILL_TYPE_ID, "HasProperty", Rule::Mandatory));
        }
    }
}

/// The identifiers of a variable and of the first of its properties.
struct Ids {
    node: u32,
    properties: u32,
}

fn xml_value(value: &SkillValue) -> String {
    let one = |value: &SkillValue, attributes: &str| {
        let name = value.shape().builtin.name();
        let text = value.as_str().map_or_else(|| value.to_string(), escaped);
        format!("<{name}{attributes}>{text}</{name}>")
    };
    let SkillValue::Array(builtin, elements) = value else {
        return one(value, TYPES_NAMESPACE);
    };
    let name = builtin.name();
    let elements: String = elements.iter().map(|element| one(element, "")).collect();
    format!("<ListOf{name}{TYPES_NAMESPACE}>{elements}</ListOf{name}>")
}

fn engineering_unit(unit: &TableUnit) -> String {
    let TableUnit { symbol, name, id } = unit;
    let body = format!(
        "<EUInformation><NamespaceUri>http://www.opcfoundation.org/UA/units/un/cefact</NamespaceUri><UnitId>{id}</UnitId>\
         <DisplayName><Text>{symbol}</Text></DisplayName><Description><Text>{name}</Text></Description></EUInformation>"
    );
    structure("i=888", &body)
}

fn structure(encoding: &str, body: &str) -> String {
    format!(
        "<ExtensionObject{TYPES_NAMESPACE}><TypeId><Identifier>{encoding}</Identifier></TypeId><Body>{body}</Body></ExtensionObject>"
    )
}

fn escaped(text: &str) -> String {
    text.replace('&', "&amp;")
        .replace('<', "&lt;")
        .replace('>', "&gt;")
}

/// An optional property of a type.
struct OptionalProperty {
    /// The type.
    of: &'static str,
    offset: u32,
    name: &'static str,
    builtin: Builtin,
    /// The number of elements of an array; 0 for any.
    length: Option<u32>,
    about: &'static str,
}

const OPTIONAL: [OptionalProperty; 9] = [
    OptionalProperty {
        of: "GraspSkillType",
        offset: 94,
        name: GRIP_POINT_OFFSET,
        builtin: Builtin::Double,
        length: Some(6),
        about: "The grip point in the frame of the tool plate: x, y, z in m and the rotations about them in rad. Its z axis points towards the part.",
    },
    OptionalProperty {
        of: "GraspSkillType",
        offset: 95,
        name: GRIP_POINT_TYPE,
        builtin: Builtin::Int32,
        length: None,
        about: "0: two fingers that close along the x axis of the grip point; 1: vacuum; 2: several fingers.",
    },
    OptionalProperty {
        of: "GraspSkillType",
        offset: 96,
        name: GRIP_POINT_OPENING,
        builtin: Builtin::Double,
        length: Some(2),
        about: "The smallest and the largest width that fits between the fingers, m.",
    },
    OptionalProperty {
        of: "ToolSkillType",
        offset: 94,
        name: TOOL_PLATE_OFFSET,
        builtin: Builtin::Double,
        length: Some(6),
        about: "The tool plate in the frame of the flange: x, y, z in m and the rotations about them in rad.",
    },
    OptionalProperty {
        of: "ToolSkillType",
        offset: 95,
        name: CURRENT_TOOL,
        builtin: Builtin::String,
        length: None,
        about: "The ApplicationUri of the attached tool; empty for none, and bad while it is unknown.",
    },
    OptionalProperty {
        of: "ToolSkillType",
        offset: 96,
        name: MOVER_ENDPOINT,
        builtin: Builtin::String,
        length: None,
        about: "The endpoint of the robot that carries the changer; empty until it is found.",
    },
    OptionalProperty {
        of: "MotionSkillType",
        offset: 94,
        name: REACH,
        builtin: Builtin::Double,
        length: None,
        about: "The largest distance of a target from the base of the robot, m.",
    },
    OptionalProperty {
        of: "MotionSkillType",
        offset: 95,
        name: ZONE_NAMES,
        builtin: Builtin::String,
        length: Some(0),
        about: "The zones of the robot. Targets outside of all zones are refused.",
    },
    OptionalProperty {
        of: "MotionSkillType",
        offset: 96,
        name: ZONE_BOUNDS,
        builtin: Builtin::Double,
        length: Some(0),
        about: "Six numbers for each zone: the smallest x, y, z and the largest x, y, z in the frame of the base, m.",
    },
];

/// Offset, BrowseName, type, whether it is an array, whether it is a property, and the description.
const MEMBERS: [(u32, &str, Builtin, bool, bool, &str); 6] = [
    (
        20,
        "1:Name",
        Builtin::String,
        false,
        true,
        "What its component calls it.",
    ),
    (
        21,
        "1:Capabilities",
        Builtin::String,
        true,
        true,
        "The IRIs of the capabilities that it provides.",
    ),
    (
        22,
        "1:RunId",
        Builtin::UInt32,
        false,
        false,
        "The number of the newest run; 0 before the first one.",
    ),
    (
        23,
        "1:Progress",
        Builtin::Float,
        false,
        false,
        "How much of the run is done, from 0 to 1.",
    ),
    (
        24,
        "1:SkillStep",
        Builtin::String,
        false,
        false,
        "What the run is about now.",
    ),
    (
        26,
        "1:UsesSkills",
        Builtin::String,
        true,
        true,
        "The skills of other components that its work is done with, each as its endpoint and type.",
    ),
];

const METHODS: [ProgramMethod; 5] = [
    ProgramMethod::Start,
    ProgramMethod::Halt,
    ProgramMethod::Suspend,
    ProgramMethod::Resume,
    ProgramMethod::Reset,
];

const PARAMETER_SET: u32 = 1;
const FINAL_RESULT_DATA: u32 = 2;
const FIRST_METHOD: u32 = 5;
const PARAMETERS: u32 = 10;
const RESULTS: u32 = 40;
const PARAMETER_PROPERTIES: u32 = 50;
const RESULT_PROPERTIES: u32 = 80;
const EVENT_TYPE_ID: u32 = 2000;
const CONTROLLER_TYPE_ID: u32 = 2100;

const USES_SKILL_ID: u32 = 9000;
const USED_SKILL_TYPE_ID: u32 = 9001;

const BASE_OBJECT_TYPE: &str = "i=58";
const NON_HIERARCHICAL_REFERENCES: &str = "i=32";
const PROGRAM_STATE_MACHINE_TYPE: &str = "i=2391";
const PROGRAM_TRANSITION_EVENT_TYPE: &str = "i=2378";
const BASE_INTERFACE_TYPE: &str = "i=17602";
const FOLDER_TYPE: &str = "i=61";
const PROPERTY_TYPE: &str = "i=68";
const BASE_DATA_VARIABLE_TYPE: &str = "i=63";
const ANALOG_ITEM_TYPE: &str = "i=2368";
const ANALOG_UNIT_TYPE: &str = "i=17497";
const ANALOG_UNIT_RANGE_TYPE: &str = "i=17570";
const TYPES_NAMESPACE: &str = " xmlns=\"http://opcfoundation.org/UA/2008/02/Types.xsd\"";

#[cfg(test)]
mod tests;
